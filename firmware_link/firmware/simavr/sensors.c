/* What hangs on the board's pins: ultrasonic sensors, a wheel, a gyro, a battery.
 * SPDX-License-Identifier: GPL-3.0-or-later */
#include <simavr/avr_adc.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_twi.h>
#include <string.h>

#include "board.h"

enum { SONARS = 3, FIRST_TRIGGER = 4, WHEEL_A = 2, WHEEL_B = 3, BATTERY = 6 };
#define US (CLOCK_HZ / 1000000)
#define ECHO_DELAY (450 * US) /* the burst, and what the sensor takes to begin */
#define ECHO_OF_NOTHING (38000 * US)
#define CYCLES_PER_MM (2.0 * 1e-3 / 343.0 * CLOCK_HZ)

static avr_t* avr;
static struct senses senses;

static uint8_t c_levels, d_levels = 1 << WHEEL_B; /* of the input pins */

/* simavr forgets an input's level when its port is written: it must be told the levels as pulls, too. */
static void drive(char port, uint8_t bit, int high) {
  uint8_t* levels = port == 'C' ? &c_levels : &d_levels;
  *levels = (uint8_t)((*levels & ~(1 << bit)) | (high ? 1 << bit : 0));
  avr_ioport_external_t pulls = {.name = port, .mask = port == 'C' ? 0x07 : 0x0C, .value = *levels};
  avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(port), &pulls);
  avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(port), bit), high);
}

/* A reset clears the pins' register behind the back of their lines, which pass no level on that they had before. */
static void drive_anew(char port, uint8_t bit, int high) {
  drive(port, bit, !high);
  drive(port, bit, high);
}

/* --- ultrasonic --- */

static struct {
  int trigger;
  uint64_t rise, fall; /* when, 0: not */
} sonars[SONARS];

static void triggered(struct avr_irq_t* irq, uint32_t value, void* param) {
  const int i = (int)(intptr_t)param;
  const int fell = sonars[i].trigger && !(value & 0xFF);
  (void)irq;
  sonars[i].trigger = value & 0xFF;
  if (!fell || sonars[i].rise || sonars[i].fall || (senses.sonars_gone >> i & 1)) return; /* busy with the one before */
  const uint16_t range = senses.ranges_mm[i];
  sonars[i].rise = avr->cycle + ECHO_DELAY;
  sonars[i].fall = sonars[i].rise + (range == RANGE_NONE ? ECHO_OF_NOTHING : (uint64_t)(range * CYCLES_PER_MM));
  agenda_changed();
}

static void sonars_act(uint64_t now) {
  for (int i = 0; i < SONARS; ++i) {
    if (sonars[i].rise && sonars[i].rise <= now) {
      sonars[i].rise = 0;
      drive('C', (uint8_t)i, 1);
    }
    if (!sonars[i].rise && sonars[i].fall && sonars[i].fall <= now && !(senses.echoes_stuck >> i & 1)) {
      sonars[i].fall = 0;
      drive('C', (uint8_t)i, 0);
    }
  }
}

static uint64_t sonars_due(void) {
  uint64_t due = UINT64_MAX;
  for (int i = 0; i < SONARS; ++i) {
    const uint64_t next = sonars[i].rise ? sonars[i].rise : senses.echoes_stuck >> i & 1 ? 0 : sonars[i].fall;
    if (next && next < due) due = next;
  }
  return due;
}

/* --- wheel --- */

static int32_t wheel_at; /* ticks made */
static uint64_t wheel_due = UINT64_MAX, wheel_step;

static void wheel_act(uint64_t now) {
  while (wheel_due <= now) {
    const int ahead = senses.wheel_ticks > wheel_at;
    drive('D', WHEEL_A, 0);
    drive('D', WHEEL_B, ahead);
    drive('D', WHEEL_A, 1);
    wheel_at += ahead ? 1 : -1;
    wheel_due = wheel_at == senses.wheel_ticks ? UINT64_MAX : wheel_due + wheel_step;
  }
}

/* --- gyro: an MPU-6050 at address 0x68 --- */

enum { GYRO_ADDRESS = 0x68 << 1, WHO_AM_I = 0x75, POWER = 0x6B, GYRO_CONFIG = 0x1B, GYRO_Z = 0x47 };
static uint8_t registers[128];
static int selected, place_known;
static uint8_t place;

static void gyro_power_on(void) {
  memset(registers, 0, sizeof(registers));
  registers[POWER] = 0x40; /* asleep */
  registers[WHO_AM_I] = 0x68;
}

static void answer(uint8_t message, uint8_t data) {
  avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_INPUT),
                avr_twi_irq_msg(message, GYRO_ADDRESS, data));
}

static uint8_t gyro_read(void) {
  const uint16_t rate = registers[POWER] & 0x40 || registers[GYRO_CONFIG] != 0x08 ? 0 : (uint16_t)senses.gyro;
  registers[GYRO_Z] = rate >> 8;
  registers[GYRO_Z + 1] = (uint8_t)rate;
  return registers[place++ & 0x7F];
}

static void bus_message(struct avr_irq_t* irq, uint32_t value, void* param) {
  avr_twi_msg_irq_t message = {.u.v = value};
  const uint8_t what = message.u.twi.msg;
  (void)irq;
  (void)param;
  if (what & TWI_COND_STOP) selected = 0;
  if (what & TWI_COND_START) {
    selected = (message.u.twi.addr & 0xFE) == GYRO_ADDRESS && senses.gyro_state != GYRO_NONE;
    place_known = message.u.twi.addr & 1;
    if (selected) answer(TWI_COND_ACK, 1);
  }
  if (!selected) return;
  if (what & TWI_COND_WRITE) {
    answer(TWI_COND_ACK, 1);
    if (place_known)
      registers[place++ & 0x7F] = message.u.twi.data;
    else
      place = message.u.twi.data;
    place_known = 1;
  }
  if (what & TWI_COND_READ) answer(TWI_COND_READ, gyro_read());
}

/* --- all --- */

uint64_t sensors_due(void) {
  const uint64_t due = sonars_due();
  return wheel_due < due ? wheel_due : due;
}

void sensors_act(uint64_t now) {
  sonars_act(now);
  wheel_act(now);
}

void sensors_set(const struct senses* next, uint64_t until) {
  if (next->gyro_state == GYRO_ASLEEP && senses.gyro_state != GYRO_ASLEEP) gyro_power_on();
  const uint8_t stuck = next->echoes_stuck & ~senses.echoes_stuck;
  const uint8_t freed = senses.echoes_stuck & ~next->echoes_stuck;
  senses = *next;
  for (uint8_t i = 0; i < SONARS; ++i) {
    if (stuck >> i & 1) drive('C', i, 1);
    if ((freed >> i & 1) && !sonars[i].fall) drive('C', i, 0);
  }
  avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, BATTERY), senses.battery_mv);
  const int32_t ticks = senses.wheel_ticks - wheel_at;
  wheel_due = UINT64_MAX;
  if (ticks) {
    wheel_step = (until - avr->cycle) / (uint64_t)((ticks < 0 ? -ticks : ticks) + 1);
    if (!wheel_step) wheel_step = 1;
    wheel_due = avr->cycle + wheel_step;
  }
  agenda_changed();
}

void sensors_restore(void) {
  for (uint8_t i = 0; i < SONARS; ++i) {
    sonars[i].trigger = 0;
    drive_anew('C', i, c_levels >> i & 1);
  }
  drive_anew('D', WHEEL_A, d_levels >> WHEEL_A & 1);
  drive_anew('D', WHEEL_B, d_levels >> WHEEL_B & 1);
}

void sensors_begin(avr_t* of) {
  avr = of;
  gyro_power_on();
  for (int i = 0; i < SONARS; ++i) senses.ranges_mm[i] = RANGE_NONE;
  for (intptr_t i = 0; i < SONARS; ++i)
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), FIRST_TRIGGER + (int)i), triggered,
                            (void*)i);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_OUTPUT), bus_message, NULL);
}
