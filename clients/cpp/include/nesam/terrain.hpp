#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>

#include <nesam/span.hpp>

namespace nesam {

/// Where the pixels of a map lie: pixel (row, column) at `origin_m + resolution_m * (column, row)` in World. Row 0 is the southernmost, column 0 the westernmost.
struct MapGeometry {
  /// World position of pixel (0, 0), m.
  std::array<double, 2> origin_m{};
  /// Distance between neighbouring pixels, m.
  double resolution_m = 0.0;
  /// Number of columns and of rows, at least 2 each.
  std::uint32_t width = 0;
  std::uint32_t height = 0;
};

/// A map to upload. The layers are only read during the call.
struct Map {
  /// 1 to 64 of A-Z a-z 0-9 _ . -
  std::string id;
  /// At least 1, and above the version that the service holds.
  std::uint64_t version = 1;
  MapGeometry geometry;
  /// Shape (height, width), row-major: elevation in World, m; NaN = hole.
  Span<const float> elevation_m;
  /// Shape (height, width, 3), row-major: red, green, blue of the semantic map. Empty = no colours: the soil prior is the stated default.
  Span<const std::uint8_t> semantic_rgb;
  /// Instant that the map was made at, ns of the vehicle's clock; absent = not told. Carried for those who read the map, nothing is computed from it.
  std::optional<std::int64_t> stamp_ns{};
  /// Frame that the source of the map names, at most 64 bytes; empty = World. Carried in the same way.
  std::string frame{};
};

/// A rectangle of pixels to put into a map. The layers are only read during the call.
struct MapTile {
  /// South-west pixel.
  std::uint32_t row = 0;
  std::uint32_t column = 0;
  /// Size in pixels.
  std::uint32_t rows = 0;
  std::uint32_t columns = 0;
  /// Shape (rows, columns), row-major: elevation in World, m; NaN = hole.
  Span<const float> elevation_m;
  /// Shape (rows, columns, 3), row-major: red, green, blue of the semantic map. Empty = the colours stay.
  Span<const std::uint8_t> semantic_rgb;
};

/// A map without its layers.
struct MapDescription {
  std::string id;
  std::uint64_t version = 0;
  /// SHA-256 (hex) of the layers.
  std::string hash;
  MapGeometry geometry;
  /// Whether the map has colours.
  bool semantic = false;
  /// As `Map::stamp_ns` and `Map::frame`.
  std::optional<std::int64_t> stamp_ns{};
  std::string frame{};
};

}  // namespace nesam
