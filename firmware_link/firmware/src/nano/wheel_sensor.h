// Wheel ticks: channel A on D2, which interrupts, channel B on D3.
#pragma once

#include <stdint.h>

namespace wheel_sensor {

void begin();

// Since the start, decreasing in reverse.
int32_t ticks();

}  // namespace wheel_sensor
