// Wanted pulses to pulses at the pin, within the limits. All pulses are in steps of 0.5 us.
#pragma once

#include <stdint.h>

#include "protocol.h"

// Whether the limits are pulses, in order, and let the pulses move at all.
bool limits_fit(const protocol::Limits& limits);

// Clamped to the limits when wanted, slewed at each 20 ms servo frame. Towards neutral the motor is not slewed: nothing
// delays a stop.
class Pulses {
 public:
  explicit Pulses(const protocol::Limits& limits);

  // Take pulses over from the next servo frame on.
  void want(uint16_t servo_us, uint16_t motor_us);

  // Straight and neutral, without slewing.
  void straighten();

  // Begin a servo frame: `servo_us` and `motor_us` are its pulses.
  void frame();

  uint16_t servo_us() const { return static_cast<uint16_t>(servo_us_); }
  uint16_t motor_us() const { return static_cast<uint16_t>(motor_us_); }

 private:
  protocol::Limits limits_;
  int16_t servo_us_, motor_us_;
  int16_t servo_want_us_, motor_want_us_;
};
