#pragma once

#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <deque>
#include <exception>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "core.hpp"

namespace nesam::detail {

/// A bidirectional stream of a session with its two threads, in which each request gets exactly one answer, in order. The reader outlives the writer: it joins
/// it, then reads the final status, so that nothing is called on the stream after that.
///
/// `Kind` says what travels: the messages `Request` and `Reply`, what is kept of a request until its answer comes (`Sent`), the `Answer`, the most of them that
/// may be outstanding or uncollected (`pending_max`), how the stream is opened (`open`), how a reply is read (`answer`) and what becomes of a request that gets
/// none, or none in time (`unanswered`).
template <class Kind>
class DuplexStream {
 public:
  using Request = typename Kind::Request;
  using Reply = typename Kind::Reply;
  using Sent = typename Kind::Sent;
  using Answer = typename Kind::Answer;

  /// Throws `std::system_error` where the machine has no thread for it.
  DuplexStream(std::shared_ptr<Core> shared, const std::string& id);
  ~DuplexStream();

  Result<void> send(Request message, Sent sent);
  Result<Answer> receive(std::chrono::nanoseconds timeout);
  Result<void> finish(std::chrono::nanoseconds timeout);
  /// What was sent and not answered yet, oldest first.
  std::vector<Sent> unanswered() const;

  const std::string session_id;

 protected:
  const std::shared_ptr<Core> core;

 private:
  void write_all() noexcept;
  void read_all() noexcept;
  /// Hands a reply over as the answer to the oldest request. False: there is none.
  bool take(const Reply& reply);
  void end(std::optional<Error> error) noexcept;
  /// Tells of what has no answer; under the lock.
  void forgo() const {
    for (const Sent& sent : unanswered_) Kind::unanswered(*core, session_id, sent);
  }
  /// What to say after the end. Only when `ended_`.
  Error ending() const;

  grpc::ClientContext context_;
  std::unique_ptr<grpc::ClientReaderWriter<Request, Reply>> stream_;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::deque<Request> outbox_;
  std::deque<Sent> unanswered_;
  std::deque<Answer> inbox_;
  bool finishing_ = false;
  bool reading_ended_ = false;
  bool ended_ = false;
  /// Why the stream ended, when not because it was finished.
  std::optional<Error> failure_;

  std::thread writer_;
  std::thread reader_;
};

template <class Kind>
DuplexStream<Kind>::DuplexStream(std::shared_ptr<Core> shared, const std::string& id) : session_id(id), core(std::move(shared)) {
  core->introduce(context_);
  stream_ = Kind::open(*core, context_);
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

template <class Kind>
DuplexStream<Kind>::~DuplexStream() {
  {
    const std::lock_guard lock(mutex_);
    reading_ended_ = true;
  }
  context_.TryCancel();
  changed_.notify_all();
  reader_.join();
}

template <class Kind>
Result<void> DuplexStream<Kind>::send(Request message, Sent sent) {
  {
    const std::lock_guard lock(mutex_);
    if (ended_) return ending();
    if (finishing_) return Error(Code::failed_precondition, "", "the stream is finished; open another one");
    if (unanswered_.size() + inbox_.size() >= Kind::pending_max) {
      return Error(Code::resource_exhausted, "", std::to_string(Kind::pending_max) + " answers are outstanding or wait; receive them first");
    }
    outbox_.push_back(std::move(message));
    unanswered_.push_back(std::move(sent));
  }
  changed_.notify_all();
  return {};
}

template <class Kind>
auto DuplexStream<Kind>::receive(std::chrono::nanoseconds timeout) -> Result<Answer> {
  std::unique_lock lock(mutex_);
  const bool ready = changed_.wait_for(lock, bounded(timeout), [this] { return !inbox_.empty() || ended_; });
  if (!ready) {
    // Who only looks whether there is an answer has not waited for it.
    if (timeout > std::chrono::nanoseconds(0)) forgo();
    return Error(Code::deadline_exceeded, "", "no answer came in time");
  }
  if (inbox_.empty()) return ending();
  Answer answer = std::move(inbox_.front());
  inbox_.pop_front();
  return answer;
}

template <class Kind>
Result<void> DuplexStream<Kind>::finish(std::chrono::nanoseconds timeout) {
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

template <class Kind>
auto DuplexStream<Kind>::unanswered() const -> std::vector<Sent> {
  const std::lock_guard lock(mutex_);
  return {unanswered_.begin(), unanswered_.end()};
}

template <class Kind>
void DuplexStream<Kind>::write_all() noexcept {
  std::unique_lock lock(mutex_);
  while (true) {
    changed_.wait(lock, [this] { return reading_ended_ || ended_ || finishing_ || !outbox_.empty(); });
    if (reading_ended_ || ended_) return;
    if (outbox_.empty()) break;  // finishing
    const Request message = std::move(outbox_.front());
    outbox_.pop_front();
    lock.unlock();
    // False: the call is over; the reader learns why.
    if (!stream_->Write(message)) return;
    lock.lock();
  }
  lock.unlock();
  stream_->WritesDone();
}

template <class Kind>
void DuplexStream<Kind>::read_all() noexcept {
  std::optional<Error> failure;
  try {
    Reply message;
    while (stream_->Read(&message)) {
      if (!take(message)) {
        context_.TryCancel();
        failure = Error(Code::internal, "", "the server answered what was not sent");
        break;
      }
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
  if (!failure && !status.ok()) failure = core->error_from(status, context_);
  end(std::move(failure));
}

template <class Kind>
bool DuplexStream<Kind>::take(const Reply& reply) {
  const Sent* sent = nullptr;
  {
    const std::lock_guard lock(mutex_);
    if (unanswered_.empty()) return false;
    sent = &unanswered_.front();
  }
  // Only this thread takes requests off, and others that are added leave this one where it is: no lock is held while a large reply is unpacked.
  Answer answer = Kind::answer(*core, session_id, reply, *sent);
  {
    const std::lock_guard lock(mutex_);
    inbox_.push_back(std::move(answer));
    unanswered_.pop_front();
  }
  changed_.notify_all();
  return true;
}

template <class Kind>
void DuplexStream<Kind>::end(std::optional<Error> error) noexcept {
  {
    const std::lock_guard lock(mutex_);
    // An end without a failure that nobody asked for is one all the same: another stream can be opened, as after any break.
    const bool early = !finishing_ || !unanswered_.empty();
    forgo();
    if (!error && early) error = Error(Code::unavailable, "", "the server ended the stream before it was finished and everything answered");
    failure_ = std::move(error);
    ended_ = true;
  }
  changed_.notify_all();
}

template <class Kind>
Error DuplexStream<Kind>::ending() const {
  return failure_.value_or(Error(Code::failed_precondition, "", "the stream is finished; open another one"));
}

}  // namespace nesam::detail
