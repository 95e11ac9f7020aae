#include "pulses.h"

namespace {

constexpr uint8_t kStepsPerSlew = 8;  // 4 us over 0.5 us

bool in_order(uint16_t low, uint16_t middle, uint16_t high) {
  return protocol::kPulseMin <= low && low <= middle && middle <= high && high <= protocol::kPulseMax;
}

int16_t clamped(int16_t value, int16_t low, int16_t high) {
  if (value < low) return low;
  return value > high ? high : value;
}

}  // namespace

bool limits_fit(const protocol::Limits& limits) {
  return in_order(limits.servo_min_us, limits.servo_straight_us, limits.servo_max_us) &&
         in_order(limits.motor_min_us, limits.motor_neutral_us, limits.motor_max_us) && limits.servo_slew_us > 0 &&
         limits.motor_slew_us > 0;
}

Pulses::Pulses(const protocol::Limits& limits) : limits_(limits) {
  straighten();
}

void Pulses::set_target(uint16_t servo_us, uint16_t motor_us) {
  rolling_ = false;
  servo_target_us_ = clamped(servo_us, limits_.servo_min_us, limits_.servo_max_us);
  motor_target_us_ = clamped(motor_us, limits_.motor_min_us, limits_.motor_max_us);
}

void Pulses::roll_out(uint32_t t_ms) {
  motor_us_ = motor_target_us_ = limits_.motor_neutral_us;
  if (rolling_) return;
  rolling_ = true;
  rolling_since_ms_ = t_ms;
}

void Pulses::tick(uint32_t t_ms) {
  if (rolling_ && t_ms - rolling_since_ms_ >= protocol::kRollOutMs) straighten();
}

void Pulses::stand() {
  if (rolling_) straighten();
}

void Pulses::straighten() {
  rolling_ = false;
  servo_us_ = servo_target_us_ = limits_.servo_straight_us;
  motor_us_ = motor_target_us_ = limits_.motor_neutral_us;
}

void Pulses::frame() {
  const int16_t slew = limits_.servo_slew_us * kStepsPerSlew;
  servo_us_ = clamped(servo_target_us_, servo_us_ - slew, servo_us_ + slew);
  const int16_t neutral = limits_.motor_neutral_us;
  const int16_t now = motor_us_ - neutral;
  const int16_t target = motor_target_us_ - neutral;
  int16_t reach = limits_.motor_slew_us * kStepsPerSlew;
  if (now > 0 && target > 0) reach += now;
  if (now < 0 && target < 0) reach -= now;
  motor_us_ = neutral + clamped(target, -reach, reach);
}
