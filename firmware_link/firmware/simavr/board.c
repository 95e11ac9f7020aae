/* The microcontroller: clock, resets, watchdog, servo pins, serial line. SPDX-License-Identifier: GPL-3.0-or-later */
#include "board.h"

#include <simavr/avr_ioport.h>
#include <simavr/avr_timer.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_elf.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

enum { MCUSR = 0x54, DDRB = 0x24, OCR1AL = 0x88, OCR1BL = 0x8A, UBRR0L = 0xC4, UBRR0H = 0xC5, SPL = 0x5D, SPH = 0x5E };
enum { TRAP = 0x7FFE, RJMP_SELF = 0xCFFF, LINE_BYTES = 8192 };

static avr_t* avr;
static avr_timer_t* timer1;
static avr_uart_t* uart;
static avr_irq_t* uart_in;

static uint64_t boot_cycles, held_until; /* the bootloader's time; 0: the program runs */
static int releasing;
static uint64_t rise[2]; /* of the pulse that is on, 0: none */
static uint16_t told[2]; /* the values of OCR1A and OCR1B that the host knows of */

static struct {
  uint64_t due;
  uint8_t byte;
} line[LINE_BYTES]; /* from the host */
static uint32_t line_in, line_out;
static double byte_cycles;
static uint64_t sent_until;

static uint64_t awake_since, longest_awake;
static uint16_t lowest_stack = 0xFFFF;

static void* module(const char* kind, char name, size_t name_at) {
  for (avr_io_t* io = avr->io_port; io; io = io->next)
    if (!strcmp(io->kind, kind) && ((char*)io)[name_at] == name) return io;
  abort();
}

/* --- servo pins --- */

static uint16_t compare(int channel) {
  const int low = channel ? OCR1BL : OCR1AL;
  return avr->data[low] | avr->data[low + 1] << 8;
}

/* simavr moves a match at once when OCR1x is written. The chip buffers it until the count begins anew in this mode
 * (data sheet 16.9.3), so simavr's own function is replaced by one that only stores. */
static void compare_written(avr_t* of, avr_io_addr_t address, uint8_t value, void* param) {
  const int channel = (int)(intptr_t)param;
  of->data[address] = value; /* the high byte was written before: the low one makes both valid */
  const uint16_t now = compare(channel);
  if (now != told[channel]) note(of->cycle, EVENT_REGISTER, (uint32_t)channel << 16 | now);
  told[channel] = now;
}

static void pin_changed(struct avr_irq_t* irq, uint32_t value, void* param) {
  const int channel = (int)(intptr_t)param;
  (void)irq;
  if (value & 0xFF) {
    /* The count begins anew: the buffered value takes hold. simavr asks for the match's time right after this. */
    timer1->comp[channel].comp_cycles = timer1->cs_div_value * (compare(channel) + 1u);
    if (avr->data[DDRB] & 2 << channel) rise[channel] = avr->cycle;
  } else if (rise[channel]) {
    note(avr->cycle, EVENT_PULSE, (uint32_t)channel << 31 | (uint32_t)(avr->cycle - rise[channel]));
    rise[channel] = 0;
  }
}

/* --- serial line --- */

/* simavr counts a parity bit that is not there. */
static uint32_t board_byte_cycles(void) {
  return ((avr->data[UBRR0L] | avr->data[UBRR0H] << 8) + 1u) * 8 * 10;
}

static void byte_sent(struct avr_irq_t* irq, uint32_t value, void* param) {
  (void)irq;
  (void)param;
  uart->cycles_per_byte = board_byte_cycles();
  sent_until = (avr->cycle > sent_until ? avr->cycle : sent_until) + uart->cycles_per_byte;
  note(sent_until, EVENT_BYTE, value & 0xFF);
}

static void byte_arrives(uint8_t byte) {
  uart->cycles_per_byte = 1; /* it has been on the line for its time already */
  avr_raise_irq(uart_in, byte);
  uart->cycles_per_byte = board_byte_cycles();
}

/* Bytes from the host, back to back from `start` on. */
void board_receive(uint64_t start, const uint8_t* bytes, uint16_t count) {
  for (uint16_t i = 0; i < count && line_in - line_out < LINE_BYTES; ++i, ++line_in) {
    line[line_in % LINE_BYTES].due = start + (uint64_t)((i + 1) * byte_cycles);
    line[line_in % LINE_BYTES].byte = bytes[i];
  }
  agenda_changed();
}

/* --- what is due --- */

static uint64_t run_until;

static uint64_t next_due(void) {
  uint64_t due = sensors_due();
  if (line_in != line_out && line[line_out % LINE_BYTES].due < due) due = line[line_out % LINE_BYTES].due;
  return run_until < due ? run_until : due;
}

static avr_cycle_count_t agenda(avr_t* of, avr_cycle_count_t when, void* param) {
  (void)param;
  while (line_in != line_out && line[line_out % LINE_BYTES].due <= of->cycle)
    byte_arrives(line[line_out++ % LINE_BYTES].byte);
  sensors_act(of->cycle);
  const uint64_t due = next_due();
  return due == UINT64_MAX ? 0 : due > when ? due : when + 1;
}

void agenda_changed(void) {
  const uint64_t due = next_due();
  if (due != UINT64_MAX) avr_cycle_timer_register(avr, due > avr->cycle ? due - avr->cycle : 1, agenda, NULL);
}

/* --- resets --- */

/* Whatever resets the chip comes here. It then lies still for the bootloader's time. */
static void was_reset(avr_io_t* io) {
  (void)io;
  rise[0] = rise[1] = 0;
  told[0] = told[1] = 0;
  awake_since = 0;
  sensors_restore();
  agenda_changed();
  if (!releasing) held_until = avr->cycle + boot_cycles + 1;
}

static void release(void) {
  const uint8_t mcusr = avr->data[MCUSR];
  if (avr->cycle < held_until) avr->cycle = held_until;
  held_until = 0;
  releasing = 1;
  avr_reset(avr); /* the bootloader's time has passed, and with it the watchdog that it stops */
  releasing = 0;
  avr->data[MCUSR] = mcusr;
  note(avr->cycle, EVENT_RESET, mcusr);
}

void board_reset(uint8_t mcusr) {
  avr_reset(avr);
  avr->data[MCUSR] = mcusr;
}

/* The program goes round in a loop of one instruction, with or without answering interrupts. */
void board_hang(int deaf) {
  if (held_until) return;
  avr->pc = TRAP;
  avr->state = cpu_Running;
  if (deaf) avr->sreg[S_I] = 0;
}

static void no_sleep(avr_t* of, avr_cycle_count_t cycles) {
  (void)of;
  (void)cycles; /* simulated time passes without waiting */
}

static void observe(int was_asleep) {
  const int asleep = avr->state == cpu_Sleeping;
  if (was_asleep && !asleep) awake_since = avr->cycle;
  if (!was_asleep && asleep && awake_since && avr->cycle - awake_since > longest_awake)
    longest_awake = avr->cycle - awake_since;
  const uint16_t stack = avr->data[SPL] | avr->data[SPH] << 8;
  if (stack > 0x100 && stack < lowest_stack) lowest_stack = stack;
}

void board_statistics(void) {
  note(avr->cycle, EVENT_AWAKE, (uint32_t)longest_awake);
  note(avr->cycle, EVENT_STACK, lowest_stack);
  longest_awake = 0;
}

void board_run(uint64_t until) {
  run_until = until;
  agenda_changed();
  while (avr->cycle < until) {
    if (held_until) {
      if (until < held_until) {
        avr->cycle = until;
        agenda(avr, until, NULL);
        break;
      }
      release();
    }
    const int was_asleep = avr->state == cpu_Sleeping;
    const int state = avr_run(avr);
    if (state == cpu_Done || state == cpu_Crashed) {
      note(avr->cycle, EVENT_CRASH, avr->pc);
      avr->cycle = until;
      return;
    }
    observe(was_asleep);
  }
}

avr_t* board_begin(const char* elf, uint64_t boot, uint32_t baud) {
  static elf_firmware_t firmware;
  static avr_io_t reset_watch = {.kind = "reset watch", .reset = was_reset};
  if (elf_read_firmware(elf, &firmware)) return NULL;
  avr = avr_make_mcu_by_name("atmega328p");
  if (!avr) return NULL;
  avr_init(avr);
  avr_load_firmware(avr, &firmware);
  avr->frequency = CLOCK_HZ;
  avr->vcc = avr->avcc = avr->aref = 5000;
  avr->log = LOG_ERROR;
  avr->sleep = no_sleep;
  avr->flash[TRAP] = RJMP_SELF & 0xFF;
  avr->flash[TRAP + 1] = RJMP_SELF >> 8;
  boot_cycles = boot;
  byte_cycles = CLOCK_HZ * 10.0 / baud;
  timer1 = module("timer", '1', offsetof(avr_timer_t, name));
  uart = module("uart", '0', offsetof(avr_uart_t, name));
  uart->flags &= ~(AVR_UART_FLAG_POLL_SLEEP | AVR_UART_FLAG_STDIO);
  uart_in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), byte_sent, NULL);
  for (intptr_t channel = 0; channel < 2; ++channel) {
    avr_irq_t* pin = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 1 + (int)channel);
    avr_irq_register_notify(pin, pin_changed, (void*)channel);
    const avr_io_addr_t at = AVR_DATA_TO_IO(channel ? OCR1BL : OCR1AL);
    avr->io[at].w.c = compare_written;
    avr->io[at].w.param = (void*)channel;
  }
  avr_register_io(avr, &reset_watch);
  sensors_begin(avr);
  run_until = UINT64_MAX;
  board_reset(1); /* power on */
  return avr;
}
