// Steering servo on D9 (OC1A) and motor controller on D10 (OC1B): timer 1 generates 50 pulses a second in hardware, in
// steps of 0.5 us. New widths take effect with the next pulse, never within one.
#pragma once

#include <stdint.h>

namespace servos {

// Starts with these pulses [0.5 us]. The first one starts half a millisecond after the call, then one every 20 ms: the
// main loop, which runs at whole milliseconds, has set them by then.
void begin(uint16_t steering, uint16_t motor);

// The widths from the next pulse on [0.5 us].
void set(uint16_t steering, uint16_t motor);

}  // namespace servos
