#pragma once

#include <chrono>
#include <memory>
#include <string>

#include <nesam/alarm.hpp>
#include <nesam/error.hpp>

namespace nesam {

namespace detail {
class Core;
class AlarmWatchImpl;
}  // namespace detail

/// Tells the alarms of one session: the active one first, if there is one, then each that is raised or cleared until the session closes.
///
/// One thread at a time may call `receive`. Destruction cancels the watch.
class AlarmWatch {
 public:
  AlarmWatch(AlarmWatch&&) noexcept;
  AlarmWatch& operator=(AlarmWatch&&) noexcept;
  ~AlarmWatch();

  /// The next alarm.
  ///
  /// DEADLINE_EXCEEDED: none in time; the watch goes on. NOT_FOUND: the session was closed. Else why the watch ended.
  Result<Alarm> receive(std::chrono::nanoseconds timeout);

 private:
  friend class Session;
  AlarmWatch(std::shared_ptr<detail::Core> core, const std::string& session_id);
  std::unique_ptr<detail::AlarmWatchImpl> impl_;
};

}  // namespace nesam
