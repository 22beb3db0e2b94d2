#pragma once

#include <array>
#include <optional>

#include <nesam/array.hpp>
#include <nesam/span.hpp>

namespace nesam {

/// What to compute beyond the states; what is not asked for costs nothing. Not together with `PredictRequest::cost`.
///
/// `PredictRequest::stride` picks the steps of what is returned, `PredictRequest::channels` does not apply to it. The limits are those of the server's
/// configuration, here with their defaults. Errors name the field below `extras`, for example `extras.jacobians`.
struct Extras {
  /// Derivatives of every state in start, commands and soil correction. At most 8 samples, not together with what-if soils.
  bool jacobians = false;
  /// Covariance of every state. At most 64 samples, not together with what-if soils. FAILED_PRECONDITION when the bundle does not know its errors.
  bool covariance = false;
  /// Covariance of the start, shape (12, 12), symmetric positive semi-definite, units of the state squared; empty = that of a measured state as the bundle
  /// knows it. Only with `covariance`. Only read during the call.
  Span<const float> start_covariance;
  /// Wheel loads, wheel slips, load transfer and traction reserve of every step.
  bool risk = false;
  /// What-if soils, shape (S, 6), 1 to 16 of them: corrections that are added to the session's, in its coordinates and in the order of `SoilVector`; empty =
  /// none. Each makes a group of N trajectories: see `Prediction::row`. Only read during the call.
  Span<const float> soil_deltas;
  /// Instead: thirteen groups for the sigma points of what the session knows of the soil. First the estimate, then estimate plus and minus sqrt(6) times each
  /// column of the lower Cholesky factor of its covariance in turn (+1, -1, +2, -2, ...): mean and covariance over the last twelve, equally weighted, are those of the unscented transform.
  bool soil_sigma_points = false;
  /// Encodes the terrain at every predicted pose instead of interpolating on the pose grid. At most 16 samples, not together with what-if soils.
  bool exact_terrain = false;
  /// Says how far that moves the first candidate. Not together with `exact_terrain`.
  bool interpolation_deviation = false;
};

/// What was computed beyond the states; empty or absent where it was not asked for.
///
/// States are x y z roll pitch yaw vx vy vz wx wy wz: m and rad in World, m/s and rad/s in Body. Wheels are front left, front right, rear left, rear right.
/// `steps` are those of `Prediction::states`, `rows` too: one for each sample, or with what-if soils for each soil and sample.
struct ExtraOutputs {
  /// Derivative of each state in the measured or given one, before any rolling forward: shape (samples, steps, 12, 12), entry (n, k, i, j) = d state i / d start j.
  /// Here and below the terrain is held as the rollout met it, and numbers after a state that is not finite are NaN.
  Array<float, 4> jacobian_start;
  /// In the commands: shape (samples, steps, 12, K, 2), entry (n, k, i, j, c) = d state i / d command c of step j. Zero for commands that come later.
  Array<float, 5> jacobian_controls;
  /// In the session's soil correction, in its coordinates and in the order of `SoilVector`: shape (samples, steps, 12, 6).
  Array<float, 4> jacobian_soil;
  /// Covariance of what would be measured, units of the state squared: shape (samples, steps, 12, 12). Start and soil through the derivatives, plus the errors
  /// of the model that were calibrated for the bundle.
  Array<float, 4> covariance;
  /// 90 % of the measured (x, y) lie where d' P^-1 d is at most this: d their distance from the predicted ones, P the 2 x 2 block of `covariance`.
  /// Not without a map or off it (`validity_no_map`, `validity_off_map`).
  std::optional<double> region_90_planar;
  /// The same for x, y, z, roll, pitch and yaw alone: d^2 / variance is at most this.
  std::optional<std::array<double, 6>> region_90_single;
  /// Loads of the wheels, N: shape (rows, steps, 4).
  Array<float, 3> wheel_load_n;
  /// Slips of the wheels, -1 (locked) to 1 (spinning on the spot): shape (rows, steps, 4).
  Array<float, 3> wheel_slip;
  /// |left - right| over the sum of the wheel loads, 0 even, 1 one side carries nothing: shape (rows, steps).
  Array<float, 2> load_transfer_ratio;
  /// Drawbar pull that the wheels could give at a slip of 0.8 less what the slope asks for in the direction of the speed command, over the weight: below 0 the
  /// vehicle gets stuck, or does not start. Shape (rows, steps).
  Array<float, 2> traction_reserve;
  /// Horizontal distance between the first candidate and the same one with the terrain encoded at every pose, mean over the horizon, m. Absent also without a
  /// map, where nothing is interpolated.
  std::optional<double> interpolation_deviation_m;
};

}  // namespace nesam
