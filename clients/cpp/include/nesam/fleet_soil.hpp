#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include <nesam/types.hpp>

namespace nesam {

/// Evidence on the correction of the soil prior in one cell, in the coordinates of `SoilCorrection`: information matrix and vector, without any prior.
struct FleetSoilCell {
  /// World map.
  std::string map_id;
  /// Colour of the semantic map, 0xRRGGBB, in steps of 16 levels.
  std::uint32_t colour_rgb = 0;
  /// floor(x / cell) and floor(y / cell) in World.
  std::int32_t column = 0;
  std::int32_t row = 0;
  /// Inverse of a covariance, in the order of `SoilVector`: symmetric positive semi-definite.
  std::array<std::array<double, 6>, 6> information{};
  /// Information times mean.
  SoilVector vector;
  /// Buffers of a filter that went in, aged to the last one.
  double buffers = 0.0;
  /// Time since the last one, s; until now the evidence ages on.
  double age_s = 0.0;
};

/// Evidence of the soil by place and by what the ground looks like, brought by the sessions of a service. A session that begins on such ground starts from it.
struct FleetSoilMap {
  /// Edge of a cell, m.
  double cell_m = 0.0;
  /// By map, colour and place.
  std::vector<FleetSoilCell> cells;
};

}  // namespace nesam
