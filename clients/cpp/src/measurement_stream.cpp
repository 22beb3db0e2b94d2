#include <nesam/measurement_stream.hpp>

#include <utility>

#include "convert.hpp"
#include "stream_impl.hpp"

namespace nesam {
namespace detail {

StreamImpl::StreamImpl(std::shared_ptr<Core> core, std::string session_id) : core_(std::move(core)), session_id_(std::move(session_id)) {
  core_->introduce(context_);
  stream_ = core_->measurements->Stream(&context_);
  writer_ = std::thread([this] { write_all(); });
  try {
    reader_ = std::thread([this] { read_all(); });
  } catch (...) {
    // Without its reader the stream is of no use; the writer must not outlive this object.
    end(Error(Code::internal, "", "no thread for reading the answers"));
    context_.TryCancel();
    writer_.join();
    throw;
  }
}

StreamImpl::~StreamImpl() {
  {
    const std::lock_guard lock(mutex_);
    reading_ended_ = true;
  }
  context_.TryCancel();
  changed_.notify_all();
  reader_.join();
}

Result<void> StreamImpl::send(const Measurement& measurement) {
  v1::Measurement message = to_message(session_id_, measurement);
  {
    const std::lock_guard lock(mutex_);
    if (ended_) return ending();
    if (finishing_) return Error(Code::failed_precondition, "", "the stream is finished; open another one");
    if (unanswered_.size() + inbox_.size() >= MeasurementStream::pending_max) {
      return Error(Code::resource_exhausted, "", "answers to " + std::to_string(MeasurementStream::pending_max) + " measurements wait; receive them first");
    }
    outbox_.push_back(std::move(message));
    unanswered_.push_back(measurement);
  }
  changed_.notify_all();
  return {};
}

Result<MeasurementAnswer> StreamImpl::receive(std::chrono::nanoseconds timeout) {
  std::unique_lock lock(mutex_);
  const bool ready = changed_.wait_for(lock, bounded(timeout), [this] { return !inbox_.empty() || ended_; });
  if (!ready) return Error(Code::deadline_exceeded, "", "no answer to a measurement came in time");
  if (inbox_.empty()) return ending();
  MeasurementAnswer answer = std::move(inbox_.front());
  inbox_.pop_front();
  return answer;
}

Result<void> StreamImpl::finish(std::chrono::nanoseconds timeout) {
  std::unique_lock lock(mutex_);
  finishing_ = true;
  changed_.notify_all();
  if (!changed_.wait_for(lock, bounded(timeout), [this] { return ended_; })) {
    context_.TryCancel();
    return Error(Code::deadline_exceeded, "", "the server did not end the stream in time");
  }
  if (failure_) return *failure_;
  return {};
}

std::vector<Measurement> StreamImpl::unanswered() const {
  const std::lock_guard lock(mutex_);
  return {unanswered_.begin(), unanswered_.end()};
}

void StreamImpl::write_all() noexcept {
  std::unique_lock lock(mutex_);
  while (true) {
    changed_.wait(lock, [this] { return reading_ended_ || ended_ || finishing_ || !outbox_.empty(); });
    if (reading_ended_ || ended_) return;
    if (outbox_.empty()) break;  // finishing
    const v1::Measurement message = std::move(outbox_.front());
    outbox_.pop_front();
    lock.unlock();
    // False: the call is over; the reader learns why.
    if (!stream_->Write(message)) return;
    lock.lock();
  }
  lock.unlock();
  stream_->WritesDone();
}

void StreamImpl::read_all() noexcept {
  std::optional<Error> failure;
  try {
    v1::MeasurementAnswer message;
    while (stream_->Read(&message)) {
      MeasurementAnswer answer = from_message(message);
      {
        const std::lock_guard lock(mutex_);
        inbox_.push_back(std::move(answer));
        if (!unanswered_.empty()) unanswered_.pop_front();
      }
      changed_.notify_all();
    }
  } catch (const std::exception& exception) {
    context_.TryCancel();
    failure = Error(Code::internal, "", exception.what());
  }
  {
    const std::lock_guard lock(mutex_);
    reading_ended_ = true;
  }
  changed_.notify_all();
  writer_.join();
  const grpc::Status status = stream_->Finish();
  if (!failure && !status.ok()) failure = error_from(status, context_);
  end(std::move(failure));
}

void StreamImpl::end(std::optional<Error> error) noexcept {
  {
    const std::lock_guard lock(mutex_);
    if (!error && !unanswered_.empty()) error = Error(Code::unavailable, "", "the server ended the stream before it answered everything");
    failure_ = std::move(error);
    ended_ = true;
  }
  changed_.notify_all();
}

Error StreamImpl::ending() const {
  return failure_.value_or(Error(Code::failed_precondition, "", "the stream is finished; open another one"));
}

}  // namespace detail

MeasurementStream::MeasurementStream(std::unique_ptr<detail::StreamImpl> impl) : impl_(std::move(impl)) {}
MeasurementStream::MeasurementStream(MeasurementStream&&) noexcept = default;
MeasurementStream& MeasurementStream::operator=(MeasurementStream&&) noexcept = default;
MeasurementStream::~MeasurementStream() = default;

Result<void> MeasurementStream::send(const Measurement& measurement) { return impl_->send(measurement); }
Result<MeasurementAnswer> MeasurementStream::receive(std::chrono::nanoseconds timeout) { return impl_->receive(timeout); }
Result<void> MeasurementStream::finish(std::chrono::nanoseconds timeout) { return impl_->finish(timeout); }
std::vector<Measurement> MeasurementStream::unanswered() const { return impl_->unanswered(); }

}  // namespace nesam
