// Three HC-SR04 in turn: their triggers and the ranges from their echoes.
#pragma once

#include <stdint.h>

constexpr uint8_t kSensors = 3;

// A slot for each sensor: in 30 ms sound travels 5.1 m, so that the echo of the previous sensor is over. No echo means
// no range: `ranges()` never reports free space, only the distance of the nearest echo.
class Ranging {
 public:
  static constexpr uint8_t kSlotMs = 30;

  Ranging();

  // Each millisecond, with the echo pins' levels as bits; the trigger pins' levels as bits.
  uint8_t tick(uint32_t t_ms, uint8_t echo_pins);

  // The echo pin of `sensor` has changed at `at` [4 us, modulo 2^16].
  void edge(uint8_t sensor, bool high, uint16_t at);

  // [0.001 m], protocol::Ranges::kNoLeftM without an echo.
  uint16_t range(uint8_t sensor) const { return ranges_[sensor]; }

 private:
  enum State : uint8_t { kIdle, kTriggered, kEcho, kDone };

  void finish();

  uint16_t ranges_[kSensors];
  uint32_t slot_ms_ = 0;  // start of the slot
  uint16_t rise_ = 0;
  uint16_t width_ = 0;
  uint8_t sensor_ = kSensors - 1;
  State state_ = kIdle;
  bool started_ = false;
};
