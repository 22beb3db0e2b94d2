//! What the files of `[tls]` hold, read at the start and again when they change: certificates are renewed and rights withdrawn without a restart.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{Error, RootCertStore, ServerConfig};

use super::certificate;
use super::fleet_file::FleetFile;
use super::identity::Identity;
use super::rereading::{Rereading, read_file, reread};
use crate::config::TlsConfig;
use crate::error::ServerError;
use crate::telemetry::{Metrics, Part};

/// The bytes of the files of TLS; empty = not configured.
#[derive(PartialEq, Eq)]
pub(crate) struct TlsFiles {
    certificate: Vec<u8>,
    key: Vec<u8>,
    client_ca: Vec<u8>,
}

/// The rights of the fleet, and the file that says them.
struct Rights {
    file: Vec<u8>,
    in_force: watch::Sender<Arc<FleetFile>>,
}

/// TLS of new connections and the rights of the fleet, as the files say. Both change by themselves: what is wrong with the files of one keeps no change of the
/// other out.
pub struct Credentials {
    config: TlsConfig,
    /// What is in force of the files of TLS; told anew when the rights change too.
    files: watch::Sender<Arc<TlsFiles>>,
    /// When the certificate expires, s since 1970.
    expires_s: u64,
    tls: watch::Sender<Arc<ServerConfig>>,
    /// `None` = clients show no certificates.
    rights: Option<Rights>,
    /// Whether the certificate is shown on Zenoh too.
    on_zenoh: bool,
}

impl Credentials {
    /// Reads the files of a configuration with `tls.certificate`.
    ///
    /// # Errors
    /// `ServerError::Tls` naming the key whose file cannot be used.
    pub fn read(config: &TlsConfig) -> Result<Self, ServerError> {
        let files = TlsFiles::read(config)?;
        let tls = watch::channel(Arc::new(files.server_config()?)).0;
        let expires_s = files.expiry_s(&config.certificate)?;
        let rights = match config.restricts() {
            true => {
                let file = read_file("tls.fleet", &config.fleet)?;
                let in_force = watch::channel(Arc::new(fleet(&file, &config.fleet)?)).0;
                Some(Rights { file, in_force })
            }
            false => None,
        };
        Ok(Self { config: config.clone(), files: watch::channel(Arc::new(files)).0, expires_s, tls, rights, on_zenoh: false })
    }

    /// The same, shown on Zenoh too, which knows servers by their common name.
    #[must_use]
    pub fn on_zenoh(self, on_zenoh: bool) -> Self {
        Self { on_zenoh, ..self }
    }

    /// The configuration that new connections get.
    pub fn tls(&self) -> watch::Receiver<Arc<ServerConfig>> {
        self.tls.subscribe()
    }

    /// The files of TLS that are in force; a change of the rights is told there too.
    pub(crate) fn files(&self) -> watch::Receiver<Arc<TlsFiles>> {
        self.files.subscribe()
    }

    /// The rights of the fleet, where clients have identities.
    pub(super) fn rights(&self) -> Option<watch::Receiver<Arc<FleetFile>>> {
        self.rights.as_ref().map(|rights| rights.in_force.subscribe())
    }

    /// Reads the files of TLS again and puts them in force when they have changed and are sound; says whether they have changed.
    ///
    /// # Errors
    /// As [`Credentials::read`]; what was in force stays so.
    fn reread_tls(&mut self) -> Result<bool, ServerError> {
        let (files, before) = (TlsFiles::read(&self.config)?, self.files.borrow().clone());
        if files == *before {
            return Ok(false);
        }
        let tls = files.server_config()?;
        // One that expired while it was in force is no reason to keep an authority that was withdrawn.
        if files.certificate != before.certificate {
            self.expires_s = files.expiry_s(&self.config.certificate)?;
        }
        self.tls.send_replace(Arc::new(tls));
        self.files.send_replace(Arc::new(files));
        Ok(true)
    }

    /// The same for the rights.
    ///
    /// # Errors
    /// As [`Credentials::read`]; what was in force stays so.
    fn reread_rights(&mut self) -> Result<bool, ServerError> {
        let Some(rights) = &mut self.rights else { return Ok(false) };
        let file = read_file("tls.fleet", &self.config.fleet)?;
        if file == rights.file {
            return Ok(false);
        }
        rights.in_force.send_replace(Arc::new(fleet(&file, &self.config.fleet)?));
        rights.file = file;
        self.files.send_modify(|_| {});
        Ok(true)
    }

    /// What is readable and may be a mistake.
    pub fn doubts(&self) -> Vec<String> {
        let files = self.files.borrow().clone();
        let of_rights = self.rights.as_ref().map_or_else(Vec::new, |rights| rights.in_force.borrow().doubts());
        files.foreign_certificate().into_iter().chain(self.stranger_on_zenoh(&files)).chain(of_rights).collect()
    }

    /// Why routers may take this server for a stranger, where it shows its certificate on Zenoh.
    fn stranger_on_zenoh(&self, files: &TlsFiles) -> Option<String> {
        let rights = self.rights.as_ref().filter(|_| self.on_zenoh)?.in_force.borrow().clone();
        let name = certificate::common_name(certificates("tls.certificate", &files.certificate).ok()?.first()?).unwrap_or_default();
        let known = Identity::parse(&name).is_ok_and(|who| matches!(who, Identity::Server(_)) && rights.knows(&who));
        let doubt = format!(
            "the certificate in `tls.certificate` has the common name `{name}`: Zenoh routers let nobody answer vehicles but `nesam:server:NAME` with a NAME from \
             `servers` in `tls.fleet`"
        );
        (!known).then_some(doubt)
    }

    /// Says what is in force: when the certificate expires as a metric, what may be a mistake in the log.
    fn in_force(&self, metrics: &Metrics) {
        metrics.reloads().expires(Part::Certificate, self.expires_s);
        self.doubts().iter().for_each(|doubt| tracing::warn!(target: "nesam::audit", doubt, "certificates or rights may be wrong"));
    }

    /// Follows the files until the server stops. What cannot be used is logged once, counted and told as long as it is so, and changes nothing.
    pub async fn follow(self, metrics: Arc<Metrics>, stopping: watch::Receiver<bool>) {
        self.in_force(&metrics);
        let every = Duration::from_secs_f64(self.config.reload_s);
        let mut parts = [Part::Certificate, Part::Rights].map(Rereading::of);
        let read = |credentials: &mut Self| [credentials.reread_tls(), credentials.reread_rights()];
        reread("certificates and rights", self, every, stopping, read, |credentials, results| {
            let changed: Vec<bool> = parts.iter_mut().zip(results).map(|(part, result)| part.tell(result, metrics.reloads())).collect();
            if changed.contains(&true) {
                credentials.in_force(&metrics);
            }
        })
        .await;
    }
}

/// Failure of the file of a key. What is in the file never reaches a message.
fn unusable(key: &'static str, reason: impl Into<String>) -> ServerError {
    ServerError::Tls { key, reason: reason.into() }
}

/// What the fleet file says.
fn fleet(file: &[u8], path: &Path) -> Result<FleetFile, ServerError> {
    let text = std::str::from_utf8(file).map_err(|error| error.to_string());
    text.and_then(FleetFile::parse).map_err(|reason| unusable("tls.fleet", format!("{}: {reason}", path.display())))
}

impl TlsFiles {
    /// Reads them.
    ///
    /// # Errors
    /// `ServerError::Tls` naming the key whose file cannot be read.
    pub fn read(config: &TlsConfig) -> Result<Self, ServerError> {
        Ok(Self {
            certificate: read_file("tls.certificate", &config.certificate)?,
            key: read_file("tls.key", &config.key)?,
            client_ca: read_file("tls.client_ca", &config.client_ca)?,
        })
    }

    /// TLS 1.2 and 1.3 over HTTP/2, with client certificates where there is an authority for them.
    fn server_config(&self) -> Result<ServerConfig, ServerError> {
        let failed = |error| match error {
            Error::InconsistentKeys(_) => unusable("tls.key", "does not belong to the certificate in `tls.certificate`"),
            other => unusable("tls", other.to_string()),
        };
        let provider = Arc::new(ring::default_provider());
        let builder = ServerConfig::builder_with_provider(provider.clone()).with_safe_default_protocol_versions().map_err(failed)?;
        let builder = if self.client_ca.is_empty() {
            builder.with_no_client_auth()
        } else {
            let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(self.authorities()?), provider).build();
            builder.with_client_cert_verifier(verifier.map_err(|error| unusable("tls.client_ca", error.to_string()))?)
        };
        let key = private_key(&self.key)?;
        let mut config = builder.with_single_cert(certificates("tls.certificate", &self.certificate)?, key).map_err(failed)?;
        config.alpn_protocols.push(b"h2".to_vec());
        Ok(config)
    }

    /// The authorities of the clients' certificates.
    fn authorities(&self) -> Result<RootCertStore, ServerError> {
        let mut roots = RootCertStore::empty();
        for certificate in certificates("tls.client_ca", &self.client_ca)? {
            roots.add(certificate).map_err(|error| unusable("tls.client_ca", error.to_string()))?;
        }
        Ok(roots)
    }

    /// When the certificate expires, s since 1970; an error where no client would accept it.
    fn expiry_s(&self, path: &Path) -> Result<u64, ServerError> {
        let chain = certificates("tls.certificate", &self.certificate)?;
        certificate::expiry_s(&chain[0], UnixTime::now())
            .map_err(|reason| unusable("tls.certificate", format!("the certificate in {} {reason}", path.display())))
    }

    /// Why members of the fleet may not accept the certificate, where it is of another authority than theirs.
    fn foreign_certificate(&self) -> Option<String> {
        let (chain, authorities) = (certificates("tls.certificate", &self.certificate).ok()?, self.authorities().ok()?);
        let error = certificate::verify(&chain[0], &chain[1..], &authorities.roots, UnixTime::now()).err()?;
        Some(format!(
            "no authority in `tls.client_ca` has signed the certificate in `tls.certificate`: who trusts them alone refuses this server ({error})"
        ))
    }
}

/// The private key of a server.
fn private_key(pem: &[u8]) -> Result<PrivateKeyDer<'static>, ServerError> {
    let text = String::from_utf8_lossy(pem);
    if ["BEGIN ENCRYPTED PRIVATE KEY", "4,ENCRYPTED"].iter().any(|head| text.contains(head)) {
        let reason = "the private key is encrypted, and a server has nobody to ask for its passphrase: write it without one (`openssl pkey -in KEY -out PLAIN_KEY`) and \
                      let only the server read it";
        return Err(unusable("tls.key", reason));
    }
    PrivateKeyDer::from_pem_slice(pem).map_err(|_| unusable("tls.key", "the file holds no private key in PEM"))
}

/// The certificates in the file of a key.
///
/// # Errors
/// `ServerError::Tls` where there is none.
pub(crate) fn certificates(key: &'static str, pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, ServerError> {
    let read: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    read.ok().filter(|list| !list.is_empty()).ok_or_else(|| unusable(key, "the file holds no certificate in PEM"))
}

#[cfg(test)]
mod tests;
