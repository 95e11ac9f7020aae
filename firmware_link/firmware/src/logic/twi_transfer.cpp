#include "twi_transfer.h"

namespace {

// Status codes of the ATmega328P, section 22.7 of its data sheet.
constexpr uint8_t kStarted = 0x08;
constexpr uint8_t kStartedAgain = 0x10;
constexpr uint8_t kAddressTaken = 0x18;
constexpr uint8_t kByteTaken = 0x28;
constexpr uint8_t kReadAddressTaken = 0x40;
constexpr uint8_t kByteCame = 0x50;
constexpr uint8_t kLastByteCame = 0x58;

}  // namespace

TwiAction TwiTransfer::write(uint8_t device, uint8_t reg, uint8_t value) {
  value_ = value;
  return read(device, reg, 0);
}

TwiAction TwiTransfer::read(uint8_t device, uint8_t reg, uint8_t count) {
  device_ = device;
  reg_ = reg;
  to_read_ = count;
  step_ = 0;
  state_ = kBusy;
  return {Twi::kStart, 0};
}

TwiAction TwiTransfer::on_status(uint8_t status, uint8_t received) {
  if (state_ != kBusy) return {Twi::kOff, 0};  // of a transfer that was abandoned
  switch (status) {
    case kStarted:
      return {Twi::kSend, static_cast<uint8_t>(device_ << 1)};
    case kStartedAgain:
      step_ = 0;
      return {Twi::kSend, static_cast<uint8_t>(device_ << 1 | 1)};
    case kAddressTaken:
    case kByteTaken:
      return acknowledged();
    case kReadAddressTaken:
      return {to_read_ > 1 ? Twi::kReceive : Twi::kReceiveLast, 0};
    case kByteCame:
      bytes_[step_++] = received;
      return {step_ + 1 < to_read_ ? Twi::kReceive : Twi::kReceiveLast, 0};
    case kLastByteCame:
      bytes_[step_] = received;
      return end(kDone);
    default:  // not acknowledged, arbitration lost, bus error
      return end(kFailed);
  }
}

TwiAction TwiTransfer::acknowledged() {
  ++step_;
  if (step_ == 1) return {Twi::kSend, reg_};
  if (to_read_ > 0) return {Twi::kStart, 0};
  if (step_ == 2) return {Twi::kSend, value_};
  return end(kDone);
}

TwiAction TwiTransfer::end(State state) {
  state_ = state;
  return {Twi::kStop, 0};
}
