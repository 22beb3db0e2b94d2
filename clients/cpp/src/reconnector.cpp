#include "reconnector.hpp"

#include <chrono>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <optional>
#include <thread>

#include <unistd.h>

namespace nesam::detail {

namespace {

using SteadyTime = std::chrono::steady_clock::time_point;

/// Longest wait for a change of the channel. Chosen: no more than a bound of how long the destructor could wait.
constexpr std::chrono::seconds wait_max{1};
/// How long the thread goes on after the last call that has failed: who does not call any more is not missed. Chosen: longer than between two calls of whoever minds.
constexpr std::chrono::seconds wanted_for{60};

}  // namespace

/// What the thread works with.
struct Reconnector::Waiting {
  std::mutex mutex;
  std::condition_variable changed;
  grpc::Channel* channel = nullptr;
  std::optional<grpc::CompletionQueue> queue;
  std::thread thread;
  /// Until when the channel is to be connected; absent while it is, or nobody calls.
  std::optional<SteadyTime> wanted_until;
  bool stopping = false;

  void run() noexcept;
};

Reconnector::Reconnector() : waiting_(std::make_unique<Waiting>()), process_(getpid()) {}

Reconnector::~Reconnector() {
  if (process_ != getpid()) {
    // Without the thread nothing of it can be ended in order.
    (void)waiting_.release();
    return;
  }
  stop();
  if (waiting_->thread.joinable()) waiting_->thread.join();
}

void Reconnector::call_failed(grpc::Channel& channel) noexcept {
  if (process_ != getpid() || channel.GetState(false) == GRPC_CHANNEL_READY) return;
  Waiting& waiting = *waiting_;
  try {
    const std::lock_guard lock(waiting.mutex);
    if (waiting.stopping) return;
    if (!waiting.thread.joinable()) {
      waiting.channel = &channel;
      if (!waiting.queue) waiting.queue.emplace();
      waiting.thread = std::thread([&waiting] { waiting.run(); });
    }
    waiting.wanted_until = std::chrono::steady_clock::now() + wanted_for;
  } catch (const std::exception&) {
    return;
  }
  waiting.changed.notify_all();
}

void Reconnector::stop() noexcept {
  if (process_ != getpid()) return;
  {
    const std::lock_guard lock(waiting_->mutex);
    waiting_->stopping = true;
  }
  waiting_->changed.notify_all();
}

void Reconnector::Waiting::run() noexcept {
  void* tag = nullptr;
  bool has_changed = false;
  while (true) {
    {
      std::unique_lock lock(mutex);
      changed.wait(lock, [this] { return wanted_until || stopping; });
      if (stopping) break;
      // Asks an idle channel to connect.
      const grpc_connectivity_state state = channel->GetState(true);
      if (state == GRPC_CHANNEL_READY || state == GRPC_CHANNEL_SHUTDOWN || std::chrono::steady_clock::now() > *wanted_until) {
        wanted_until.reset();
        continue;
      }
      channel->NotifyOnStateChange(state, std::chrono::system_clock::now() + wait_max, &*queue, nullptr);
    }
    queue->Next(&tag, &has_changed);
  }
  queue->Shutdown();
  while (queue->Next(&tag, &has_changed)) {
  }
}

}  // namespace nesam::detail
