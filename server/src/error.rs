//! Why a server does not start.

use std::net::SocketAddr;
use std::path::PathBuf;

/// Failure of reading the configuration or of starting.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// A configuration file cannot be used.
    #[error("configuration {}: {reason}", path.display())]
    Config {
        /// File at fault.
        path: PathBuf,
        /// Key and reason.
        reason: String,
    },
    /// A configured value makes no sense.
    #[error("configuration key `{key}`: {reason}")]
    Value {
        /// Dotted key.
        key: &'static str,
        /// What was wrong and what is allowed.
        reason: String,
    },
    /// An address cannot be listened on.
    #[error("cannot listen on {address} (`{key}`): {source}; choose another address or stop the program that uses it")]
    Listen {
        /// Address asked for.
        address: SocketAddr,
        /// Configuration key.
        key: &'static str,
        /// What the system said.
        source: std::io::Error,
    },
    /// The bundle's settings of the soil filter cannot be used.
    #[error("bundle {bundle}: soil_filter.json: {reason}; make it again with `nesam adapt --calibrate`")]
    SoilFilter {
        /// Name of the bundle.
        bundle: String,
        /// What is wrong with them.
        reason: String,
    },
    /// The recording cannot be begun.
    #[error("recording does not start: {source}; choose another folder (`recording.directory`, --record)")]
    Recording {
        /// What is wrong.
        source: crate::recording::RecordingError,
    },
    /// TLS or the rights of the clients cannot be set up.
    #[error("configuration key `{key}`: {reason}")]
    Tls {
        /// Dotted key.
        key: &'static str,
        /// What is wrong with its file; never what is in it.
        reason: String,
    },
    /// The store of the sessions cannot be used.
    #[error("the store {source}; choose another folder (`store.directory`, --store) or mend this one")]
    Store {
        /// What is wrong.
        source: crate::store::StoreError,
    },
    /// Zenoh does not start.
    #[error("zenoh does not start: {reason}; check `zenoh.listen` and `zenoh.connect`, or set `zenoh.enabled = false`")]
    Zenoh {
        /// What Zenoh said.
        reason: String,
    },
    /// Zenoh needs more than the runtime offers.
    #[error("zenoh needs a multi-thread tokio runtime; start the server in one or set `zenoh.enabled = false`")]
    Runtime,
    /// The threads that compute predictions.
    #[error("worker threads: {reason}")]
    Workers {
        /// Why they were not started.
        reason: String,
    },
}

impl ServerError {
    /// A configured value that makes no sense.
    pub(crate) fn value(key: &'static str, reason: impl Into<String>) -> Self {
        Self::Value { key, reason: reason.into() }
    }
}
