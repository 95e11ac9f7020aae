#include "board.h"

#include "crc16.h"
#include "protocol.h"

namespace {

constexpr uint8_t kServoFrameMs = 20;
constexpr uint8_t kReportMs = 20;
constexpr uint16_t kHelloMs = 500;
constexpr uint8_t kStatusPhaseMs = 1;  // after the servo frame's start, so that it reports this frame's pulses
constexpr uint8_t kSensorPhaseMs = 11;  // halfway between two statuses
constexpr uint8_t kMaxBytesALoop = 64;  // six times the bytes of a millisecond: the loop always ends

uint32_t time_us(uint32_t t_ms) {
  return t_ms * 1000;
}

}  // namespace

bool Periodic::due(uint32_t t_ms) {
  if (static_cast<int32_t>(t_ms - next_ms_) < 0) return false;
  do {
    next_ms_ += period_ms_;
  } while (static_cast<int32_t>(t_ms - next_ms_) >= 0);
  return true;
}

Board::Board(Port& port, uint16_t boot_id, uint8_t reset_cause, const uint8_t* limits)
    : port_(port),
      logic_(boot_id, protocol::Limits::read(limits)),
      servo_frame_(0, kServoFrameMs),
      status_(kStatusPhaseMs, kReportMs),
      sensors_(kSensorPhaseMs, kReportMs),
      hello_(0, kHelloMs),
      boot_id_(boot_id),
      limits_crc_(crc16_dnp(limits, protocol::Limits::kBytes)),
      reset_cause_(reset_cause) {
}

void Board::loop(uint32_t t_ms) {
  receive(t_ms);
  logic_.tick(t_ms);
  if (servo_frame_.due(t_ms)) move();
  // In every iteration: a stop is in the timer's registers at once, not only with the next servo frame.
  port_.set_pulses(logic_.pulses().servo_us(), logic_.pulses().motor_us());
  if (status_.due(t_ms)) say_status(t_ms);
  if (sensors_.due(t_ms)) say_sensors(t_ms);
  if (hello_.due(t_ms)) say_hello();
}

void Board::receive(uint32_t t_ms) {
  if (port_.take_rx_overflow()) logic_.event(protocol::fault::kRxOverflow);
  uint8_t byte;
  for (uint8_t left = kMaxBytesALoop; left > 0 && port_.receive(byte); --left) {
    if (decoder_.push(byte)) obey(t_ms);
  }
}

void Board::obey(uint32_t t_ms) {
  const uint8_t* payload = decoder_.payload();
  switch (decoder_.type()) {
    case protocol::Command::kType:
      logic_.on_command(protocol::Command::read(payload), decoder_.counter(), t_ms);
      break;
    case protocol::Arm::kType:
      logic_.on_arm(protocol::Arm::read(payload), decoder_.counter(), t_ms);
      break;
    case protocol::Disarm::kType:
      logic_.on_disarm(t_ms);
      break;
    case protocol::Limits::kType:
      if (!logic_.on_limits(protocol::Limits::read(payload))) break;
      limits_crc_ = crc16_dnp(payload, protocol::Limits::kBytes);
      port_.keep_limits(payload);
      say_hello();
      break;
    default:  // the decoder accepts only one other: HelloRequest
      say_hello();
  }
}

void Board::move() {
  logic_.pulses().frame();
  at_pin_servo_us_ = logic_.pulses().servo_us();
  at_pin_motor_us_ = logic_.pulses().motor_us();
}

void Board::say_hello() {
  protocol::Hello hello;
  hello.table_hash = protocol::kTableHash;
  hello.version = protocol::kVersion;
  hello.reset_cause = reset_cause_;
  hello.boot_id = boot_id_;
  hello.limits_crc = limits_crc_;
  uint8_t payload[protocol::Hello::kBytes];
  hello.write(payload);
  say(protocol::Hello::kType, payload, sizeof(payload));
}

void Board::say_status(uint32_t t_ms) {
  if (decoder_.take_error()) logic_.event(protocol::fault::kFrameErrors);
  protocol::Status status;
  status.time_us = time_us(t_ms);
  status.servo_us = at_pin_servo_us_;
  status.motor_us = at_pin_motor_us_;
  status.faults = logic_.take_faults() | port_.sensor_faults();
  status.nonce = logic_.arming().nonce();
  status.command_counter = logic_.command_counter();
  status.flags = logic_.status_flags();
  uint8_t payload[protocol::Status::kBytes];
  status.write(payload);
  say(protocol::Status::kType, payload, sizeof(payload));
}

void Board::say_sensors(uint32_t t_ms) {
  const SensorReadings readings = port_.read_sensors();
  logic_.on_wheel(readings.wheel_ticks, t_ms);
  protocol::Odometry odometry;
  odometry.time_us = time_us(t_ms);
  odometry.wheel_ticks = readings.wheel_ticks;
  odometry.yaw_rate_radps = readings.yaw_rate;
  uint8_t payload[protocol::Ranges::kBytes];
  odometry.write(payload);
  say(protocol::Odometry::kType, payload, protocol::Odometry::kBytes);
  protocol::Ranges ranges;
  ranges.time_us = time_us(t_ms);
  ranges.left_m = readings.ranges[0];
  ranges.centre_m = readings.ranges[1];
  ranges.right_m = readings.ranges[2];
  ranges.battery_v = readings.battery_v;
  ranges.write(payload);
  say(protocol::Ranges::kType, payload, protocol::Ranges::kBytes);
}

void Board::say(uint8_t type, const uint8_t* payload, uint8_t count) {
  uint8_t bytes[frame::kMaxWire];
  const uint8_t length = frame::encode(type, counter_, payload, count, bytes);
  if (length > port_.transmit_room()) {
    logic_.event(protocol::fault::kTxOverflow);
    return;
  }
  ++counter_;
  port_.transmit(bytes, length);
}
