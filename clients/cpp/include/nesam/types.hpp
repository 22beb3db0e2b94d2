#pragma once

#include <array>
#include <chrono>
#include <cstdint>
#include <optional>
#include <string>

namespace nesam {

// Conventions of the whole library: SI units and radians, the unit stands last in a name. World is ENU (x east, y north, z up); Body is FLU at the reference
// point of the vehicle card (x forward, y left, z up), as in REP-103/105. Wheels: front left, front right, rear left, rear right.

/// Longest wait of one call; absent = the default of `ClientOptions`.
using Timeout = std::optional<std::chrono::nanoseconds>;

/// Step of the model, s.
constexpr double step_s = 0.1;
/// Steps of the longest prediction.
constexpr std::uint32_t horizon_max = 32;

/// State of a vehicle, R^12.
struct VehicleState {
  /// Reference point in World, m.
  std::array<double, 3> position_m{};
  /// Roll, pitch, yaw with R_WB = Rz(yaw) Ry(pitch) Rx(roll), rad: roll > 0 is left side up, pitch > 0 is nose down.
  std::array<double, 3> attitude_rad{};
  /// Velocity of the reference point, expressed in Body, m/s.
  std::array<double, 3> velocity_m_s{};
  /// Angular velocity, expressed in Body, rad/s.
  std::array<double, 3> angular_velocity_rad_s{};
};

/// Command of one interval of 0.1 s. Values outside the range of the vehicle card are refused.
struct Control {
  /// Forward speed, m/s.
  double speed_m_s = 0.0;
  /// Second command, positive to the left; meaning and unit as `VehicleCard::second` says.
  double second = 0.0;
};

/// Meaning of the second command.
enum class SecondCommand {
  unspecified = 0,
  steering_normalised = 1,    ///< In [-1, 1], mapped to road-wheel angles by the table of the card.
  road_wheel_angle_rad = 2,   ///< Road-wheel angle, rad.
  yaw_rate_rad_s = 3,         ///< Yaw rate of a skid-steer vehicle, rad/s.
};

/// What a client needs of the vehicle card to form valid commands.
struct VehicleCard {
  std::string name;
  SecondCommand second = SecondCommand::unspecified;
  /// Admitted speed command, both ends included, m/s.
  double speed_min_m_s = 0.0;
  double speed_max_m_s = 0.0;
  /// Admitted second command, both ends included, in the unit of `second`.
  double second_min = 0.0;
  double second_max = 0.0;
  /// Distance between the axles, m.
  double wheelbase_m = 0.0;
  /// Road-wheel angle (mean of left and right) at `second_max`, rad; 0 for a vehicle that does not steer its wheels.
  double road_wheel_angle_max_rad = 0.0;
};

/// One number for each soil parameter; a variance has these units squared. A correction may be in other coordinates: see `SoilCoordinates`.
struct SoilVector {
  double k_phi = 0.0;      ///< Frictional modulus of sinkage, N/m^(n+2).
  double k_c = 0.0;        ///< Cohesive modulus of sinkage, N/m^(n+1).
  double n = 0.0;          ///< Exponent of sinkage, -.
  double c_pa = 0.0;       ///< Cohesion, Pa.
  double phi_rad = 0.0;    ///< Angle of internal friction, rad.
  double k_shear_m = 0.0;  ///< Shear deformation modulus, m.
};

/// Coordinates in which a correction is added to the soil prior.
enum class SoilCoordinates {
  unspecified = 0,
  physical = 1,     ///< Differences in the units of `SoilVector`.
  logarithmic = 2,  ///< Natural logarithm of the factor for k_phi, k_c, c and k_shear; differences for n and phi.
};

/// Correction of the soil prior, the same wherever the vehicle goes.
struct SoilCorrection {
  SoilCoordinates coordinates = SoilCoordinates::unspecified;
  /// In these coordinates; zero before any update.
  SoilVector delta;
  /// Diagonal of the covariance of `delta`, in these coordinates; absent while no filter runs.
  std::optional<SoilVector> variance;
  /// Whether the drive has at least halved the prior variance of each parameter, in the order of `SoilVector`, with a correction that is more likely right
  /// than the prior alone. A parameter that is not learned has no number to show; predictions use its correction all the same.
  std::array<bool, 6> learned{};
  /// Covariance of `delta`, in these coordinates and in the order of `SoilVector`; absent while no filter runs.
  std::optional<std::array<std::array<double, 6>, 6>> covariance;
};

/// What a reply was computed from. A planner may refuse a reply whose provenance it does not accept.
struct Provenance {
  std::uint64_t history_epoch = 0;  ///< Changes of the session's history since it was opened; 0 = no measurement yet.
  std::uint64_t soil_epoch = 0;     ///< Changes of the session's soil correction; 0 = none yet.
  std::string map_id;               ///< Map of the session; empty = no map.
  std::uint64_t map_version = 0;
  std::string map_hash;             ///< SHA-256 (hex) of the layers of the map.
  std::string bundle_name;
  std::string bundle_hash;          ///< SHA-256 (hex) of the manifest of the model bundle.
};

}  // namespace nesam
