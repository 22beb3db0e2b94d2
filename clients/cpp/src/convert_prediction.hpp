#pragma once

#include <cstddef>
#include <string>

#include <nesam/error.hpp>
#include <nesam/prediction.hpp>
#include <nesam/prediction_stream.hpp>
#include "nesam/v1/prediction.pb.h"

// Between requests, predictions and the messages of nesam.v1; the same for single calls and streams.

namespace nesam::detail {

/// What of a request decides the shape of its reply: kept until the reply comes, when the arrays of the request may be gone.
struct Asked {
  explicit Asked(const PredictRequest& request);

  std::size_t samples;
  std::size_t samples_min;
  std::size_t horizon;
  /// Groups of trajectories, one for each what-if soil.
  std::size_t soil_groups;
  bool drawn;
  bool ranked;
  bool wheel_sinkage;
  bool half;
  bool jacobians;
  bool covariance;
  bool risk;
};

/// INVALID_ARGUMENT when the controls do not have the shape that they say. The limits themselves are the server's.
Result<v1::PredictRequest> to_message(const std::string& session_id, const PredictRequest& request);

/// INTERNAL when the reply does not have the shape that was asked for.
Result<Prediction> from_message(const v1::PredictReply& message, const Asked& asked);
PredictionAnswer from_message(const v1::PredictStreamReply& message, const Asked& asked);

}  // namespace nesam::detail
