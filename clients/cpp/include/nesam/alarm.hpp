#pragma once

#include <cstdint>
#include <string>

namespace nesam {

/// The test that raised an alarm.
enum class AlarmKind {
  unspecified = 0,
  nis_large = 1,    ///< The innovations are larger than their covariance says.
  nis_small = 2,    ///< They are smaller: the covariance is too large, and power to see anything is lost.
  correlated = 3,   ///< Consecutive innovations resemble each other: the model is wrong in the same way all the time.
  motion_jump = 4,  ///< The mean of a channel of velocity against its prediction has jumped.
  sensor_jump = 5,  ///< The mean of a contradiction between sensors has jumped: no soil and no force can do that.
};

/// An episode in which the measurements of a session disagree with its predictions for longer than chance and soil explain: told when it begins and when it
/// ends. Stamps are of the vehicle's clock.
struct Alarm {
  std::string session_id;
  std::string vehicle_id;
  /// Counts the episodes of the session from 1.
  std::uint64_t episode = 0;
  /// True when it is raised, false when it is cleared.
  bool active = false;
  AlarmKind kind = AlarmKind::unspecified;
  /// Channel that jumped, for instance `yaw_rate_rad_s`; empty for a test of all channels.
  std::string channel;
  /// Mean of that channel since the onset, measured minus predicted, in the unit that its name ends in; 0 without a channel.
  double size = 0.0;
  /// Test statistic that raised it, and the threshold that it passed.
  double statistic = 0.0;
  double threshold = 0.0;
  /// Stamp of the last measurement that the test has seen, ns.
  std::int64_t stamp_ns = 0;
  /// Estimated stamp from which on the measurements disagree, ns.
  std::int64_t onset_stamp_ns = 0;
  /// Share of the misfit since the onset that a soil other than the map shows could explain at most, 0 to 1.
  double soil_share = 0.0;
  /// What it looks like, in one sentence.
  std::string description;
  /// Command that diagnoses the recorded window; RECORDING stands for the recording of the server.
  std::string diagnose;
};

}  // namespace nesam
