//! TLS.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::ServerError;

/// TLS of gRPC and of Zenoh endpoints `tls/...`. Files are PEM; an empty path = none.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TlsConfig {
    /// Certificate of the server, with its chain. Empty = no TLS: everybody on the way reads and changes everything.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
    /// Authority of the clients' certificates. Empty = clients show none, and whoever reaches the port may do everything.
    pub client_ca: PathBuf,
    /// Fleet file: what each client may do; needed with `client_ca`.
    pub fleet: PathBuf,
    /// Longest handshake, s; a connection that says nothing for longer is closed, also without TLS, and one of HTTP on which nothing is asked for longer.
    pub handshake_s: f64,
    /// Interval at which the files are read again, s. What has changed and is sound holds for new connections, rights at once.
    pub reload_s: f64,
}

impl Default for TlsConfig {
    fn default() -> Self {
        let none = PathBuf::new;
        Self { certificate: none(), key: none(), client_ca: none(), fleet: none(), handshake_s: 5.0, reload_s: 10.0 }
    }
}

impl TlsConfig {
    /// Checks that the keys go together; the files are read when the server starts.
    pub(super) fn check(&self) -> Result<(), ServerError> {
        let given = |path: &Path| !path.as_os_str().is_empty();
        let needs = [
            ("tls.key", given(&self.key), given(&self.certificate), "tls.certificate"),
            ("tls.certificate", given(&self.certificate), given(&self.key), "tls.key"),
            ("tls.client_ca", given(&self.client_ca), given(&self.certificate), "tls.certificate"),
            ("tls.client_ca", given(&self.client_ca), given(&self.fleet), "tls.fleet"),
            ("tls.fleet", given(&self.fleet), given(&self.client_ca), "tls.client_ca"),
        ];
        match needs.iter().find(|(_, this, other, _)| *this && !other) {
            Some((key, .., other)) => Err(ServerError::value(key, format!("is given without `{other}`"))),
            None => Ok(()),
        }
    }

    /// Whether clients have to say who they are.
    pub fn restricts(&self) -> bool {
        !self.client_ca.as_os_str().is_empty()
    }
}
