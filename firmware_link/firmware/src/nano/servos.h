// Steering servo on D9 (OC1A) and motor controller on D10 (OC1B): timer 1 makes 50 pulses a second by itself, in steps
// of 0.5 us. New widths take hold with the next pulse, never within one.
#pragma once

#include <stdint.h>

namespace servos {

// Begins with these pulses [0.5 us]. The first begins half a millisecond after the call, the others each 20 ms after
// it: the main loop, which begins its turns at whole milliseconds, has set them by then.
void begin(uint16_t steering, uint16_t motor);

// The widths from the next pulse on [0.5 us].
void set(uint16_t steering, uint16_t motor);

}  // namespace servos
