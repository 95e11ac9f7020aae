#include "logic.h"

namespace {

constexpr uint8_t kMaxCounterStep = 127;  // a counter further ahead is an old one

bool is_pulse(uint16_t pulse_us) {
  return protocol::kPulseMin <= pulse_us && pulse_us <= protocol::kPulseMax;
}

}  // namespace

void CommandTimer::feed(uint32_t t_ms) {
  fed_ms_ = t_ms;
  running_ = true;
}

bool CommandTimer::expired(uint32_t t_ms) const {
  return running_ && t_ms - fed_ms_ >= protocol::kCommandTimeoutMs;
}

bool Arming::arm(const protocol::Arm& message) {
  if (message.nonce != nonce_ || message.boot_id != boot_id_) return false;
  armed_ = true;
  return true;
}

void Arming::disarm() {
  armed_ = false;
  nonce_ += protocol::kNonceStep;
}

uint16_t CommandGate::fault_of(const protocol::Command& command, uint8_t counter, uint32_t t_ms) {
  if (!is_pulse(command.servo_us) || !is_pulse(command.motor_us)) return protocol::fault::kCommandRefused;
  if (command.flags & ~protocol::command_flag::kFresh) return protocol::fault::kCommandRefused;
  const uint8_t step = counter - counter_;
  if (step == 0 || step > kMaxCounterStep) return protocol::fault::kCommandRepeated;
  const uint16_t ahead_ms = command.deadline_ms - static_cast<uint16_t>(t_ms);
  const bool fresh = command.flags & protocol::command_flag::kFresh;
  if (fresh && ahead_ms > protocol::kMaxDeadlineMs) return protocol::fault::kCommandLate;
  counter_ = counter;
  return 0;
}

bool Standstill::step(int32_t ticks, bool drives, uint32_t t_ms) {
  if (read_ && ticks != ticks_) {
    const uint32_t gap_ms = t_ms - ticked_ms_;
    gap_ms_ = gap_ms < protocol::kMaxGapMs ? gap_ms : protocol::kMaxGapMs;
    ticked_ms_ = t_ms;
    counts_ = true;
  }
  read_ = true;
  ticks_ = ticks;
  const uint16_t quiet_ms = protocol::kStandGaps * gap_ms_;
  const bool stands = t_ms - ticked_ms_ >= (quiet_ms < protocol::kStandMs ? protocol::kStandMs : quiet_ms);
  if (drives && stands) counts_ = false;
  return counts_ && stands && !drives;
}

void Logic::on_command(const protocol::Command& command, uint8_t counter, uint32_t t_ms) {
  command_counter_ = counter;
  if (!arming_.armed()) return;
  const uint16_t fault = gate_.fault_of(command, counter, t_ms);
  if (fault) {
    event(fault);
  } else if (command.flags & protocol::command_flag::kFresh) {
    timer_.feed(t_ms);
    pulses_.set_target(command.servo_us, command.motor_us);
  } else {
    pulses_.roll_out(t_ms);
  }
}

void Logic::on_arm(const protocol::Arm& message, uint8_t counter, uint32_t t_ms) {
  if (arming_.armed()) return;
  if (!pulses_.limited() || !arming_.arm(message)) {
    event(protocol::fault::kArmRefused);
    return;
  }
  timed_out_ = false;
  pulses_.straighten();
  gate_.start(counter);
  timer_.feed(t_ms);
}

void Logic::on_disarm(uint32_t t_ms) {
  arming_.disarm();
  timer_.stop();
  pulses_.roll_out(t_ms);
}

bool Logic::on_limits(const protocol::Limits& limits) {
  if (arming_.armed() || !limits_fit(limits)) {
    event(protocol::fault::kLimitsRefused);
    return false;
  }
  pulses_ = Pulses(limits);
  return true;
}

void Logic::tick(uint32_t t_ms) {
  pulses_.tick(t_ms);
  if (!timer_.expired(t_ms)) return;
  on_disarm(t_ms);
  timed_out_ = true;
}

void Logic::on_wheel(int32_t ticks, uint32_t t_ms) {
  if (standstill_.step(ticks, pulses_.drives(), t_ms)) pulses_.stand();
}

uint8_t Logic::status_flags() const {
  return (arming_.armed() ? protocol::status_flag::kArmed : 0) |
         (pulses_.limited() ? 0 : protocol::status_flag::kNoLimits);
}

uint16_t Logic::take_faults() {
  const uint16_t events = events_;
  events_ = 0;
  return events | (timed_out_ ? protocol::fault::kCommandTimeout : 0);
}
