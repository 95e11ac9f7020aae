#include "battery_sensor.h"

#include <avr/io.h>

#include "../logic/battery.h"
#include "config.h"

namespace {

constexpr uint8_t kChannel = 6;
constexpr uint8_t kSettleMs = 8;  // of the reference, which charges the capacitor at AREF

Battery battery(config::kBatteryFullScaleMv);
uint8_t conversions = 0;

}  // namespace

namespace battery_sensor {

void begin() {
  ADMUX = 1 << REFS1 | 1 << REFS0 | kChannel;  // 1.1 V
  ADCSRA = 1 << ADEN | 1 << ADSC | 1 << ADPS2 | 1 << ADPS1 | 1 << ADPS0;  // 125 kHz: 0.1 ms a conversion
}

void tick() {
  if (ADCSRA & 1 << ADSC) return;
  const uint16_t reading = ADC;
  if (conversions < kSettleMs) {
    ++conversions;
  } else {
    battery.take(reading);
  }
  ADCSRA |= 1 << ADSC;
}

uint16_t millivolts() {
  return battery.millivolts();
}

}  // namespace battery_sensor
