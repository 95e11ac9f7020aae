#include "uart.h"

#include <avr/interrupt.h>
#include <avr/io.h>

#include "../logic/ring.h"
#include "config.h"

#define BAUD_TOL 3  // 115200 is 2.1 % off at 16 MHz; the other end is usually exact
#include <util/setbaud.h>

namespace {

Ring<64> received;
Ring<128> to_send;
volatile bool overflow = false;

}  // namespace

ISR(USART_RX_vect) {
  if (UCSR0A & 1 << DOR0) overflow = true;  // before UDR0 is read, which clears it
  if (!received.put(UDR0)) overflow = true;
}

ISR(USART_UDRE_vect) {
  uint8_t byte;
  if (to_send.take(byte)) {
    UDR0 = byte;
  } else {
    UCSR0B &= ~(1 << UDRIE0);
  }
}

namespace uart {

void begin() {
  UBRR0 = UBRR_VALUE;
  UCSR0A = USE_2X << U2X0;
  UCSR0C = 1 << UCSZ01 | 1 << UCSZ00;  // 8 bits, no parity, 1 stop bit
  UCSR0B = 1 << RXCIE0 | 1 << RXEN0 | 1 << TXEN0;
}

bool receive(uint8_t& byte) {
  return received.take(byte);
}

bool take_overflow() {
  if (!overflow) return false;
  overflow = false;
  return true;
}

uint8_t transmit_room() {
  return to_send.room();
}

void transmit(const uint8_t* bytes, uint8_t count) {
  while (count--) to_send.put(*bytes++);
  const uint8_t status = SREG;
  cli();  // the interrupt clears the same bit
  UCSR0B |= 1 << UDRIE0;
  SREG = status;
}

}  // namespace uart
