#pragma once

#include <chrono>
#include <cstddef>
#include <memory>
#include <string>
#include <vector>

#include <nesam/error.hpp>
#include <nesam/measurement.hpp>

namespace nesam {

namespace detail {
class Core;
class DurableStreamImpl;
class MeasurementStreamImpl;
}  // namespace detail

/// The bidirectional stream that feeds one session. Each measurement gets exactly one answer, in order; a bad measurement is answered and does not end the
/// stream.
///
/// `send` and `receive` may be called from two threads at once. Two threads of the client write and read the network; they throw nothing, a failure ends the
/// stream and comes out of the next `send` or `receive` as a value. Destruction cancels what is under way and waits for those threads.
class MeasurementStream {
 public:
  /// Measurements whose answers may be outstanding or uncollected.
  static constexpr std::size_t pending_max = 1024;

  MeasurementStream(MeasurementStream&&) noexcept;
  MeasurementStream& operator=(MeasurementStream&&) noexcept;
  ~MeasurementStream();

  /// Queues a measurement; never waits for the network.
  ///
  /// RESOURCE_EXHAUSTED: `pending_max` answers wait to be collected with `receive`. FAILED_PRECONDITION: after `finish`. Else why the stream ended.
  Result<void> send(const Measurement& measurement);

  /// The next answer.
  ///
  /// DEADLINE_EXCEEDED: none in time; the stream goes on. FAILED_PRECONDITION: the stream is finished and all answers were collected. Else why the stream
  /// ended; answers that arrived before the end come first.
  Result<MeasurementAnswer> receive(std::chrono::nanoseconds timeout);

  /// Sends no more, and waits until the server has answered everything and ended the stream. The answers can still be collected with `receive`.
  ///
  /// DEADLINE_EXCEEDED: not in time; the stream is cancelled. Else why the stream ended.
  Result<void> finish(std::chrono::nanoseconds timeout);

  /// What was sent and not answered yet, oldest first: after a broken stream, send it again on a new one (the server tells what it has already).
  std::vector<Measurement> unanswered() const;

 private:
  friend class Session;
  friend class detail::DurableStreamImpl;
  MeasurementStream(std::shared_ptr<detail::Core> core, const std::string& session_id);
  std::unique_ptr<detail::MeasurementStreamImpl> impl_;
};

}  // namespace nesam
