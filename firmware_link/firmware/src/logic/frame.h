// Frames on the serial line: 00, COBS(type, counter, payload), check, 00. The check is described in
// firmware_link/framing.py.
#pragma once

#include <stdint.h>

namespace frame {

constexpr uint8_t kMaxPayload = 14;
constexpr uint8_t kMaxBody = 2 + kMaxPayload;  // type, counter, payload
constexpr uint8_t kCheckBytes = 5;
constexpr uint8_t kMaxChunk = kMaxBody + 1 + kCheckBytes;  // between two zeros
constexpr uint8_t kMaxWire = kMaxChunk + 2;

// Writes a frame of `payload` (`count` bytes, kMaxPayload at most) to `out` (kMaxWire bytes); its length.
uint8_t encode(uint8_t type, uint8_t counter, const uint8_t* payload, uint8_t count, uint8_t* out);

// Bytes in, frames to the board out. Needs the memory of one frame; damaged frames are rejected.
class Decoder {
 public:
  // Processes a byte; true if it completes a valid frame, which can be read until the next call.
  bool push(uint8_t byte);

  // Whether a frame was rejected since the last call.
  bool take_error();

  uint8_t type() const { return bytes_[0]; }
  uint8_t counter() const { return bytes_[1]; }
  const uint8_t* payload() const { return bytes_ + 2; }

 private:
  bool good();

  uint8_t bytes_[kMaxChunk];
  uint8_t count_ = 0;  // kMaxChunk + 1: already too long
  bool error_ = false;
};

}  // namespace frame
