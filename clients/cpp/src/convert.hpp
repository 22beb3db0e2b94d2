#pragma once

#include <string>
#include <vector>

#include <nesam/alarm.hpp>
#include <nesam/effect.hpp>
#include <nesam/error.hpp>
#include <nesam/fleet_soil.hpp>
#include <nesam/measurement.hpp>
#include <nesam/session.hpp>
#include <nesam/session_status.hpp>
#include <nesam/soil_watch.hpp>
#include <nesam/terrain.hpp>
#include <nesam/types.hpp>
#include "nesam/v1/alarms.pb.h"
#include "nesam/v1/effects.pb.h"
#include "nesam/v1/measurements.pb.h"
#include "nesam/v1/sessions.pb.h"
#include "nesam/v1/soil.pb.h"
#include "nesam/v1/terrain.pb.h"

// Between the types of the client and the messages of nesam.v1; predictions have a file of their own.

namespace nesam::detail {

Code code_from(int code) noexcept;

/// Appends values as little-endian IEEE 754 binary32.
void pack(Span<const float> values, std::string& bytes);
/// The values of packed little-endian binary32; left-over bytes are ignored.
std::vector<float> unpack(const std::string& bytes);

void set(v1::VehicleState* message, const VehicleState& state);
void set(v1::Control* message, const Control& command);
VehicleState from_message(const v1::VehicleState& message);
SoilVector from_message(const v1::SoilVector& message);
SoilCorrection from_message(const v1::SoilCorrection& message);
Provenance from_message(const v1::Provenance& message);

v1::Measurement to_message(const std::string& session_id, const Measurement& measurement);
v1::OpenSessionRequest to_message(const OpenOptions& options);
v1::MapHeader to_header(const Map& map);
v1::MapTile to_message(const MapTile& tile);
v1::Effect to_message(const Effect& effect);

SessionStatus from_message(const v1::Session& message);
MeasurementAnswer from_message(const v1::MeasurementAnswer& message);
SoilEstimate from_message(const v1::SoilEstimate& message);
Effect from_message(const v1::Effect& message);
Alarm from_message(const v1::Alarm& message);
/// INTERNAL when a cell does not have six by six numbers.
Result<FleetSoilMap> from_message(const v1::FleetSoilMap& message);
MapDescription from_message(const v1::MapDescription& message);

}  // namespace nesam::detail
