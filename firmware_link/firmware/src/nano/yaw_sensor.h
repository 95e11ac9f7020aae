// An MPU-6050 on A4 (SDA) and A5 (SCL), by interrupt at 400 kHz.
#pragma once

#include <stdint.h>

namespace yaw_sensor {

void begin();

// Each millisecond.
void tick(uint32_t t_ms);

// As on the wire; protocol::Odometry::kNoYawRateRadps without one.
int16_t yaw_rate();

// Whether a gyro that worked has failed.
bool failed();

}  // namespace yaw_sensor
