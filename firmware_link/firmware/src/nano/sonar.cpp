#include "sonar.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "../logic/ranging.h"
#include "clock.h"

namespace {

constexpr uint8_t kEchoes = 1 << PC0 | 1 << PC1 | 1 << PC2;
constexpr uint8_t kFirstTrigger = PD4;
constexpr uint8_t kTriggers = 1 << PD4 | 1 << PD5 | 1 << PD6;

Ranging ranging;
uint8_t echoes_before = 0;

}  // namespace

ISR(PCINT1_vect) {
  const uint16_t at = clock::stamp();
  const uint8_t echoes = PINC & kEchoes;
  const uint8_t changed = echoes ^ echoes_before;
  echoes_before = echoes;
  for (uint8_t sensor = 0; sensor < kSensors; ++sensor) {
    if (changed & 1 << sensor) ranging.edge(sensor, echoes & 1 << sensor, at);
  }
}

namespace sonar {

void begin() {
  DDRD |= kTriggers;
  echoes_before = PINC & kEchoes;
  PCMSK1 = kEchoes;
  PCICR = 1 << PCIE1;
}

// A trigger stays high until the next millisecond (at least 10 us are required), so that no code has to wait.
void tick(uint32_t t_ms) {
  PORTD &= ~kTriggers;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    PORTD |= ranging.tick(t_ms, PINC & kEchoes) << kFirstTrigger;
  }
}

uint16_t range(uint8_t sensor) {
  return ranging.range(sensor);
}

}  // namespace sonar
