//! The Zenoh side: the same messages, the same conversions, the same engine.

mod access_control;
mod arrival;
mod keys;
mod measurements;
mod neighbours;
mod predict;
mod presence;
mod renewal;
mod ros2;
mod sharing;
mod soil;

pub use access_control::{LinkFiles, router_config};
pub(crate) use neighbours::Neighbours;
pub(crate) use presence::Presence;
pub(crate) use renewal::RenewedBus;

use std::time::Duration;

use nesam_engine::EngineError;
use tokio::sync::mpsc;

use crate::access::FleetFile;
use crate::config::{FleetSoilConfig, Ros2Config, TlsConfig, ZenohConfig, ZenohMode};
use crate::error::ServerError;
use crate::grpc::Edge;

use self::sharing::Sharing;

/// Largest payload of a measurement, bytes.
const MEASUREMENT_BYTES_MAX: usize = 64 << 10;
/// Answers that may wait to be published; more are dropped, as the vehicle resends what it got no answer to.
const ANSWERS_WAITING_MAX: usize = 4096;

/// What the configuration says of the network.
pub(crate) struct BusConfig {
    /// Role, endpoints and keys.
    pub zenoh: ZenohConfig,
    /// Machines of ROS 2.
    pub ros2: Ros2Config,
    /// Whether servers share their soil maps.
    pub fleet_soil: FleetSoilConfig,
    /// Certificates.
    pub tls: TlsConfig,
}

/// A running Zenoh side.
struct Bus {
    session: ::zenoh::Session,
    publisher: tokio::task::JoinHandle<()>,
    soil: tokio::task::JoinHandle<()>,
    sharing: Option<tokio::task::JoinHandle<()>>,
    status: tokio::task::JoinHandle<()>,
    neighbours: tokio::task::JoinHandle<()>,
    /// Machines of ROS 2, where there may be some.
    graph: Option<ros2::Graph>,
    /// Tells the network that this server is there; goes with it.
    _token: ::zenoh::liveliness::LivelinessToken,
}

/// A message to publish: key and payload.
type Outgoing = (String, Vec<u8>);

impl Bus {
    /// Joins the network and declares subscriber, publisher, queryable and liveliness token.
    pub async fn start(all: &BusConfig, edge: &Edge) -> Result<Self, ServerError> {
        let BusConfig { zenoh: config, ros2, fleet_soil, .. } = all;
        if tokio::runtime::Handle::current().runtime_flavor() == tokio::runtime::RuntimeFlavor::CurrentThread {
            return Err(ServerError::Runtime);
        }
        let failed = |error: ::zenoh::Error| ServerError::Zenoh { reason: error.to_string() };
        ros2.check_for(&edge.predictor.bundle().vehicle)?;
        let session = ::zenoh::open(zenoh_config(all, edge.access.rights().as_deref()).map_err(failed)?).await.map_err(failed)?;
        let (sender, receiver) = mpsc::channel(ANSWERS_WAITING_MAX);
        let name = if config.name.is_empty() { session.zid().to_string() } else { config.name.clone() };
        let shares = fleet_soil.enabled && fleet_soil.exchange_s > 0.0;
        let sharing = shares.then(|| Sharing::new(edge, &config.fleet, &name));
        let events = edge.events.subscribe();
        let asking = match &sharing {
            Some(sharing) => {
                let every = Duration::from_secs_f64(fleet_soil.exchange_s);
                Some(sharing.declare(&session, &config.fleet, every).await.map_err(failed)?)
            }
            None => None,
        };
        measurements::declare(&session, &config.fleet, edge.clone(), sender.clone()).await.map_err(failed)?;
        predict::declare(&session, &config.fleet, edge.clone()).await.map_err(failed)?;
        let presence = edge.presence.clone().unwrap_or_default();
        let token = presence::declare(&session, &config.fleet, &name, presence.clone()).await.map_err(failed)?;
        let graph = match ros2.enabled {
            true => Some(ros2::join(&session, ros2, edge).await.map_err(failed)?),
            false => None,
        };
        // Tasks begin when nothing can fail any more: one that holds the session would keep it, and its port, open.
        let soil = tokio::spawn(soil::publish_changes(events, config.fleet.clone(), sharing, sender.clone()));
        let sharing = asking.map(tokio::spawn);
        let interval = Duration::from_secs_f64(config.status_interval_s);
        presence.neighbours.seek(!config.connect.is_empty());
        let neighbours = tokio::spawn(presence.neighbours.clone().watch(session.clone()));
        let status = tokio::spawn(presence::publish_status(edge.clone(), presence, config.fleet.clone(), name, interval, sender));
        let publisher = tokio::spawn(publish(session.clone(), receiver));
        tracing::info!(zid = %session.zid(), fleet = config.fleet, "zenoh started");
        Ok(Self { session, publisher, soil, sharing, status, neighbours, graph, _token: token })
    }

    /// Leaves the network.
    pub async fn stop(self) {
        drop(self.graph);
        if let Err(error) = self.session.close().await {
            tracing::warn!(%error, "zenoh did not close cleanly");
        }
        self.publisher.abort();
        self.soil.abort();
        self.sharing.iter().for_each(tokio::task::JoinHandle::abort);
        self.status.abort();
        self.neighbours.abort();
    }
}

/// The configuration of the session. Whoever connects to this server over TLS gets the keys that the fleet file says.
fn zenoh_config(all: &BusConfig, members: Option<&FleetFile>) -> Result<::zenoh::Config, ::zenoh::Error> {
    let BusConfig { zenoh: config, ros2, tls, .. } = all;
    let mode = match config.mode {
        ZenohMode::Peer => "peer",
        ZenohMode::Client => "client",
        ZenohMode::Router => "router",
    };
    let mut zenoh = ::zenoh::Config::default();
    let list = |endpoints: &[String]| serde_json::Value::from(endpoints.to_vec()).to_string();
    zenoh.insert_json5("mode", &format!("{mode:?}"))?;
    zenoh.insert_json5("scouting/multicast/enabled", "false")?;
    zenoh.insert_json5("listen/endpoints", &list(&config.listen))?;
    zenoh.insert_json5("connect/endpoints", &list(&config.connect))?;
    zenoh.insert_json5("transport/link/rx/max_message_size", &config.message_bytes_max.to_string())?;
    let shared = config.shared_memory && !config.uses_tls();
    zenoh.insert_json5("transport/shared_memory/enabled", &shared.to_string())?;
    if config.uses_tls() {
        let files = LinkFiles { certificate: &tls.certificate, key: &tls.key, authority: &tls.client_ca };
        zenoh.insert_json5("transport/link/tls", &access_control::link(files).to_string())?;
    }
    if let Some(members) = members.filter(|_| config.listens_with_tls()) {
        zenoh.insert_json5("access_control", &access_control::access_control(members, &config.fleet, ros2).to_string())?;
    }
    Ok(zenoh)
}

/// Publishes what the others hand over, so that no callback of Zenoh or of the engine waits for the network.
async fn publish(session: ::zenoh::Session, mut outgoing: mpsc::Receiver<Outgoing>) {
    while let Some((key, payload)) = outgoing.recv().await {
        match session.put(key.as_str(), payload).await {
            // The server stops.
            Err(_) if session.is_closed() => return,
            Err(error) => tracing::warn!(%error, key, "not published"),
            Ok(()) => {}
        }
    }
}

/// A message of `kind` from a payload of limited size.
fn decode<M: prost::Message + Default>(kind: &str, payload: impl bytes::Buf, limit: usize) -> Result<M, EngineError> {
    let length = payload.remaining();
    if length > limit {
        return Err(EngineError::invalid("", format!("a payload of {length} bytes is above the limit of {limit}")));
    }
    M::decode(payload).map_err(|error| EngineError::invalid("", format!("the payload is no {kind}: {error}")))
}

/// The bytes of a message.
fn encode(message: &impl prost::Message) -> Vec<u8> {
    message.encode_to_vec()
}
