#include "servos.h"

#include <avr/io.h>

namespace {

constexpr uint16_t kPeriod = 40000;  // 20 ms at 2 MHz
constexpr uint16_t kFirstPulse = 1000;  // 0.5 ms

}  // namespace

namespace servos {

void begin(uint16_t steering, uint16_t motor) {
  TCCR1B = 0;  // a bootloader may have used the timer
  TCCR1A = 0;
  set(steering, motor);  // at once: the values are only buffered in the mode below
  TCCR1A = 1 << COM1A1 | 1 << COM1B1 | 1 << WGM11;  // mode 14: high from 0 to the match, up to ICR1
  TCCR1B = 1 << WGM13 | 1 << WGM12;
  ICR1 = kPeriod - 1;  // can be written in this mode only
  TCCR1B |= 1 << CS11;  // by 8: it runs
  TCNT1 = kPeriod - kFirstPulse;
  DDRB |= 1 << DDB1 | 1 << DDB2;
}

void set(uint16_t steering, uint16_t motor) {
  OCR1A = steering - 1;  // the pin falls at the end of the count that matches
  OCR1B = motor - 1;
}

}  // namespace servos
