// An MPU-6050's yaw rate. None fitted is normal; one that was there and stops answering is a fault.
#pragma once

#include <stdint.h>

#include "protocol.h"
#include "twi_transfer.h"

class Gyro {
 public:
  // Each millisecond, while the bus's interrupt is held back.
  TwiAction tick(uint32_t t_ms);

  // From the bus's interrupt.
  TwiAction on_status(uint8_t status, uint8_t received) { return transfer_.on_status(status, received); }

  // Anticlockwise positive, as on the wire; protocol::Odometry::kNoYawRateRadps without a gyro.
  int16_t yaw_rate() const { return yaw_rate_; }

  // Whether a gyro that was there gives no yaw rate.
  bool failed() const { return fitted_ && yaw_rate_ == protocol::Odometry::kNoYawRateRadps; }

 private:
  TwiAction begin_transfer();
  TwiAction fail(uint32_t t_ms);
  bool taken();

  TwiTransfer transfer_;
  int16_t yaw_rate_ = protocol::Odometry::kNoYawRateRadps;
  uint32_t since_ms_ = 0;  // when what is going on began
  uint16_t pause_ms_ = 0;  // before the next transfer
  uint8_t step_ = 0;  // of setting it up; then: reading
  uint8_t reads_ = 0;  // since it was last asked whether it is still set up
  uint8_t half_clocks_ = 0;  // left, to make a device let go of the data wire
  bool fitted_ = false;
};
