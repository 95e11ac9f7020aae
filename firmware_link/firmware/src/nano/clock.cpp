#include "clock.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <util/atomic.h>

namespace {

constexpr uint8_t kCountsPerMs = 250;  // 16 MHz / 64

volatile uint32_t milliseconds = 0;

}  // namespace

ISR(TIMER2_COMPA_vect) {
  milliseconds = milliseconds + 1;
}

namespace clock {

void begin() {
  TCCR2B = 0;
  OCR2A = kCountsPerMs - 1;
  TCCR2A = 1 << WGM21;  // count to OCR2A
  TIMSK2 = 1 << OCIE2A;
  TCNT2 = 0;
  TCCR2B = 1 << CS22;  // by 64
}

uint32_t ms() {
  uint32_t now;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    now = milliseconds;
  }
  return now;
}

uint32_t wait_beyond(uint32_t t_ms) {
  set_sleep_mode(SLEEP_MODE_IDLE);
  for (;;) {
    cli();
    if (milliseconds != t_ms) break;
    sleep_enable();
    sei();  // takes effect after the next instruction: no interrupt can come between it and the sleep
    sleep_cpu();
    sleep_disable();
  }
  sei();
  return ms();
}

uint16_t stamp() {
  uint8_t count = TCNT2;
  uint16_t now = static_cast<uint16_t>(milliseconds);
  if (TIFR2 & 1 << OCF2A) {  // a millisecond has passed, and its interrupt is pending
    count = TCNT2;
    ++now;
  }
  return now * kCountsPerMs + count;
}

}  // namespace clock
