#pragma once

#include <optional>

#include <nesam/prediction.hpp>

namespace nesam::detail {

/// What the fallback of a request that fits its shapes answers instead of the service, from its start or the newest known state, and why.
///
/// Absent where there is no fallback or no state, or where the service has refused the request: it was not late, overloaded or away.
std::optional<Prediction> fallback_prediction(const PredictRequest& request, const std::optional<VehicleState>& known, const Error& reason);

}  // namespace nesam::detail
