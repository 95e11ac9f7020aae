#include "servos.h"

#include <avr/io.h>

namespace {

constexpr uint16_t kPeriod = 40000;  // 20 ms at 2 MHz
constexpr uint16_t kFirstPulse = 1000;  // 0.5 ms
constexpr uint8_t kMode = 1 << WGM11;  // with TCCR1B's, mode 14: high from 0 to the match, up to ICR1
constexpr uint8_t kToPins = 1 << COM1A1 | 1 << COM1B1;

}  // namespace

namespace servos {

void begin() {
  TCCR1B = 0;  // a bootloader may have used the timer
  TCCR1A = kMode;
  TCCR1B = 1 << WGM13 | 1 << WGM12;
  ICR1 = kPeriod - 1;  // can be written in this mode only
  TCCR1B |= 1 << CS11;  // by 8: it runs
  TCNT1 = kPeriod - kFirstPulse;
  PORTB &= ~(1 << PORTB1 | 1 << PORTB2);
  DDRB |= 1 << DDB1 | 1 << DDB2;
}

void set(uint16_t steering, uint16_t motor) {
  if (steering == 0 || motor == 0) return;
  OCR1A = steering - 1;  // the pin falls at the end of the count that matches
  OCR1B = motor - 1;
  TCCR1A = kMode | kToPins;  // the pins stay low until the period that has begun is over
}

}  // namespace servos
