#pragma once

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <nesam/alarm_watch.hpp>
#include <nesam/durable_stream.hpp>
#include <nesam/effect.hpp>
#include <nesam/error.hpp>
#include <nesam/measurement.hpp>
#include <nesam/measurement_stream.hpp>
#include <nesam/prediction.hpp>
#include <nesam/prediction_stream.hpp>
#include <nesam/session_status.hpp>
#include <nesam/soil_watch.hpp>
#include <nesam/span.hpp>
#include <nesam/types.hpp>

namespace nesam {

namespace detail {
class Core;
struct SessionImpl;
}  // namespace detail

/// What to open.
struct OpenOptions {
  /// 1 to 64 of A-Z a-z 0-9 _ . -
  std::string vehicle_id;
  /// Name of the session, same characters; empty = the vehicle id.
  std::string session_id;
  /// Name of the vehicle card that the caller expects; empty = whatever the bundle was trained for.
  std::string vehicle_card;
  /// Uploaded map to drive on; empty = flat ground and the default soil, and every prediction says so (`validity_no_map`).
  std::string map_id;
  /// First measurement, if there is one already.
  std::optional<Measurement> initial;
};

/// An open session, closed when this object goes (unless `detach`ed): the service forgets the vehicle's history then.
///
/// All methods may be called from several threads at once. The object keeps the connection of its `Client` alive. A moved-from session may only be assigned to
/// or destroyed.
class Session {
 public:
  Session(Session&& other) noexcept;
  Session& operator=(Session&& other) noexcept;
  /// Closes the session if it is still open, waiting at most `ClientOptions::close_timeout`; a failure is ignored.
  ~Session();

  const std::string& id() const noexcept;
  /// Vehicle card of the server's bundle: ranges and meaning of the commands.
  const VehicleCard& vehicle() const noexcept;

  /// The session as the service holds it now. NOT_FOUND: it was closed.
  Result<SessionStatus> status(Timeout timeout = {}) const;

  /// Rolls N candidate command sequences K steps of 0.1 s ahead. Only reads the session. The first prediction at a new place takes longer, because the
  /// service encodes the terrain there.
  ///
  /// INVALID_ARGUMENT: names the field and the limit. NOT_FOUND: the session was closed. FAILED_PRECONDITION: no start state and no measurement yet, or the
  /// measured position lies outside the map. RESOURCE_EXHAUSTED: overloaded, ask again. DEADLINE_EXCEEDED: not in time. Instead of the last two and UNAVAILABLE
  /// `PredictRequest::fallback` answers, where there is one and a start is given or known, and `Prediction::computed_by` says so.
  Result<Prediction> predict(const PredictRequest& request, Timeout timeout = {}) const;

  /// Opens a stream of predictions from this session, for planners with a fixed rate. UNAVAILABLE comes out of its first `receive`.
  Result<PredictionStream> predictions() const;

  /// Watches what this session learns of the soil. UNAVAILABLE and NOT_FOUND come out of its first `receive`.
  SoilWatch watch_soil() const;

  /// Watches the alarms of this session. UNAVAILABLE and NOT_FOUND come out of its first `receive`.
  AlarmWatch watch_alarms() const;

  /// Puts physical effects on this session, in place of those that were applied before: its predictions and its soil filter use them from now on, and its soil
  /// begins again from the prior. Needs the rights of an operator.
  ///
  /// `effects`: 1 to 16. `source`: where they come from, for people, at most 256 bytes. INVALID_ARGUMENT names the effect: none or too many, an unknown id, an
  /// unknown, missing or repeated parameter, a value outside its range. NOT_FOUND: the session was closed.
  Result<SessionStatus> apply_effects(const std::vector<Effect>& effects, const std::string& source = {}, Timeout timeout = {});

  /// Takes the applied effects away again; a session without any stays as it is. Needs the rights of an operator. NOT_FOUND: the session was closed.
  Result<SessionStatus> revert_effects(Timeout timeout = {});

  /// Copies this session with its history and its soil under a new name, for questions of "what if" that leave this one alone; the copy closes when the returned
  /// object goes.
  ///
  /// INVALID_ARGUMENT: a bad name. ALREADY_EXISTS: a session of the new name is open. NOT_FOUND: this one was closed. RESOURCE_EXHAUSTED: too many sessions.
  Result<Session> fork(const std::string& new_id, Timeout timeout = {}) const;

  /// Everything that this session remembers, for `Client::import_session`. NOT_FOUND: it was closed.
  Result<std::string> export_image(Timeout timeout = {}) const;

  /// Opens a stream of measurements into this session, for senders that do not wait for each answer. UNAVAILABLE comes out of its first `receive`.
  Result<MeasurementStream> measurements() const;

  /// A stream that keeps measurements until the service has them on stable storage, and sends them again after a crash of the server, which needs a store
  /// (`nesam serve --store DIR`). Nothing is sent yet.
  DurableStream durable_measurements(const DurableOptions& options = {}) const;

  /// Sends one measurement and waits for its answer, on a stream that stays open between calls.
  ///
  /// DEADLINE_EXCEEDED and UNAVAILABLE leave open whether the measurement was applied; sending it again is safe and answered with `Duplicate` if it was.
  Result<MeasurementAnswer> send(const Measurement& measurement, Timeout timeout = {});

  /// Sends several measurements at once and waits for all answers, in order. The timeout holds for all of them together; errors as for one.
  Result<std::vector<MeasurementAnswer>> send(Span<const Measurement> measurements, Timeout timeout = {});

  /// Closes the session. NOT_FOUND: it was closed already. After a failure other than NOT_FOUND the destructor tries once more.
  Result<void> close(Timeout timeout = {});

  /// Leaves the session open on the server when this object goes. Returns its id, for `Client::attach`.
  std::string detach() noexcept;

 private:
  friend class Client;
  explicit Session(std::unique_ptr<detail::SessionImpl> impl);
  std::unique_ptr<detail::SessionImpl> impl_;
};

}  // namespace nesam
