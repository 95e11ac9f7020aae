// The battery's voltage from readings of the converter.
#pragma once

#include <stdint.h>

// Smoothed over 16 readings, one per millisecond: the motor's current causes voltage jumps.
class Battery {
 public:
  // `full_scale_mv` is the battery voltage for a reading of 1024.
  explicit Battery(uint16_t full_scale_mv) : full_scale_mv_(full_scale_mv) {}

  // Adds a 10-bit reading.
  void take(uint16_t reading) {
    sum_ = started_ ? sum_ - sum_ / kReadings + reading : reading * kReadings;
    started_ = true;
  }

  // [0.001 V]; 0 before the first reading.
  uint16_t millivolts() const {
    return static_cast<uint16_t>(static_cast<uint32_t>(sum_) * full_scale_mv_ / (1024UL * kReadings));
  }

 private:
  static constexpr uint8_t kReadings = 16;

  uint16_t full_scale_mv_;
  uint16_t sum_ = 0;
  bool started_ = false;
};
