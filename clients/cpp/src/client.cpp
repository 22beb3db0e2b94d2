#include <nesam/client.hpp>

#include <utility>

#include "convert.hpp"
#include "core.hpp"
#include "session_impl.hpp"

namespace nesam {

Client::Client(const std::string& target, ClientOptions options) : core_(std::make_shared<detail::Core>(target, options)) {}
Client::Client(Client&&) noexcept = default;
Client& Client::operator=(Client&&) noexcept = default;
Client::~Client() = default;

Result<void> Client::connect(std::chrono::nanoseconds timeout) {
  if (auto wrong = core_->wrong_vehicle()) return *wrong;
  if (core_->channel->WaitForConnected(detail::Core::deadline(timeout))) return {};
  return Error(Code::deadline_exceeded, "", "no connection to the server in time");
}

Result<Session> Client::open(const OpenOptions& options, Timeout timeout) {
  auto reply = core_->call(*core_->sessions, &v1::Sessions::Stub::Open, detail::to_message(options), timeout);
  if (!reply) return reply.error();
  return Session(std::make_unique<detail::SessionImpl>(core_, core_->opened(*reply)));
}

Result<Session> Client::attach(const std::string& session_id, Timeout timeout) {
  auto status = core_->session(session_id, timeout);
  if (!status) return status.error();
  return Session(std::make_unique<detail::SessionImpl>(core_, std::move(*status)));
}

Result<SessionStatus> Client::session(const std::string& session_id, Timeout timeout) const { return core_->session(session_id, timeout); }

Result<std::vector<SessionStatus>> Client::sessions(Timeout timeout) const {
  auto reply = core_->call(*core_->sessions, &v1::Sessions::Stub::List, v1::ListSessionsRequest(), timeout);
  if (!reply) return reply.error();
  std::vector<SessionStatus> sessions;
  for (const v1::Session& session : reply->sessions()) sessions.push_back(detail::from_message(session));
  return sessions;
}

Result<void> Client::close(const std::string& session_id, Timeout timeout) { return core_->close(session_id, timeout); }

Result<std::string> Client::export_session(const std::string& session_id, Timeout timeout) const { return core_->export_session(session_id, timeout); }

Result<Session> Client::import_session(const std::string& image, const std::string& session_id, Timeout timeout) {
  v1::ImportSessionRequest request;
  request.set_image(image);
  request.set_session_id(session_id);
  auto reply = core_->call(*core_->sessions, &v1::Sessions::Stub::Import, request, timeout);
  if (!reply) return reply.error();
  return Session(std::make_unique<detail::SessionImpl>(core_, core_->opened(*reply)));
}

Result<FleetSoilMap> Client::fleet_soil(const std::string& map_id, Timeout timeout) const {
  v1::FleetSoilRequest request;
  request.set_map_id(map_id);
  auto reply = core_->call(*core_->soil, &v1::Soil::Stub::Map, request, timeout);
  if (!reply) return reply.error();
  return detail::from_message(*reply);
}

Diagnosis Client::diagnose(const DiagnosisRequest& request) const { return Diagnosis(core_, request); }

Result<MapDescription> Client::upload_map(const Map& map, Timeout timeout) { return core_->upload(map, timeout); }

Result<MapDescription> Client::patch_tile(const std::string& map_id, std::uint64_t base_version, const MapTile& tile, Timeout timeout) {
  return core_->patch(map_id, base_version, tile, timeout);
}

Result<MapDescription> Client::map(const std::string& map_id, Timeout timeout) const {
  v1::GetMapRequest request;
  request.set_map_id(map_id);
  auto reply = core_->call(*core_->terrain, &v1::Terrain::Stub::Get, request, timeout);
  if (!reply) return reply.error();
  return detail::from_message(*reply);
}

Result<std::vector<MapDescription>> Client::maps(Timeout timeout) const {
  auto reply = core_->call(*core_->terrain, &v1::Terrain::Stub::List, v1::ListMapsRequest(), timeout);
  if (!reply) return reply.error();
  std::vector<MapDescription> maps;
  for (const v1::MapDescription& map : reply->maps()) maps.push_back(detail::from_message(map));
  return maps;
}

Result<void> Client::delete_map(const std::string& map_id, Timeout timeout) {
  v1::DeleteMapRequest request;
  request.set_map_id(map_id);
  auto reply = core_->call(*core_->terrain, &v1::Terrain::Stub::Delete, request, timeout);
  if (!reply) return reply.error();
  return {};
}

}  // namespace nesam
