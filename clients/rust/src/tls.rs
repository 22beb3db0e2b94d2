//! What a client shows and trusts.

use std::path::Path;

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use tonic::transport::{Certificate, ClientTlsConfig, Identity};

use crate::error::ClientError;

/// TLS of a client, in PEM.
#[derive(Clone, Default)]
pub struct Tls {
    /// Authority of the server's certificate.
    pub authority: Vec<u8>,
    /// Certificate of the client and its key, where the server wants to know who it is.
    pub identity: Option<(Vec<u8>, Vec<u8>)>,
    /// Name in the server's certificate; empty = that of the address.
    pub server_name: String,
}

impl core::fmt::Debug for Tls {
    /// Without the key.
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (identity, server_name) = (self.identity.is_some(), &self.server_name);
        f.debug_struct("Tls").field("identity", &identity).field("server_name", server_name).finish_non_exhaustive()
    }
}

impl Tls {
    /// Reads the files.
    ///
    /// # Errors
    /// `ClientError::File` naming the file that cannot be read.
    pub fn from_files(authority: &Path, identity: Option<(&Path, &Path)>) -> Result<Self, ClientError> {
        let read = |path: &Path| std::fs::read(path).map_err(|source| ClientError::File { path: path.into(), source });
        let identity = identity.map(|(certificate, key)| Ok::<_, ClientError>((read(certificate)?, read(key)?))).transpose()?;
        Ok(Self { authority: read(authority)?, identity, server_name: String::new() })
    }

    /// Writes authority and identity into the configuration of a Zenoh session.
    pub(crate) fn configure_zenoh(&self, config: &mut zenoh::Config) -> Result<(), zenoh::Error> {
        let mut set = |key: &str, pem: &[u8]| {
            let value = BASE64_STANDARD.encode(pem);
            config.insert_json5(&format!("transport/link/tls/{key}_base64"), &format!("{value:?}"))
        };
        set("root_ca_certificate", &self.authority)?;
        if let Some((certificate, key)) = &self.identity {
            set("connect_certificate", certificate)?;
            set("connect_private_key", key)?;
            config.insert_json5("transport/link/tls/enable_mtls", "true")?;
        }
        Ok(())
    }

    pub(crate) fn config(&self) -> ClientTlsConfig {
        let mut config = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(&self.authority));
        if let Some((certificate, key)) = &self.identity {
            config = config.identity(Identity::from_pem(certificate, key));
        }
        if !self.server_name.is_empty() {
            config = config.domain_name(&self.server_name);
        }
        config
    }
}
