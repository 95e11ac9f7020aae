#include "frame.h"

#include "crc16.h"
#include "crc32.h"
#include "protocol.h"

namespace frame {
namespace {

constexpr uint8_t kHeader = 2;  // type, counter
constexpr uint8_t kNotCobs = 0xFF;
constexpr uint8_t kOldCheckBytes = 3;

// COBS of fewer than 254 bytes; one byte longer than `raw`.
uint8_t stuff(const uint8_t* raw, uint8_t count, uint8_t* out) {
  uint8_t code_at = 0;
  uint8_t at = 1;
  for (uint8_t i = 0; i < count; ++i) {
    if (raw[i] == 0) {
      out[code_at] = at - code_at;
      code_at = at;
    } else {
      out[at] = raw[i];
    }
    ++at;
  }
  out[code_at] = at - code_at;
  return at;
}

// The inverse of `stuff` in place (reading is always ahead of writing); the length, or kNotCobs.
uint8_t unstuff(uint8_t* bytes, uint8_t count) {
  uint8_t from = 0;
  uint8_t to = 0;
  while (from < count) {
    const uint8_t code = bytes[from];
    if (code > count - from) return kNotCobs;  // there are no zeros here, so code is never 0
    for (uint8_t i = 1; i < code; ++i) bytes[to++] = bytes[from + i];
    from += code;
    if (from < count) bytes[to++] = 0;
  }
  return to;
}

// The check of `count` stuffed bytes.
void check(const uint8_t* stuffed, uint8_t count, uint8_t* out) {
  uint32_t crc = crc32(stuffed, count, protocol::kTableHash);
  for (uint8_t i = 0; i < kCheckBytes; ++i) {
    out[i] = 0x80 | (crc & 0x7F);
    crc >>= 7;
  }
}

// The check of a Hello, the same in every version of the protocol: the first byte comes last.
void old_check(const uint8_t* stuffed, uint8_t count, uint8_t* out) {
  const uint16_t others = crc16_dnp(stuffed + 1, count - 1, 0) ^ 0xFFFF;  // without the final inversion
  const uint16_t crc = crc16_dnp(stuffed, 1, others);
  out[0] = 0x40 | (crc & 0x3F);
  out[1] = 0x40 | (crc >> 6 & 0x3F);
  out[2] = 0x40 | crc >> 12;
}

}  // namespace

uint8_t encode(uint8_t type, uint8_t counter, const uint8_t* payload, uint8_t count, uint8_t* out) {
  uint8_t body[kMaxBody];
  body[0] = type;
  body[1] = counter;
  for (uint8_t i = 0; i < count; ++i) body[kHeader + i] = payload[i];
  uint8_t* const stuffed = out + 1;
  const uint8_t length = stuff(body, kHeader + count, stuffed);
  const bool is_hello = type == protocol::Hello::kType;
  (is_hello ? old_check : check)(stuffed, length, stuffed + length);
  const uint8_t wire = length + (is_hello ? kOldCheckBytes : kCheckBytes) + 2;
  out[0] = out[wire - 1] = 0;
  return wire;
}

bool Decoder::push(uint8_t byte) {
  if (byte != 0) {
    if (count_ < kMaxChunk) bytes_[count_] = byte;
    if (count_ <= kMaxChunk) ++count_;
    return false;
  }
  if (count_ == 0) return false;  // the zeros of two adjacent frames
  const bool is_good = good();
  count_ = 0;
  error_ |= !is_good;
  return is_good;
}

bool Decoder::take_error() {
  const bool error = error_;
  error_ = false;
  return error;
}

bool Decoder::good() {
  if (count_ > kMaxChunk || count_ <= kCheckBytes) return false;
  const uint8_t stuffed = count_ - kCheckBytes;
  uint8_t right[kCheckBytes];
  check(bytes_, stuffed, right);
  for (uint8_t i = 0; i < kCheckBytes; ++i) {
    if (bytes_[stuffed + i] != right[i]) return false;
  }
  const uint8_t count = unstuff(bytes_, stuffed);
  if (count == kNotCobs || count < kHeader) return false;
  const uint8_t payload_bytes = protocol::payload_bytes(bytes_[0]);
  return payload_bytes != protocol::kUnknownType && count == payload_bytes + kHeader;
}

}  // namespace frame
