#include "crc32.h"

namespace {

// Half a byte at a time, as in crc16.cpp.
constexpr uint32_t kPolynomialReflected = 0xEDB88320;

constexpr uint32_t after_bits(uint32_t crc, uint8_t bits) {
  return bits == 0 ? crc : after_bits(crc >> 1 ^ (crc & 1 ? kPolynomialReflected : 0), bits - 1);
}

constexpr uint32_t kTable[16] = {after_bits(0, 4),  after_bits(1, 4),  after_bits(2, 4),  after_bits(3, 4),
                                 after_bits(4, 4),  after_bits(5, 4),  after_bits(6, 4),  after_bits(7, 4),
                                 after_bits(8, 4),  after_bits(9, 4),  after_bits(10, 4), after_bits(11, 4),
                                 after_bits(12, 4), after_bits(13, 4), after_bits(14, 4), after_bits(15, 4)};

}  // namespace

uint32_t crc32(const uint8_t* bytes, uint8_t count, uint32_t crc) {
  crc = ~crc;
  while (count--) {
    crc ^= *bytes++;
    crc = crc >> 4 ^ kTable[crc & 0xF];
    crc = crc >> 4 ^ kTable[crc & 0xF];
  }
  return ~crc;
}
