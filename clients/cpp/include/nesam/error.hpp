#pragma once

#include <chrono>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>

namespace nesam {

/// Why a call failed: the codes of google.rpc.Code that the service and gRPC itself use.
enum class Code : int {
  cancelled = 1,            ///< The caller gave up.
  unknown = 2,              ///< A code that this client does not know.
  invalid_argument = 3,     ///< `Error::field()` names what is wrong; sending it again does not help.
  deadline_exceeded = 4,    ///< The answer did not come in time. A prediction may be asked again; see `Session::send` for measurements.
  not_found = 5,            ///< Unknown session or map.
  already_exists = 6,       ///< The session is open, or the map is there in this or a newer version.
  permission_denied = 7,    ///< The certificate that the client shows gives no right to this.
  resource_exhausted = 8,   ///< A limit is reached or the service is overloaded; try again later or ask for less.
  failed_precondition = 9,  ///< No start state and no measurement yet, the vehicle lies outside its map, or the map is in use.
  aborted = 10,             ///< The map changed meanwhile; read its version again.
  out_of_range = 11,        ///< Not used by the service itself.
  unimplemented = 12,       ///< The server does not know the method: another version.
  internal = 13,            ///< A bug of the service, or a reply that contradicts the request.
  unavailable = 14,         ///< The server is not reached, or it is shutting down.
  data_loss = 15,           ///< `DurableStream::flush`: some measurements were refused when they were sent again. Not used by the service itself.
  unauthenticated = 16,     ///< The certificate that the client shows says of nobody that the fleet file knows.
};

/// The name of a code in capitals, as gRPC writes it: INVALID_ARGUMENT.
const char* name(Code code) noexcept;

/// A failed call: a value that can be kept and copied, and the exception that `Result::value()` throws.
///
/// The client throws only in the thread that calls `value()`: its own threads hand failures over as values.
class Error : public std::runtime_error {
 public:
  Error(Code code, std::string field, const std::string& message, std::optional<std::chrono::nanoseconds> retry_after = std::nullopt);

  Code code() const noexcept { return code_; }
  /// Path of the field at fault, for example `controls[2, 3].speed_m_s`; empty when no field is.
  const std::string& field() const noexcept { return field_; }
  /// Whether the same call may succeed later without any change: UNAVAILABLE or RESOURCE_EXHAUSTED.
  bool retryable() const noexcept { return code_ == Code::unavailable || code_ == Code::resource_exhausted; }
  /// Pause after which the service may have room or be there again, as it says itself; nothing where it does not say.
  std::optional<std::chrono::nanoseconds> retry_after() const noexcept { return retry_after_; }
  // what(): "INVALID_ARGUMENT: ..." with what was wrong and what is allowed.

 private:
  Code code_;
  std::string field_;
  std::optional<std::chrono::nanoseconds> retry_after_;
};

/// The value of a call, or why there is none. `T` is `void` for calls without a value.
template <class T>
class [[nodiscard]] Result {
 public:
  Result(T value) : outcome_(std::in_place_index<0>, std::move(value)) {}
  Result(Error error) : outcome_(std::in_place_index<1>, std::move(error)) {}

  bool ok() const noexcept { return outcome_.index() == 0; }
  explicit operator bool() const noexcept { return ok(); }
  /// The value. Throws the `Error` in the calling thread when there is none.
  T& value() & { return check(), std::get<0>(outcome_); }
  const T& value() const& { return check(), std::get<0>(outcome_); }
  T&& value() && { return check(), std::get<0>(std::move(outcome_)); }
  /// The error; only when `ok()` is false (throws `std::bad_variant_access` otherwise).
  const Error& error() const { return std::get<1>(outcome_); }
  T* operator->() { return &value(); }
  const T* operator->() const { return &value(); }
  T& operator*() & { return value(); }
  const T& operator*() const& { return value(); }

 private:
  void check() const {
    if (const Error* error = std::get_if<1>(&outcome_)) throw *error;
  }
  std::variant<T, Error> outcome_;
};

template <>
class [[nodiscard]] Result<void> {
 public:
  Result() = default;
  Result(Error error) : outcome_(std::move(error)) {}

  bool ok() const noexcept { return outcome_.index() == 0; }
  explicit operator bool() const noexcept { return ok(); }
  /// Throws the `Error` in the calling thread when the call failed.
  void value() const {
    if (const Error* error = std::get_if<1>(&outcome_)) throw *error;
  }
  /// The error; only when `ok()` is false (throws `std::bad_variant_access` otherwise).
  const Error& error() const { return std::get<1>(outcome_); }

 private:
  std::variant<std::monostate, Error> outcome_;
};

}  // namespace nesam
