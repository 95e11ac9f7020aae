#include "gyro.h"

namespace {

constexpr uint8_t kDevice = 0x68;
constexpr uint8_t kWhoAmI = 0x75;
constexpr uint8_t kGyroConfig = 0x1B;
constexpr uint8_t kGyroZ = 0x47;
constexpr uint8_t kRange500 = 0x08;  // +- 500 deg/s

struct Setting {
  uint8_t reg, value;
};
constexpr Setting kSettings[] = {
    {0x6B, 0x01},  // PWR_MGMT_1: awake, clocked by a gyro
    {0x1A, 0x03},  // CONFIG: low-pass filter of 42 Hz
    {kGyroConfig, kRange500},
};
constexpr uint8_t kSettingCount = sizeof(kSettings) / sizeof(kSettings[0]);
constexpr uint8_t kIdentify = kSettingCount;
constexpr uint8_t kRead = kSettingCount + 1;
constexpr uint8_t kCheck = kSettingCount + 2;

constexpr uint8_t kReadsPerCheck = 32;
constexpr uint8_t kReadMs = 5;
constexpr uint8_t kTransferMs = 3;  // it takes 0.2 ms
constexpr uint8_t kRetryMs = 100;
constexpr uint16_t kLookMs = 1000;  // for one that never answered
constexpr uint8_t kHalfClocks = 18;  // nine clocks end any byte of a device
constexpr int16_t kMaxYawRate = 32767;

// The MPU-6050 answers 0x68; others with the same registers (6500, 9250, 9255) have other numbers.
bool is_gyro(uint8_t who) {
  return who == 0x68 || who == 0x70 || who == 0x71 || who == 0x73;
}

// 1/65.5 deg/s to 0.0002 rad/s: times 1.332312.
int16_t on_wire(int16_t raw) {
  const int32_t rate = raw * 21829L / 16384;
  if (rate > kMaxYawRate) return kMaxYawRate;
  return rate < -kMaxYawRate ? -kMaxYawRate : static_cast<int16_t>(rate);
}

}  // namespace

TwiAction Gyro::tick(uint32_t t_ms) {
  if (half_clocks_ > 0) {
    --half_clocks_;
    return {half_clocks_ & 1 ? Twi::kClockLow : Twi::kClockHigh, 0};
  }
  const uint32_t waited_ms = t_ms - since_ms_;
  switch (transfer_.state()) {
    case TwiTransfer::kBusy:
      return waited_ms < kTransferMs ? TwiAction{Twi::kNothing, 0} : fail(t_ms);
    case TwiTransfer::kFailed:
      return fail(t_ms);
    case TwiTransfer::kDone:
      if (!taken()) return fail(t_ms);
      transfer_.abandon();
      return {Twi::kNothing, 0};
    default:
      if (waited_ms < pause_ms_) return {Twi::kNothing, 0};
      since_ms_ = t_ms;
      return begin_transfer();
  }
}

TwiAction Gyro::begin_transfer() {
  if (step_ < kSettingCount) return transfer_.write(kDevice, kSettings[step_].reg, kSettings[step_].value);
  if (step_ == kIdentify) return transfer_.read(kDevice, kWhoAmI, 1);
  if (step_ == kCheck) return transfer_.read(kDevice, kGyroConfig, 1);
  return transfer_.read(kDevice, kGyroZ, 2);
}

// Processes the result of a transfer; false if it is implausible.
bool Gyro::taken() {
  pause_ms_ = 0;
  if (step_ < kSettingCount) {
    ++step_;
    return true;
  }
  if (step_ == kIdentify) {
    step_ = kRead;
    return is_gyro(transfer_.byte(0));
  }
  if (step_ == kCheck) {
    step_ = kRead;
    return transfer_.byte(0) == kRange500;  // otherwise its supply has dipped; it sleeps and reads 0
  }
  fitted_ = true;
  pause_ms_ = kReadMs;
  yaw_rate_ = on_wire(static_cast<int16_t>(transfer_.byte(0) << 8 | transfer_.byte(1)));
  if (++reads_ == kReadsPerCheck) {
    reads_ = 0;
    step_ = kCheck;
  }
  return true;
}

TwiAction Gyro::fail(uint32_t t_ms) {
  transfer_.abandon();
  yaw_rate_ = protocol::Odometry::kNoYawRateRadps;
  step_ = 0;
  since_ms_ = t_ms;
  pause_ms_ = fitted_ ? kRetryMs : kLookMs;
  half_clocks_ = kHalfClocks;
  return {Twi::kOff, 0};
}
