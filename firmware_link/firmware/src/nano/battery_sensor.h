// The battery's voltage at A6, through a divider, against the chip's 1.1 V.
#pragma once

#include <stdint.h>

namespace battery_sensor {

void begin();

// Each millisecond: reads a finished conversion, and starts the next.
void tick();

// [0.001 V]
uint16_t millivolts();

}  // namespace battery_sensor
