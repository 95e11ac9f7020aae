// The state machine between the messages and the pulses. The table of its states is in the docstring of
// firmware_link.emulator.board.EmulatedArduino; firmware_link/emulator/logic.py is identical to the bit.
// Time is the board's own: milliseconds since the program started, modulo 2^32.
#pragma once

#include <stdint.h>

#include "protocol.h"
#include "pulses.h"

// Expires 100 ms after it was last fed; stopped until it is first fed.
class CommandTimer {
 public:
  void feed(uint32_t t_ms);
  void stop() { running_ = false; }
  bool expired(uint32_t t_ms) const;

 private:
  uint32_t fed_ms_ = 0;
  bool running_ = false;
};

// The arming state. Each arming requires a new nonce: an Arm from before a Disarm or restart is invalid.
class Arming {
 public:
  explicit Arming(uint16_t boot_id) : boot_id_(boot_id), nonce_(boot_id) {}

  // Arms if nonce and boot id are correct; returns whether they were.
  bool arm(const protocol::Arm& message);

  // Disarms, and invalidates every Arm in transmission.
  void disarm();

  bool armed() const { return armed_; }
  uint16_t nonce() const { return nonce_; }

 private:
  uint16_t boot_id_;
  uint16_t nonce_;
  bool armed_ = false;
};

// Checks commands.
class CommandGate {
 public:
  // Counts from `counter` on.
  void start(uint8_t counter) { counter_ = counter; }

  // The fault of the command: its values, its counter (must be 1 .. 127 ahead) or its deadline; 0 if it is valid.
  uint16_t fault_of(const protocol::Command& command, uint8_t counter, uint32_t t_ms);

 private:
  uint8_t counter_ = 0;
};

// Whether the car stands, as the wheel's ticks say: `Standstill` of firmware_link/emulator/logic.py.
class Standstill {
 public:
  // Processes a reading, at which the motor turns or does not; returns whether the car stands.
  bool step(int32_t ticks, bool drives, uint32_t t_ms);

 private:
  int32_t ticks_ = 0;
  uint32_t ticked_ms_ = 0;
  uint16_t gap_ms_ = protocol::kMaxGapMs;
  bool read_ = false;
  bool counts_ = false;  // whether the sensor counted while the motor last turned, or since then
};

class Logic {
 public:
  Logic(uint16_t boot_id, const protocol::Limits& limits) : arming_(boot_id), pulses_(limits) {}

  // Follows a valid command while armed; only a fresh one feeds the timer.
  void on_command(const protocol::Command& command, uint8_t counter, uint32_t t_ms);

  // Disarmed to armed; the first fresh command must follow within the timer's 100 ms.
  void on_arm(const protocol::Arm& message, uint8_t counter, uint32_t t_ms);

  // Any state to disarmed; a car that drove rolls out.
  void on_disarm(uint32_t t_ms);

  // Accepts new limits while disarmed; returns whether they were accepted.
  bool on_limits(const protocol::Limits& limits);

  // After the messages: ends the roll-out, and armed to disarmed if the timer has expired.
  void tick(uint32_t t_ms);

  // With each reading of the wheel's ticks: ends the roll-out of a car that stands.
  void on_wheel(int32_t ticks, uint32_t t_ms);

  // Records a fault for the next status.
  void event(uint16_t fault) { events_ |= fault; }

  // The faults for a status; they are cleared, except for the timeout, which is kept until the next arming.
  uint16_t take_faults();

  const Arming& arming() const { return arming_; }
  Pulses& pulses() { return pulses_; }
  uint8_t status_flags() const;
  uint8_t command_counter() const { return command_counter_; }

 private:
  Arming arming_;
  Pulses pulses_;
  CommandTimer timer_;
  CommandGate gate_;
  Standstill standstill_;
  uint16_t events_ = 0;
  uint8_t command_counter_ = 0;
  bool timed_out_ = false;
};
