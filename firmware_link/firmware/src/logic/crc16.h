// CRC-16/DNP: polynomial 0x3D65 reflected, final XOR 0xFFFF.
#pragma once

#include <stdint.h>

uint16_t crc16_dnp(const uint8_t* bytes, uint8_t count, uint16_t seed = 0);
