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
use crate::config::TlsConfig;
use crate::error::ServerError;
use crate::grpc::stopped;
use crate::telemetry::Metrics;

/// The bytes of the files; empty = not configured.
#[derive(PartialEq, Eq)]
struct Files {
    certificate: Vec<u8>,
    key: Vec<u8>,
    client_ca: Vec<u8>,
    fleet: Vec<u8>,
}

/// TLS of new connections and the rights of the fleet, as the files say.
pub struct Credentials {
    config: TlsConfig,
    files: Files,
    /// When the certificate expires, s since 1970.
    expires_s: u64,
    tls: watch::Sender<Arc<ServerConfig>>,
    /// `None` = clients show no certificates.
    rights: Option<watch::Sender<Arc<FleetFile>>>,
}

impl Credentials {
    /// Reads the files of a configuration with `tls.certificate`.
    ///
    /// # Errors
    /// `ServerError::Tls` naming the key whose file cannot be used.
    pub fn read(config: &TlsConfig) -> Result<Self, ServerError> {
        let files = Files::read(config)?;
        let tls = watch::channel(Arc::new(files.server_config()?)).0;
        let expires_s = files.expiry_s(&config.certificate)?;
        let rights = match config.restricts() {
            true => Some(watch::channel(Arc::new(files.rights(&config.fleet)?)).0),
            false => None,
        };
        Ok(Self { config: config.clone(), files, expires_s, tls, rights })
    }

    /// The configuration that new connections get.
    pub fn tls(&self) -> watch::Receiver<Arc<ServerConfig>> {
        self.tls.subscribe()
    }

    /// The rights of the fleet, where clients have identities.
    pub(super) fn rights(&self) -> Option<watch::Receiver<Arc<FleetFile>>> {
        self.rights.as_ref().map(watch::Sender::subscribe)
    }

    /// Reads the files again and puts them in force when they have changed and are sound; says whether they have changed.
    ///
    /// # Errors
    /// As [`Credentials::read`]; what was in force stays so.
    fn reread(&mut self) -> Result<bool, ServerError> {
        let files = Files::read(&self.config)?;
        if files == self.files {
            return Ok(false);
        }
        let tls = files.server_config()?;
        // One that expired while it was in force is no reason to keep rights that were withdrawn.
        let expires_s = match files.certificate == self.files.certificate {
            true => self.expires_s,
            false => files.expiry_s(&self.config.certificate)?,
        };
        if let Some(rights) = &self.rights {
            rights.send_replace(Arc::new(files.rights(&self.config.fleet)?));
        }
        self.tls.send_replace(Arc::new(tls));
        (self.files, self.expires_s) = (files, expires_s);
        Ok(true)
    }

    /// What is readable and may be a mistake.
    pub fn doubts(&self) -> Vec<String> {
        let of_rights = self.rights.as_ref().map_or_else(Vec::new, |rights| rights.borrow().doubts());
        self.files.foreign_certificate().into_iter().chain(of_rights).collect()
    }

    /// Says what is in force: when the certificate expires as a metric, what may be a mistake in the log.
    fn in_force(&self, metrics: &Metrics) {
        metrics.certificate_expires(self.expires_s);
        self.doubts().iter().for_each(|doubt| tracing::warn!(target: "nesam::audit", doubt, "certificates or rights may be wrong"));
    }

    /// Follows the files until the server stops. What cannot be used is logged once and counted, and changes nothing.
    pub async fn follow(mut self, metrics: Arc<Metrics>, stopping: watch::Receiver<bool>) {
        self.in_force(&metrics);
        let stop = stopped(stopping);
        tokio::pin!(stop);
        let mut tick = tokio::time::interval(Duration::from_secs_f64(self.config.reload_s));
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let mut said = String::new();
        loop {
            tokio::select! {
                _ = tick.tick() => {}
                () = &mut stop => return,
            }
            // A file system that hangs holds up no request.
            let read = tokio::task::spawn_blocking(move || {
                let result = self.reread();
                (self, result)
            });
            let Ok((back, result)) = read.await else { return };
            self = back;
            match result {
                Ok(false) => said.clear(),
                Ok(true) => {
                    said.clear();
                    metrics.reloaded(true);
                    tracing::info!(target: "nesam::audit", "certificates and rights were read anew");
                    self.in_force(&metrics);
                }
                Err(error) if error.to_string() == said => {}
                Err(error) => {
                    said = error.to_string();
                    metrics.reloaded(false);
                    tracing::error!(target: "nesam::audit", %error, "changed certificates or rights cannot be used; those before stay in force");
                }
            }
        }
    }
}

/// Failure of the file of a key. What is in the file never reaches a message.
fn unusable(key: &'static str, reason: impl Into<String>) -> ServerError {
    ServerError::Tls { key, reason: reason.into() }
}

impl Files {
    fn read(config: &TlsConfig) -> Result<Self, ServerError> {
        let read = |key: &'static str, path: &Path| match path.as_os_str().is_empty() {
            true => Ok(Vec::new()),
            false => std::fs::read(path).map_err(|source| unusable(key, format!("{}: {source}", path.display()))),
        };
        Ok(Self {
            certificate: read("tls.certificate", &config.certificate)?,
            key: read("tls.key", &config.key)?,
            client_ca: read("tls.client_ca", &config.client_ca)?,
            fleet: read("tls.fleet", &config.fleet)?,
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
        let key = PrivateKeyDer::from_pem_slice(&self.key).map_err(|_| unusable("tls.key", "the file holds no private key in PEM"))?;
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

    fn rights(&self, path: &Path) -> Result<FleetFile, ServerError> {
        let text = std::str::from_utf8(&self.fleet).map_err(|error| error.to_string());
        text.and_then(FleetFile::parse).map_err(|reason| unusable("tls.fleet", format!("{}: {reason}", path.display())))
    }
}

fn certificates(key: &'static str, pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, ServerError> {
    let read: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem).collect();
    read.ok().filter(|list| !list.is_empty()).ok_or_else(|| unusable(key, "the file holds no certificate in PEM"))
}
