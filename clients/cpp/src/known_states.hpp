#pragma once

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <mutex>
#include <optional>
#include <string>
#include <unordered_map>

#include <nesam/error.hpp>
#include <nesam/measurement.hpp>
#include <nesam/prediction.hpp>

namespace nesam::detail {

/// Whether all numbers of a state are finite.
inline bool finite(const VehicleState& state) noexcept {
  for (const auto* part : {&state.position_m, &state.attitude_rad, &state.velocity_m_s, &state.angular_velocity_rad_s}) {
    for (const double value : *part) {
      if (!std::isfinite(value)) return false;
    }
  }
  return true;
}

/// A state of a session, its instant, ns of the vehicle's clock (absent for a start that was given), and the steps from the newest measurement to it.
struct KnownState {
  VehicleState state;
  std::optional<std::int64_t> stamp_ns;
  std::uint32_t rolled_forward_steps = 0;
};

/// What is known of where a vehicle was: its newest measured state, and the state that the service last rolled forward from a measurement.
struct Known {
  std::optional<KnownState> measured;
  std::optional<KnownState> ahead;
};

/// When something was sent: its number among all that is, and the client's clock.
struct Moment {
  std::uint64_t number = 0;
  std::chrono::steady_clock::time_point at;
};

/// The newest state that a client knows of each session; a fallback without a given start begins there, unless it is too old. Where a prediction began that was rolled
/// forward is kept apart: it is later than what was measured, and no measurement. Safe from several threads at once.
///
/// What is sent is numbered, as answers may overtake each other: a state that was asked for later replaces another, one that was asked for earlier only where its
/// stamp is larger and neither session nor vehicle's clock has begun anew since. A measurement that is no step of the session yet stays until a state with a larger
/// stamp comes, or it is too old to begin at.
class KnownStates {
 public:
  using Time = std::chrono::steady_clock::time_point;
  /// Oldest state that a fallback begins at, by the client's clock: as far as it rolls one forward.
  static constexpr std::chrono::milliseconds age_max{3200};

  /// Number and time of what is sent now.
  Moment ask() {
    const std::lock_guard lock(mutex_);
    return {++asked_, std::chrono::steady_clock::now()};
  }

  /// Notes a measured state that is now the newest of its session; `sent` is when the measurement was.
  void measured(const Moment& sent, const std::string& session_id, const Measurement& measurement, const MeasurementAnswer& answer) {
    if (const auto* rejected = answer.is<Rejected>()) {
      const bool no_room = rejected->code == Code::resource_exhausted || rejected->code == Code::unavailable;
      if (no_room) unheard(sent, session_id, measurement);
      if (rejected->code == Code::not_found && rejected->field == "session_id") forget(session_id);
      return;
    }
    if (!answer.accepted() || answer.reordered) return;
    const bool begins_anew = answer.is<ClockJump>() || answer.is<Restarted>();
    Noted noted;
    noted.begins_anew = begins_anew;
    noted.ahead = answer.is<Buffered>();
    note(session_id, {measurement.state, measurement.stamp_ns}, sent, noted);
  }

  /// Notes a measured state that got no answer: the vehicle was there all the same. The same one sent again, or what was kept meanwhile, is not where it is now.
  void unheard(const Moment& sent, const std::string& session_id, const Measurement& measurement) {
    const std::lock_guard lock(mutex_);
    const auto held = states_.find(session_id);
    const KnownState known{measurement.state, measurement.stamp_ns};
    if (held == states_.end() || held->second.is_before(known)) {
      Noted noted;
      noted.ahead = true;
      note_locked(session_id, known, sent, noted);
    }
  }

  /// Notes where a prediction of the session began that was not given its start; `asked` is when its question was.
  void predicted(Moment asked, const std::string& session_id, const PredictRequest& request, const Prediction& prediction) {
    if (request.start) return;
    // Who asks from an instant asks from now.
    const double age_s = request.start_stamp_ns ? 0.0 : prediction.measurement_age_s.value_or(0.0);
    if (!(age_s >= 0.0 && age_s < 1e6)) return;
    asked.at -= std::chrono::duration_cast<Time::duration>(std::chrono::duration<double>(age_s));
    const KnownState known{prediction.start, prediction.start_stamp_ns, prediction.rolled_forward_steps};
    if (known.rolled_forward_steps > 0) return note_ahead(session_id, known, asked);
    // Measurements may have overtaken the instant that was asked from.
    Noted noted;
    noted.overtaken = request.start_stamp_ns.has_value();
    note(session_id, known, asked, noted);
  }

  /// What is known of a session and not too old to begin at.
  Known of(const std::string& session_id, Time now = std::chrono::steady_clock::now()) const {
    const std::lock_guard lock(mutex_);
    Known known;
    if (const auto held = states_.find(session_id); held != states_.end() && now - held->second.at <= age_max) known.measured = held->second.known;
    if (const auto held = ahead_.find(session_id); held != ahead_.end() && now - held->second.asked.at <= age_max) known.ahead = held->second.known;
    return known;
  }

  /// Forgets what was known under the name of a session that was opened now, also what comes late.
  void opened(const std::string& session_id) {
    const Moment now = ask();
    const std::lock_guard lock(mutex_);
    states_[session_id] = {std::nullopt, now.number, now.number, now.at, false, now.number};
    ahead_.erase(session_id);
  }

  /// Which session of this name it is, as far as the client knows: another number than before where it was opened or closed since. 0 = not known.
  std::uint64_t opening(const std::string& session_id) const {
    const std::lock_guard lock(mutex_);
    const auto held = states_.find(session_id);
    return held == states_.end() ? 0 : held->second.opened;
  }

  /// Forgets a closed session.
  void forget(const std::string& session_id) {
    const std::lock_guard lock(mutex_);
    states_.erase(session_id);
    ahead_.erase(session_id);
  }

  /// Forgets a session where the service says that it is not open.
  void refused(const std::string& session_id, const Error& error) {
    if (error.code() == Code::not_found && error.field() == "session_id") forget(session_id);
  }

 private:
  struct Newest {
    /// Absent where the session was opened and nothing is known of it yet.
    std::optional<KnownState> known;
    /// Number of what it answered, or of what was answered before.
    std::uint64_t asked = 0;
    /// Number of that with which the session or the vehicle's clock began anew.
    std::uint64_t clock = 0;
    /// When it was so.
    Time at;
    /// Whether it is no step of the session yet, as far as the client knows: it waits for the grid, or got no answer.
    bool ahead = false;
    /// Number of the opening of the session; 0 where this client has not opened it.
    std::uint64_t opened = 0;

    bool is_before(const KnownState& other) const { return !known || (other.stamp_ns && known->stamp_ns && *other.stamp_ns > *known->stamp_ns); }
    /// Whether a state of the same clock is newer. One that measurements may have overtaken is so where it is later.
    bool is_replaced_by(const KnownState& other, const Moment& sent, bool overtaken) const {
      const bool stays = (ahead || overtaken) && sent.at - at <= age_max;
      return is_before(other) || (!stays && sent.number > asked);
    }
  };

  /// A state that the service rolled forward, and when it was asked for.
  struct Ahead {
    KnownState known;
    Moment asked;
  };

  /// How a state becomes known.
  struct Noted {
    /// The session or the vehicle's clock begins anew with it.
    bool begins_anew = false;
    /// It is no step of the session yet.
    bool ahead = false;
    /// Measurements may have overtaken it.
    bool overtaken = false;
  };

  void note(const std::string& session_id, const KnownState& known, const Moment& sent, const Noted& noted) {
    const std::lock_guard lock(mutex_);
    note_locked(session_id, known, sent, noted);
  }

  void note_locked(const std::string& session_id, const KnownState& known, const Moment& sent, const Noted& noted) {
    if (!finite(known.state)) return;
    if (const auto rolled = ahead_.find(session_id); noted.begins_anew && rolled != ahead_.end() && rolled->second.asked.number < sent.number) ahead_.erase(rolled);
    const auto [held, is_new] = states_.try_emplace(session_id);
    Newest& newest = held->second;
    if (!is_new && (sent.number <= newest.clock || !(noted.begins_anew || newest.is_replaced_by(known, sent, noted.overtaken)))) return;
    newest = {known, std::max(sent.number, newest.asked), noted.begins_anew ? sent.number : newest.clock, sent.at, noted.ahead, newest.opened};
  }

  /// Notes a state that the service rolled forward, unless a later question has told of another one or the clock has begun anew since.
  void note_ahead(const std::string& session_id, const KnownState& known, const Moment& asked) {
    if (!finite(known.state)) return;
    const std::lock_guard lock(mutex_);
    const auto measured = states_.find(session_id);
    if (measured != states_.end() && asked.number <= measured->second.clock) return;
    const auto [held, is_new] = ahead_.try_emplace(session_id);
    if (is_new || asked.number > held->second.asked.number) held->second = {known, asked};
  }

  std::uint64_t asked_ = 0;
  mutable std::mutex mutex_;
  std::unordered_map<std::string, Newest> states_;
  std::unordered_map<std::string, Ahead> ahead_;
};

}  // namespace nesam::detail
