#include <nesam/fallback.hpp>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <utility>

#include "fallback_prediction.hpp"
#include "refused.hpp"

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

/// The state one step after another at a speed and a yaw rate.
VehicleState stepped(const VehicleState& from, double speed_m_s, double rate_rad_s, double dt_s) noexcept {
  const double half_turn_rad = 0.5 * rate_rad_s * dt_s;
  // Exact for an arc: the chord is speed dt sin(h) / h with h = half of the turned angle.
  const double chord_m = speed_m_s * dt_s * (half_turn_rad == 0.0 ? 1.0 : std::sin(half_turn_rad) / half_turn_rad);
  const double yaw_rad = from.attitude_rad[2];
  VehicleState state = from;
  state.position_m[0] += chord_m * std::cos(yaw_rad + half_turn_rad);
  state.position_m[1] += chord_m * std::sin(yaw_rad + half_turn_rad);
  state.attitude_rad[2] = wrapped(yaw_rad + rate_rad_s * dt_s);
  state.velocity_m_s = {speed_m_s, 0.0, 0.0};
  state.angular_velocity_rad_s = {0.0, 0.0, rate_rad_s};
  return state;
}

/// Steps between two instants, with their fractions.
double steps_between(const KinematicFallback& fallback, std::int64_t from_ns, std::int64_t until_ns) noexcept {
  // Whole seconds apart from the rest: a double does not hold the nanoseconds since 1970.
  constexpr std::int64_t second_ns = 1'000'000'000;
  const double apart_s = static_cast<double>(until_ns / second_ns - from_ns / second_ns);
  const double apart_ns = apart_s * 1e9 + static_cast<double>(until_ns % second_ns - from_ns % second_ns);
  return apart_ns / (fallback.dt_s * 1e9);
}

/// The same, rounded to the nearest step.
double whole_steps_between(const KinematicFallback& fallback, std::int64_t from_ns, std::int64_t until_ns) noexcept {
  return std::floor(steps_between(fallback, from_ns, until_ns) + 0.5);
}

/// A known state rolled forward to an instant, rounded to the nearest step; absent where it lies too far after the measurement, and itself where it is earlier. Each
/// step uses the command that is in effect at its middle; before the first of them the vehicle goes on as it moves.
std::optional<detail::KnownState> rolled_forward(const KinematicFallback& fallback, const detail::KnownState& known, std::int64_t until_ns,
                                                 Span<const SentCommand> sent) {
  if (!known.stamp_ns) return known;
  const std::int64_t known_ns = *known.stamp_ns;
  const double steps = std::max(0.0, whole_steps_between(fallback, known_ns, until_ns));
  if (!(known.rolled_forward_steps + steps <= horizon_max)) return std::nullopt;
  detail::KnownState start = known;
  for (std::uint32_t k = 0; k < static_cast<std::uint32_t>(steps); ++k) {
    VehicleState& state = start.state;
    double speed_m_s = state.velocity_m_s[0], rate_rad_s = state.angular_velocity_rad_s[2];
    for (const SentCommand& command : sent) {
      if (steps_between(fallback, known_ns, command.stamp_ns) > k + 0.5) break;
      speed_m_s = command.command.speed_m_s;
      rate_rad_s = fallback.yaw_rate_rad_s(speed_m_s, command.command.second);
    }
    state = stepped(state, speed_m_s, rate_rad_s, fallback.dt_s);
  }
  start.stamp_ns = known_ns + static_cast<std::int64_t>(std::llround(steps * fallback.dt_s * 1e9));
  start.rolled_forward_steps += static_cast<std::uint32_t>(steps);
  return start;
}

/// Whether a state that the service rolled forward serves where a prediction from an instant begins: it is no measurement, so not where it is later than the instant
/// or a newer measurement is known.
bool serves(const KinematicFallback& fallback, const detail::Known& known, std::int64_t until_ns) noexcept {
  if (!known.ahead || !known.ahead->stamp_ns) return false;
  if (whole_steps_between(fallback, *known.ahead->stamp_ns, until_ns) < 0.0) return false;
  if (!known.measured || !known.measured->stamp_ns) return true;
  return std::llround(steps_between(fallback, *known.measured->stamp_ns, *known.ahead->stamp_ns) * 1e6) >=
         static_cast<long long>(known.ahead->rolled_forward_steps) * 1'000'000;
}

/// Where the fallback of a request begins. Without an instant that is the measured state.
std::optional<detail::KnownState> start_of(const PredictRequest& request, const detail::Known& known) {
  if (request.start) return detail::KnownState{*request.start, std::nullopt};
  const auto& newest = known.measured ? known.measured : known.ahead;
  if (!request.start_stamp_ns) return newest;
  const auto& begin = serves(*request.fallback, known, *request.start_stamp_ns) ? known.ahead : known.measured;
  if (!begin) return std::nullopt;
  return rolled_forward(*request.fallback, *begin, *request.start_stamp_ns, request.sent);
}

/// Whether the service would take a command: finite and within the card's range, compared in single precision, so that the ends of the range are admitted in both.
bool admitted(const VehicleCard& card, float speed_m_s, float second) noexcept {
  const auto within = [](float value, double low, double high) { return value >= static_cast<float>(low) && value <= static_cast<float>(high); };
  return within(speed_m_s, card.speed_min_m_s, card.speed_max_m_s) && within(second, card.second_min, card.second_max);
}

/// Whether the service would take all commands of a request.
bool admitted(const PredictRequest& request, const View3<const float>& controls) noexcept {
  const VehicleCard& card = request.fallback->vehicle;
  for (std::size_t n = 0; n < controls.samples(); ++n) {
    for (std::size_t k = 0; k < controls.steps(); ++k) {
      if (!admitted(card, controls(n, k, 0), controls(n, k, 1))) return false;
    }
  }
  for (const SentCommand& sent : request.sent) {
    if (!admitted(card, static_cast<float>(sent.command.speed_m_s), static_cast<float>(sent.command.second))) return false;
  }
  return true;
}

/// Whether a fallback may answer instead: the service is late, overloaded or away, or what it knows of the session is too old to be rolled forward.
bool late(const Error& error) noexcept {
  const bool knows_nothing_new = error.code() == Code::failed_precondition && error.field() == "start_stamp_ns";
  return error.retryable() || error.code() == Code::deadline_exceeded || knows_nothing_new;
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
    VehicleState state = start;
    for (std::size_t k = 0; k < controls.steps(); ++k) {
      const double speed_m_s = controls(n, k, 0);
      state = stepped(state, speed_m_s, yaw_rate_rad_s(speed_m_s, controls(n, k, 1)), dt_s);
      for (const auto* part : {&state.position_m, &state.attitude_rad, &state.velocity_m_s, &state.angular_velocity_rad_s}) {
        for (const double value : *part) states.push_back(static_cast<float>(value));
      }
    }
  }
  return states;
}

namespace detail {

std::optional<Prediction> fallback_prediction(const PredictRequest& request, const Known& known, const Error& reason) {
  if (!request.fallback || !late(reason) || !takes(request)) return std::nullopt;
  const std::optional<KnownState> start = start_of(request, known);
  if (!start) return std::nullopt;
  View3<const float> controls = request.controls;
  if (request.drawing) controls = {request.drawing->nominal, 1, request.drawing->nominal.size() / 2, 2};
  const std::uint32_t channels = request.channels == 0 ? all_channels : request.channels & all_channels;
  if (controls.empty() || channels == 0 || !admitted(request, controls)) return std::nullopt;
  const std::size_t stride = std::max<std::size_t>(1, request.stride);
  Prediction prediction;
  prediction.tag = request.tag;
  prediction.samples = controls.samples();
  prediction.steps = controls.steps() / stride;
  prediction.channels = channels;
  prediction.validity.assign(prediction.samples, 0);
  prediction.start = start->state;
  prediction.start_stamp_ns = start->stamp_ns;
  prediction.rolled_forward_steps = start->rolled_forward_steps;
  if (request.drawing) prediction.drawn_storage.assign(request.drawing->nominal.begin(), request.drawing->nominal.end());
  constexpr double unknown = std::numeric_limits<double>::quiet_NaN();
  prediction.soil = {unknown, unknown, unknown, unknown, unknown, unknown};
  prediction.computed_by = ComputedBy::kinematic_fallback;
  prediction.fallback_reason = reason;
  const std::vector<float> all = request.fallback->rollout(prediction.start, controls);
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
