#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

#include <nesam/error.hpp>
#include <nesam/prediction.hpp>

namespace nesam {

namespace detail {
class Core;
class PredictionStreamImpl;
}  // namespace detail

/// The answer to one request of a stream.
struct PredictionAnswer {
  /// Copied from the request.
  std::uint64_t tag;
  /// The prediction, or why there is none; errors as those of `Session::predict`.
  Result<Prediction> prediction;
};

/// The bidirectional stream of predictions from one session, for planners with a fixed rate. Each request gets exactly one answer, in order and with the same
/// numbers as from `Session::predict`; one that fails is answered and does not end the stream.
///
/// `send` and `receive` may be called from two threads at once. Two threads of the client write and read the network; they throw nothing, a failure ends the
/// stream and comes out of the next `send` or `receive` as a value. A prediction changes nothing: after a broken stream, ask again on a new one. Destruction
/// cancels what is under way and waits for those threads.
class PredictionStream {
 public:
  /// Requests whose answers may be outstanding or uncollected.
  static constexpr std::size_t pending_max = 16;

  PredictionStream(PredictionStream&&) noexcept;
  PredictionStream& operator=(PredictionStream&&) noexcept;
  ~PredictionStream();

  /// Queues a request; never waits for the network. Its arrays are only read during this call.
  ///
  /// INVALID_ARGUMENT: the controls do not have the shape that they say; nothing was sent. RESOURCE_EXHAUSTED: `pending_max` answers wait to be collected with
  /// `receive`. FAILED_PRECONDITION: after `finish`. Else why the stream ended.
  Result<void> send(const PredictRequest& request);

  /// The next answer.
  ///
  /// DEADLINE_EXCEEDED: none in time; the stream goes on. FAILED_PRECONDITION: the stream is finished and all answers were collected. Else why the stream
  /// ended; answers that arrived before the end come first.
  Result<PredictionAnswer> receive(std::chrono::nanoseconds timeout);

  /// Sends no more, and waits until the server has answered everything and ended the stream. The answers can still be collected with `receive`.
  ///
  /// DEADLINE_EXCEEDED: not in time; the stream is cancelled. Else why the stream ended.
  Result<void> finish(std::chrono::nanoseconds timeout);

 private:
  friend class Session;
  PredictionStream(std::shared_ptr<detail::Core> core, const std::string& session_id);
  std::unique_ptr<detail::PredictionStreamImpl> impl_;
};

}  // namespace nesam
