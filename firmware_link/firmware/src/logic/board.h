// The board's main loop without its registers: frames in, pulses and frames out, once a millisecond.
#pragma once

#include <stdint.h>

#include "frame.h"
#include "logic.h"

// The sensor readings in the units of the wire.
struct SensorReadings {
  int32_t wheel_ticks;
  int16_t yaw_rate;  // protocol::Odometry::kNoYawRateRadps without a gyro
  uint16_t ranges[3];  // left, centre, right; protocol::Ranges::kNoLeftM without an echo
  uint16_t battery_v;
};

// The hardware interface of the loop. No call blocks.
class Port {
 public:
  // The next byte that has arrived, if there is one.
  virtual bool receive(uint8_t& byte) = 0;

  // Whether bytes were lost since the last call because the buffer was full.
  virtual bool take_rx_overflow() = 0;

  // The number of bytes that can be queued for sending.
  virtual uint8_t transmit_room() = 0;

  // Queues a frame; there is room for it.
  virtual void transmit(const uint8_t* bytes, uint8_t count) = 0;

  // The pulses from the next servo frame on [0.5 us]; 0, for both, until limits are known: no pulses at all.
  virtual void set_pulses(uint16_t servo_us, uint16_t motor_us) = 0;

  virtual SensorReadings read_sensors() = 0;

  // The current faults of sensors, as bits of a status.
  virtual uint16_t sensor_faults() = 0;

  // Stores the payload of limits over restarts; may finish later.
  virtual void keep_limits(const uint8_t* payload) = 0;

 protected:
  ~Port() = default;
};

// Due every `period_ms`; missed periods are skipped.
class Periodic {
 public:
  Periodic(uint16_t first_ms, uint16_t period_ms) : next_ms_(first_ms), period_ms_(period_ms) {}
  bool due(uint32_t t_ms);

 private:
  uint32_t next_ms_;
  uint16_t period_ms_;
};

class Board {
 public:
  // `limits` is the payload of valid limits, or kept::kNoLimits.
  Board(Port& port, uint16_t boot_id, uint8_t reset_cause, const uint8_t* limits);

  // One iteration of the main loop at `t_ms` since the program started; the first one at 0.
  void loop(uint32_t t_ms);

 private:
  void receive(uint32_t t_ms);
  void obey(uint32_t t_ms);
  void move();
  void say_hello();
  void say_status(uint32_t t_ms);
  void say_sensors(uint32_t t_ms);
  void say(uint8_t type, const uint8_t* payload, uint8_t count);

  Port& port_;
  Logic logic_;
  frame::Decoder decoder_;
  Periodic servo_frame_, status_, sensors_, hello_;
  uint16_t boot_id_;
  uint16_t limits_crc_;
  uint16_t at_pin_servo_us_ = 0, at_pin_motor_us_ = 0;
  uint8_t reset_cause_;
  uint8_t counter_ = 0;
};
