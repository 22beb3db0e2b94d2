#pragma once

#include <nesam/prediction.hpp>

namespace nesam::detail {

/// Whether the service would take a request that fits its shapes whatever the session, but for its commands, extras and number of samples, of which it may be told
/// other limits. For those who answer in its place.
bool takes(const PredictRequest& request) noexcept;

}  // namespace nesam::detail
