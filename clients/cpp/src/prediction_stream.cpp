#include <nesam/prediction_stream.hpp>

#include <string>
#include <utility>

#include "convert_prediction.hpp"
#include "duplex_stream.hpp"

namespace nesam {
namespace detail {

struct PredictionExchange {
  using Request = v1::PredictRequest;
  using Reply = v1::PredictStreamReply;
  using Sent = Asked;
  using Answer = PredictionAnswer;
  static constexpr std::size_t pending_max = PredictionStream::pending_max;

  static auto open(Core& core, grpc::ClientContext& context) { return core.prediction->PredictStream(&context); }
  static Answer answer(const Core&, const std::string&, const Reply& reply, const Sent& asked) { return from_message(reply, asked); }
  static void unanswered(const Core&, const std::string&, const Sent&) {}
};

class PredictionStreamImpl : public DuplexStream<PredictionExchange> {
 public:
  using DuplexStream::DuplexStream;
};

}  // namespace detail

PredictionStream::PredictionStream(std::shared_ptr<detail::Core> core, const std::string& session_id)
    : impl_(std::make_unique<detail::PredictionStreamImpl>(std::move(core), session_id)) {}
PredictionStream::PredictionStream(PredictionStream&&) noexcept = default;
PredictionStream& PredictionStream::operator=(PredictionStream&&) noexcept = default;
PredictionStream::~PredictionStream() = default;

Result<void> PredictionStream::send(const PredictRequest& request) {
  auto message = detail::to_message(impl_->session_id, request);
  if (!message) return message.error();
  return impl_->send(std::move(*message), detail::Asked(request));
}
Result<PredictionAnswer> PredictionStream::receive(std::chrono::nanoseconds timeout) { return impl_->receive(timeout); }
Result<void> PredictionStream::finish(std::chrono::nanoseconds timeout) { return impl_->finish(timeout); }

}  // namespace nesam
