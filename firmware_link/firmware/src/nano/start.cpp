#include "start.h"

#include <avr/io.h>
#include <avr/wdt.h>

#include "../logic/reset.h"

// Not in .bss, which is cleared after .init3.
static uint8_t saved_mcusr __attribute__((section(".noinit")));
static uint8_t saved_r2 __attribute__((section(".noinit")));

// Before main: after a watchdog reset the watchdog keeps running with its shortest time and would reset again. It can
// only be stopped after its flag in MCUSR is cleared. Optiboot leaves the flags that it has cleared in r2.
extern "C" void save_reset_cause() __attribute__((naked, used, section(".init3")));
extern "C" void save_reset_cause() {
  asm volatile("sts %0, r2" : "=m"(saved_r2));
  saved_mcusr = MCUSR;
  MCUSR = 0;
  wdt_disable();
}

namespace start {

uint8_t reset_cause() {
  return reset_cause_of(saved_mcusr, saved_r2);
}

}  // namespace start
