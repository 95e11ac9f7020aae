#include "kept.h"

#include "crc16.h"
#include "pulses.h"
#include "wire.h"

namespace kept {
namespace {

constexpr uint16_t kAllOnes = 0xFFFF;

bool slot_holds(const uint8_t* slots, uint16_t boot_id) {
  const uint8_t* slot = slots + slot_of(boot_id) * kSlotBytes;
  return wire::get16(slot) == boot_id && (wire::get16(slot + 2) ^ kAllOnes) == boot_id;
}

uint16_t crc(const uint8_t* payload) {
  return crc16_dnp(payload, protocol::Limits::kBytes, protocol::kTableHash);
}

}  // namespace

void limits_record(const uint8_t* payload, uint8_t* record) {
  for (uint8_t i = 0; i < protocol::Limits::kBytes; ++i) record[i] = payload[i];
  wire::put16(record + protocol::Limits::kBytes, crc(payload));
}

const uint8_t* limits_of(const uint8_t* record) {
  const bool whole = wire::get16(record + protocol::Limits::kBytes) == crc(record);
  return whole && limits_fit(protocol::Limits::read(record)) ? record : kNoLimits;
}

uint16_t next_boot_id(const uint8_t* slots) {
  for (uint8_t i = 0; i < kSlots; ++i) {
    const uint16_t boot_id = wire::get16(slots + i * kSlotBytes);
    if (slot_of(boot_id) == i && slot_holds(slots, boot_id) && !slot_holds(slots, boot_id + 1)) return boot_id + 1;
  }
  return 1;  // the very first start
}

void slot_record(uint16_t boot_id, uint8_t* record) {
  wire::put16(record, boot_id);
  wire::put16(record + 2, boot_id ^ kAllOnes);
}

}  // namespace kept
