// Limits the commanded pulses. All pulses are in steps of 0.5 us.
#pragma once

#include <stdint.h>

#include "protocol.h"

// Whether the limits are valid pulses, in order, and allow the pulses to change.
bool limits_fit(const protocol::Limits& limits);

// Clamped to the limits on command, slew-rate limited at each 20 ms servo frame. Towards neutral the motor has no slew
// limit, so that a stop is never delayed.
class Pulses {
 public:
  explicit Pulses(const protocol::Limits& limits);

  // Whether the limits are valid; without, the pulses are 0: there are none.
  bool limited() const { return limits_fit(limits_); }

  // Whether the motor's pulse is not neutral.
  bool drives() const { return motor_us_ != static_cast<int16_t>(limits_.motor_neutral_us); }

  // Sets the pulses from the next servo frame on.
  void set_target(uint16_t servo_us, uint16_t motor_us);

  // Neutral from the next servo frame on, without slewing; the steering goes on to its target, and is straight
  // `kRollOutMs` later, or when the car stands. A car that is rolling out already is given no more time.
  void roll_out(uint32_t t_ms);

  // Each millisecond: ends the roll-out.
  void tick(uint32_t t_ms);

  // The car stands: ends the roll-out.
  void stand();

  // Straight and neutral, without slewing.
  void straighten();

  // Starts a servo frame: `servo_us` and `motor_us` are its pulses.
  void frame();

  uint16_t servo_us() const { return static_cast<uint16_t>(servo_us_); }
  uint16_t motor_us() const { return static_cast<uint16_t>(motor_us_); }

 private:
  protocol::Limits limits_;
  int16_t servo_us_, motor_us_;
  int16_t servo_target_us_, motor_target_us_;
  uint32_t rolling_since_ms_ = 0;
  bool rolling_ = false;
};
