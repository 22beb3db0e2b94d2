#pragma once

#include <chrono>
#include <cstdint>
#include <optional>
#include <vector>

#include <nesam/error.hpp>
#include <nesam/extras.hpp>
#include <nesam/fallback.hpp>
#include <nesam/span.hpp>
#include <nesam/types.hpp>

namespace nesam {

/// Channel of a predicted state: the order of the 12-vector and the bit of a channel mask. m, rad, m/s (Body), rad/s (Body).
enum class Channel : std::uint32_t { x, y, z, roll, pitch, yaw, vx, vy, vz, wx, wy, wz };

/// The bit of a channel in a mask.
constexpr std::uint32_t bit(Channel channel) noexcept { return std::uint32_t{1} << static_cast<std::uint32_t>(channel); }

/// All twelve channels.
constexpr std::uint32_t all_channels = 0xfff;

/// Bits of `Prediction::validity`. 0 = nothing to say against the sample.
enum Validity : std::uint32_t {
  validity_not_finite = 1,          ///< A state of this sample is not finite; the other samples are unaffected.
  validity_off_map = 2,             ///< The sample left the known map.
  validity_no_map = 4,              ///< The session has no map: flat ground and the default soil were used.
  validity_speed_untrained = 8,     ///< A speed command lies outside the trained range, or a speed of the vehicle far beyond it.
  validity_steering_untrained = 16, ///< A second command lies outside the trained range.
  validity_slope_untrained = 32,    ///< Roll or pitch lies outside the trained range.
  validity_overturned = 64,         ///< |roll| or |pitch| over 60 degrees.
  validity_soil_not_learned = 128,  ///< The drive has not updated the soil yet: the prior alone speaks.
  validity_alarm_active = 256,      ///< An alarm of the session is active (`SessionStatus::alarm`): its measurements disagree with its predictions.
  validity_start_off_ground = 512,  ///< The start lies more than half a metre above or below where the map would carry it.
};

/// Whether the measured history of the session may speak for the start state.
enum class HistoryUse {
  measured = 1,  ///< The history precedes the start. A given start is taken to hold at the newest measurement and replaces its state.
  none = 2,      ///< The start stands alone, as for a what-if question at another place.
};

/// Candidates that the service draws as MPPI does: the first is the nominal sequence, the others are nominal plus Gaussian noise, cut to the range of the card
/// and to nothing narrower: not to what was trained, nor to limits of a planner or of how fast commands may change.
struct CandidateDrawing {
  /// Number of candidates N.
  std::uint32_t samples = 0;
  /// Shape (K, 2): speed in m/s, second command in the unit of the vehicle card. Only read during the call.
  Span<const float> nominal;
  /// Standard deviation of the noise of the speed, m/s, and of the second command, in its unit.
  double speed_sd_m_s = 0.0;
  double second_sd = 0.0;
  /// Correlation of the noise from one step to the next, 0 (white) to below 1.
  double correlation = 0.0;
  /// The same drawing with the same seed gives the same candidates.
  std::uint64_t seed = 0;
};

/// Cost of a candidate: the mean over its steps of weighted squares. Infinite for one that overturns, leaves the map or is not finite; other bits of
/// `Validity`, such as `validity_speed_untrained`, cost nothing.
struct PathCost {
  /// Shape (points, 2): the path in the order it is driven, World, m; 2 to 1024 points. Only read during the call.
  Span<const float> path_m;
  /// Speed to be made along the path, m/s.
  double speed_m_s = 0.0;
  /// Weights of the distance from the path (per m^2), of the speed along it (per (m/s)^2; vx and vy turned by the yaw alone), of roll and pitch
  /// (per rad^2), and of the change of the commands from step to step (per (m/s)^2 and per unit of the second command squared).
  double path_weight = 1.0;
  double speed_weight = 0.0;
  double tilt_weight = 0.0;
  double speed_change_weight = 0.0;
  double second_change_weight = 0.0;
  /// Candidates to return, best first; 0 = none.
  std::uint32_t best = 1;
  /// Temperature of `Prediction::mean_controls`, in units of the cost; 0 = no mean.
  double temperature = 0.0;
};

/// A command on its way to the vehicle.
struct SentCommand {
  /// Instant from which the vehicle applies it, ns of the vehicle's clock.
  std::int64_t stamp_ns = 0;
  Control command;
};

/// A batch of candidate command sequences.
struct PredictRequest {
  /// Shape (N, K, 2): speed in m/s, second command in the unit of the vehicle card. N 1 to 4096, K 1 to 32. Only read during the call. Empty with `drawing`.
  View3<const float> controls;
  /// State to start from; absent = the newest measured step.
  std::optional<VehicleState> start;
  HistoryUse history_use = HistoryUse::measured;
  /// Instant from which the controls apply, ns of the vehicle's clock; absent = that of the newest measured step. The session is rolled forward to it, rounded
  /// to the nearest step of 0.1 s, so by up to 50 ms (`Prediction::start_stamp_ns` says to which): at most half a step before the newest one, and so near after
  /// it that the steps rolled forward and K together do not exceed 32. Not together with `start`.
  std::optional<std::int64_t> start_stamp_ns;
  /// Commands that the vehicle was sent, by ascending stamp, at most 256; only with `start_stamp_ns`. Each step that is rolled forward uses the one in effect at
  /// its middle; before the first of them that is later than the newest step, the command measured with this step. Only read during the call.
  Span<const SentCommand> sent;
  /// Channels to return, a sum of `bit(Channel)`; 0 = all twelve.
  std::uint32_t channels = 0;
  /// Returns the steps stride, 2 stride, ... up to K.
  std::uint32_t stride = 1;
  /// Also return the sinkage of the four wheels.
  bool wheel_sinkage = false;
  /// Lets states and sinkage travel as 16-bit numbers of eleven significant bits, half of the bytes; positions travel as offsets from the start and are rounded by
  /// at most 4 mm within 16 m of it. Extras keep their 32 bits.
  bool half = false;
  /// Copied to the reply; for the caller's own use.
  std::uint64_t tag = 0;
  /// Fewest samples that are of use when the timeout is near, 0 = all or nothing; `Prediction::samples` says how many were computed.
  std::uint32_t samples_min = 0;
  /// Time after which the answer is of no use, above 0: what a timeout is to a call, for each request of a stream. Absent = the deadline of the server.
  std::optional<std::chrono::nanoseconds> budget;
  /// Lets the service draw the candidates: 8 K bytes on the wire instead of 8 N K.
  std::optional<CandidateDrawing> drawing;
  /// Lets the service say what each candidate is worth and return the best only: 4 N bytes and 48 K for each of them instead of 48 N K.
  std::optional<PathCost> cost;
  /// What to compute beyond the states.
  Extras extras;
  /// Answers `Session::predict` when the service is late, overloaded or away, or knows no measurement that is new enough for `start_stamp_ns`, from `start` or
  /// the newest state that this client knows, which it rolls forward to `start_stamp_ns` by its own kinematics, no further than 32 steps; a state that is older
  /// than 3.2 s by the clock of this program is none. Absent = nothing does. It has no extras, costs or what-if soils; of a drawing it predicts the nominal
  /// sequence alone. Streams leave it unread.
  std::optional<KinematicFallback> fallback;
};

/// Who computed a prediction.
enum class ComputedBy {
  service = 0,
  kinematic_fallback = 1,  ///< `PredictRequest::fallback`, because the service did not answer in time.
};

/// The predicted states and what they were computed from. With `ComputedBy::kinematic_fallback`, `soil` is not a number, `validity` is 0 and everything else that only
/// the service knows is empty: provenance, sinkage, soil correction, extras, `costs`, `best` and `mean_controls`.
class Prediction {
 public:
  /// Shape (rows, floor(K / stride), C) with C = number of channels asked for, in the order of `Channel`; yaw in (-pi, pi]. Step k (from 0) is the state
  /// (k + 1) stride x 0.1 s after the start. A row for each candidate, for each of `best` where a cost was given, or for each soil and candidate (`row`).
  /// Valid as long as this object is neither changed nor moved from.
  View3<const float> states() const noexcept { return {states_storage, rows(), steps, channel_count()}; }
  /// Sinkage of the wheels, m, shape (rows, floor(K / stride), 4); empty unless asked for.
  View3<const float> sinkage_m() const noexcept {
    return sinkage_storage_m.empty() ? View3<const float>{} : View3<const float>{sinkage_storage_m, rows(), steps, 4};
  }
  /// Candidates that the service drew, shape (candidates, K, 2); empty for candidates that were sent.
  View3<const float> drawn_controls() const noexcept {
    return drawn_storage.empty() ? View3<const float>{} : View3<const float>{drawn_storage, candidates(), drawn_storage.size() / (2 * candidates()), 2};
  }
  /// Number of candidates returned: all, or those of `best` where a cost was given.
  std::size_t candidates() const noexcept { return costs.empty() ? samples : best.size(); }
  /// Number of trajectories returned: one for each candidate, with what-if soils one for each soil and candidate.
  std::size_t rows() const noexcept { return soil_groups * candidates(); }
  /// Row of a candidate in the group of a what-if soil: of `Extras::soil_deltas`, or of the thirteen sigma points.
  std::size_t row(std::size_t group, std::size_t candidate) const noexcept { return group * candidates() + candidate; }
  /// Column of a channel in `states()`; absent when it was not asked for.
  std::optional<std::size_t> column(Channel channel) const noexcept;
  /// Number of channels returned.
  std::size_t channel_count() const noexcept;

  std::uint64_t tag = 0;
  /// Candidates that were computed.
  std::size_t samples = 0;
  std::size_t steps = 0;
  /// Groups of trajectories, one for each what-if soil; 1 without.
  std::size_t soil_groups = 1;
  /// Channels returned, a sum of `bit(Channel)`.
  std::uint32_t channels = 0;
  std::vector<float> states_storage;
  std::vector<float> sinkage_storage_m;
  std::vector<float> drawn_storage;
  /// Cost of every candidate, (N); empty without a cost.
  std::vector<float> costs;
  /// Indices of the candidates returned, best first; empty without a cost.
  std::vector<std::uint32_t> best;
  /// Mean of all candidates weighted with exp(-(cost - least cost) / temperature), shape (K, 2): the step of MPPI. Empty without a temperature, or when no
  /// candidate has a finite cost.
  std::vector<float> mean_controls;
  /// One word for each row: the sum of its `Validity` bits.
  std::vector<std::uint32_t> validity;
  /// State that the controls started from: given, measured, or rolled forward.
  VehicleState start;
  /// Instant of the start, ns of the vehicle's clock; absent when a start was given.
  std::optional<std::int64_t> start_stamp_ns;
  /// Steps of 0.1 s from the newest measured step to the start: the age of the measurement in the vehicle's own time.
  std::uint32_t rolled_forward_steps = 0;
  /// Measured steps that preceded the start, 0 to 31.
  std::uint32_t history_steps = 0;
  /// Soil used under the given or measured start: prior plus correction, clipped to the admissible range.
  SoilVector soil;
  /// Variance of that soil to first order, units of `SoilVector` squared; absent while no filter runs.
  std::optional<SoilVector> soil_variance;
  /// What the session knew of the soil: `Extras::soil_deltas` and `ExtraOutputs::jacobian_soil` are in its coordinates.
  SoilCorrection soil_correction;
  /// Time between the arrival of the session's newest measurement and the start of this computation, s; absent before the first.
  std::optional<double> measurement_age_s;
  Provenance provenance;
  /// Time that the request waited for the engine and time that the engine computed, s.
  double queue_s = 0.0;
  double compute_s = 0.0;
  /// What was computed beyond the states.
  ExtraOutputs extras;
  /// Who computed it.
  ComputedBy computed_by = ComputedBy::service;
  /// The service's error that a fallback has answered instead of; absent when the service has answered.
  std::optional<Error> fallback_reason;
};

}  // namespace nesam
