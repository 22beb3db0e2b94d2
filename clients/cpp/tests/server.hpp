#pragma once

// A server that a test may kill and start again, on one port and one store.

#include <fcntl.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <fstream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

extern char** environ;

class Server {
 public:
  /// `arguments` follow `nesam serve`; what the server says goes into `folder`. Starts it; throws when it does not get ready in a minute.
  Server(std::string binary, std::string folder, std::vector<std::string> arguments)
      : binary_(std::move(binary)), folder_(std::move(folder)), arguments_(std::move(arguments)) {
    start();
  }
  Server(const Server&) = delete;
  Server& operator=(const Server&) = delete;
  ~Server() { (void)stop(SIGKILL); }

  /// Address of gRPC, the same after each start.
  const std::string& address() const { return address_; }

  /// When it said last that it is ready, to within 50 ms.
  std::chrono::steady_clock::time_point ready_since() const { return ready_since_; }

  void start() {
    const std::string out = folder_ + "/durable.out", log = folder_ + "/durable.log";
    std::vector<std::string> words = {binary_, "serve", "--grpc", address_, "--no-http", "--no-zenoh"};
    words.insert(words.end(), arguments_.begin(), arguments_.end());
    std::vector<char*> argv;
    for (std::string& word : words) argv.push_back(word.data());
    argv.push_back(nullptr);
    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_addopen(&actions, STDOUT_FILENO, out.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0600);
    posix_spawn_file_actions_addopen(&actions, STDERR_FILENO, log.c_str(), O_WRONLY | O_CREAT | O_APPEND, 0600);
    // What the server before has said is not taken for what this one says.
    std::ofstream(out, std::ios::trunc).close();
    const int failure = posix_spawn(&process_, binary_.c_str(), &actions, nullptr, argv.data(), environ);
    posix_spawn_file_actions_destroy(&actions);
    if (failure != 0) throw std::runtime_error("the server cannot be started: " + binary_);
    await_ready(out);
  }

  /// Sends a signal and waits for the end; the exit status as `waitpid` tells it.
  int stop(int signal) {
    if (process_ <= 0) return 0;
    int status = 0;
    kill(process_, signal);
    waitpid(process_, &status, 0);
    process_ = -1;
    return status;
  }

 private:
  void await_ready(const std::string& out) {
    for (int attempt = 0; attempt < 1200; ++attempt) {
      std::ifstream file(out);
      std::string address, line;
      while (std::getline(file, line)) {
        std::istringstream words(line);
        std::string first, second;
        words >> first >> second;
        if (first == "grpc") address = second;
        if (first == "ready;" && !address.empty()) {
          address_ = address;
          ready_since_ = std::chrono::steady_clock::now();
          return;
        }
      }
      if (waitpid(process_, nullptr, WNOHANG) != 0) {
        process_ = -1;
        break;
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
    (void)stop(SIGKILL);
    throw std::runtime_error("the server did not get ready; its log is " + folder_ + "/durable.log");
  }

  const std::string binary_;
  const std::string folder_;
  const std::vector<std::string> arguments_;
  std::string address_ = "127.0.0.1:0";
  std::chrono::steady_clock::time_point ready_since_;
  pid_t process_ = -1;
};
