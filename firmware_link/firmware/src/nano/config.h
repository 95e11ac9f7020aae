// The constants that depend on the car. The wiring table is in ../../README.md.
#pragma once

#include <stdint.h>

// The serial line; as `[link] baud` in car.toml.
#ifndef BAUD
#define BAUD 115200
#endif

namespace config {

// The battery voltage for 1.1 V at A6: with 100 kOhm above and 10 kOhm below, eleven times 1.1 V. Compare `battery_v`
// with a meter and correct it: the chip's reference is only accurate to 10 %.
constexpr uint16_t kBatteryFullScaleMv = 12100;

}  // namespace config
