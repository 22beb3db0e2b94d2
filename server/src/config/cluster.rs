//! Servers that share sessions.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::error::ServerError;

/// Servers that share sessions through etcd.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClusterConfig {
    /// Members of etcd, e.g. `http://etcd:2379`; empty = this server is alone.
    pub etcd: Vec<String>,
    /// First part of all keys; servers with the same one share their sessions.
    pub prefix: String,
    /// Name of this server among the others; empty = its host and port.
    pub name: String,
    /// Time without a word from this server after which its sessions are free for others, whole seconds.
    pub lease_s: u32,
    /// Certificate of this server towards etcd, PEM; empty = none.
    pub certificate: PathBuf,
    /// Its key.
    pub key: PathBuf,
    /// Authority of etcd's certificates, PEM.
    pub authority: PathBuf,
}

impl Default for ClusterConfig {
    fn default() -> Self {
        let (certificate, key, authority) = Default::default();
        Self { etcd: Vec::new(), prefix: "nesam".into(), name: String::new(), lease_s: 2, certificate, key, authority }
    }
}

impl ClusterConfig {
    /// Whether sessions are shared.
    pub fn enabled(&self) -> bool {
        !self.etcd.is_empty()
    }

    /// Whether a member needs certificates.
    pub fn uses_tls(&self) -> bool {
        self.etcd.iter().any(|address| address.starts_with("https://"))
    }

    /// Checks what the types do not.
    ///
    /// # Errors
    /// `ServerError::Value` naming the key.
    pub fn check(&self) -> Result<(), ServerError> {
        let wrong = |key, reason: String| Err(ServerError::value(key, reason));
        if let Some(other) = self.etcd.iter().find(|address| !address.starts_with("http://") && !address.starts_with("https://")) {
            return wrong("cluster.etcd", format!("`{other}` is no address; expected `http://host:2379` or `https://host:2379`"));
        }
        if self.prefix.is_empty() || self.prefix.starts_with('/') || self.prefix.ends_with('/') {
            return wrong("cluster.prefix", format!("`{}` is empty or begins or ends with `/`", self.prefix));
        }
        if !(1..=60).contains(&self.lease_s) {
            return wrong("cluster.lease_s", format!("is {}, allowed is 1 to 60 s", self.lease_s));
        }
        if self.certificate.as_os_str().is_empty() != self.key.as_os_str().is_empty() {
            return wrong("cluster.key", "a certificate and its key come together".into());
        }
        if self.uses_tls() && self.authority.as_os_str().is_empty() {
            return wrong("cluster.authority", "is needed for `https://` endpoints: the authority of etcd's certificates".into());
        }
        Ok(())
    }
}
