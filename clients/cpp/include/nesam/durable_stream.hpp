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
}  // namespace detail

/// How long a durable stream tries.
struct DurableOptions {
  /// Longest time without the service before `DurableStream::send` gives up.
  std::chrono::nanoseconds reconnect = std::chrono::seconds(30);
  /// Time between two attempts, where the service asks for no other.
  std::chrono::nanoseconds pause = std::chrono::milliseconds(200);
  /// Measurements that are kept at most; beyond it `send` refuses. A store commits at least every second (`store.interval_s`), so this many are more than ten
  /// minutes at 100 Hz and about 15 MB; without a store nothing becomes durable, and they are all that can be sent.
  std::size_t pending_max = 65536;
};

/// A measurement that the service did not take when it was sent again, and what it said.
struct RefusedMeasurement {
  Measurement measurement;
  MeasurementAnswer answer;
};

/// A stream of the measurements of one session that outlives crashes of the server: what is not known to be durable is kept and sent again over a new
/// connection, and the service drops what it has. The server needs a store (`nesam serve --store DIR`).
///
/// A session that was closed and opened again under its name has nothing of what was kept: everything goes again, from the oldest on. Where another client did
/// that within a second, the stream learns it by the answer to the next measurement, behind which the session takes no older ones: `take_refused` has them.
///
/// One thread at a time may use it. It has no threads beyond those of its present `MeasurementStream`, and keeps the connection of its `Client` alive.
class DurableStream {
 public:
  DurableStream(DurableStream&&) noexcept;
  DurableStream& operator=(DurableStream&&) noexcept;
  ~DurableStream();

  /// Sends one measurement and waits for its answer, over as many connections as it takes. `Measurement::run` is left to the stream.
  /// One without a `sequence` or `boot_id` gets one of this program, so that nothing is taken for new that is sent again.
  ///
  /// UNAVAILABLE: the service was not reached, did not answer or had no room for `DurableOptions::reconnect`. NOT_FOUND: the session is not open. The measurement
  /// is kept, here and after every other error but one, and a later `send` or `flush` sends it. RESOURCE_EXHAUSTED of `pending_max`: so many are kept; this one is
  /// not, `flush` first. A measurement that the session refuses (`Rejected`, `NotFinite`, ...) is answered and not kept; where it is an older one that goes again
  /// before this one, `take_refused` has it.
  Result<MeasurementAnswer> send(const Measurement& measurement);

  /// Waits until everything is durable, sending again what has to be.
  ///
  /// DEADLINE_EXCEEDED: not in time, also where the server keeps no store. UNAVAILABLE: as `send`. NOT_FOUND: the session was closed. DATA_LOSS: all that the
  /// session has taken is durable, but some was refused when it was sent again; so until `take_refused` was called.
  Result<void> flush(std::chrono::nanoseconds timeout = std::chrono::seconds(10));

  /// Measurements that were refused when they were sent again and whose answers nobody got, oldest first, and forgets them: the last
  /// `DurableOptions::pending_max` of them.
  std::vector<RefusedMeasurement> take_refused();

  /// Measurements that are not known to be durable, oldest first.
  std::vector<Measurement> pending() const;

  /// Ends the connection; what is not durable stays in `pending`, and a later `send` or `flush` opens another one.
  void close();

 private:
  friend class Session;
  DurableStream(std::shared_ptr<detail::Core> core, const std::string& session_id, const DurableOptions& options);
  std::unique_ptr<detail::DurableStreamImpl> impl_;
};

}  // namespace nesam
