#include "reset.h"

#include "protocol.h"

namespace {

// Bits of MCUSR, ATmega328P.
constexpr uint8_t kPowerOn = 1 << 0;
constexpr uint8_t kExternal = 1 << 1;
constexpr uint8_t kBrownOut = 1 << 2;
constexpr uint8_t kWatchdog = 1 << 3;
constexpr uint8_t kAll = kPowerOn | kExternal | kBrownOut | kWatchdog;

}  // namespace

uint8_t reset_cause_of(uint8_t mcusr, uint8_t from_bootloader) {
  uint8_t flags = mcusr & kAll;
  if (flags == 0 && (from_bootloader & ~kAll) == 0) flags = from_bootloader;
  if (flags & kPowerOn) return protocol::reset_cause::kPowerOn;  // the supply's rise sets the brown-out flag, too
  if (flags & kBrownOut) return protocol::reset_cause::kBrownOut;
  // A bootloader that runs after the reset line may exit by the watchdog: the cause is the reset line.
  if (flags & kExternal) return protocol::reset_cause::kExternal;
  if (flags & kWatchdog) return protocol::reset_cause::kWatchdog;
  return protocol::reset_cause::kExternal;  // cleared by an old bootloader, which runs only for the reset line
}
