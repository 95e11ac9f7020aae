// Made from the message table (firmware_link/messages.py) by `python -m firmware_link.protocol_files`.
// Do not edit: change the table, then make it anew.
#pragma once

#include <stdint.h>

#include "wire.h"

namespace protocol {

constexpr uint8_t kVersion = 2;
constexpr uint16_t kTableHash = 0x4c0d;
constexpr uint16_t kPulseMin = 1000;  // [0.5 us]
constexpr uint16_t kPulseMax = 5000;  // [0.5 us]
constexpr uint16_t kCommandTimeoutMs = 100;
constexpr uint16_t kRollOutMs = 2000;
constexpr uint16_t kStandMs = 200;
constexpr uint8_t kStandGaps = 3;
constexpr uint16_t kMaxGapMs = 1000;
constexpr uint16_t kMaxDeadlineMs = 150;
constexpr uint16_t kNonceStep = 0x9e37;

namespace command_flag {
constexpr uint8_t kFresh = 1;
}  // namespace command_flag

namespace status_flag {
constexpr uint8_t kArmed = 1;
constexpr uint8_t kNoLimits = 2;
}  // namespace status_flag

namespace fault {
constexpr uint16_t kCommandTimeout = 1;
constexpr uint16_t kCommandLate = 2;
constexpr uint16_t kCommandRepeated = 4;
constexpr uint16_t kCommandRefused = 8;
constexpr uint16_t kFrameErrors = 16;
constexpr uint16_t kRxOverflow = 32;
constexpr uint16_t kTxOverflow = 64;
constexpr uint16_t kArmRefused = 128;
constexpr uint16_t kLimitsRefused = 256;
constexpr uint16_t kGyroFailed = 512;
}  // namespace fault

namespace reset_cause {
constexpr uint8_t kPowerOn = 0;
constexpr uint8_t kExternal = 1;
constexpr uint8_t kBrownOut = 2;
constexpr uint8_t kWatchdog = 3;
}  // namespace reset_cause

struct Command {
  static constexpr uint8_t kType = 0x01;
  static constexpr uint8_t kBytes = 7;
  uint16_t servo_us;  // [0.5 us] steering pulse
  uint16_t motor_us;  // [0.5 us] motor pulse
  uint16_t deadline_ms;  // [ms] board time, modulo 65536, after which the command is ignored
  uint8_t flags;  // [bits] CommandFlag

  static Command read(const uint8_t* payload) {
    Command message;
    message.servo_us = wire::get16(payload + 0);
    message.motor_us = wire::get16(payload + 2);
    message.deadline_ms = wire::get16(payload + 4);
    message.flags = wire::get8(payload + 6);
    return message;
  }
};

struct Limits {
  static constexpr uint8_t kType = 0x02;
  static constexpr uint8_t kBytes = 14;
  uint16_t servo_min_us;  // [0.5 us] smallest steering pulse
  uint16_t servo_straight_us;  // [0.5 us] steering pulse for straight ahead
  uint16_t servo_max_us;  // [0.5 us] largest steering pulse
  uint16_t motor_min_us;  // [0.5 us] smallest motor pulse
  uint16_t motor_neutral_us;  // [0.5 us] motor pulse for neutral
  uint16_t motor_max_us;  // [0.5 us] largest motor pulse
  uint8_t servo_slew_us;  // [4 us] maximum steering change per 20 ms servo frame
  uint8_t motor_slew_us;  // [4 us] maximum motor change away from neutral per servo frame

  static Limits read(const uint8_t* payload) {
    Limits message;
    message.servo_min_us = wire::get16(payload + 0);
    message.servo_straight_us = wire::get16(payload + 2);
    message.servo_max_us = wire::get16(payload + 4);
    message.motor_min_us = wire::get16(payload + 6);
    message.motor_neutral_us = wire::get16(payload + 8);
    message.motor_max_us = wire::get16(payload + 10);
    message.servo_slew_us = wire::get8(payload + 12);
    message.motor_slew_us = wire::get8(payload + 13);
    return message;
  }
};

struct Arm {
  static constexpr uint8_t kType = 0x03;
  static constexpr uint8_t kBytes = 4;
  uint16_t nonce;  // as in Status
  uint16_t boot_id;  // as in Hello

  static Arm read(const uint8_t* payload) {
    Arm message;
    message.nonce = wire::get16(payload + 0);
    message.boot_id = wire::get16(payload + 2);
    return message;
  }
};

struct Disarm {
  static constexpr uint8_t kType = 0x04;
  static constexpr uint8_t kBytes = 0;
};

struct HelloRequest {
  static constexpr uint8_t kType = 0x05;
  static constexpr uint8_t kBytes = 0;
};

struct Hello {
  static constexpr uint8_t kType = 0x81;
  static constexpr uint8_t kBytes = 8;
  uint16_t table_hash;  // hash of the message table
  uint8_t version;  // protocol version
  uint8_t reset_cause;  // ResetCause
  uint16_t boot_id;  // new after every start
  uint16_t limits_crc;  // CRC-16/DNP of the payload of the Limits in force, of zeros without any

  void write(uint8_t* payload) const {
    wire::put16(payload + 0, table_hash);
    wire::put8(payload + 2, version);
    wire::put8(payload + 3, reset_cause);
    wire::put16(payload + 4, boot_id);
    wire::put16(payload + 6, limits_crc);
  }
};

struct Status {
  static constexpr uint8_t kType = 0x82;
  static constexpr uint8_t kBytes = 14;
  uint32_t time_us;  // [us] board time, modulo 2^32
  uint16_t servo_us;  // [0.5 us] steering pulse at the pin
  uint16_t motor_us;  // [0.5 us] motor pulse at the pin
  uint16_t faults;  // [bits] Fault
  uint16_t nonce;  // required in the next Arm; new after every start and disarming
  uint8_t command_counter;  // counter of the last Command received
  uint8_t flags;  // [bits] StatusFlag

  void write(uint8_t* payload) const {
    wire::put32(payload + 0, time_us);
    wire::put16(payload + 4, servo_us);
    wire::put16(payload + 6, motor_us);
    wire::put16(payload + 8, faults);
    wire::put16(payload + 10, nonce);
    wire::put8(payload + 12, command_counter);
    wire::put8(payload + 13, flags);
  }
};

struct Odometry {
  static constexpr uint8_t kType = 0x83;
  static constexpr uint8_t kBytes = 10;
  uint32_t time_us;  // [us] board time of the reading, modulo 2^32
  int32_t wheel_ticks;  // wheel ticks since the start, decreasing in reverse
  int16_t yaw_rate_radps;  // [0.0002 rad/s] anticlockwise positive; none without a gyro
  static constexpr int16_t kNoYawRateRadps = -32767 - 1;

  void write(uint8_t* payload) const {
    wire::put32(payload + 0, time_us);
    wire::put32(payload + 4, static_cast<uint32_t>(wheel_ticks));
    wire::put16(payload + 8, static_cast<uint16_t>(yaw_rate_radps));
  }
};

struct Ranges {
  static constexpr uint8_t kType = 0x84;
  static constexpr uint8_t kBytes = 12;
  uint32_t time_us;  // [us] board time of the reading, modulo 2^32
  uint16_t left_m;  // [0.001 m] none without an echo
  uint16_t centre_m;  // [0.001 m] none without an echo
  uint16_t right_m;  // [0.001 m] none without an echo
  uint16_t battery_v;  // [0.001 V] battery
  static constexpr uint16_t kNoLeftM = 65535;
  static constexpr uint16_t kNoCentreM = 65535;
  static constexpr uint16_t kNoRightM = 65535;

  void write(uint8_t* payload) const {
    wire::put32(payload + 0, time_us);
    wire::put16(payload + 4, left_m);
    wire::put16(payload + 6, centre_m);
    wire::put16(payload + 8, right_m);
    wire::put16(payload + 10, battery_v);
  }
};

constexpr uint8_t kUnknownType = 0xff;

// The payload's length of a message to the board, or kUnknownType.
inline uint8_t payload_bytes(uint8_t type) {
  switch (type) {
    case Command::kType:
      return Command::kBytes;
    case Limits::kType:
      return Limits::kBytes;
    case Arm::kType:
      return Arm::kBytes;
    case Disarm::kType:
      return Disarm::kBytes;
    case HelloRequest::kType:
      return HelloRequest::kBytes;
    default:
      return kUnknownType;
  }
}

}  // namespace protocol
