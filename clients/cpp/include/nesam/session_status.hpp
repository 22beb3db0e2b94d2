#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include <nesam/alarm.hpp>
#include <nesam/effect.hpp>
#include <nesam/types.hpp>

namespace nesam {

/// Predictions of a session held against what was measured in the end, one every 3.2 s.
struct ForecastCheck {
  /// Comparisons so far.
  std::uint64_t checked = 0;
  /// Root mean square of the distance in (x, y) after 0.8, 1.6 and 3.2 s over about the last minute, m: as measured, and as bundle and soil filter expected it.
  std::vector<double> error_rms_m;
  std::vector<double> expected_rms_m;
  /// How many times the model's part of predicted covariances counts for it, 1 = as expected: of all but the height, and of the height.
  double scale = 1.0;
  double height_scale = 1.0;
};

/// A session as the service holds it.
struct SessionStatus {
  std::string session_id;
  std::string vehicle_id;
  Provenance provenance;
  VehicleCard vehicle;
  /// Measured steps in the history, the newest included: 0 to 32.
  std::uint32_t history_steps = 0;
  /// Stamp of the newest accepted measurement, ns of the vehicle's clock; absent before the first.
  std::optional<std::int64_t> last_stamp_ns;
  /// Highest accepted sequence number; absent when the vehicle numbers nothing.
  std::optional<std::uint64_t> last_sequence;
  /// State and command of the newest step of the history; absent before the first.
  std::optional<VehicleState> state;
  std::optional<Control> command;
  /// What was learned of the soil.
  SoilCorrection soil_correction;
  /// Start of the vehicle's software that feeds the session; absent when the vehicle does not tell.
  std::optional<std::uint64_t> boot_id;
  /// Whether the vehicle's Zenoh liveliness token is there; absent when the server takes no part in a Zenoh network.
  std::optional<bool> vehicle_alive;
  /// Measurements accepted so far: the highest `MeasurementAnswer::place`.
  std::uint64_t accepted = 0;
  /// How many of them survive a crash of the server and of its machine; 0 where the server keeps no store.
  std::uint64_t durable_place = 0;
  /// Which server in which run counts the places: those of different runs say nothing of each other.
  std::uint64_t run = 0;
  /// Effects that were applied to this session, on top of those of the bundle, and where they come from.
  std::vector<Effect> effects;
  std::string effects_source;
  /// The alarm that is active; absent when none is.
  std::optional<Alarm> alarm;
  /// How predictions came true; absent before the first comparison.
  std::optional<ForecastCheck> forecasts;
};

}  // namespace nesam
