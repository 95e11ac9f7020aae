// The cause of the board's start.
#pragma once

#include <stdint.h>

// protocol::reset_cause from the flags of MCUSR and, where a bootloader has cleared them, what it left in r2
// (Optiboot).
uint8_t reset_cause_of(uint8_t mcusr, uint8_t from_bootloader);
