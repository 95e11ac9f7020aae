/* The simulated board behind a pipe: commands on stdin, what the board did on stdout. The other end is
 * firmware_link/emulator/avr.py, which also says what each command means. Ends when stdin does.
 * SPDX-License-Identifier: GPL-3.0-or-later */
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

#include "board.h"

static FILE* out; /* simavr prints to stdout: that goes to stderr instead */
static struct event* events;
static size_t count, room;

void note(uint64_t cycle, enum event_kind kind, uint32_t value) {
  if (count == room) {
    room = room ? 2 * room : 256;
    events = realloc(events, room * sizeof(*events));
    if (!events) abort();
  }
  events[count++] = (struct event){.cycle = cycle, .value = value, .kind = kind};
}

static void tell(void) {
  const uint32_t told = (uint32_t)count;
  fwrite(&told, sizeof(told), 1, out);
  fwrite(events, sizeof(*events), count, out);
  fflush(out);
  count = 0;
}

static void want(void* into, size_t bytes) {
  if (fread(into, 1, bytes, stdin) != bytes) _exit(0);
}

static void advance(void) {
  uint64_t until;
  struct senses senses;
  want(&until, sizeof(until));
  want(&senses, sizeof(senses));
  sensors_set(&senses, until);
  board_run(until);
  tell();
}

static void receive(void) {
  static uint8_t bytes[4096];
  uint64_t start;
  uint16_t length;
  want(&start, sizeof(start));
  want(&length, sizeof(length));
  if (length > sizeof(bytes)) _exit(2);
  want(bytes, length);
  board_receive(start, bytes, length);
}

int main(int argc, char** argv) {
  if (argc != 4) {
    fprintf(stderr, "usage: %s FIRMWARE.elf BOOT_CYCLES BAUD\n", argv[0]);
    return 2;
  }
  out = fdopen(dup(STDOUT_FILENO), "wb");
  if (!out || dup2(STDERR_FILENO, STDOUT_FILENO) < 0) return 2;
  if (!board_begin(argv[1], strtoull(argv[2], NULL, 10), (uint32_t)strtoul(argv[3], NULL, 10))) {
    fprintf(stderr, "%s: cannot be run\n", argv[1]);
    return 2;
  }
  for (;;) {
    uint8_t command, argument;
    want(&command, 1);
    switch (command) {
      case 'A':
        advance();
        break;
      case 'R':
        receive();
        break;
      case 'X':
        want(&argument, 1);
        board_reset(argument);
        break;
      case 'H':
        want(&argument, 1);
        board_hang(argument);
        break;
      case 'S':
        board_statistics();
        tell();
        break;
      default:
        return 2;
    }
  }
}
