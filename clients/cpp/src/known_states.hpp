#pragma once

#include <cstdint>
#include <mutex>
#include <optional>
#include <string>
#include <unordered_map>

#include <nesam/measurement.hpp>
#include <nesam/prediction.hpp>

namespace nesam::detail {

/// A state of a session and its instant, ns of the vehicle's clock; absent for a start that was given.
struct KnownState {
  VehicleState state;
  std::optional<std::int64_t> stamp_ns;
};

/// The newest state that a client knows of each session; a fallback without a given start begins there. Safe from several threads at once.
class KnownStates {
 public:
  /// Notes a measured state that is now the newest of its session.
  void measured(const Measurement& measurement, const MeasurementAnswer& answer) {
    // One that is buffered is no step of the history yet.
    if (!answer.accepted() || answer.is<Buffered>() || answer.reordered) return;
    note(answer.session_id, {measurement.state, measurement.stamp_ns});
  }

  /// Notes where a prediction of the session began that was not given its start.
  void predicted(const std::string& session_id, const PredictRequest& request, const Prediction& prediction) {
    if (!request.start) note(session_id, {prediction.start, prediction.start_stamp_ns});
  }

  /// The newest known state of a session.
  std::optional<KnownState> of(const std::string& session_id) const {
    const std::lock_guard lock(mutex_);
    const auto known = states_.find(session_id);
    if (known == states_.end()) return std::nullopt;
    return known->second;
  }

  /// Forgets a closed session.
  void forget(const std::string& session_id) {
    const std::lock_guard lock(mutex_);
    states_.erase(session_id);
  }

 private:
  void note(const std::string& session_id, const KnownState& newest) {
    const std::lock_guard lock(mutex_);
    states_[session_id] = newest;
  }

  mutable std::mutex mutex_;
  std::unordered_map<std::string, KnownState> states_;
};

}  // namespace nesam::detail
