#pragma once

// What of nav2's MPPI controller a motion model touches, in the two shapes that its releases have, so that `RemoteMotionModel` is compiled and run without
// nav2: arrays of xtensor (`shape`) and of Eigen (`rows`, `cols`), and the integration of velocities into poses.

#include <cmath>
#include <cstddef>
#include <vector>

template <bool eigen>
class Array {
 public:
  Array(std::size_t batch, std::size_t time, float value) : time_(time), values_(batch * time, value) {}
  float& operator()(std::size_t i, std::size_t j) { return values_[i * time_ + j]; }
  const float& operator()(std::size_t i, std::size_t j) const { return values_[i * time_ + j]; }
  template <bool yes = !eigen, class = std::enable_if_t<yes>>
  std::size_t shape(std::size_t dimension) const {
    return dimension == 0 ? values_.size() / time_ : time_;
  }
  template <bool yes = eigen, class = std::enable_if_t<yes>>
  long rows() const {
    return static_cast<long>(values_.size() / time_);
  }
  template <bool yes = eigen, class = std::enable_if_t<yes>>
  long cols() const {
    return static_cast<long>(time_);
  }

 private:
  std::size_t time_;
  std::vector<float> values_;
};

template <bool eigen>
struct MinimalState {
  Array<eigen> vx, vy, wz, cvx, cvy, cwz;
  MinimalState(std::size_t batch, std::size_t time)
      : vx(batch, time, 0), vy(batch, time, 0), wz(batch, time, 0), cvx(batch, time, 0), cvy(batch, time, 0), cwz(batch, time, 0) {}
};

template <bool eigen>
class MinimalMotionModel {
 public:
  virtual ~MinimalMotionModel() = default;
  virtual void predict(MinimalState<eigen>& state) = 0;
  virtual bool isHolonomic() = 0;
};

struct MinimalPose {
  double x_m, y_m, yaw_rad;
};

/// Pose of a sample after columns 0 to j: each moves it by its velocities in the heading before it.
template <bool eigen>
MinimalPose integrated(const MinimalState<eigen>& state, std::size_t i, std::size_t j, MinimalPose pose, double dt_s) {
  for (std::size_t column = 0; column <= j; ++column) {
    const double ahead_m = state.vx(i, column) * dt_s, left_m = state.vy(i, column) * dt_s;
    const double sin_yaw = std::sin(pose.yaw_rad), cos_yaw = std::cos(pose.yaw_rad);
    pose = {pose.x_m + cos_yaw * ahead_m - sin_yaw * left_m, pose.y_m + sin_yaw * ahead_m + cos_yaw * left_m, pose.yaw_rad + state.wz(i, column) * dt_s};
  }
  return pose;
}
