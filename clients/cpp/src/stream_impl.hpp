#pragma once

#include <condition_variable>
#include <deque>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "core.hpp"

namespace nesam::detail {

/// A measurement stream with its two threads. The reader outlives the writer: it joins it, then reads the final status, so that nothing is called on the stream
/// after that.
class StreamImpl {
 public:
  StreamImpl(std::shared_ptr<Core> core, std::string session_id);
  ~StreamImpl();

  Result<void> send(const Measurement& measurement);
  Result<MeasurementAnswer> receive(std::chrono::nanoseconds timeout);
  Result<void> finish(std::chrono::nanoseconds timeout);
  std::vector<Measurement> unanswered() const;

 private:
  void write_all() noexcept;
  void read_all() noexcept;
  void end(std::optional<Error> error) noexcept;
  /// What to say after the end. Only when `ended_`.
  Error ending() const;

  const std::shared_ptr<Core> core_;
  const std::string session_id_;
  grpc::ClientContext context_;
  std::unique_ptr<grpc::ClientReaderWriter<v1::Measurement, v1::MeasurementAnswer>> stream_;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::deque<v1::Measurement> outbox_;
  std::deque<Measurement> unanswered_;
  std::deque<MeasurementAnswer> inbox_;
  bool finishing_ = false;
  bool reading_ended_ = false;
  bool ended_ = false;
  /// Why the stream ended, when not because it was finished.
  std::optional<Error> failure_;

  std::thread writer_;
  std::thread reader_;
};

}  // namespace nesam::detail
