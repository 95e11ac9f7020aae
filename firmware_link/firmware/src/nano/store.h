// What is kept over restarts, in the EEPROM.
#pragma once

#include <stdint.h>

namespace store {

// The boot id of this start, which is another one after every start. Writes it, which takes 14 ms: for the start only.
uint16_t begin();

// The payload of the limits in force.
const uint8_t* limits();

// Keeps other limits from now on; `tick` writes them.
void keep_limits(const uint8_t* payload);

// Each millisecond: writes one byte that differs, when the last is written (3.4 ms).
void tick();

}  // namespace store
