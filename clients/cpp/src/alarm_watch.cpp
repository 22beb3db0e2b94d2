#include <nesam/alarm_watch.hpp>

#include <utility>

#include "convert.hpp"
#include "watch.hpp"

namespace nesam {
namespace detail {

struct AlarmNews {
  using Request = v1::WatchAlarmsRequest;
  using News = v1::Alarm;
  using Value = Alarm;
  static constexpr const char* awaited = "alarm";

  static auto open(Core& core, grpc::ClientContext& context, const Request& request, grpc::CompletionQueue& queue) {
    return core.sessions->AsyncWatchAlarms(&context, request, &queue, nullptr);
  }
  static Value value(const News& message) { return from_message(message); }
  static Error over() { return session_closed(); }
};

class AlarmWatchImpl : public Watch<AlarmNews> {
 public:
  using Watch::Watch;
};

}  // namespace detail

AlarmWatch::AlarmWatch(std::shared_ptr<detail::Core> core, const std::string& session_id)
    : impl_(std::make_unique<detail::AlarmWatchImpl>(std::move(core), detail::about<detail::AlarmNews>(session_id))) {}
AlarmWatch::AlarmWatch(AlarmWatch&&) noexcept = default;
AlarmWatch& AlarmWatch::operator=(AlarmWatch&&) noexcept = default;
AlarmWatch::~AlarmWatch() = default;

Result<Alarm> AlarmWatch::receive(std::chrono::nanoseconds timeout) { return impl_->receive(timeout); }

}  // namespace nesam
