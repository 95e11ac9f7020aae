// The board's program: the registers. The decisions are in ../logic.

#include <avr/interrupt.h>
#include <avr/wdt.h>

#include "../logic/board.h"
#include "battery_sensor.h"
#include "clock.h"
#include "servos.h"
#include "sonar.h"
#include "start.h"
#include "store.h"
#include "uart.h"
#include "wheel_sensor.h"
#include "yaw_sensor.h"

namespace {

class NanoPort : public Port {
 public:
  bool receive(uint8_t& byte) override { return uart::receive(byte); }
  bool take_rx_overflow() override { return uart::take_overflow(); }
  uint8_t transmit_room() override { return uart::transmit_room(); }
  void transmit(const uint8_t* bytes, uint8_t count) override { uart::transmit(bytes, count); }
  void set_pulses(uint16_t servo_us, uint16_t motor_us) override { servos::set(servo_us, motor_us); }
  uint16_t sensor_faults() override { return yaw_sensor::failed() ? protocol::fault::kGyroFailed : 0; }
  void keep_limits(const uint8_t* payload) override { store::keep_limits(payload); }

  SensorReadings read_sensors() override {
    SensorReadings readings;
    readings.wheel_ticks = wheel_sensor::ticks();
    readings.yaw_rate = yaw_sensor::yaw_rate();
    for (uint8_t i = 0; i < 3; ++i) readings.ranges[i] = sonar::range(i);
    readings.battery_v = battery_sensor::millivolts();
    return readings;
  }
};

void begin_sensors() {
  sonar::begin();
  wheel_sensor::begin();
  battery_sensor::begin();
  yaw_sensor::begin();
}

}  // namespace

int main() {
  wdt_enable(WDTO_60MS);
  const uint16_t boot_id = store::begin();
  NanoPort port;
  Board board(port, boot_id, start::reset_cause(), store::limits());
  begin_sensors();
  uart::begin();
  clock::begin();
  servos::begin();
  sei();
  uint32_t t_ms = 0;
  for (;;) {
    board.loop(t_ms);
    sonar::tick(t_ms);
    yaw_sensor::tick(t_ms);
    battery_sensor::tick();
    store::tick();
    wdt_reset();  // only here: a loop that is blocked for 60 ms restarts the board, which is straight and neutral
    t_ms = clock::wait_beyond(t_ms);
  }
}
