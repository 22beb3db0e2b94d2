#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <variant>

#include <nesam/error.hpp>
#include <nesam/types.hpp>

namespace nesam {

/// What a vehicle knows at one instant.
struct Measurement {
  /// Instant of the state, ns of the vehicle's clock; only differences matter.
  std::int64_t stamp_ns = 0;
  /// Increases by at least 1 with each measurement; 0 = not numbered. Resending is always safe.
  std::uint64_t sequence = 0;
  /// Start of the vehicle's software that stamps and numbers belong to: differs from start to start; 0 = not told. Another one begins a new history and keeps the soil.
  std::uint64_t boot_id = 0;
  /// `MeasurementAnswer::run` of the answers so far; 0 = whatever it is. Where the session is at another run now, which may lack what that one had not made
  /// durable, the measurement is `Rejected` with FAILED_PRECONDITION for `run`: send again what is not durable, in order.
  std::uint64_t run = 0;
  /// Pose in World, twist in Body.
  VehicleState state;
  /// Command that the vehicle applies from this instant on.
  Control command;
  /// Speeds of the four wheels about their axles, rad/s, positive forward, where measured.
  std::optional<std::array<double, 4>> wheel_speed_rad_s;
  /// Road-wheel angles of the front left and front right wheel, rad, positive left, where measured.
  std::optional<std::array<double, 2>> road_wheel_angle_rad;
};

/// The measurement ended a step of the history.
struct Applied {
  std::uint32_t history_steps = 0;  ///< Steps in the history now, 1 to 32.
};
/// Accepted, but denser than the 0.1 s grid of the model: it waits for the next grid point.
struct Buffered {
  double next_step_in_s = 0.0;
};
/// This sequence number was accepted before, or this stamp and no higher number comes with it. Nothing changed.
struct Duplicate {};
/// Behind the reorder window, numbered against the order of the stamps, or of a former start of the vehicle. Nothing changed.
struct TooOld {
  double behind_s = 0.0;  ///< 0 when only the sequence number is old.
};
/// A number is NaN or infinite. Nothing changed.
struct NotFinite {
  std::string field;  ///< For example `state.velocity_m_s.x`.
};
/// In the history, but refused by the soil filter because it disagrees too much with the prediction.
struct Gated {
  double nis = 0.0;  ///< Normalised innovation squared, -.
};
/// Applied after a pause of more than 1.5 steps: the history starts again here.
struct Gap {
  double gap_s = 0.0;
};
/// Further ahead of the last one than time has passed since. Nothing changed.
struct Future {
  double ahead_s = 0.0;
};
/// Applied after the vehicle's clock was set: the history starts again here, the soil stays.
struct ClockJump {
  double jump_s = 0.0;  ///< Negative = back.
};
/// Applied after a restart of the vehicle: the history starts again here, the soil stays.
struct Restarted {};
/// Not a valid measurement for this session. Nothing changed.
struct Rejected {
  Code code = Code::unknown;
  std::string field;
  std::string message;
};
/// An outcome that this version of the client does not know.
struct Unrecognised {};

/// The answer to one measurement.
struct MeasurementAnswer {
  std::string session_id;
  std::uint64_t sequence = 0;       ///< Copied from the measurement.
  std::int64_t stamp_ns = 0;        ///< Copied from the measurement.
  /// After this measurement. It, `soil_epoch`, `map_version` and `bundle_hash` are 0 and empty for one that was `Rejected` without a look at the session: it is
  /// not open or not the sender's, or the service is overloaded.
  std::uint64_t history_epoch = 0;
  std::uint64_t soil_epoch = 0;     ///< After this measurement.
  /// What the session knows of the soil after this measurement; absent when it was rejected.
  std::optional<SoilCorrection> soil_correction;
  bool reordered = false;           ///< It arrived after a later one and was put in its place.
  /// Place among the measurements that the session has accepted, counted from 1 in the order of arrival; that of the newest accepted one for a duplicate; 0 when
  /// it was refused. It is durable as soon as an answer of the same run, or `SessionStatus`, tells a `durable_place` that reaches it.
  std::uint64_t place = 0;
  /// What was accepted up to this place survives a crash of the server and of its machine; 0 where the server keeps no store.
  std::uint64_t durable_place = 0;
  /// Which server in which run counts the places. When it changes, everything that is not known to be durable has to be sent again.
  std::uint64_t run = 0;
  std::uint64_t map_version = 0;    ///< Version of the map of the session; 0 = no map.
  std::string bundle_hash;          ///< SHA-256 (hex) of the manifest of the model bundle.
  std::variant<Applied, Buffered, Duplicate, TooOld, NotFinite, Gated, Gap, Future, ClockJump, Restarted, Rejected, Unrecognised> outcome = Unrecognised{};

  /// The outcome if it is of this type, else null.
  template <class T>
  const T* is() const noexcept {
    return std::get_if<T>(&outcome);
  }
  /// Whether the measurement changed the session: Applied, Buffered, Gated, Gap, ClockJump or Restarted.
  bool accepted() const noexcept {
    return is<Applied>() || is<Buffered>() || is<Gated>() || is<Gap>() || is<ClockJump>() || is<Restarted>();
  }
};

}  // namespace nesam
