#include <nesam/fallback.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <utility>

#include "fallback_prediction.hpp"

namespace nesam {

namespace {

/// Entries of a state.
constexpr std::size_t state_size = 12;
constexpr double pi = 3.14159265358979323846;

/// The same angle in (-pi, pi].
double wrapped(double angle_rad) noexcept {
  double below_pi_rad = std::fmod(pi - angle_rad, 2.0 * pi);
  if (below_pi_rad < 0.0) below_pi_rad += 2.0 * pi;
  return pi - below_pi_rad;
}

/// What a fallback may answer instead of.
bool late(const Error& error) noexcept {
  return error.retryable() || error.code() == Code::deadline_exceeded;
}

}  // namespace

double KinematicFallback::yaw_rate_rad_s(double speed_m_s, double second) const noexcept {
  if (vehicle.second == SecondCommand::yaw_rate_rad_s) return second;
  const double angle_rad = vehicle.second == SecondCommand::steering_normalised ? second * vehicle.road_wheel_angle_max_rad : second;
  return speed_m_s * std::tan(angle_rad) / vehicle.wheelbase_m;
}

std::vector<float> KinematicFallback::rollout(const VehicleState& start, View3<const float> controls) const {
  std::vector<float> states;
  states.reserve(controls.samples() * controls.steps() * state_size);
  for (std::size_t n = 0; n < controls.samples(); ++n) {
    double x_m = start.position_m[0], y_m = start.position_m[1], yaw_rad = start.attitude_rad[2];
    for (std::size_t k = 0; k < controls.steps(); ++k) {
      const double speed_m_s = controls(n, k, 0);
      const double rate_rad_s = yaw_rate_rad_s(speed_m_s, controls(n, k, 1));
      const double half_turn_rad = 0.5 * rate_rad_s * dt_s;
      // Exact for an arc: the chord is speed dt sin(h) / h with h = half of the turned angle.
      const double chord_m = speed_m_s * dt_s * (half_turn_rad == 0.0 ? 1.0 : std::sin(half_turn_rad) / half_turn_rad);
      x_m += chord_m * std::cos(yaw_rad + half_turn_rad);
      y_m += chord_m * std::sin(yaw_rad + half_turn_rad);
      yaw_rad += rate_rad_s * dt_s;
      const std::array<double, state_size> state = {x_m, y_m, start.position_m[2], start.attitude_rad[0], start.attitude_rad[1], wrapped(yaw_rad),
                                                    speed_m_s, 0.0, 0.0, 0.0, 0.0, rate_rad_s};
      for (const double value : state) states.push_back(static_cast<float>(value));
    }
  }
  return states;
}

namespace detail {

std::optional<Prediction> fallback_prediction(const PredictRequest& request, const std::optional<VehicleState>& known, const Error& reason) {
  const std::optional<VehicleState>& start = request.start ? request.start : known;
  if (!request.fallback || !start || !late(reason)) return std::nullopt;
  View3<const float> controls = request.controls;
  if (request.drawing) controls = {request.drawing->nominal, 1, request.drawing->nominal.size() / 2, 2};
  const std::uint32_t channels = request.channels == 0 ? all_channels : request.channels & all_channels;
  if (controls.empty() || channels == 0) return std::nullopt;
  const std::size_t stride = std::max<std::size_t>(1, request.stride);
  Prediction prediction;
  prediction.tag = request.tag;
  prediction.samples = controls.samples();
  prediction.steps = controls.steps() / stride;
  prediction.channels = channels;
  prediction.validity.assign(prediction.samples, 0);
  prediction.start = *start;
  constexpr double unknown = std::numeric_limits<double>::quiet_NaN();
  prediction.soil = {unknown, unknown, unknown, unknown, unknown, unknown};
  prediction.computed_by = ComputedBy::kinematic_fallback;
  prediction.fallback_reason = reason;
  const std::vector<float> all = request.fallback->rollout(*start, controls);
  prediction.states_storage.reserve(prediction.samples * prediction.steps * prediction.channel_count());
  for (std::size_t n = 0; n < prediction.samples; ++n) {
    for (std::size_t k = stride - 1; k < controls.steps(); k += stride) {
      for (std::size_t channel = 0; channel < state_size; ++channel) {
        if ((channels >> channel & 1) != 0) prediction.states_storage.push_back(all[(n * controls.steps() + k) * state_size + channel]);
      }
    }
  }
  return prediction;
}

}  // namespace detail
}  // namespace nesam
