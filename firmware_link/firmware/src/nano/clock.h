// Board time by timer 2: milliseconds since the program started, and stamps of 4 us for echoes.
#pragma once

#include <stdint.h>

namespace clock {

// Starts at 0.
void begin();

// Milliseconds, modulo 2^32.
uint32_t ms();

// Sleeps until `ms` is no longer `t_ms`; the new time.
uint32_t wait_beyond(uint32_t t_ms);

// [4 us], modulo 2^16; for use in interrupts.
uint16_t stamp();

}  // namespace clock
