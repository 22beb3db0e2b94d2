#include <nesam/measurement_stream.hpp>

#include <string>
#include <utility>

#include "convert.hpp"
#include "duplex_stream.hpp"

namespace nesam {
namespace detail {

/// A measurement and when it was sent.
struct Reported {
  Measurement measurement;
  Moment sent;
};

struct MeasurementExchange {
  using Request = v1::Measurement;
  using Reply = v1::MeasurementAnswer;
  using Sent = Reported;
  using Answer = MeasurementAnswer;
  static constexpr std::size_t pending_max = MeasurementStream::pending_max;

  static auto open(Core& core, grpc::ClientContext& context) { return core.measurements->Stream(&context); }
  static Answer answer(const Core& core, const std::string& session_id, const Reply& reply, const Sent& sent) {
    Answer answer = from_message(reply);
    core.known_states.measured(sent.sent, session_id, sent.measurement, answer);
    return answer;
  }
  static void unanswered(const Core& core, const std::string& session_id, const Sent& sent) {
    core.known_states.unheard(sent.sent, session_id, sent.measurement);
  }
};

class MeasurementStreamImpl : public DuplexStream<MeasurementExchange> {
 public:
  using DuplexStream::DuplexStream;

  Result<void> send(const Measurement& measurement) {
    const Reported reported{measurement, core->known_states.ask()};
    auto queued = DuplexStream::send(to_message(session_id, measurement), reported);
    if (!queued) MeasurementExchange::unanswered(*core, session_id, reported);
    return queued;
  }
};

}  // namespace detail

MeasurementStream::MeasurementStream(std::shared_ptr<detail::Core> core, const std::string& session_id)
    : impl_(std::make_unique<detail::MeasurementStreamImpl>(std::move(core), session_id)) {}
MeasurementStream::MeasurementStream(MeasurementStream&&) noexcept = default;
MeasurementStream& MeasurementStream::operator=(MeasurementStream&&) noexcept = default;
MeasurementStream::~MeasurementStream() = default;

Result<void> MeasurementStream::send(const Measurement& measurement) {
  return impl_->send(measurement);
}
Result<MeasurementAnswer> MeasurementStream::receive(std::chrono::nanoseconds timeout) { return impl_->receive(timeout); }
Result<void> MeasurementStream::finish(std::chrono::nanoseconds timeout) { return impl_->finish(timeout); }
std::vector<Measurement> MeasurementStream::unanswered() const {
  std::vector<Measurement> measurements;
  for (detail::Reported& reported : impl_->unanswered()) measurements.push_back(std::move(reported.measurement));
  return measurements;
}

}  // namespace nesam
