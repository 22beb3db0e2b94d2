#include <nesam/measurement_stream.hpp>

#include <utility>

#include "convert.hpp"
#include "duplex_stream.hpp"

namespace nesam {
namespace detail {

struct MeasurementExchange {
  using Request = v1::Measurement;
  using Reply = v1::MeasurementAnswer;
  using Sent = Measurement;
  using Answer = MeasurementAnswer;
  static constexpr std::size_t pending_max = MeasurementStream::pending_max;

  static auto open(Core& core, grpc::ClientContext& context) { return core.measurements->Stream(&context); }
  static Answer answer(const Core& core, const Reply& reply, const Sent& sent) {
    Answer answer = from_message(reply);
    core.known_states.measured(sent, answer);
    return answer;
  }
};

class MeasurementStreamImpl : public DuplexStream<MeasurementExchange> {
 public:
  using DuplexStream::DuplexStream;
};

}  // namespace detail

MeasurementStream::MeasurementStream(std::shared_ptr<detail::Core> core, const std::string& session_id)
    : impl_(std::make_unique<detail::MeasurementStreamImpl>(std::move(core), session_id)) {}
MeasurementStream::MeasurementStream(MeasurementStream&&) noexcept = default;
MeasurementStream& MeasurementStream::operator=(MeasurementStream&&) noexcept = default;
MeasurementStream::~MeasurementStream() = default;

Result<void> MeasurementStream::send(const Measurement& measurement) {
  return impl_->send(detail::to_message(impl_->session_id, measurement), measurement);
}
Result<MeasurementAnswer> MeasurementStream::receive(std::chrono::nanoseconds timeout) { return impl_->receive(timeout); }
Result<void> MeasurementStream::finish(std::chrono::nanoseconds timeout) { return impl_->finish(timeout); }
std::vector<Measurement> MeasurementStream::unanswered() const { return impl_->unanswered(); }

}  // namespace nesam
