// The serial line to the host, by interrupt, through rings of 64 bytes in and 128 out.
#pragma once

#include <stdint.h>

namespace uart {

void begin();
bool receive(uint8_t& byte);

// Whether a byte was lost since the last call, in the ring or in the hardware.
bool take_overflow();

uint8_t transmit_room();
void transmit(const uint8_t* bytes, uint8_t count);

}  // namespace uart
