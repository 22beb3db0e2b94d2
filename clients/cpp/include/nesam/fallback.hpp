#pragma once

#include <vector>

#include <nesam/span.hpp>
#include <nesam/types.hpp>

namespace nesam {

/// A declared fallback for planners that must have an answer: flat-ground kinematics of a vehicle card.
///
/// The commanded speed is reached at once, a bicycle turns with tan(angle) / wheelbase, a skid-steer vehicle with the commanded yaw rate. It knows no terrain, soil
/// or slip; height, roll and pitch stay those of the start. It answers only where a caller puts it into `PredictRequest::fallback` or
/// `MotionModelOptions::fallback`, and the prediction says so in `Prediction::computed_by`. What the service would refuse it does not answer: a number that is none, a command beyond the card,
/// a shape, start or cost beyond the limits.
struct KinematicFallback {
  /// Vehicle card, as `Session::vehicle` has it.
  VehicleCard vehicle;
  /// Step, s.
  double dt_s = step_s;

  /// Yaw rate that a command means.
  double yaw_rate_rad_s(double speed_m_s, double second) const noexcept;

  /// States, row-major (samples, horizon, 12), from a start and controls (samples, horizon, 2).
  std::vector<float> rollout(const VehicleState& start, View3<const float> controls) const;
};

}  // namespace nesam
