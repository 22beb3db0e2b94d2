#pragma once

#include <string>
#include <vector>

#include <nesam/error.hpp>
#include <nesam/measurement.hpp>
#include <nesam/prediction.hpp>
#include <nesam/session.hpp>
#include <nesam/terrain.hpp>
#include <nesam/types.hpp>
#include "nesam/v1/measurements.pb.h"
#include "nesam/v1/prediction.pb.h"
#include "nesam/v1/sessions.pb.h"
#include "nesam/v1/terrain.pb.h"

// Between the types of the client and the messages of nesam.v1.

namespace nesam::detail {

Code code_from(int code) noexcept;

/// Appends values as little-endian IEEE 754 binary32.
void pack(Span<const float> values, std::string& bytes);
/// The values of packed little-endian binary32; left-over bytes are ignored.
std::vector<float> unpack(const std::string& bytes);

v1::Measurement to_message(const std::string& session_id, const Measurement& measurement);
v1::OpenSessionRequest to_message(const OpenOptions& options);
v1::PredictRequest to_message(const std::string& session_id, const PredictRequest& request);
v1::MapHeader to_header(const Map& map);

SessionStatus from_message(const v1::Session& message);
MeasurementAnswer from_message(const v1::MeasurementAnswer& message);
MapDescription from_message(const v1::MapDescription& message);
/// INTERNAL when the reply does not have the shape that was asked for.
Result<Prediction> from_message(const v1::PredictReply& message, const PredictRequest& request);

}  // namespace nesam::detail
