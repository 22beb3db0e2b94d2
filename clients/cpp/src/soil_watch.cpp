#include <nesam/soil_watch.hpp>

#include <utility>

#include "convert.hpp"
#include "watch.hpp"

namespace nesam {
namespace detail {

struct SoilNews {
  using Request = v1::WatchSoilRequest;
  using News = v1::SoilEstimate;
  using Value = SoilEstimate;
  static constexpr const char* awaited = "estimate of the soil";

  static auto open(Core& core, grpc::ClientContext& context, const Request& request, grpc::CompletionQueue& queue) {
    return core.soil->AsyncWatch(&context, request, &queue, nullptr);
  }
  static Value value(const News& message) { return from_message(message); }
  static Error over() { return session_closed(); }
};

class SoilWatchImpl : public Watch<SoilNews> {
 public:
  using Watch::Watch;
};

}  // namespace detail

SoilWatch::SoilWatch(std::shared_ptr<detail::Core> core, const std::string& session_id)
    : impl_(std::make_unique<detail::SoilWatchImpl>(std::move(core), detail::about<detail::SoilNews>(session_id))) {}
SoilWatch::SoilWatch(SoilWatch&&) noexcept = default;
SoilWatch& SoilWatch::operator=(SoilWatch&&) noexcept = default;
SoilWatch::~SoilWatch() = default;

Result<SoilEstimate> SoilWatch::receive(std::chrono::nanoseconds timeout) { return impl_->receive(timeout); }

}  // namespace nesam
