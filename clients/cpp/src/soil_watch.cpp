#include <nesam/soil_watch.hpp>

#include <optional>
#include <utility>

#include "convert.hpp"
#include "core.hpp"

namespace nesam {
namespace detail {

/// A server stream without a thread of its own: one operation is under way at a time, and `receive` waits for it.
class SoilWatchImpl {
 public:
  SoilWatchImpl(std::shared_ptr<Core> core, const std::string& session_id) : core_(std::move(core)) {
    core_->introduce(context_);
    v1::WatchSoilRequest request;
    request.set_session_id(session_id);
    reader_ = core_->soil->AsyncWatch(&context_, request, &queue_, nullptr);
  }

  ~SoilWatchImpl() {
    context_.TryCancel();
    queue_.Shutdown();
    // Nothing may be under way when the call goes.
    void* tag = nullptr;
    bool done = false;
    while (queue_.Next(&tag, &done)) {
    }
  }

  Result<SoilEstimate> receive(std::chrono::nanoseconds timeout) {
    const auto until = Core::deadline(timeout);
    while (under_way_ != Operation::none) {
      void* tag = nullptr;
      bool done = false;
      if (queue_.AsyncNext(&tag, &done, until) != grpc::CompletionQueue::GOT_EVENT) {
        return Error(Code::deadline_exceeded, "", "no estimate of the soil came in time");
      }
      if (auto estimate = go_on(done)) return *std::move(estimate);
    }
    if (!status_.ok()) return error_from(status_, context_);
    return Error(Code::not_found, "session_id", "the session was closed");
  }

 private:
  enum class Operation { open, read, finish, none };

  /// Begins what follows the operation that has ended; the estimate that it has brought, if any.
  std::optional<SoilEstimate> go_on(bool done) {
    std::optional<SoilEstimate> estimate;
    if (under_way_ == Operation::finish) {
      under_way_ = Operation::none;
    } else if (!done) {
      under_way_ = Operation::finish;
      reader_->Finish(&status_, nullptr);
    } else {
      if (under_way_ == Operation::read) estimate = from_message(message_);
      under_way_ = Operation::read;
      reader_->Read(&message_, nullptr);
    }
    return estimate;
  }

  const std::shared_ptr<Core> core_;
  grpc::ClientContext context_;
  grpc::CompletionQueue queue_;
  v1::SoilEstimate message_;
  grpc::Status status_;
  std::unique_ptr<grpc::ClientAsyncReader<v1::SoilEstimate>> reader_;
  Operation under_way_ = Operation::open;
};

}  // namespace detail

SoilWatch::SoilWatch(std::shared_ptr<detail::Core> core, const std::string& session_id)
    : impl_(std::make_unique<detail::SoilWatchImpl>(std::move(core), session_id)) {}
SoilWatch::SoilWatch(SoilWatch&&) noexcept = default;
SoilWatch& SoilWatch::operator=(SoilWatch&&) noexcept = default;
SoilWatch::~SoilWatch() = default;

Result<SoilEstimate> SoilWatch::receive(std::chrono::nanoseconds timeout) { return impl_->receive(timeout); }

}  // namespace nesam
