// The logic as a C library for this machine, which the tests call from Python.

#include <stdint.h>
#include <string.h>

#include "../src/logic/battery.h"
#include "../src/logic/board.h"
#include "../src/logic/crc16.h"
#include "../src/logic/frame.h"
#include "../src/logic/gyro.h"
#include "../src/logic/kept.h"
#include "../src/logic/ranging.h"
#include "../src/logic/reset.h"
#include "../src/logic/ring.h"
#include "../src/logic/wheel.h"

namespace {

constexpr uint16_t kRxCapacity = 64;
constexpr uint16_t kTxCapacity = 256;
constexpr uint8_t kMostDamaged = 2 * frame::kMaxWire + 1;

// The inputs and outputs of one iteration of the loop. tests/support/compiled_board.py has the same layout.
struct Turn {
  uint32_t t_ms;
  uint16_t rx_count, tx_room;
  int32_t wheel_ticks;
  int16_t yaw_rate;
  uint16_t ranges[3], battery_v, sensor_faults;
  uint16_t servo_us, motor_us;  // from here on: out
  uint16_t tx_count, tx_frames, limits_kept;
  uint8_t limits[protocol::Limits::kBytes];
  uint8_t tx[kTxCapacity];
};

class HostPort : public Port {
 public:
  void begin(Turn& turn, const uint8_t* rx) {
    turn_ = &turn;
    overflow_ = turn.rx_count > kRxCapacity;
    for (uint16_t i = 0; i < turn.rx_count; ++i) received_.put(rx[i]);
    turn.tx_count = turn.tx_frames = turn.limits_kept = 0;
  }

  bool receive(uint8_t& byte) override { return received_.take(byte); }
  bool take_rx_overflow() override { return overflow_; }
  uint16_t sensor_faults() override { return turn_->sensor_faults; }

  uint8_t transmit_room() override {
    const uint16_t room = turn_->tx_room - turn_->tx_count;
    return room > 255 ? 255 : static_cast<uint8_t>(room);
  }

  void transmit(const uint8_t* bytes, uint8_t count) override {
    memcpy(turn_->tx + turn_->tx_count, bytes, count);
    turn_->tx_count += count;
    ++turn_->tx_frames;
  }

  void set_pulses(uint16_t servo_us, uint16_t motor_us) override {
    turn_->servo_us = servo_us;
    turn_->motor_us = motor_us;
  }

  SensorReadings read_sensors() override {
    const Turn& turn = *turn_;
    return {turn.wheel_ticks, turn.yaw_rate, {turn.ranges[0], turn.ranges[1], turn.ranges[2]}, turn.battery_v};
  }

  void keep_limits(const uint8_t* payload) override {
    memcpy(turn_->limits, payload, protocol::Limits::kBytes);
    ++turn_->limits_kept;
  }

 private:
  Turn* turn_ = nullptr;
  Ring<kRxCapacity> received_;
  bool overflow_ = false;
};

// Random numbers (xorshift64*, S. Vigna 2016).
class Random {
 public:
  explicit Random(uint64_t seed) : state_(seed) {}
  uint32_t below(uint32_t end) {
    state_ ^= state_ >> 12;
    state_ ^= state_ << 25;
    state_ ^= state_ >> 27;
    return static_cast<uint32_t>((state_ * 0x2545F4914F6CDD1DULL >> 32) * end >> 32);
  }

 private:
  uint64_t state_;
};

// Whether a decoder that was idle takes anything from these bytes and a zero behind them.
bool is_taken(const uint8_t* bytes, uint8_t count) {
  frame::Decoder decoder;
  bool taken = false;
  for (uint8_t i = 0; i < count; ++i) taken |= decoder.push(bytes[i]);
  return taken | decoder.push(0);
}

struct HostBoard {
  HostBoard(uint16_t boot_id, uint8_t cause, const uint8_t* limits) : board(port, boot_id, cause, limits) {}
  HostPort port;
  Board board;
};

}  // namespace

extern "C" {

HostBoard* board_new(uint16_t boot_id, uint8_t reset_cause, const uint8_t* limits) {
  return new HostBoard(boot_id, reset_cause, limits);
}

void board_delete(HostBoard* board) {
  delete board;
}

void board_turn(HostBoard* board, Turn* turn, const uint8_t* rx) {
  board->port.begin(*turn, rx);
  board->board.loop(turn->t_ms);
}

// Each of `count` commands in the same armed state at `t_ms`; its fault and the pulses of the next servo frame.
void sweep_commands(const uint8_t* limits, const uint8_t* payloads, const uint8_t* counters, uint32_t count,
                    uint32_t t_ms, uint16_t* faults, uint16_t* servo_us, uint16_t* motor_us) {
  Logic armed(1, protocol::Limits::read(limits));
  armed.on_arm(protocol::Arm{1, 1}, 0, t_ms);
  for (uint32_t i = 0; i < count; ++i) {
    Logic logic = armed;
    logic.on_command(protocol::Command::read(payloads + i * protocol::Command::kBytes), counters[i], t_ms);
    logic.pulses().frame();
    faults[i] = logic.take_faults();
    servo_us[i] = logic.pulses().servo_us();
    motor_us[i] = logic.pulses().motor_us();
  }
}

// Which of `count` limits are valid.
void sweep_limits(const uint8_t* payloads, uint32_t count, uint8_t* fit) {
  for (uint32_t i = 0; i < count; ++i)
    fit[i] = limits_fit(protocol::Limits::read(payloads + i * protocol::Limits::kBytes));
}

// Whether the car stands after each of `count` readings of the wheel, 20 ms apart from 11 ms on.
void sweep_standstill(const int32_t* ticks, const uint8_t* drives, uint32_t count, uint8_t* stands) {
  Standstill standstill;
  for (uint32_t i = 0; i < count; ++i) stands[i] = standstill.step(ticks[i], drives[i], 11 + 20 * i);
}

// Feeds a stream; writes type, counter and payload of each accepted frame, one after the other, and counts the rejected
// ones.
uint32_t decode_stream(const uint8_t* bytes, uint32_t count, uint8_t* out, uint32_t* errors) {
  frame::Decoder decoder;
  uint32_t taken = 0;
  *errors = 0;
  for (uint32_t i = 0; i < count; ++i) {
    if (decoder.push(bytes[i])) {
      const uint8_t length = 2 + protocol::payload_bytes(decoder.type());
      *out++ = decoder.type();
      *out++ = decoder.counter();
      memcpy(out, decoder.payload(), length - 2);
      out += length - 2;
      ++taken;
    }
    *errors += decoder.take_error();
  }
  return taken;
}

// All errors of exactly `bits` bits (4 at most) of a frame on the wire, each followed by a zero: the number of trials,
// and of those that gave a frame.
void flip_bits(const uint8_t* wire, uint8_t length, uint8_t bits, uint32_t* tried, uint32_t* accepted) {
  const uint16_t total = length * 8;
  uint16_t at[4] = {0, 1, 2, 3};
  *tried = *accepted = 0;
  for (;;) {
    uint8_t damaged[32];
    memcpy(damaged, wire, length);
    for (uint8_t i = 0; i < bits; ++i) damaged[at[i] / 8] ^= static_cast<uint8_t>(1 << at[i] % 8);
    damaged[length] = 0;
    frame::Decoder decoder;
    for (uint8_t i = 0; i <= length; ++i) *accepted += decoder.push(damaged[i]);
    ++*tried;
    uint8_t moved = bits;
    while (moved > 0 && at[moved - 1] == total - bits + moved - 1) --moved;
    if (moved == 0) return;
    ++at[moved - 1];
    for (uint8_t i = moved; i < bits; ++i) at[i] = at[i - 1] + 1;
  }
}

// The beginning of one of `count` frames (`length` bytes each, without delimiters) with the end of another behind it, as
// where bytes are lost; `aligned`: the result has a frame's length. How many of `trials` were taken.
uint32_t splice(const uint8_t* frames, uint32_t count, uint8_t length, bool aligned, uint32_t trials, uint64_t seed) {
  Random random(seed);
  uint32_t accepted = 0;
  for (uint32_t trial = 0; trial < trials;) {
    const uint8_t* const first = frames + random.below(count) * length;
    const uint8_t* const second = frames + random.below(count) * length;
    const uint8_t end = 1 + random.below(length - 1);
    const uint8_t begin = aligned ? end : 1 + random.below(length - 1);
    uint8_t bytes[kMostDamaged];
    memcpy(bytes, first, end);
    memcpy(bytes + end, second + begin, length - begin);
    const uint8_t total = end + length - begin;
    if (total == length && (!memcmp(bytes, first, length) || !memcmp(bytes, second, length))) continue;
    accepted += is_taken(bytes, total);
    ++trial;
  }
  return accepted;
}

// `bits` different wrong bits anywhere in one of `count` frames (as above). How many of `trials` were taken.
uint32_t wrong_bits(const uint8_t* frames, uint32_t count, uint8_t length, uint8_t bits, uint32_t trials,
                    uint64_t seed) {
  Random random(seed);
  uint32_t accepted = 0;
  for (uint32_t trial = 0; trial < trials; ++trial) {
    const uint8_t* const right = frames + random.below(count) * length;
    uint8_t bytes[kMostDamaged];
    memcpy(bytes, right, length);
    for (uint8_t wrong = 0; wrong < bits;) {
      const uint16_t at = random.below(length * 8);
      const uint8_t bit = 1 << at % 8;
      if ((bytes[at / 8] ^ right[at / 8]) & bit) continue;
      bytes[at / 8] ^= bit;
      ++wrong;
    }
    accepted += is_taken(bytes, length);
  }
  return accepted;
}

uint8_t encode_frame(uint8_t type, uint8_t counter, const uint8_t* payload, uint8_t count, uint8_t* out) {
  return frame::encode(type, counter, payload, count, out);
}

uint16_t crc(const uint8_t* bytes, uint8_t count, uint16_t seed) {
  return crc16_dnp(bytes, count, seed);
}

uint8_t cause_of(uint8_t mcusr, uint8_t from_bootloader) {
  return reset_cause_of(mcusr, from_bootloader);
}

int8_t wheel_step(bool b_high) {
  return wheel_tick(b_high);
}

uint16_t kept_next_boot_id(const uint8_t* slots) {
  return kept::next_boot_id(slots);
}

uint8_t kept_slot(uint16_t boot_id, uint8_t* record) {
  kept::slot_record(boot_id, record);
  return kept::slot_of(boot_id);
}

void kept_record(const uint8_t* payload, uint8_t* record) {
  kept::limits_record(payload, record);
}

void kept_limits(const uint8_t* record, uint8_t* payload) {
  memcpy(payload, kept::limits_of(record), protocol::Limits::kBytes);
}

void battery_of(const uint16_t* readings, uint32_t count, uint16_t full_scale_mv, uint16_t* out) {
  Battery battery(full_scale_mv);
  for (uint32_t i = 0; i < count; ++i) {
    battery.take(readings[i]);
    out[i] = battery.millivolts();
  }
}

Ranging* ranging_new() {
  return new Ranging;
}
void ranging_delete(Ranging* ranging) {
  delete ranging;
}
uint8_t ranging_tick(Ranging* ranging, uint32_t t_ms, uint8_t pins) {
  return ranging->tick(t_ms, pins);
}
void ranging_edge(Ranging* ranging, uint8_t sensor, bool high, uint16_t at) {
  ranging->edge(sensor, high, at);
}
uint16_t ranging_range(Ranging* ranging, uint8_t sensor) {
  return ranging->range(sensor);
}

Gyro* gyro_new() {
  return new Gyro;
}
void gyro_delete(Gyro* gyro) {
  delete gyro;
}
int16_t gyro_yaw_rate(Gyro* gyro) {
  return gyro->yaw_rate();
}
bool gyro_failed(Gyro* gyro) {
  return gyro->failed();
}

// The bus's action in the low byte, the byte to send above it.
uint16_t gyro_tick(Gyro* gyro, uint32_t t_ms) {
  const TwiAction action = gyro->tick(t_ms);
  return static_cast<uint16_t>(static_cast<uint8_t>(action.what) | action.data << 8);
}

uint16_t gyro_status(Gyro* gyro, uint8_t status, uint8_t received) {
  const TwiAction action = gyro->on_status(status, received);
  return static_cast<uint16_t>(static_cast<uint8_t>(action.what) | action.data << 8);
}

}  // extern "C"
