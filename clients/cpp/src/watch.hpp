#pragma once

#include <chrono>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "core.hpp"

namespace nesam::detail {

/// The request for what becomes of a session.
template <class Kind>
typename Kind::Request about(const std::string& session_id) {
  typename Kind::Request request;
  request.set_session_id(session_id);
  return request;
}

/// What it means that the news of a session have ended.
inline Error session_closed() { return Error(Code::not_found, "session_id", "the session was closed"); }

/// A server stream that tells what becomes of a session, or of work on it. It has no thread of its own: one operation is under way at a time, and `receive` waits for it.
///
/// `Kind` says what travels: the message `Request` that asks for it, the messages `News` and what becomes of them (`Value`), how the stream is opened
/// (`open`), how a message is read (`value`), what did not come when the time is over (`awaited`), and what it means that nothing more comes (`over`).
template <class Kind>
class Watch {
 public:
  using Value = typename Kind::Value;

  Watch(std::shared_ptr<Core> core, const typename Kind::Request& request);
  ~Watch();

  Result<Value> receive(std::chrono::nanoseconds timeout);

 private:
  enum class Operation { open, read, finish, none };

  /// Begins what follows the operation that has ended; the value that it has brought, if any.
  std::optional<Value> go_on(bool done);

  const std::shared_ptr<Core> core_;
  grpc::ClientContext context_;
  grpc::CompletionQueue queue_;
  typename Kind::News message_;
  grpc::Status status_;
  std::unique_ptr<grpc::ClientAsyncReader<typename Kind::News>> reader_;
  Operation under_way_ = Operation::open;
};

template <class Kind>
Watch<Kind>::Watch(std::shared_ptr<Core> core, const typename Kind::Request& request) : core_(std::move(core)) {
  core_->introduce(context_);
  reader_ = Kind::open(*core_, context_, request, queue_);
}

template <class Kind>
Watch<Kind>::~Watch() {
  context_.TryCancel();
  queue_.Shutdown();
  // Nothing may be under way when the call goes.
  void* tag = nullptr;
  bool done = false;
  while (queue_.Next(&tag, &done)) {
  }
}

template <class Kind>
auto Watch<Kind>::receive(std::chrono::nanoseconds timeout) -> Result<Value> {
  const auto until = Core::deadline(timeout);
  while (under_way_ != Operation::none) {
    void* tag = nullptr;
    bool done = false;
    if (queue_.AsyncNext(&tag, &done, until) != grpc::CompletionQueue::GOT_EVENT) {
      return Error(Code::deadline_exceeded, "", std::string("no ") + Kind::awaited + " came in time");
    }
    if (auto value = go_on(done)) return *std::move(value);
  }
  if (!status_.ok()) return core_->error_from(status_, context_);
  return Kind::over();
}

template <class Kind>
auto Watch<Kind>::go_on(bool done) -> std::optional<Value> {
  std::optional<Value> value;
  if (under_way_ == Operation::finish) {
    under_way_ = Operation::none;
  } else if (!done) {
    under_way_ = Operation::finish;
    reader_->Finish(&status_, nullptr);
  } else {
    if (under_way_ == Operation::read) value = Kind::value(message_);
    under_way_ = Operation::read;
    reader_->Read(&message_, nullptr);
  }
  return value;
}

}  // namespace nesam::detail
