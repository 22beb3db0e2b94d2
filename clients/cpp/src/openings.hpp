#pragma once

#include <cstdint>
#include <mutex>
#include <string>
#include <unordered_map>

namespace nesam::detail {

/// Which opening of a session is the newest of its name, as far as this client has opened it: who holds an older one does not close it.
class Openings {
 public:
  /// Notes that a session of this name was opened.
  void opened(const std::string& id) {
    const std::lock_guard lock(mutex_);
    newest_[id] = ++count_;
  }

  /// Notes that it was closed.
  void closed(const std::string& id) {
    const std::lock_guard lock(mutex_);
    newest_.erase(id);
  }

  /// The newest opening of this name; 0 = this client has not opened it.
  std::uint64_t newest(const std::string& id) const {
    const std::lock_guard lock(mutex_);
    const auto found = newest_.find(id);
    return found == newest_.end() ? 0 : found->second;
  }

 private:
  mutable std::mutex mutex_;
  std::uint64_t count_ = 0;
  std::unordered_map<std::string, std::uint64_t> newest_;
};

}  // namespace nesam::detail
