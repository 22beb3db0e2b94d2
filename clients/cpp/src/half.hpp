#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

namespace nesam::detail {

/// The number that an IEEE 754 binary16 stands for; every one of them is a binary32 too, so nothing is rounded.
inline float from_half(std::uint16_t bits) noexcept {
  const int exponent = bits >> 10 & 0x1f;
  const int fraction = bits & 0x3ff;
  float size = 0.0F;
  if (exponent == 0x1f) {
    size = fraction == 0 ? std::numeric_limits<float>::infinity() : std::numeric_limits<float>::quiet_NaN();
  } else if (exponent == 0) {
    // Below the normal numbers: multiples of 2^-24.
    size = std::ldexp(static_cast<float>(fraction), -24);
  } else {
    size = std::ldexp(static_cast<float>(0x400 + fraction), exponent - 25);
  }
  return (bits & 0x8000) != 0 ? -size : size;
}

/// The values of packed little-endian binary16; a left-over byte is ignored.
inline std::vector<float> unpack_half(const std::string& bytes) {
  std::vector<float> values(bytes.size() / 2);
  for (std::size_t i = 0; i < values.size(); ++i) {
    const auto low = static_cast<unsigned char>(bytes[2 * i]), high = static_cast<unsigned char>(bytes[2 * i + 1]);
    values[i] = from_half(static_cast<std::uint16_t>(high << 8 | low));
  }
  return values;
}

}  // namespace nesam::detail
