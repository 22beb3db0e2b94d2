#pragma once

#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <nesam/diagnosis.hpp>
#include <nesam/error.hpp>
#include <nesam/fleet_soil.hpp>
#include <nesam/session.hpp>
#include <nesam/session_status.hpp>
#include <nesam/terrain.hpp>
#include <nesam/tls.hpp>
#include <nesam/types.hpp>

namespace nesam {

/// Settings of a connection.
struct ClientOptions {
  /// Longest wait of a call that brings no timeout of its own.
  std::chrono::nanoseconds timeout = std::chrono::seconds(10);
  /// Longest wait of a map upload that brings none.
  std::chrono::nanoseconds upload_timeout = std::chrono::seconds(120);
  /// Longest wait of `~Session` for the answer to its close.
  std::chrono::nanoseconds close_timeout = std::chrono::seconds(1);
  /// Interval of keep-alive pings; a server that has gone is noticed after about twice this.
  std::chrono::milliseconds keepalive = std::chrono::seconds(20);
  /// Largest reply, bytes. 4096 samples x 16 steps take 4 MiB with all channels and the sinkage.
  int reply_bytes_max = 64 << 20;
  /// Whether to honour the proxy that the environment names. Off: planners talk to a machine nearby.
  bool use_proxy = false;
  /// Encrypts the connection and shows who this client is; absent = neither, for a trusted network.
  std::optional<Tls> tls;
  /// Vehicle that this client works for: a proxy in front of several servers keeps its calls together (metadata `x-vehicle-id`); empty = not told.
  std::string vehicle_id;
};

/// A connection to a nesam server. Cheap calls, safe from several threads at once.
///
/// The connection is made with the first call and again after a failure; a call on a server that cannot be reached, or whose certificate `ClientOptions::tls`
/// does not accept, fails with UNAVAILABLE. UNAUTHENTICATED and PERMISSION_DENIED: the server does not know this client, or it may not do this.
class Client {
 public:
  /// `target` is `host:port`. Nothing is sent yet.
  explicit Client(const std::string& target, ClientOptions options = {});
  Client(Client&&) noexcept;
  Client& operator=(Client&&) noexcept;
  ~Client();

  /// Waits for a connection. DEADLINE_EXCEEDED: none in time.
  Result<void> connect(std::chrono::nanoseconds timeout);

  /// Opens a session.
  ///
  /// INVALID_ARGUMENT: a bad name, a vehicle card that the bundle was not trained for, a bad initial measurement. NOT_FOUND: unknown map. ALREADY_EXISTS: the
  /// session is open. RESOURCE_EXHAUSTED: too many sessions.
  Result<Session> open(const OpenOptions& options, Timeout timeout = {});

  /// Takes over a session that is open already; the returned object closes it when it goes. NOT_FOUND: unknown session.
  Result<Session> attach(const std::string& session_id, Timeout timeout = {});

  /// Reads a session. NOT_FOUND: unknown session.
  Result<SessionStatus> session(const std::string& session_id, Timeout timeout = {}) const;

  /// The open sessions, by session id.
  Result<std::vector<SessionStatus>> sessions(Timeout timeout = {}) const;

  /// Closes a session by name. NOT_FOUND: unknown session.
  Result<void> close(const std::string& session_id, Timeout timeout = {});

  /// Everything that a session remembers, as opaque bytes for `import_session` here or on another server with the same bundle; about 20 kB. The session stays
  /// open. NOT_FOUND: unknown session.
  Result<std::string> export_session(const std::string& session_id, Timeout timeout = {}) const;

  /// Opens a session from an export; from then on it answers as the original would, bit for bit. `session_id`: its name; empty = that of the exported one.
  ///
  /// INVALID_ARGUMENT of `image`: damaged or cut bytes, another version of the format, another bundle, other settings of the soil filter. NOT_FOUND: the map is
  /// not uploaded. FAILED_PRECONDITION: the map has other layers. ALREADY_EXISTS, RESOURCE_EXHAUSTED: as `open`.
  Result<Session> import_session(const std::string& image, const std::string& session_id = {}, Timeout timeout = {});

  /// What the fleet has learned of the ground of a map; empty = of all maps. FAILED_PRECONDITION: the service keeps no such map (`fleet_soil.enabled`).
  Result<FleetSoilMap> fleet_soil(const std::string& map_id = {}, Timeout timeout = {}) const;

  /// Starts a diagnosis of what the server has recorded of a session: which physical effect does the model lack? It takes minutes. Needs the rights of an
  /// operator. Everything that is refused comes out of its first `receive`.
  Diagnosis diagnose(const DiagnosisRequest& request) const;

  /// Uploads a map in tiles.
  ///
  /// INVALID_ARGUMENT: a layer does not have the shape of the geometry, or the server refuses a field. ALREADY_EXISTS: the map is there in this or a newer
  /// version. RESOURCE_EXHAUSTED: too many maps, pixels or simultaneous uploads.
  Result<MapDescription> upload_map(const Map& map, Timeout timeout = {});

  /// Replaces a rectangle of a map that is at `base_version`; the result is the next version, which sessions use from then on.
  ///
  /// INVALID_ARGUMENT: a layer does not have the shape of the tile, or the tile lies outside the map. NOT_FOUND: unknown map. ABORTED: the map is not at
  /// `base_version` any more.
  Result<MapDescription> patch_tile(const std::string& map_id, std::uint64_t base_version, const MapTile& tile, Timeout timeout = {});

  /// Describes a map. NOT_FOUND: unknown map.
  Result<MapDescription> map(const std::string& map_id, Timeout timeout = {}) const;

  /// The maps that the server holds, by id.
  Result<std::vector<MapDescription>> maps(Timeout timeout = {}) const;

  /// Forgets a map. NOT_FOUND: unknown map. FAILED_PRECONDITION: a session drives on it.
  Result<void> delete_map(const std::string& map_id, Timeout timeout = {});

 private:
  std::shared_ptr<detail::Core> core_;
};

}  // namespace nesam
