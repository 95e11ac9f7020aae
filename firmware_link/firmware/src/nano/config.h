// What differs from car to car. The wiring table is in ../../README.md.
#pragma once

#include <stdint.h>

// The serial line; as `[link] baud` in car.toml.
#ifndef BAUD
#define BAUD 115200
#endif

namespace config {

// The voltage at the battery that makes 1.1 V at A6: with 100 kOhm above and 10 kOhm below, eleven times that.
// Compare `battery_v` with a meter and correct it: the chip's 1.1 V are within 10 % only.
constexpr uint16_t kBatteryFullScaleMv = 12100;

}  // namespace config
