// The yaw rate of an MPU-6050. A missing gyro is normal; one that stops answering is a fault.
#pragma once

#include <stdint.h>

#include "protocol.h"
#include "twi_transfer.h"

class Gyro {
 public:
  // Each millisecond, with the bus's interrupt disabled.
  TwiAction tick(uint32_t t_ms);

  // From the bus's interrupt.
  TwiAction on_status(uint8_t status, uint8_t received) { return transfer_.on_status(status, received); }

  // Anticlockwise positive, as on the wire; protocol::Odometry::kNoYawRateRadps without a gyro.
  int16_t yaw_rate() const { return yaw_rate_; }

  // Whether a gyro that worked gives no yaw rate.
  bool failed() const { return fitted_ && yaw_rate_ == protocol::Odometry::kNoYawRateRadps; }

 private:
  TwiAction begin_transfer();
  TwiAction fail(uint32_t t_ms);
  bool taken();

  TwiTransfer transfer_;
  int16_t yaw_rate_ = protocol::Odometry::kNoYawRateRadps;
  uint32_t since_ms_ = 0;  // start of the current action
  uint16_t pause_ms_ = 0;  // before the next transfer
  uint8_t step_ = 0;  // of the set-up; then: reading
  uint8_t reads_ = 0;  // since its set-up was last checked
  uint8_t half_clocks_ = 0;  // left, to make a device release the data wire
  bool fitted_ = false;
};
