#pragma once

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <system_error>

#include <grpcpp/grpcpp.h>

#include <nesam/client.hpp>

#include "known_states.hpp"
#include "openings.hpp"
#include "nesam/v1/diagnosis.grpc.pb.h"
#include "nesam/v1/measurements.grpc.pb.h"
#include "nesam/v1/prediction.grpc.pb.h"
#include "nesam/v1/sessions.grpc.pb.h"
#include "nesam/v1/soil.grpc.pb.h"
#include "nesam/v1/terrain.grpc.pb.h"
#include "reconnector.hpp"

namespace nesam::detail {

/// A timeout that can be added to any clock without overflow.
inline std::chrono::nanoseconds bounded(std::chrono::nanoseconds timeout) {
  return std::clamp<std::chrono::nanoseconds>(timeout, std::chrono::nanoseconds(0), std::chrono::hours(24 * 365));
}

/// A stream, or RESOURCE_EXHAUSTED where the machine has no threads for it.
template <class Open>
auto open_stream(Open open) -> Result<decltype(open())> {
  try {
    return open();
  } catch (const std::system_error& error) {
    return Error(Code::resource_exhausted, "", std::string("no thread for the stream: ") + error.what());
  }
}

/// Connection and stubs, shared by a client, its sessions and their streams.
class Core {
 public:
  Core(const std::string& target, const ClientOptions& settings);
  Core(const Core&) = delete;
  Core& operator=(const Core&) = delete;
  ~Core() { reconnector.stop(); }

  /// Calls a unary method of a stub.
  template <class Stub, class Request, class Reply>
  Result<Reply> call(Stub& stub, grpc::Status (Stub::*method)(grpc::ClientContext*, const Request&, Reply*), const Request& request,
                     Timeout timeout) const {
    if (auto wrong = wrong_vehicle()) return *wrong;
    grpc::ClientContext context;
    introduce(context);
    context.set_deadline(deadline(timeout.value_or(options.timeout)));
    Reply reply;
    const grpc::Status status = (stub.*method)(&context, request, &reply);
    if (!status.ok()) return error_from(status, context);
    return reply;
  }

  /// The failure that a status and its trailing metadata describe. Where the connection is lost, it is made again from here on.
  Error error_from(const grpc::Status& status, const grpc::ClientContext& context) const;

  /// Tells a proxy which vehicle a call is about.
  void introduce(grpc::ClientContext& context) const {
    if (!options.vehicle_id.empty() && !wrong_vehicle()) context.AddMetadata("x-vehicle-id", options.vehicle_id);
  }

  /// Why the vehicle of the options is no name that the service takes; none where it is one, or none is given. gRPC ends the process for metadata of other
  /// characters.
  std::optional<Error> wrong_vehicle() const {
    const auto allowed = [](char c) { return (c >= '0' && c <= '9') || (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z') || c == '_' || c == '.' || c == '-'; };
    const std::string& name = options.vehicle_id;
    if (name.size() <= 64 && std::all_of(name.begin(), name.end(), allowed)) return std::nullopt;
    return Error(Code::invalid_argument, "vehicle_id", "must be 1 to 64 of A-Z a-z 0-9 _ . -");
  }

  static std::chrono::system_clock::time_point deadline(std::chrono::nanoseconds timeout) {
    // No time is none: gRPC rounds deadlines up to milliseconds, within which a service may refuse.
    if (timeout.count() <= 0) return {};
    return std::chrono::system_clock::now() + std::chrono::duration_cast<std::chrono::system_clock::duration>(bounded(timeout));
  }

  Result<SessionStatus> session(const std::string& id, Timeout timeout) const;
  /// What the reply to an opening says, of a session that is another one than any of the same name before.
  SessionStatus opened(const v1::Session& session) const;
  Result<void> close(const std::string& id, Timeout timeout) const;
  Result<Prediction> predict(const std::string& id, const PredictRequest& request, Timeout timeout) const;
  Result<std::string> export_session(const std::string& id, Timeout timeout) const;
  Result<MapDescription> upload(const Map& map, Timeout timeout) const;
  Result<MapDescription> patch(const std::string& map_id, std::uint64_t base_version, const MapTile& tile, Timeout timeout) const;

  const ClientOptions options;
  /// Guards itself. Before the channel, whose end it waits for.
  mutable Reconnector reconnector;
  const std::shared_ptr<grpc::Channel> channel;
  const std::unique_ptr<v1::Sessions::Stub> sessions;
  const std::unique_ptr<v1::Prediction::Stub> prediction;
  const std::unique_ptr<v1::Measurements::Stub> measurements;
  const std::unique_ptr<v1::Soil::Stub> soil;
  const std::unique_ptr<v1::Terrain::Stub> terrain;
  const std::unique_ptr<v1::Diagnosis::Stub> diagnosis;
  /// Guards itself; what is known of a session is no setting of the connection.
  mutable KnownStates known_states;
  /// Guards itself.
  mutable Openings openings;
};

}  // namespace nesam::detail
