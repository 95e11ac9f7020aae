// What is kept over restarts in the EEPROM, and how it is known to be whole: limits and boot ids.
#pragma once

#include <stdint.h>

#include "protocol.h"

namespace kept {

// The limits' payload and its CRC, which starts from the table's hash: limits of another table are none.
constexpr uint8_t kLimitsBytes = protocol::Limits::kBytes + 2;
void limits_record(const uint8_t* payload, uint8_t* record);

// The payload in a record; kDefaultLimits where it is not whole or does not fit.
const uint8_t* limits_of(const uint8_t* record);

// Boot ids go round in slots, so that each cell is written every eighth start only. A slot is the id and its
// complement: one that was cut short by a power loss is none.
constexpr uint8_t kSlots = 8;
constexpr uint8_t kSlotBytes = 4;

// The boot id of this start from all slots.
uint16_t next_boot_id(const uint8_t* slots);

// Where this boot id is to be kept, and what is to be written there.
inline uint8_t slot_of(uint16_t boot_id) {
  return boot_id % kSlots;
}
void slot_record(uint16_t boot_id, uint8_t* record);

}  // namespace kept
