#pragma once

#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include <nesam/error.hpp>
#include <nesam/types.hpp>

namespace nesam {

namespace detail {
class Core;
class SoilWatchImpl;
}  // namespace detail

/// What a session has learned of the soil.
struct SoilEstimate {
  std::string session_id;
  /// Counts the changes since the session was opened: updates, and beginnings anew from the prior (effects were applied or reverted) or from the fleet's
  /// soil; 0 = none yet.
  std::uint64_t soil_epoch = 0;
  /// Stamp of the last measurement that went into the estimate, ns of the vehicle's clock; absent where none has since the beginning.
  std::optional<std::int64_t> stamp_ns;
  SoilCorrection correction;
  std::uint64_t history_epoch = 0;  ///< Counts the changes of the session's history; 0 = no measurement yet.
  std::uint64_t map_version = 0;    ///< Version of the map of the session; 0 = no map.
  std::string bundle_hash;          ///< SHA-256 (hex) of the manifest of the model bundle.
};

/// Tells what one session learns of the soil: the present estimate first, then each change until the session closes.
///
/// One thread at a time may call `receive`. Estimates that nobody collects wait with client and server; where they become too many, the server leaves some out
/// and goes on with what holds by then (`soil_epoch` shows the gap). Destruction cancels the watch.
class SoilWatch {
 public:
  SoilWatch(SoilWatch&&) noexcept;
  SoilWatch& operator=(SoilWatch&&) noexcept;
  ~SoilWatch();

  /// The next estimate.
  ///
  /// DEADLINE_EXCEEDED: none in time; the watch goes on. NOT_FOUND: the session was closed. Else why the watch ended.
  Result<SoilEstimate> receive(std::chrono::nanoseconds timeout);

 private:
  friend class Session;
  SoilWatch(std::shared_ptr<detail::Core> core, const std::string& session_id);
  std::unique_ptr<detail::SoilWatchImpl> impl_;
};

}  // namespace nesam
