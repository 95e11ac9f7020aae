// CRC-32 (ISO 3309): that of zlib and Ethernet.
#pragma once

#include <stdint.h>

// Continues from `crc`, the CRC of what came before (0: nothing).
uint32_t crc32(const uint8_t* bytes, uint8_t count, uint32_t crc);
