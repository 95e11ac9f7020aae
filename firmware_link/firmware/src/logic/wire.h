// Little-endian numbers in a payload.
#pragma once

#include <stdint.h>

namespace wire {

inline uint8_t get8(const uint8_t* bytes) {
  return bytes[0];
}

inline uint16_t get16(const uint8_t* bytes) {
  return static_cast<uint16_t>(bytes[0] | bytes[1] << 8);
}

inline void put8(uint8_t* bytes, uint8_t value) {
  bytes[0] = value;
}

inline void put16(uint8_t* bytes, uint16_t value) {
  bytes[0] = static_cast<uint8_t>(value);
  bytes[1] = static_cast<uint8_t>(value >> 8);
}

inline void put32(uint8_t* bytes, uint32_t value) {
  put16(bytes, static_cast<uint16_t>(value));
  put16(bytes + 2, static_cast<uint16_t>(value >> 16));
}

}  // namespace wire
