#include <nesam/motion_model.hpp>

#include <algorithm>
#include <cmath>
#include <deque>
#include <limits>
#include <mutex>
#include <string>
#include <utility>

namespace nesam {

namespace {

/// Speed below which a steering angle says little of the yaw rate, m/s.
constexpr double slow_m_s = 0.3;
/// A little more than the 32 steps of the service.
constexpr std::int64_t roll_forward_ns = 3'300'000'000;
constexpr double pi = 3.14159265358979323846;

double wrapped(double angle_rad) noexcept { return std::remainder(angle_rad, 2.0 * pi); }

/// Planner's steps in one of the service; 0 = no whole number.
std::size_t fineness_of(double model_dt_s) noexcept {
  if (!(model_dt_s > 0.0) || model_dt_s > 1.5 * step_s) return 0;
  const double ratio = step_s / model_dt_s;
  return std::abs(ratio - std::round(ratio)) < 1e-4 ? static_cast<std::size_t>(std::lround(ratio)) : 0;
}

struct PlanarPose {
  double x_m, y_m, yaw_rad;
};

}  // namespace

Control command_from_twist(const VehicleCard& card, double speed_m_s, double yaw_rate_rad_s) noexcept {
  double second = yaw_rate_rad_s;
  if (card.second != SecondCommand::yaw_rate_rad_s) {
    const double speed = std::copysign(std::max(std::abs(speed_m_s), slow_m_s), speed_m_s);
    second = std::atan(card.wheelbase_m * yaw_rate_rad_s / speed);
    if (card.second == SecondCommand::steering_normalised && card.road_wheel_angle_max_rad > 0.0) second *= card.second_max / card.road_wheel_angle_max_rad;
  }
  return {std::clamp(speed_m_s, card.speed_min_m_s, card.speed_max_m_s), std::clamp(second, card.second_min, card.second_max)};
}

struct VelocityRollout::Sent {
  std::mutex mutex;
  /// By ascending stamp.
  std::deque<SentCommand> commands;

  /// Those that may matter to a prediction that begins at this instant.
  std::vector<SentCommand> before(std::int64_t start_ns) {
    const std::int64_t oldest_ns = std::max(start_ns, std::numeric_limits<std::int64_t>::min() + roll_forward_ns) - roll_forward_ns;
    const std::lock_guard lock(mutex);
    const auto first = std::find_if(commands.begin(), commands.end(), [&](const SentCommand& command) { return command.stamp_ns >= oldest_ns; });
    return {first, commands.end()};
  }
};

VelocityRollout::VelocityRollout(std::shared_ptr<const Session> session, MotionModelOptions options)
    : session_(std::move(session)), options_(std::move(options)), fineness_(fineness_of(options_.model_dt_s)), sent_(std::make_shared<Sent>()) {
  if (fineness_ == 0) {
    throw Error(Code::invalid_argument, "model_dt_s", "`model_dt_s`: " + std::to_string(options_.model_dt_s) + " s, must be 0.1 s or a whole fraction of it");
  }
  if (!(options_.age_max_s >= 0.0 && options_.age_max_s <= (horizon_max - 1) * step_s)) {
    throw Error(Code::invalid_argument, "age_max_s", "`age_max_s`: " + std::to_string(options_.age_max_s) + " s, allowed is 0 to 3.1 s");
  }
}

void VelocityRollout::sent(std::int64_t stamp_ns, double speed_m_s, double yaw_rate_rad_s) {
  if (!std::isfinite(speed_m_s) || !std::isfinite(yaw_rate_rad_s)) return;
  const SentCommand command{stamp_ns, command_from_twist(session_->vehicle(), speed_m_s, yaw_rate_rad_s)};
  const std::lock_guard lock(sent_->mutex);
  auto& commands = sent_->commands;
  // A clock that was set back.
  while (!commands.empty() && commands.back().stamp_ns >= stamp_ns) commands.pop_back();
  commands.push_back(command);
  if (commands.size() > sent_max) commands.pop_front();
}

std::size_t VelocityRollout::steps_for(std::size_t time) const noexcept {
  std::size_t steps_max = horizon_max;
  if (options_.now) steps_max -= static_cast<std::size_t>(std::ceil(options_.age_max_s / step_s - 1e-9));
  return std::min((time + fineness_ - 1) / fineness_, steps_max);
}

std::vector<float> VelocityRollout::controls(View3<const float> commands, std::size_t steps) const {
  std::vector<float> controls;
  controls.reserve(commands.samples() * steps * 2);
  for (std::size_t n = 0; n < commands.samples(); ++n) {
    for (std::size_t k = 0; k < steps; ++k) {
      const std::size_t from = k * fineness_, to = std::min(from + fineness_, commands.steps());
      double speed = 0.0, yaw_rate = 0.0;
      for (std::size_t j = from; j < to; ++j) {
        speed += commands(n, j, 0) / static_cast<double>(to - from);
        yaw_rate += commands(n, j, 1) / static_cast<double>(to - from);
      }
      const Control control = command_from_twist(session_->vehicle(), speed, yaw_rate);
      controls.push_back(static_cast<float>(control.speed_m_s));
      controls.push_back(static_cast<float>(control.second));
    }
  }
  return controls;
}

void VelocityRollout::predict(View3<const float> commands, View3<float> velocities) {
  const std::size_t time = commands.steps();
  if (!commands.fits() || !velocities.fits() || commands.channels() != 2 || velocities.channels() != 3 || velocities.steps() != time ||
      velocities.samples() != commands.samples()) {
    throw Error(Code::invalid_argument, "commands", "commands (batch, time, 2) and velocities (batch, time, 3) do not fit each other");
  }
  if (commands.samples() == 0 || time == 0) return;
  const std::size_t steps = steps_for(time);
  const std::vector<float> asked = controls(commands, steps);
  PredictRequest request;
  request.controls = {Span<const float>(asked), commands.samples(), steps, 2};
  request.channels = bit(Channel::x) | bit(Channel::y) | bit(Channel::yaw);
  request.fallback = options_.fallback;
  std::vector<SentCommand> sent;
  if (options_.now) {
    request.start_stamp_ns = options_.now();
    sent = sent_->before(*request.start_stamp_ns);
  }
  request.sent = sent;
  auto answer = session_->predict(request, options_.timeout);
  if (!answer) {
    failure_ = answer.error();
    if (++failures_ > options_.failures_max) throw answer.error();
    for (std::size_t n = 0; n < commands.samples(); ++n) {
      for (std::size_t j = 1; j < time; ++j) {
        velocities(n, j, 0) = commands(n, j - 1, 0);
        velocities(n, j, 1) = 0.0F;
        velocities(n, j, 2) = commands(n, j - 1, 1);
      }
    }
    return;
  }
  failures_ = 0;
  failure_ = answer->fallback_reason;
  prediction_ = std::move(*answer);
  for (std::size_t n = 0; n < commands.samples(); ++n) follow(n, velocities);
}

/// Velocities whose integration gives the predicted poses of a sample.
void VelocityRollout::follow(std::size_t sample, View3<float> velocities) const {
  const auto states = prediction_->states();
  const VehicleState& start = prediction_->start;
  const double dt_s = step_s / static_cast<double>(fineness_);
  const bool hopeless = (prediction_->validity[sample] & (validity_not_finite | validity_overturned)) != 0;
  // Pose after `steps` steps of the service.
  const auto predicted = [&](std::size_t steps) -> PlanarPose {
    if (steps == 0) return {start.position_m[0], start.position_m[1], start.attitude_rad[2]};
    return {states(sample, steps - 1, 0), states(sample, steps - 1, 1), states(sample, steps - 1, 2)};
  };
  // Pose that the planner's own integration has reached.
  PlanarPose reached = predicted(0);
  for (std::size_t j = 0; j < velocities.steps(); ++j) {
    const auto out = velocities.step(sample, j);
    if (j > 0) {
      const std::size_t k = j / fineness_;
      if (hopeless) {
        std::fill(out.begin(), out.end(), 0.0F);
      } else if (k >= states.steps()) {
        const auto before = velocities.step(sample, j - 1);
        std::copy(before.begin(), before.end(), out.begin());
      } else {
        const PlanarPose from = predicted(k), to = predicted(k + 1);
        const double share = static_cast<double>(j % fineness_ + 1) / static_cast<double>(fineness_);
        const double east_m = from.x_m + share * (to.x_m - from.x_m) - reached.x_m, north_m = from.y_m + share * (to.y_m - from.y_m) - reached.y_m;
        const double sin_yaw = std::sin(reached.yaw_rad), cos_yaw = std::cos(reached.yaw_rad);
        out[0] = static_cast<float>((cos_yaw * east_m + sin_yaw * north_m) / dt_s);
        out[1] = options_.lateral ? static_cast<float>((cos_yaw * north_m - sin_yaw * east_m) / dt_s) : 0.0F;
        out[2] = static_cast<float>(wrapped(from.yaw_rad + share * wrapped(to.yaw_rad - from.yaw_rad) - reached.yaw_rad) / dt_s);
      }
    }
    const double ahead_m = out[0] * dt_s, left_m = out[1] * dt_s;
    const double sin_yaw = std::sin(reached.yaw_rad), cos_yaw = std::cos(reached.yaw_rad);
    reached = {reached.x_m + cos_yaw * ahead_m - sin_yaw * left_m, reached.y_m + sin_yaw * ahead_m + cos_yaw * left_m, reached.yaw_rad + out[2] * dt_s};
  }
}

}  // namespace nesam
