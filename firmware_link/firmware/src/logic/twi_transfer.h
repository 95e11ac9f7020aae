// Writes or reads a register of a device on the two-wire bus step by step: the bus's status codes in, its next action
// out.
#pragma once

#include <stdint.h>

enum class Twi : uint8_t {
  kNothing,
  kStart,
  kSend,
  kReceive,  // and acknowledge: more bytes follow
  kReceiveLast,  // and do not acknowledge
  kStop,
  kOff,  // release both wires
  kClockLow,  // pull the clock down by hand, with the bus off
  kClockHigh,
};

struct TwiAction {
  Twi what;
  uint8_t data;
};

class TwiTransfer {
 public:
  enum State : uint8_t { kIdle, kBusy, kDone, kFailed };
  static constexpr uint8_t kMaxBytes = 2;

  // Starts; returns the first action.
  TwiAction write(uint8_t device, uint8_t reg, uint8_t value);
  TwiAction read(uint8_t device, uint8_t reg, uint8_t count);

  // The bus has completed its action.
  TwiAction on_status(uint8_t status, uint8_t received);

  // Abandons the transfer.
  void abandon() { state_ = kIdle; }

  State state() const { return state_; }
  uint8_t byte(uint8_t index) const { return bytes_[index]; }

 private:
  TwiAction acknowledged();
  TwiAction end(State state);

  State state_ = kIdle;
  uint8_t device_ = 0, reg_ = 0, value_ = 0;
  uint8_t to_read_ = 0;  // 0: a write
  uint8_t step_ = 0;  // bytes that were acknowledged, or have come
  uint8_t bytes_[kMaxBytes] = {};
};
