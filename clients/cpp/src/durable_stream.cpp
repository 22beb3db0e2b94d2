#include <nesam/durable_stream.hpp>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <map>
#include <mutex>
#include <optional>
#include <random>
#include <string>
#include <thread>
#include <utility>

#include "core.hpp"

namespace nesam {
namespace detail {

namespace {

using SteadyTime = std::chrono::steady_clock::time_point;

/// How a connection that broke looks, by itself or through a proxy. Everything else is a refusal.
bool broken(const Error& error) {
  const Code code = error.code();
  return code == Code::unavailable || code == Code::cancelled || code == Code::unknown || code == Code::internal;
}

/// Whether the session is not open.
bool unknown_session(Code code, const std::string& field) { return code == Code::not_found && field == "session_id"; }

/// Time without an answer after which the session is read before the next measurement goes. Chosen: what is sent at a usual rate waits for one answer each.
constexpr std::chrono::seconds rest_max{1};

/// Whether the service had no room for a measurement: it has to be sent again.
bool no_room(const MeasurementAnswer& answer) {
  const auto* rejected = answer.is<Rejected>();
  return rejected && (rejected->code == Code::resource_exhausted || rejected->code == Code::unavailable);
}

/// A measurement without a number or a boot gets one of this program: by them the service knows what it has had, however long ago.
void number(Measurement& measurement, const std::string& session_id) {
  static const std::uint64_t boot_id = [] {
    std::random_device random;
    return (static_cast<std::uint64_t>(random()) << 32U) | random() | 1U;
  }();
  static std::mutex mutex;
  static std::map<std::string, std::uint64_t> numbers;
  const std::lock_guard<std::mutex> lock(mutex);
  if (measurement.sequence == 0) measurement.sequence = ++numbers[session_id];
  if (measurement.boot_id == 0) measurement.boot_id = boot_id;
}

}  // namespace

class DurableStreamImpl {
 public:
  DurableStreamImpl(std::shared_ptr<Core> core, const std::string& session_id, const DurableOptions& options)
      : core_(std::move(core)), session_id_(session_id), options_(options), opening_(core_->known_states.opening(session_id)) {}

  Result<MeasurementAnswer> send(const Measurement& measurement) {
    if (kept() >= options_.pending_max) {
      return Error(Code::resource_exhausted, "pending_max", std::to_string(kept()) + " measurements are not known to be durable; flush them first");
    }
    const bool numbered = measurement.sequence != 0;
    if (numbered_.value_or(numbered) != numbered) {
      return Error(Code::invalid_argument, "sequence", "some measurements have a number and some have none; 0 is none, numbers begin at 1");
    }
    numbered_ = numbered;
    waiting_.push_back({measurement, std::nullopt});
    Measurement& kept_one = waiting_.back().measurement;
    // Which run counts is the matter of this object.
    kept_one.run = 0;
    number(kept_one, session_id_);
    newest_.emplace(kept_one, core_->known_states.ask());
    accepted_.reset();
    return deliver(SteadyTime::max(), true);
  }

  Result<void> flush(std::chrono::nanoseconds timeout) {
    const SteadyTime end = std::chrono::steady_clock::now() + bounded(timeout);
    while (kept() != 0) {
      if (opened_anew()) begin_anew();
      if (!waiting_.empty()) {
        auto answer = deliver(end, false);
        if (!answer && (answer.error().code() != Code::unavailable || !over(end))) return answer.error();
      }
      auto status = core_->session(session_id_, std::min(left(end), core_->options.timeout));
      if (status) {
        told(*status);
      } else if (broken(status.error())) {
        forget_places();
      } else if (status.error().code() != Code::deadline_exceeded) {
        if (unknown_session(status.error().code(), status.error().field())) begin_anew();
        return status.error();
      }
      if (kept() == 0) break;
      if (over(end)) {
        return Error(Code::deadline_exceeded, "", std::to_string(kept()) + " measurements are not durable in time; does the server keep a store?");
      }
      std::this_thread::sleep_for(std::min({bounded(options_.pause), left(end), std::chrono::nanoseconds(std::chrono::milliseconds(50))}));
    }
    if (refused_.empty()) return {};
    return Error(Code::data_loss, "", std::to_string(refused_.size()) + " measurements were refused when they were sent again; `take_refused` has them");
  }

  std::vector<RefusedMeasurement> take_refused() {
    return std::exchange(refused_, {});
  }

  std::vector<Measurement> pending() const {
    std::vector<Measurement> measurements;
    measurements.reserve(kept());
    for (const Answered& answered : answered_) measurements.push_back(answered.measurement);
    for (const Waiting& waiting : waiting_) measurements.push_back(waiting.measurement);
    return measurements;
  }

  /// What is sent over the next connection is sent from the beginning: another run of the server may count otherwise.
  void close() {
    stream_.reset();
    forget_places();
  }

 private:
  struct Answered {
    Measurement measurement;
    std::uint64_t place;
  };
  struct Taken {
    std::uint64_t run;
    std::uint64_t place;
  };
  struct Waiting {
    Measurement measurement;
    /// Run in which the session took it already and its place there, as far as is known.
    std::optional<Taken> taken;
  };

  static std::chrono::nanoseconds left(SteadyTime end) { return bounded(end - std::chrono::steady_clock::now()); }
  static bool over(SteadyTime end) { return std::chrono::steady_clock::now() >= end; }

  /// Pause before the next connection: what the service asks for, else `pause`; never none at all.
  std::chrono::nanoseconds until_again(const Error& error) const {
    constexpr std::chrono::nanoseconds least = std::chrono::milliseconds(10);
    return error.retry_after() ? std::max(least, bounded(*error.retry_after())) : bounded(options_.pause);
  }

  /// Sends what has no answer yet, oldest first, over as many connections as it takes until `end`; the answer to the newest, which the caller is `told`.
  Result<MeasurementAnswer> deliver(SteadyTime end, bool is_told) {
    const SteadyTime until = std::min(end, std::chrono::steady_clock::now() + bounded(options_.reconnect));
    while (true) {
      auto answer = attempt(end, is_told);
      if (answer) return answer;
      close();
      if (!broken(answer.error())) return answer;
      // Where the vehicle was is known by the newest measurement, though older ones go first.
      if (newest_) core_->known_states.unheard(newest_->second, session_id_, newest_->first);
      if (over(until)) {
        if (answer.error().code() == Code::unavailable) return answer;
        return Error(Code::unavailable, answer.error().field(), answer.error().what());
      }
      std::this_thread::sleep_for(std::min(until_again(answer.error()), left(until)));
    }
  }

  /// The same over one connection, each measurement after the answer to the one before: where the service has no room for one, later ones must not overtake it.
  Result<MeasurementAnswer> attempt(SteadyTime end, bool is_told) {
    if (auto same = look(end); !same) return same.error();
    if (!stream_) {
      auto opened = open_stream([this] { return MeasurementStream(core_, session_id_); });
      if (!opened) return opened.error();
      stream_.emplace(std::move(*opened));
    }
    std::optional<MeasurementAnswer> newest;
    while (!waiting_.empty()) {
      auto answer = exchange(waiting_.front().measurement, std::min(left(end), bounded(options_.reconnect)));
      if (!answer) return answer.error();
      if (no_room(*answer)) return Error(Code::unavailable, "", answer->is<Rejected>()->message);
      if (const auto* rejected = answer->is<Rejected>(); rejected && unknown_session(rejected->code, rejected->field)) {
        begin_anew();
        return Error(rejected->code, rejected->field, rejected->message);
      }
      const bool is_newest = is_told && waiting_.size() == 1;
      // A refused measurement has no place and is not kept; its answer need not tell who counts.
      if (answer->place != 0) {
        if (counted_by_another(answer->run, answer->accepted() ? answer->place - 1 : answer->place)) {
          const bool follows = !answered_.empty();
          begin_anew();
          if (follows) {
            // Those before it come first now, and then it once more.
            if (is_newest && answer->accepted()) accepted_ = std::move(*answer);
            return Error(Code::unavailable, "", "another run of the server counts now, or the session began anew");
          }
        }
        run_ = answer->run;
        place_ = answer->place;
        answered_.push_back({std::move(waiting_.front().measurement), answer->place});
        durable(run_, answer->durable_place);
      } else if (const auto& taken = waiting_.front().taken; taken && taken->run == answer->run && !answer->is<Rejected>()) {
        // The session has it, and does not know it again: it is of a boot that has ended. It keeps its place until that is durable, which this answer cannot tell:
        // the session may have begun anew.
        answered_.push_back({std::move(waiting_.front().measurement), taken->place});
      } else if (!is_newest) {
        if (refused_.size() >= options_.pending_max) refused_.erase(refused_.begin());
        refused_.push_back({std::move(waiting_.front().measurement), *answer});
      }
      waiting_.pop_front();
      newest = std::move(*answer);
    }
    if (!newest) return Error(Code::internal, "", "nothing to send; this is a bug");
    // It was accepted before what is older could be sent again.
    if (accepted_ && newest->is<Duplicate>()) return *std::exchange(accepted_, std::nullopt);
    return *std::move(newest);
  }

  /// Looks whether the session began anew while nothing was sent: then what is kept is older than what comes next, and has to go first.
  Result<void> look(SteadyTime end) {
    if (opened_anew()) begin_anew();
    if (answered_.empty() || std::chrono::steady_clock::now() - heard_ < rest_max) return {};
    auto status = core_->session(session_id_, std::min({left(end), bounded(options_.reconnect), core_->options.timeout}));
    if (status) {
      told(*status);
      return {};
    }
    const Code code = status.error().code();
    if (code == Code::deadline_exceeded) return Error(Code::unavailable, "", "the service did not answer in time");
    const bool is_unknown = unknown_session(code, status.error().field());
    if (is_unknown) begin_anew();
    if (is_unknown || broken(status.error())) return status.error();
    return {};
  }

  /// Whether this client has opened or closed the session since this was asked last.
  bool opened_anew() {
    const std::uint64_t opening = core_->known_states.opening(session_id_);
    return std::exchange(opening_, opening) != opening;
  }

  /// What the session says of itself.
  void told(const SessionStatus& status) {
    heard_ = std::chrono::steady_clock::now();
    if (counted_by_another(status.run, status.accepted)) {
      stream_.reset();
      return begin_anew();
    }
    durable(status.run, status.durable_place);
  }

  Result<MeasurementAnswer> exchange(const Measurement& measurement, std::chrono::nanoseconds timeout) {
    if (auto queued = stream_->send(measurement); !queued) return queued.error();
    auto answer = stream_->receive(timeout);
    heard_ = std::chrono::steady_clock::now();
    // Who does not answer is not there; the answer must not be taken for that of the next measurement.
    if (!answer && answer.error().code() == Code::deadline_exceeded) return Error(Code::unavailable, "", "the service did not answer in time");
    return answer;
  }

  /// Whether answers so far came from another run, or from a session that began anew, as it has `accepted` fewer than it had: then everything kept is sent again,
  /// from the oldest on.
  bool counted_by_another(std::uint64_t run, std::uint64_t accepted) const { return place_ != 0 && (run != run_ || accepted < place_); }

  void durable(std::uint64_t run, std::uint64_t durable_place) {
    run_ = run;
    while (!answered_.empty() && answered_.front().place <= durable_place) answered_.pop_front();
  }

  std::size_t kept() const { return answered_.size() + waiting_.size(); }

  /// Another run of the server may count otherwise.
  void forget_places() {
    for (; !answered_.empty(); answered_.pop_back()) {
      waiting_.push_front({std::move(answered_.back().measurement), Taken{run_, answered_.back().place}});
    }
  }

  /// The session is closed or began anew, or another run counts: what it had may be gone, and all is sent again, from the oldest on.
  void begin_anew() {
    forget_places();
    for (Waiting& waiting : waiting_) waiting.taken.reset();
    place_ = 0;
  }

  const std::shared_ptr<Core> core_;
  const std::string session_id_;
  const DurableOptions options_;
  std::optional<MeasurementStream> stream_;
  /// What is kept, oldest first: all that is answered is older than all that waits. Durable ones leave from the front, as places only rise.
  std::deque<Answered> answered_;
  /// Without an answer of this run of the server.
  std::deque<Waiting> waiting_;
  /// Who counts the places, and the newest one; 0 = none since it began.
  std::uint64_t run_ = 0;
  std::uint64_t place_ = 0;
  /// What was refused and nobody was told: the session does not have it.
  std::vector<RefusedMeasurement> refused_;
  /// Which session of the name it was.
  std::uint64_t opening_;
  /// When the service was heard last.
  SteadyTime heard_;
  /// The answer to the measurement that was given last, where it is sent once more all the same.
  std::optional<MeasurementAnswer> accepted_;
  /// The measurement that was given last, and when.
  std::optional<std::pair<Measurement, Moment>> newest_;
  /// Whether measurements come with numbers of their own; absent before the first.
  std::optional<bool> numbered_;
};

}  // namespace detail

DurableStream::DurableStream(std::shared_ptr<detail::Core> core, const std::string& session_id, const DurableOptions& options)
    : impl_(std::make_unique<detail::DurableStreamImpl>(std::move(core), session_id, options)) {}
DurableStream::DurableStream(DurableStream&&) noexcept = default;
DurableStream& DurableStream::operator=(DurableStream&&) noexcept = default;
DurableStream::~DurableStream() = default;

Result<MeasurementAnswer> DurableStream::send(const Measurement& measurement) { return impl_->send(measurement); }
Result<void> DurableStream::flush(std::chrono::nanoseconds timeout) { return impl_->flush(timeout); }
std::vector<Measurement> DurableStream::pending() const { return impl_->pending(); }
std::vector<RefusedMeasurement> DurableStream::take_refused() { return impl_->take_refused(); }
void DurableStream::close() { impl_->close(); }

}  // namespace nesam
