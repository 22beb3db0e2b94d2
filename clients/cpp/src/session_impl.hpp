#pragma once

#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <string>

#include "core.hpp"

namespace nesam::detail {

/// What a `Session` owns.
struct SessionImpl {
  SessionImpl(std::shared_ptr<Core> connection, SessionStatus&& status)
      : core(std::move(connection)), id(std::move(status.session_id)), vehicle(std::move(status.vehicle)), opening(core->openings.newest(id)) {}

  const std::shared_ptr<Core> core;
  const std::string id;
  const VehicleCard vehicle;
  /// The opening that it came from; a later one of the same name is another session, which whoever opened it closes.
  const std::uint64_t opening;

  /// Guards what follows.
  std::mutex mutex;
  /// The stream of `Session::send`; absent before the first call and after a failure.
  std::optional<MeasurementStream> stream;
  /// Whether the destructor has to close the session.
  bool owned = true;
};

}  // namespace nesam::detail
