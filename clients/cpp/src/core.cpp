#include "core.hpp"

#include <climits>
#include <utility>

#include "convert.hpp"
#include "convert_prediction.hpp"
#include "fallback_prediction.hpp"
#include "retry_after.hpp"

namespace nesam::detail {

namespace {

/// Trailing metadata in which the service names the field at fault.
constexpr const char* field_metadata = "nesam-field";

/// First and longest time between two attempts to connect, ms, to which gRPC adds up to a fifth. Chosen: a vehicle notices a restart within 2 s, and a server
/// that is away is not overrun.
constexpr int reconnect_ms_min = 200;
constexpr int reconnect_ms_max = 1600;
/// Longest attempt to connect, ms, instead of 20 s: TCP itself asks a machine that says nothing after 1, 3, 7 and 15 s, and anew with each attempt.
constexpr int connect_ms_max = 5000;

std::shared_ptr<grpc::Channel> make_channel(const std::string& target, const ClientOptions& options) {
  grpc::ChannelArguments arguments;
  arguments.SetMaxReceiveMessageSize(options.reply_bytes_max);
  arguments.SetInt(GRPC_ARG_ENABLE_HTTP_PROXY, options.use_proxy ? 1 : 0);
  const auto keepalive_ms = static_cast<int>(std::clamp<std::chrono::milliseconds::rep>(options.keepalive.count(), 1, INT_MAX));
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, keepalive_ms);
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, keepalive_ms);
  // A server that comes back is found about 2 s after it answers, however long it was away and whether its machine refused connections meanwhile or said nothing;
  // `Reconnector` sees to it. Tried with a call every 50 ms: 0.1 to 1.5 s in 20 outages of 3 to 8 s, 0 to 0.6 s in three of 9 to 12 s of silence.
  arguments.SetInt(GRPC_ARG_INITIAL_RECONNECT_BACKOFF_MS, reconnect_ms_min);
  arguments.SetInt(GRPC_ARG_MAX_RECONNECT_BACKOFF_MS, reconnect_ms_max);
  arguments.SetInt(GRPC_ARG_MIN_RECONNECT_BACKOFF_MS, connect_ms_max);
  // A stream may rest for long between two measurements; pings must go on then.
  arguments.SetInt(GRPC_ARG_HTTP2_MAX_PINGS_WITHOUT_DATA, 0);
  if (!options.tls) return grpc::CreateCustomChannel(target, grpc::InsecureChannelCredentials(), arguments);
  if (!options.tls->server_name.empty()) arguments.SetSslTargetNameOverride(options.tls->server_name);
  grpc::SslCredentialsOptions files;
  files.pem_root_certs = options.tls->authority;
  files.pem_cert_chain = options.tls->certificate;
  files.pem_private_key = options.tls->key;
  return grpc::CreateCustomChannel(target, grpc::SslCredentials(files), arguments);
}

}  // namespace

Error Core::error_from(const grpc::Status& status, const grpc::ClientContext& context) const {
  reconnector.call_failed(*channel);
  const auto& metadata = context.GetServerTrailingMetadata();
  const auto entry = metadata.find(field_metadata);
  std::string field = entry == metadata.end() ? std::string() : std::string(entry->second.data(), entry->second.size());
  // How the server's transport says that the time the client gave was over, where it notices before engine and client do.
  const bool late = status.error_code() == grpc::StatusCode::CANCELLED && status.error_message() == "Timeout expired";
  const auto code = late ? grpc::StatusCode::DEADLINE_EXCEEDED : status.error_code();
  return Error(code_from(static_cast<int>(code)), std::move(field), status.error_message(), retry_after_of(status.error_details()));
}

Core::Core(const std::string& target, const ClientOptions& settings)
    : options(settings),
      channel(make_channel(target, settings)),
      sessions(v1::Sessions::NewStub(channel)),
      prediction(v1::Prediction::NewStub(channel)),
      measurements(v1::Measurements::NewStub(channel)),
      soil(v1::Soil::NewStub(channel)),
      terrain(v1::Terrain::NewStub(channel)),
      diagnosis(v1::Diagnosis::NewStub(channel)) {}

Result<SessionStatus> Core::session(const std::string& id, Timeout timeout) const {
  v1::GetSessionRequest request;
  request.set_session_id(id);
  auto reply = call(*sessions, &v1::Sessions::Stub::Get, request, timeout);
  if (!reply) return reply.error();
  return from_message(*reply);
}

SessionStatus Core::opened(const v1::Session& session) const {
  known_states.opened(session.session_id());
  openings.opened(session.session_id());
  return from_message(session);
}

Result<void> Core::close(const std::string& id, Timeout timeout) const {
  v1::CloseSessionRequest request;
  request.set_session_id(id);
  auto reply = call(*sessions, &v1::Sessions::Stub::Close, request, timeout);
  if (!reply) return reply.error();
  known_states.forget(id);
  openings.closed(id);
  return {};
}

Result<std::string> Core::export_session(const std::string& id, Timeout timeout) const {
  v1::ExportSessionRequest request;
  request.set_session_id(id);
  auto reply = call(*sessions, &v1::Sessions::Stub::Export, request, timeout);
  if (!reply) return reply.error();
  return std::move(*reply->mutable_image());
}

Result<Prediction> Core::predict(const std::string& id, const PredictRequest& request, Timeout timeout) const {
  auto message = to_message(id, request);
  if (!message) return message.error();
  const Moment asked = known_states.ask();
  auto reply = call(*prediction, &v1::Prediction::Stub::Predict, *message, timeout);
  if (!reply) {
    known_states.refused(id, reply.error());
    if (auto fallback = fallback_prediction(request, known_states.of(id), reply.error())) return *std::move(fallback);
    return reply.error();
  }
  auto predicted = from_message(*reply, Asked(request));
  if (predicted) known_states.predicted(asked, id, request, *predicted);
  return predicted;
}

}  // namespace nesam::detail
