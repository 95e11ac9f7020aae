// The limits and boot ids in the EEPROM, and the checks of their integrity.
#pragma once

#include <stdint.h>

#include "protocol.h"

namespace kept {

// The limits' payload and its CRC, which starts from the table's hash: limits of another table are invalid.
constexpr uint8_t kLimitsBytes = protocol::Limits::kBytes + 2;
void limits_record(const uint8_t* payload, uint8_t* record);

// Zeros, which are no valid limits and stand for none: the pulses are 0, that is, there are none.
constexpr uint8_t kNoLimits[protocol::Limits::kBytes] = {};

// The payload in a record; kNoLimits if it is damaged or invalid.
const uint8_t* limits_of(const uint8_t* record);

// Boot ids rotate through slots, so that each cell is written only every eighth start. A slot is the id and its
// complement: one that was interrupted by a power loss is invalid.
constexpr uint8_t kSlots = 8;
constexpr uint8_t kSlotBytes = 4;

// The boot id of this start from all slots.
uint16_t next_boot_id(const uint8_t* slots);

// The address and the contents of the slot of this boot id.
inline uint8_t slot_of(uint16_t boot_id) {
  return boot_id % kSlots;
}
void slot_record(uint16_t boot_id, uint8_t* record);

}  // namespace kept
