//! Zenoh.

use std::net::SocketAddr;

use ::zenoh::config::EndPoint;
use nesam_engine::{EngineError, check_name};
use serde::{Deserialize, Serialize};

use crate::error::ServerError;

/// Protocols of endpoints.
const PROTOCOLS: [&str; 2] = ["tcp", "tls"];

/// Role in a Zenoh network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ZenohMode {
    /// Listens and connects.
    Peer,
    /// Connects to a router; the server does not start without one.
    Client,
    /// Routes for others too.
    Router,
}

/// Zenoh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ZenohConfig {
    /// Whether to take part in a Zenoh network.
    pub enabled: bool,
    /// Role.
    pub mode: ZenohMode,
    /// Endpoints to listen on, e.g. `tcp/127.0.0.1:7447`; `tls/0.0.0.0:7447` uses the files of `[tls]` and gives everybody the keys that the fleet file
    /// says.
    pub listen: Vec<String>,
    /// Endpoints to connect to, e.g. `tcp/router:7447` or `tls/router:7447`; a peer keeps trying.
    pub connect: Vec<String>,
    /// Fleet in the keys `nesam/v1/<fleet>/<vehicle>/...`.
    pub fleet: String,
    /// Name of this server in the keys `nesam/v1/<fleet>/server/<name>/...`; empty = its Zenoh id.
    pub name: String,
    /// Interval at which the status of this server is published, s.
    pub status_interval_s: f64,
    /// Largest message that is put together from its pieces, bytes; a larger one is dropped on its way, and its sender is not told. It bounds the memory that whoever may
    /// connect can take: so much for each connection, priority and reliability.
    pub message_bytes_max: usize,
    /// Whether large messages to and from processes of the same host go through shared memory where the other side can; never together with `tls/...`.
    pub shared_memory: bool,
}

impl Default for ZenohConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            mode: ZenohMode::Peer,
            listen: vec!["tcp/127.0.0.1:7447".into()],
            connect: Vec::new(),
            fleet: "default".into(),
            name: String::new(),
            status_interval_s: 1.0,
            message_bytes_max: 64 << 20,
            shared_memory: true,
        }
    }
}

impl ZenohConfig {
    /// Whether an endpoint needs certificates.
    pub fn uses_tls(&self) -> bool {
        self.enabled && self.listen.iter().chain(&self.connect).any(|endpoint| is_tls_endpoint(endpoint))
    }

    /// Whether somebody can connect to this server with a certificate.
    pub fn listens_with_tls(&self) -> bool {
        self.listen.iter().any(|endpoint| is_tls_endpoint(endpoint))
    }

    /// Checks what the types do not.
    ///
    /// # Errors
    /// `ServerError::Value` naming the key.
    pub(super) fn check(&self) -> Result<(), ServerError> {
        for (key, endpoints) in [("zenoh.listen", &self.listen), ("zenoh.connect", &self.connect)] {
            if let Some(endpoint) = endpoints.iter().find(|endpoint| !is_endpoint(endpoint)) {
                return Err(ServerError::value(
                    key,
                    format!("`{endpoint}` is no endpoint; expected for instance tcp/127.0.0.1:7447 or tls/router:7447"),
                ));
            }
        }
        if self.enabled && self.mode == ZenohMode::Client && self.connect.is_empty() {
            let reason = "is empty, but with `zenoh.mode = \"client\"` it has to name a router, for instance tcp/router:7447";
            return Err(ServerError::value("zenoh.connect", reason));
        }
        let name = |key: &'static str, name: &str| {
            check_name(key, name).map_err(|error| match error {
                EngineError::Invalid { reason, .. } => ServerError::value(key, reason),
                other => ServerError::value(key, other.to_string()),
            })
        };
        if !self.name.is_empty() {
            name("zenoh.name", &self.name)?;
        }
        name("zenoh.fleet", &self.fleet)
    }
}

/// Whether a text is an endpoint of a protocol that is built in, with a port.
fn is_endpoint(text: &str) -> bool {
    text.parse::<EndPoint>().is_ok_and(|endpoint| {
        let port = endpoint.address().as_str().rsplit_once(':').and_then(|(_, port)| port.parse::<u16>().ok());
        PROTOCOLS.contains(&endpoint.protocol().as_str()) && port.is_some()
    })
}

/// Address of an endpoint, where it is one of numbers.
pub(super) fn socket(endpoint: &str) -> Option<SocketAddr> {
    endpoint.parse::<EndPoint>().ok()?.address().as_str().parse().ok()
}

/// Whether a Zenoh endpoint shows who connects.
pub fn is_tls_endpoint(endpoint: &str) -> bool {
    endpoint.starts_with("tls/")
}

/// Whether a Zenoh endpoint is on this machine alone.
pub fn is_loopback_endpoint(endpoint: &str) -> bool {
    socket(endpoint).is_some_and(|address| address.ip().is_loopback())
}
