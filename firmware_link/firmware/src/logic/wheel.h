// A wheel sensor with two channels, A and B, a quarter of a period apart.
#pragma once

#include <stdint.h>

// The tick at a rising edge of A: forward if B is high. With only one channel, B stays open and its pull-up makes every
// tick a forward one.
inline int8_t wheel_tick(bool b_high) {
  return b_high ? 1 : -1;
}
