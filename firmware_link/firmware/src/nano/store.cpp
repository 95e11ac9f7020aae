#include "store.h"

#include <avr/eeprom.h>

#include "../logic/kept.h"

namespace {

uint8_t* const kSlotsAt = reinterpret_cast<uint8_t*>(0);
uint8_t* const kLimitsAt = reinterpret_cast<uint8_t*>(kept::kSlots * kept::kSlotBytes);

uint8_t record[kept::kLimitsBytes];
uint8_t written = kept::kLimitsBytes;  // of the record

}  // namespace

namespace store {

uint16_t begin() {
  uint8_t slots[kept::kSlots * kept::kSlotBytes];
  eeprom_read_block(slots, kSlotsAt, sizeof(slots));
  const uint16_t boot_id = kept::next_boot_id(slots);
  uint8_t slot[kept::kSlotBytes];
  kept::slot_record(boot_id, slot);
  eeprom_update_block(slot, kSlotsAt + kept::slot_of(boot_id) * kept::kSlotBytes, sizeof(slot));
  eeprom_read_block(record, kLimitsAt, sizeof(record));
  return boot_id;
}

const uint8_t* limits() {
  return kept::limits_of(record);
}

void keep_limits(const uint8_t* payload) {
  kept::limits_record(payload, record);
  written = 0;
}

void tick() {
  while (written < kept::kLimitsBytes && eeprom_is_ready()) {
    uint8_t* const at = kLimitsAt + written;
    const uint8_t byte = record[written++];
    if (eeprom_read_byte(at) != byte) {
      eeprom_write_byte(at, byte);
      return;
    }
  }
}

}  // namespace store
