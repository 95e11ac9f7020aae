// The start of the program: the reset cause is saved before anything else runs, and the watchdog is stopped.
#pragma once

#include <stdint.h>

namespace start {

// As protocol::reset_cause.
uint8_t reset_cause();

}  // namespace start
