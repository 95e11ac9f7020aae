// Three HC-SR04: triggers on D4, D5, D6, echoes on A0, A1, A2 (left, centre, right), timed by pin-change interrupts.
#pragma once

#include <stdint.h>

namespace sonar {

void begin();

// Each millisecond.
void tick(uint32_t t_ms);

// [0.001 m], protocol::Ranges::kNoLeftM without an echo.
uint16_t range(uint8_t sensor);

}  // namespace sonar
