#pragma once

// Stands where nav2's header stands, for blocks of pages that include it.

#include "../minimal_nav2.hpp"

namespace mppi {
using MotionModel = MinimalMotionModel<false>;
namespace models {
using State = MinimalState<false>;
}
}  // namespace mppi
