#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <type_traits>
#include <utility>
#include <vector>

#include <nesam/fallback.hpp>
#include <nesam/prediction.hpp>
#include <nesam/session.hpp>
#include <nesam/span.hpp>
#include <nesam/types.hpp>

namespace nesam {

/// Command that asks a vehicle for a forward speed (m/s) and a yaw rate (rad/s), cut to the range of the card.
///
/// A vehicle that steers its wheels gets the road-wheel angle of a bicycle without slip, atan(wheelbase x yaw rate / speed), the speed taken as 0.3 m/s at least.
/// A normalised second command is that angle as a share of the card's largest.
Control command_from_twist(const VehicleCard& card, double speed_m_s, double yaw_rate_rad_s) noexcept;

/// Settings of a motion model.
struct MotionModelOptions {
  /// Step of the planner (nav2: `model_dt`), s: 0.1 or a whole fraction of it.
  double model_dt_s = step_s;
  /// Longest wait for a prediction.
  std::chrono::nanoseconds timeout = std::chrono::milliseconds(50);
  /// Also give lateral velocities, without which a planner loses what the reference point moves sideways in a bend. nav2 then samples lateral commands too,
  /// which this model leaves unread: set its `vy_max` and `vy_std` to 0.
  bool lateral = true;
  /// Predictions that may fail in a row. Until then velocities follow the commands, as in nav2's own models; one more, and `predict` throws.
  unsigned failures_max = 5;
  /// Predicts instead of the service when that is late, overloaded or away, from the newest state that the client knows; absent = nothing does. Such a cycle is no
  /// failure, however many there are: `VelocityRollout::failure` and `Prediction::computed_by` tell them.
  std::optional<KinematicFallback> fallback;
  /// The instant that the first velocities apply to, ns of the vehicle's clock: that of the pose from which the planner integrates. Asked in `predict`, in its
  /// thread. Predictions then begin there, rounded to the nearest step of 0.1 s after the newest measurement, with the commands of `VelocityRollout::sent` on the way;
  /// empty = they begin at the newest measurement, which is older: what they say is late by speed x age.
  std::function<std::int64_t()> now;
  /// With `now`: age of the newest measurement, s, up to which the service answers in any case; 0 to 3.1. It is kept of the horizon of 3.2 s, beyond which velocities
  /// go on as the last ones. Where age and sequences together exceed 3.2 s, FAILED_PRECONDITION of `start_stamp_ns` is a failure as others are.
  double age_max_s = 0.4;
};

/// Velocities of a batch of command sequences, by the prediction service: what a planner that integrates velocities itself needs.
///
/// Column j holds the mean velocities between j and j + 1 steps of the planner; column 0, the present velocity, is the planner's own. Velocities are such
/// that integrating them as nav2 does (position with the heading before the step) gives the predicted positions, with lateral velocities exactly. Beyond the
/// horizon of the service, 3.2 s, the last velocities go on. A sample that overturns or has a state that is not finite stands still.
class VelocityRollout {
 public:
  /// Most commands that `sent` keeps, as many as a prediction takes.
  static constexpr std::size_t sent_max = 256;

  /// Throws `Error` (INVALID_ARGUMENT) for a step that is no whole fraction of 0.1 s and for a `MotionModelOptions::age_max_s` outside its range.
  VelocityRollout(std::shared_ptr<const Session> session, MotionModelOptions options);

  /// Fills the velocities from the commands.
  ///
  /// `commands` (batch, time, 2): speed in m/s and yaw rate in rad/s. `velocities` (batch, time, 3): forward and lateral in m/s, yaw rate in rad/s; column 0
  /// is read, the others are written. Starts from the newest measurement of the session, or at `MotionModelOptions::now`. Throws `Error` in the calling thread:
  /// INVALID_ARGUMENT for shapes that do not fit, the last failure once more than `failures_max` came in a row, and what `now` throws.
  void predict(View3<const float> commands, View3<float> velocities);

  /// Notes a command that the vehicle was sent: it applies from `stamp_ns` on, ns of the vehicle's clock; speed in m/s, yaw rate in rad/s, turned into a command by
  /// `command_from_twist`. Only read where there is a `MotionModelOptions::now`: without the commands sent since the newest measurement the one that was measured with
  /// it goes on. The newest `sent_max` are kept, and none that is not before this one. May be called from another thread than `predict`. A number that is not finite
  /// is no command.
  void sent(std::int64_t stamp_ns, double speed_m_s, double yaw_rate_rad_s);

  const MotionModelOptions& options() const noexcept { return options_; }
  /// The last prediction, for critics that read validity or provenance; absent before the first.
  const std::optional<Prediction>& prediction() const noexcept { return prediction_; }
  /// Why the last call fell back to the commands or, where `prediction()->computed_by` says so, to `MotionModelOptions::fallback`; absent when it did not.
  const std::optional<Error>& failure() const noexcept { return failure_; }

 private:
  /// Steps of the service to ask for.
  std::size_t steps_for(std::size_t time) const noexcept;
  std::vector<float> controls(View3<const float> commands, std::size_t steps) const;
  void follow(std::size_t sample, View3<float> velocities) const;

  std::shared_ptr<const Session> session_;
  MotionModelOptions options_;
  /// Steps of the planner in one of the service.
  std::size_t fineness_;
  std::optional<Prediction> prediction_;
  std::optional<Error> failure_;
  unsigned failures_ = 0;
  /// Commands on their way, which copies of a rollout share.
  struct Sent;
  std::shared_ptr<Sent> sent_;
};

/// A motion model of nav2's MPPI controller that asks the prediction service.
///
/// `Base` is `mppi::MotionModel` and `State` `mppi::models::State`, or types of the same shape: `predict(State&)` and `isHolonomic()` virtual in `Base`, and in
/// `State` the float arrays `vx`, `vy`, `wz`, `cvx`, `cwz`, batch x time, indexed `(i, j)`, with `shape(d)` (xtensor) or `rows()` and `cols()` (Eigen).
template <class Base, class State>
class RemoteMotionModel : public Base {
 public:
  /// Throws as `VelocityRollout`.
  explicit RemoteMotionModel(std::shared_ptr<const Session> session, MotionModelOptions options = {}) : rollout_(std::move(session), std::move(options)) {}

  /// Throws as `VelocityRollout::predict`.
  void predict(State& state) override {
    const std::size_t batch = size(state.vx, 0), time = size(state.vx, 1);
    const bool lateral = rollout_.options().lateral;
    commands_.resize(batch * time * 2);
    velocities_.resize(batch * time * 3);
    for (std::size_t i = 0; i < batch; ++i) {
      for (std::size_t j = 0; j < time; ++j) {
        commands_[(i * time + j) * 2] = state.cvx(i, j);
        commands_[(i * time + j) * 2 + 1] = state.cwz(i, j);
      }
      if (time == 0) continue;
      velocities_[i * time * 3] = state.vx(i, 0);
      velocities_[i * time * 3 + 1] = lateral ? static_cast<float>(state.vy(i, 0)) : 0.0F;
      velocities_[i * time * 3 + 2] = state.wz(i, 0);
    }
    rollout_.predict({Span<const float>(commands_), batch, time, 2}, {Span<float>(velocities_), batch, time, 3});
    for (std::size_t i = 0; i < batch; ++i) {
      for (std::size_t j = 1; j < time; ++j) {
        const float* at = &velocities_[(i * time + j) * 3];
        state.vx(i, j) = at[0];
        if (lateral) state.vy(i, j) = at[1];
        state.wz(i, j) = at[2];
      }
    }
  }

  bool isHolonomic() override { return rollout_.options().lateral; }

  /// As `VelocityRollout::sent`: for each command that the vehicle gets, for example out of a subscription of `cmd_vel`.
  void sent(std::int64_t stamp_ns, double speed_m_s, double yaw_rate_rad_s) { rollout_.sent(stamp_ns, speed_m_s, yaw_rate_rad_s); }

  /// What the last call did.
  const VelocityRollout& rollout() const noexcept { return rollout_; }

 private:
  template <class Array, class = void>
  struct HasRows : std::false_type {};
  template <class Array>
  struct HasRows<Array, std::void_t<decltype(std::declval<const Array&>().rows())>> : std::true_type {};

  template <class Array>
  static std::size_t size(const Array& array, int dimension) {
    if constexpr (HasRows<Array>::value) {
      return static_cast<std::size_t>(dimension == 0 ? array.rows() : array.cols());
    } else {
      return static_cast<std::size_t>(array.shape(static_cast<std::size_t>(dimension)));
    }
  }

  VelocityRollout rollout_;
  std::vector<float> commands_;
  std::vector<float> velocities_;
};

}  // namespace nesam
