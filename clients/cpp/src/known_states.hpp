#pragma once

#include <algorithm>
#include <atomic>
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
///
/// What is sent is numbered, as answers may overtake each other: a state that was asked for later replaces another, one that was asked for earlier only where its
/// stamp is larger and the vehicle's clock has not begun anew since.
class KnownStates {
 public:
  /// Number of what is sent now.
  std::uint64_t ask() { return ++asked_; }

  /// Notes a measured state that is now the newest of its session; `asked` is the number of the measurement.
  void measured(std::uint64_t asked, const Measurement& measurement, const MeasurementAnswer& answer) {
    // One that is buffered is no step of the history yet.
    if (!answer.accepted() || answer.is<Buffered>() || answer.reordered) return;
    note(answer.session_id, {measurement.state, measurement.stamp_ns}, asked, answer.is<ClockJump>() || answer.is<Restarted>());
  }

  /// Notes where a prediction of the session began that was not given its start; `asked` is the number of its question.
  void predicted(std::uint64_t asked, const std::string& session_id, const PredictRequest& request, const Prediction& prediction) {
    if (!request.start) note(session_id, {prediction.start, prediction.start_stamp_ns}, asked, false);
  }

  /// The newest known state of a session.
  std::optional<KnownState> of(const std::string& session_id) const {
    const std::lock_guard lock(mutex_);
    const auto known = states_.find(session_id);
    if (known == states_.end()) return std::nullopt;
    return known->second.known;
  }

  /// Forgets a closed session.
  void forget(const std::string& session_id) {
    const std::lock_guard lock(mutex_);
    states_.erase(session_id);
  }

 private:
  struct Newest {
    KnownState known;
    /// Number of what it answered, or of what was answered before.
    std::uint64_t asked = 0;
    /// Number of the measurement with which the vehicle's clock began anew.
    std::uint64_t clock = 0;
  };

  void note(const std::string& session_id, const KnownState& known, std::uint64_t asked, bool begins_anew) {
    const std::lock_guard lock(mutex_);
    const auto [held, is_new] = states_.try_emplace(session_id);
    Newest& newest = held->second;
    if (is_new || begins_anew) {
      newest = {known, asked, begins_anew ? asked : 0};
    } else if (asked > newest.asked || (asked > newest.clock && known.stamp_ns && newest.known.stamp_ns && *known.stamp_ns > *newest.known.stamp_ns)) {
      newest = {known, std::max(asked, newest.asked), newest.clock};
    }
  }

  std::atomic<std::uint64_t> asked_ = 0;
  mutable std::mutex mutex_;
  std::unordered_map<std::string, Newest> states_;
};

}  // namespace nesam::detail
