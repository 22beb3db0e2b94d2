#include <nesam/session.hpp>

#include <string>
#include <utility>

#include "convert.hpp"
#include "session_impl.hpp"

namespace nesam {

namespace {

/// Measurements of one `send` that are on their way at the same time.
constexpr std::size_t in_flight_max = 128;
static_assert(in_flight_max <= MeasurementStream::pending_max);

using SteadyTime = std::chrono::steady_clock::time_point;

/// Sends and collects in turns, so that any number of measurements fits.
Result<std::vector<MeasurementAnswer>> exchange(MeasurementStream& stream, Span<const Measurement> measurements, SteadyTime until) {
  std::vector<MeasurementAnswer> answers;
  answers.reserve(measurements.size());
  std::size_t sent = 0;
  while (answers.size() < measurements.size()) {
    while (sent < measurements.size() && sent - answers.size() < in_flight_max) {
      if (auto queued = stream.send(measurements[sent]); !queued) return queued.error();
      ++sent;
    }
    auto answer = stream.receive(until - std::chrono::steady_clock::now());
    if (!answer) return answer.error();
    answers.push_back(std::move(*answer));
  }
  return answers;
}

}  // namespace

Session::Session(std::unique_ptr<detail::SessionImpl> impl) : impl_(std::move(impl)) {}

Session::Session(Session&& other) noexcept = default;

Session& Session::operator=(Session&& other) noexcept {
  // The session that is replaced is closed here; an assignment to itself changes nothing.
  Session taken(std::move(other));
  std::swap(impl_, taken.impl_);
  return *this;
}

Session::~Session() {
  if (!impl_) return;
  try {
    impl_->stream.reset();
    const bool is_newest = impl_->core->openings.newest(impl_->id) == impl_->opening;
    if (impl_->owned && is_newest) (void)impl_->core->close(impl_->id, impl_->core->options.close_timeout);
  } catch (...) {
    // Only want of memory gets here; the server forgets the session when it stops.
  }
}

const std::string& Session::id() const noexcept { return impl_->id; }
const VehicleCard& Session::vehicle() const noexcept { return impl_->vehicle; }

Result<SessionStatus> Session::status(Timeout timeout) const { return impl_->core->session(impl_->id, timeout); }

Result<Prediction> Session::predict(const PredictRequest& request, Timeout timeout) const { return impl_->core->predict(impl_->id, request, timeout); }

Result<PredictionStream> Session::predictions() const {
  return detail::open_stream([this] { return PredictionStream(impl_->core, impl_->id); });
}

SoilWatch Session::watch_soil() const { return SoilWatch(impl_->core, impl_->id); }
AlarmWatch Session::watch_alarms() const { return AlarmWatch(impl_->core, impl_->id); }

Result<SessionStatus> Session::apply_effects(const std::vector<Effect>& effects, const std::string& source, Timeout timeout) {
  v1::ApplyEffectsRequest request;
  request.set_session_id(impl_->id);
  request.set_source(source);
  for (const Effect& effect : effects) *request.add_effects() = detail::to_message(effect);
  auto reply = impl_->core->call(*impl_->core->sessions, &v1::Sessions::Stub::ApplyEffects, request, timeout);
  if (!reply) return reply.error();
  return detail::from_message(*reply);
}

Result<SessionStatus> Session::revert_effects(Timeout timeout) {
  v1::RevertEffectsRequest request;
  request.set_session_id(impl_->id);
  auto reply = impl_->core->call(*impl_->core->sessions, &v1::Sessions::Stub::RevertEffects, request, timeout);
  if (!reply) return reply.error();
  return detail::from_message(*reply);
}

Result<Session> Session::fork(const std::string& new_id, Timeout timeout) const {
  v1::ForkSessionRequest request;
  request.set_session_id(impl_->id);
  request.set_new_session_id(new_id);
  auto reply = impl_->core->call(*impl_->core->sessions, &v1::Sessions::Stub::Fork, request, timeout);
  if (!reply) return reply.error();
  return Session(std::make_unique<detail::SessionImpl>(impl_->core, impl_->core->opened(*reply)));
}

Result<std::string> Session::export_image(Timeout timeout) const { return impl_->core->export_session(impl_->id, timeout); }

Result<MeasurementStream> Session::measurements() const {
  return detail::open_stream([this] { return MeasurementStream(impl_->core, impl_->id); });
}

DurableStream Session::durable_measurements(const DurableOptions& options) const { return DurableStream(impl_->core, impl_->id, options); }

Result<MeasurementAnswer> Session::send(const Measurement& measurement, Timeout timeout) {
  auto answers = send(Span<const Measurement>(&measurement, 1), timeout);
  if (!answers) return answers.error();
  return std::move(answers->front());
}

Result<std::vector<MeasurementAnswer>> Session::send(Span<const Measurement> measurements, Timeout timeout) {
  const std::lock_guard lock(impl_->mutex);
  const auto until = std::chrono::steady_clock::now() + detail::bounded(timeout.value_or(impl_->core->options.timeout));
  const bool reused = impl_->stream.has_value();
  for (bool first = true;; first = false) {
    if (!impl_->stream) {
      auto opened = this->measurements();
      if (!opened) return opened.error();
      impl_->stream.emplace(std::move(*opened));
    }
    auto answers = exchange(*impl_->stream, measurements, until);
    if (answers) return answers;
    // Answers that come late would be taken for those of the next call.
    impl_->stream.reset();
    // A stream that broke while it rested, for example because the server was restarted, says nothing about this call. Resending is safe.
    if (!(first && reused && answers.error().code() == Code::unavailable)) return answers;
  }
}

Result<void> Session::close(Timeout timeout) {
  const std::lock_guard lock(impl_->mutex);
  impl_->stream.reset();
  auto closed = impl_->core->close(impl_->id, timeout);
  if (closed || closed.error().code() == Code::not_found) impl_->owned = false;
  return closed;
}

std::string Session::detach() noexcept {
  const std::lock_guard lock(impl_->mutex);
  impl_->owned = false;
  return impl_->id;
}

}  // namespace nesam
