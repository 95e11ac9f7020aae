#include "yaw_sensor.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "../logic/gyro.h"

namespace {

constexpr uint8_t kBitRate = (F_CPU / 400000 - 16) / 2;
constexpr uint8_t kClock = 1 << PC5;
constexpr uint8_t kWires = 1 << PC4 | kClock;
constexpr uint8_t kGo = 1 << TWINT | 1 << TWEN | 1 << TWIE;

Gyro gyro;

void act(const TwiAction& action) {
  switch (action.what) {
    case Twi::kNothing:
      return;
    case Twi::kStart:
      TWCR = kGo | 1 << TWSTA;
      return;
    case Twi::kSend:
      TWDR = action.data;
      TWCR = kGo;
      return;
    case Twi::kReceive:
      TWCR = kGo | 1 << TWEA;
      return;
    case Twi::kReceiveLast:
      TWCR = kGo;
      return;
    case Twi::kStop:
      TWCR = 1 << TWINT | 1 << TWEN | 1 << TWSTO;
      return;
    case Twi::kOff:
      TWCR = 0;
      return;
    case Twi::kClockLow:
      PORTC &= ~kClock;
      DDRC |= kClock;
      return;
    case Twi::kClockHigh:
      DDRC &= ~kClock;
      PORTC |= kClock;
      return;
  }
}

}  // namespace

ISR(TWI_vect) {
  act(gyro.on_status(TWSR & 0xF8, TWDR));
}

namespace yaw_sensor {

void begin() {
  PORTC |= kWires;  // pull-ups: without a gyro the wires must not float
  TWBR = kBitRate;
}

void tick(uint32_t t_ms) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    act(gyro.tick(t_ms));
  }
}

int16_t yaw_rate() {
  return gyro.yaw_rate();
}

bool failed() {
  return gyro.failed();
}

}  // namespace yaw_sensor
