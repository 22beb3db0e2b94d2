#include <nesam/diagnosis.hpp>

#include <utility>

#include "convert.hpp"
#include "watch.hpp"

namespace nesam {
namespace detail {

namespace {

v1::StartDiagnosisRequest start_request(const DiagnosisRequest& request) {
  v1::StartDiagnosisRequest message;
  message.set_session_id(request.session_id);
  message.set_recording(request.recording);
  if (request.from_stamp_ns) message.set_from_stamp_ns(*request.from_stamp_ns);
  if (request.to_stamp_ns) message.set_to_stamp_ns(*request.to_stamp_ns);
  if (request.seed) message.set_seed(*request.seed);
  const bool physics = request.reference == DiagnosisReference::physics;
  message.set_reference(physics ? v1::DIAGNOSIS_REFERENCE_PHYSICS : v1::DIAGNOSIS_REFERENCE_BUNDLE);
  message.set_without_controls(request.without_controls);
  return message;
}

DiagnosisVerdict verdict_from(v1::DiagnosisVerdict verdict) {
  switch (verdict) {
    case v1::DIAGNOSIS_VERDICT_NONE: return DiagnosisVerdict::none;
    case v1::DIAGNOSIS_VERDICT_EXPLAINED: return DiagnosisVerdict::explained;
    case v1::DIAGNOSIS_VERDICT_AMBIGUOUS: return DiagnosisVerdict::ambiguous;
    case v1::DIAGNOSIS_VERDICT_UNEXPLAINED: return DiagnosisVerdict::unexplained;
    default: return DiagnosisVerdict::unspecified;
  }
}

DiagnosisReport report_from(const v1::DiagnosisReport& message) {
  DiagnosisReport report;
  report.diagnosis_id = message.diagnosis_id();
  report.verdict = verdict_from(message.verdict());
  report.reason = message.reason();
  for (const v1::Effect& effect : message.effects()) report.effects.push_back(from_message(effect));
  report.json = message.json();
  report.folder = message.folder();
  report.bundle = message.bundle();
  report.bundle_hash = message.bundle_hash();
  report.notes.assign(message.notes().begin(), message.notes().end());
  return report;
}

}  // namespace

struct DiagnosisNews {
  using Request = v1::StartDiagnosisRequest;
  using News = v1::DiagnosisEvent;
  using Value = DiagnosisEvent;
  static constexpr const char* awaited = "event of the diagnosis";

  static auto open(Core& core, grpc::ClientContext& context, const Request& request, grpc::CompletionQueue& queue) {
    return core.diagnosis->AsyncStart(&context, request, &queue, nullptr);
  }
  static Value value(const News& message) {
    if (message.has_started()) return DiagnosisStarted{message.started().diagnosis_id(), message.started().recording()};
    if (message.has_report()) return report_from(message.report());
    return DiagnosisProgress{message.progress().stage(), message.progress().done(), message.progress().total()};
  }
  static Error over() { return Error(Code::not_found, "", "the diagnosis has ended; the report was the last"); }
};

class DiagnosisImpl : public Watch<DiagnosisNews> {
 public:
  using Watch::Watch;
};

}  // namespace detail

Diagnosis::Diagnosis(std::shared_ptr<detail::Core> core, const DiagnosisRequest& request)
    : impl_(std::make_unique<detail::DiagnosisImpl>(std::move(core), detail::start_request(request))) {}
Diagnosis::Diagnosis(Diagnosis&&) noexcept = default;
Diagnosis& Diagnosis::operator=(Diagnosis&&) noexcept = default;
Diagnosis::~Diagnosis() = default;

Result<DiagnosisEvent> Diagnosis::receive(std::chrono::nanoseconds timeout) { return impl_->receive(timeout); }

}  // namespace nesam
