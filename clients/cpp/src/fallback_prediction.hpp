#pragma once

#include <optional>

#include <nesam/prediction.hpp>

#include "known_states.hpp"

namespace nesam::detail {

/// What the fallback of a request that fits its shapes answers instead of the service, from its start or what is known, and why.
///
/// Absent where there is no fallback or no state, where the known one is too old to be rolled forward to `start_stamp_ns`, where the service would refuse the request,
/// or where it has: it was not late, overloaded or away, and knew measurements that are new enough for `start_stamp_ns`.
std::optional<Prediction> fallback_prediction(const PredictRequest& request, const Known& known, const Error& reason);

}  // namespace nesam::detail
