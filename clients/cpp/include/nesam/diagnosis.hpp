#pragma once

#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <variant>
#include <vector>

#include <nesam/effect.hpp>
#include <nesam/error.hpp>

namespace nesam {

namespace detail {
class Core;
class DiagnosisImpl;
}  // namespace detail

/// What measurements are held against.
enum class DiagnosisReference {
  /// The drives without an effect that the bundle knows.
  bundle,
  /// The symbolic model itself, the network silent.
  physics,
};

/// What to diagnose.
struct DiagnosisRequest {
  /// Session whose measurements are read; it need not be open any more.
  std::string session_id;
  /// Recording of an earlier run of the server, by its name; empty = what the server has recorded until now.
  std::string recording;
  /// First and last stamp of the window, ns of the vehicle's clock; absent = all.
  std::optional<std::int64_t> from_stamp_ns;
  std::optional<std::int64_t> to_stamp_ns;
  /// Seed of the bootstrap; absent = 1.
  std::optional<std::uint64_t> seed;
  DiagnosisReference reference = DiagnosisReference::bundle;
  /// Leaves out what would expose a wrong claim, which takes most of the time where something is found.
  bool without_controls = false;
};

/// The diagnosis has begun.
struct DiagnosisStarted {
  std::string diagnosis_id;
  /// Recording that is read.
  std::string recording;
};

/// How far a stage is.
struct DiagnosisProgress {
  std::string stage;
  std::uint64_t done = 0;
  std::uint64_t total = 0;
};

/// Outcome of a diagnosis (docs/read-a-diagnosis.md).
enum class DiagnosisVerdict { unspecified, none, explained, ambiguous, unexplained };

/// What was found.
struct DiagnosisReport {
  std::string diagnosis_id;
  DiagnosisVerdict verdict = DiagnosisVerdict::unspecified;
  /// Why, in one sentence.
  std::string reason;
  /// The claimed effects, ready for `Session::apply_effects`.
  std::vector<Effect> effects;
  /// The whole report, JSON of the schema `nesam.diagnose/1`.
  std::string json;
  /// Where the server has the reports and the patched bundle, and the hash of that; empty = none.
  std::string folder;
  std::string bundle;
  std::string bundle_hash;
  /// What was remarked.
  std::vector<std::string> notes;
};

using DiagnosisEvent = std::variant<DiagnosisStarted, DiagnosisProgress, DiagnosisReport>;

/// A diagnosis that the server makes: the start, progress, last the report.
///
/// One thread at a time may call `receive`. Destruction ends the diagnosis.
class Diagnosis {
 public:
  Diagnosis(Diagnosis&&) noexcept;
  Diagnosis& operator=(Diagnosis&&) noexcept;
  ~Diagnosis();

  /// The next event.
  ///
  /// DEADLINE_EXCEEDED of this call: none in time; the diagnosis goes on. NOT_FOUND without a field: the report was the last. FAILED_PRECONDITION: the server
  /// records nothing, or what it has recorded cannot be diagnosed. Else why the diagnosis ended.
  Result<DiagnosisEvent> receive(std::chrono::nanoseconds timeout);

 private:
  friend class Client;
  Diagnosis(std::shared_ptr<detail::Core> core, const DiagnosisRequest& request);
  std::unique_ptr<detail::DiagnosisImpl> impl_;
};

}  // namespace nesam
