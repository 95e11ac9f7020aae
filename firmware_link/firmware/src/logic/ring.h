// Bytes from an interrupt to the main loop or back: one side writes, the other reads, neither waits or locks.
#pragma once

#include <stdint.h>

template <uint8_t kCapacity>
class Ring {
  static_assert(kCapacity > 0 && kCapacity <= 128 && (kCapacity & (kCapacity - 1)) == 0,
                "counts of 8 bits wrap around as they must with powers of two up to 128");

 public:
  // False if the ring is full: the byte is lost.
  bool put(uint8_t byte) {
    const uint8_t in = in_;
    if (static_cast<uint8_t>(in - out_) == kCapacity) return false;
    bytes_[in % kCapacity] = byte;
    in_ = in + 1;  // only now may the other side read it
    return true;
  }

  // False if the ring is empty.
  bool take(uint8_t& byte) {
    const uint8_t out = out_;
    if (out == in_) return false;
    byte = bytes_[out % kCapacity];
    out_ = out + 1;
    return true;
  }

  uint8_t room() const { return kCapacity - static_cast<uint8_t>(in_ - out_); }

 private:
  // A single byte is read and written whole on any processor, so that no lock is needed. Volatile also keeps the order.
  volatile uint8_t bytes_[kCapacity];
  volatile uint8_t in_ = 0;
  volatile uint8_t out_ = 0;
};
