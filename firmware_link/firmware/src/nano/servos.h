// Steering servo on D9 (OC1A) and motor controller on D10 (OC1B): timer 1 generates 50 pulses a second in hardware, in
// steps of 0.5 us. New widths take effect with the next pulse, never within one.
#pragma once

#include <stdint.h>

namespace servos {

// Starts the periods of 20 ms, with both pins low. The first one starts half a millisecond after the call: the main
// loop, which runs at whole milliseconds, has set the pulses by then.
void begin();

// The widths from the next period on [0.5 us]; 0 before the first ones leaves the pins low.
void set(uint16_t steering, uint16_t motor);

}  // namespace servos
