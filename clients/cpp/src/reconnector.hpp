#pragma once

#include <memory>

#include <sys/types.h>

#include <grpcpp/grpcpp.h>

namespace nesam::detail {

/// Connects a channel that has lost its server.
///
/// gRPC goes on with a connection only while somebody waits on the channel, else every 5 s. Calls that fail at once do not wait: a planner that asks at a fixed
/// rate found a server that was restarted 6 to 9 s late. So a thread waits from the first call that fails until the channel is connected, or none has failed for a
/// minute. It is started when it is needed first and sleeps else; how calls fail is not changed. Safe from several threads at once.
///
/// The channel has to go between `stop` and the destructor: that ends the wait at once.
class Reconnector {
 public:
  Reconnector();
  Reconnector(const Reconnector&) = delete;
  Reconnector& operator=(const Reconnector&) = delete;
  ~Reconnector();

  /// Notes that a call has failed; does nothing where the channel is connected. Where the machine has no thread for it, gRPC is left to itself.
  void call_failed(grpc::Channel& channel) noexcept;

  /// From here on the channel is left alone.
  void stop() noexcept;

 private:
  struct Waiting;

  std::unique_ptr<Waiting> waiting_;
  /// A copy of the process that `fork` makes has no thread.
  pid_t process_;
};

}  // namespace nesam::detail
