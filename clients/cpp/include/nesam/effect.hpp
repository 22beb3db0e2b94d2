#pragma once

#include <string>
#include <vector>

namespace nesam {

/// One parameter of an effect.
struct EffectParameter {
  /// Name as in the catalogue, for instance `second`.
  std::string name;
  /// Value in the unit of the catalogue, within its range.
  double value = 0.0;
  /// Standard deviation of the value, same unit; 0 = taken as exact. The soil filter expects innovations larger by what the value may be wrong.
  double sd = 0.0;
};

/// A physical effect of the catalogue (docs/effects.md) that acts on top of the vehicle card.
struct Effect {
  /// Id, for instance `steering_offset`.
  std::string id;
  /// All of its parameters, in any order.
  std::vector<EffectParameter> parameters;
};

}  // namespace nesam
