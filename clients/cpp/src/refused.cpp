#include "refused.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <iterator>

namespace nesam::detail {

namespace {

constexpr double pi = 3.14159265358979323846;
constexpr std::size_t path_points_max = 1024;

bool within(double value, double low, double high) noexcept { return value >= low && value <= high; }

template <class Numbers>
bool up_to(const Numbers& numbers, double limit) noexcept {
  return std::all_of(numbers.begin(), numbers.end(), [limit](double value) { return std::abs(value) <= limit; });
}

/// Limits by default, which a service may be told otherwise; yaw may be unwrapped.
bool takes(const VehicleState& start) noexcept {
  const auto& [roll_rad, pitch_rad, yaw_rad] = start.attitude_rad;
  const bool upright = std::abs(roll_rad) <= pi + 1e-6 && std::abs(pitch_rad) <= pi + 1e-6 && std::abs(yaw_rad) <= 1e4;
  return upright && up_to(start.position_m, 1e6) && up_to(start.velocity_m_s, 100.0) && up_to(start.angular_velocity_rad_s, 50.0);
}

bool takes(const CandidateDrawing& drawing) noexcept {
  return within(drawing.speed_sd_m_s, 0.0, 1e6) && within(drawing.second_sd, 0.0, 1e6) && drawing.correlation >= 0.0 && drawing.correlation < 1.0;
}

/// Whether not all points are the same.
bool leads_somewhere(const Span<const float>& path_m) noexcept {
  for (std::size_t i = 2; i + 1 < path_m.size(); i += 2) {
    if (path_m[i] != path_m[0] || path_m[i + 1] != path_m[1]) return true;
  }
  return false;
}

bool takes(const PathCost& cost, std::size_t samples) noexcept {
  const std::size_t points = cost.path_m.size() / 2;
  const double weights[] = {cost.path_weight, cost.speed_weight, cost.tilt_weight, cost.speed_change_weight, cost.second_change_weight, cost.temperature};
  return cost.path_m.size() % 2 == 0 && points >= 2 && points <= path_points_max && leads_somewhere(cost.path_m) &&
         std::all_of(cost.path_m.begin(), cost.path_m.end(), [](float value) { return std::isfinite(value); }) &&
         std::all_of(std::begin(weights), std::end(weights), [](double weight) { return within(weight, 0.0, 1e12); }) && std::isfinite(cost.speed_m_s) &&
         cost.best <= samples;
}

bool any(const Extras& extras) noexcept {
  return extras.jacobians || extras.covariance || !extras.start_covariance.empty() || extras.risk || !extras.soil_deltas.empty() || extras.soil_sigma_points ||
         extras.exact_terrain || extras.interpolation_deviation;
}

}  // namespace

bool takes(const PredictRequest& request) noexcept {
  const std::size_t samples = request.drawing ? request.drawing->samples : request.controls.samples();
  const std::size_t horizon = request.drawing ? request.drawing->nominal.size() / 2 : request.controls.steps();
  if (samples == 0 || request.samples_min > samples || horizon == 0 || horizon > horizon_max || request.stride > horizon) return false;
  if (request.start && (request.start_stamp_ns || !takes(*request.start))) return false;
  if (!request.start_stamp_ns && !request.sent.empty()) return false;
  if (request.drawing && !takes(*request.drawing)) return false;
  return !request.cost || (!any(request.extras) && takes(*request.cost, samples));
}

}  // namespace nesam::detail
