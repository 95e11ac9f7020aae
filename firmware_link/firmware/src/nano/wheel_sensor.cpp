#include "wheel_sensor.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "../logic/wheel.h"

namespace {

volatile int32_t count = 0;

}  // namespace

ISR(INT0_vect) {
  count = count + wheel_tick(PIND & 1 << PD3);
}

namespace wheel_sensor {

void begin() {
  PORTD |= 1 << PD2 | 1 << PD3;  // pull-ups: most sensors only pull down
  EICRA = 1 << ISC01 | 1 << ISC00;  // rising edges of D2
  EIFR = 1 << INTF0;  // the pull-up's own edge
  EIMSK = 1 << INT0;
}

int32_t ticks() {
  int32_t now;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    now = count;
  }
  return now;
}

}  // namespace wheel_sensor
