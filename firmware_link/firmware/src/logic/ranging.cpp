#include "ranging.h"

#include "protocol.h"

namespace {

constexpr uint16_t kMaxWidth = 5831;  // 4 m there and back at 343 m/s, in 4 us
constexpr uint16_t kMinRange = 20;  // shorter ranges read as 0.02 m

uint16_t millimetres(uint16_t width) {
  const uint32_t range = width * 686UL / 1000;  // 0.686 mm in 4 us, there and back
  return range < kMinRange ? kMinRange : static_cast<uint16_t>(range);
}

}  // namespace

Ranging::Ranging() {
  for (uint8_t i = 0; i < kSensors; ++i) ranges_[i] = protocol::Ranges::kNoLeftM;
}

uint8_t Ranging::tick(uint32_t t_ms, uint8_t echo_pins) {
  if (started_ && t_ms - slot_ms_ < kSlotMs) return 0;
  if (started_) finish();
  started_ = true;
  slot_ms_ = t_ms;
  sensor_ = sensor_ + 1 == kSensors ? 0 : sensor_ + 1;
  const uint8_t bit = static_cast<uint8_t>(1 << sensor_);
  state_ = kIdle;
  if (echo_pins & bit) return 0;  // still busy, or stuck: `finish` finds nothing measured
  state_ = kTriggered;
  return bit;
}

void Ranging::edge(uint8_t sensor, bool high, uint16_t at) {
  if (sensor != sensor_) return;
  if (high && state_ == kTriggered) {
    rise_ = at;
    state_ = kEcho;
  } else if (!high && state_ == kEcho) {
    width_ = at - rise_;
    state_ = kDone;
  }
}

void Ranging::finish() {
  const bool heard = state_ == kDone && width_ <= kMaxWidth;
  ranges_[sensor_] = heard ? millimetres(width_) : protocol::Ranges::kNoLeftM;
}
