#pragma once

// What the tests against a server share: checks that go on after a failure, and the program around them.
//
// Usage of such a program: NAME_test HOST:PORT        Exit code 0 when everything passed, 1 when something failed, 2 for wrong usage.

#include <nesam/nesam.hpp>

#include <chrono>
#include <cstdio>
#include <cstring>
#include <functional>
#include <iostream>
#include <string>

inline int passed = 0;
inline int failed = 0;
/// Name of the test that runs.
inline const char* current = "";

inline void check(bool holds, const std::string& what) {
  if (holds) {
    ++passed;
    return;
  }
  ++failed;
  std::cerr << "FAILED " << current << ": " << what << "\n";
}

/// Whether a call succeeded; says its error otherwise.
template <class T>
bool check_ok(const nesam::Result<T>& result, const std::string& what) {
  check(result.ok(), what + (result.ok() ? "" : std::string(": ") + result.error().what()));
  return result.ok();
}

template <class T>
void check_error(const nesam::Result<T>& result, nesam::Code code, const std::string& field, const std::string& what) {
  if (result.ok()) return check(false, what + ": succeeded, " + nesam::name(code) + " was expected");
  const nesam::Error& error = result.error();
  const bool right = error.code() == code && error.field() == field;
  check(right, what + ": expected " + nesam::name(code) + " of `" + field + "`, got `" + error.field() + "`, " + error.what());
}

inline bool equal_bits(nesam::Span<const float> a, nesam::Span<const float> b) {
  return a.size() == b.size() && !a.empty() && std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0;
}

/// Runs one test and says how it went.
inline void run(const char* name, const std::function<void()>& test) {
  current = name;
  const int failed_before = failed;
  const auto begin = std::chrono::steady_clock::now();
  try {
    test();
  } catch (const std::exception& error) {
    check(false, std::string("threw ") + error.what());
  }
  const auto took = std::chrono::duration_cast<std::chrono::milliseconds>(std::chrono::steady_clock::now() - begin);
  std::cout << (failed == failed_before ? "ok      " : "FAILED  ") << name << " (" << took.count() << " ms)" << std::endl;
}

/// The whole program: connects to the server that the arguments name and runs the tests.
inline int run_against_server(int argc, char** argv, const std::function<void(nesam::Client&)>& tests) {
  using namespace std::chrono_literals;
  if (argc != 2) {
    std::fprintf(stderr, "usage: %s HOST:PORT\n", argv[0]);
    return 2;
  }
  nesam::ClientOptions options;
  // The first prediction on a new map encodes its terrain, perhaps on a busy machine.
  options.timeout = 60s;
  nesam::Client client(argv[1], options);
  current = "connect";
  try {
    if (check_ok(client.connect(30s), "connection")) tests(client);
  } catch (const std::exception& error) {
    check(false, std::string("threw ") + error.what());
  }
  std::printf("%d passed, %d failed\n", passed, failed);
  return failed == 0 ? 0 : 1;
}
