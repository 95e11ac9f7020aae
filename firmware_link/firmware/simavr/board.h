/* A simulated ATmega328P with the firmware on it, and what is around it. SPDX-License-Identifier: GPL-3.0-or-later */
#pragma once

#include <simavr/sim_avr.h>
#include <stdint.h>

#define CLOCK_HZ 16000000ULL

/* What the board did, with the cycle at which it was over. */
enum event_kind {
  EVENT_BYTE = 1, /* sent to the host: value is the byte, cycle the end of its stop bit */
  EVENT_PULSE = 2, /* value: channel << 31 | width in cycles, cycle: its end */
  EVENT_REGISTER = 3, /* OCR1A or OCR1B has changed: channel << 16 | value */
  EVENT_RESET = 4, /* value: MCUSR */
  EVENT_CRASH = 5, /* the program counter is lost */
  EVENT_AWAKE = 6, /* asked for: the longest time between two sleeps, in cycles */
  EVENT_STACK = 7, /* asked for: the lowest stack pointer */
};

struct event {
  uint64_t cycle;
  uint32_t value;
  uint32_t kind;
};

void note(uint64_t cycle, enum event_kind kind, uint32_t value); /* keeps it for the host; in main.c */

/* What the sensors are to read from now on. */
struct senses {
  int32_t wheel_ticks; /* since the start of the simulation; the edges are spread until the next are told */
  int16_t gyro; /* raw, of +-500 deg/s */
  uint16_t ranges_mm[3]; /* RANGE_NONE: nothing is heard */
  uint16_t battery_mv; /* at the pin */
  uint8_t gyro_state; /* enum gyro_state */
  uint8_t echoes_stuck; /* bits of sensors whose echo pin stays high */
  uint8_t sonars_gone; /* bits of sensors that do not answer at all */
} __attribute__((packed));

#define RANGE_NONE 0xFFFF
enum gyro_state { GYRO_NONE, GYRO_FITTED, GYRO_ASLEEP };

/* board.c */
avr_t* board_begin(const char* elf, uint64_t boot_cycles, uint32_t baud);
void board_run(uint64_t until);
void board_reset(uint8_t mcusr);
void board_hang(int deaf);
void board_receive(uint64_t start, const uint8_t* bytes, uint16_t count);
void board_statistics(void);
void agenda_changed(void); /* something is due earlier than before */

/* sensors.c: each has what is due next, UINT64_MAX where nothing is. */
void sensors_begin(avr_t* avr);
void sensors_restore(void); /* the pins' levels, after a reset */
void sensors_set(const struct senses* senses, uint64_t until);
uint64_t sensors_due(void);
void sensors_act(uint64_t now);
