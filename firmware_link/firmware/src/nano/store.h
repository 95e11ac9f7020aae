// The values that are kept over restarts in the EEPROM.
#pragma once

#include <stdint.h>

namespace store {

// The boot id of this start, new for every start. Writes it, which takes 14 ms: only to be called at the start.
uint16_t begin();

// The payload of the limits in force.
const uint8_t* limits();

// Stores new limits; `tick` writes them.
void keep_limits(const uint8_t* payload);

// Each millisecond: writes one byte that differs, if the last one is written (3.4 ms).
void tick();

}  // namespace store
