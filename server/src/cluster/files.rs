//! The certificates towards etcd, read at the start and again when they change.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio_rustls::rustls::pki_types::UnixTime;
use tonic::transport::channel::Change;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint, Identity};

use super::etcd::{in_short, plain_endpoint};
use crate::access::{Rereading, certificate, certificates, read_file, reread};
use crate::config::ClusterConfig;
use crate::error::ServerError;
use crate::telemetry::{Metrics, Part};

/// A member of etcd that is connected to from now on as its endpoint says, by its address.
pub(super) type Renewal = Change<String, Endpoint>;

/// The bytes of the files of `[cluster]`; empty = not configured.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Files {
    authority: Vec<u8>,
    certificate: Vec<u8>,
    key: Vec<u8>,
}

/// How the members of etcd are connected to, as the files say.
#[derive(Debug)]
pub(crate) struct ClusterFiles {
    config: ClusterConfig,
    files: Files,
    /// When the certificate expires, s since 1970; `None` = there is none.
    expires_s: Option<u64>,
    /// Where renewed endpoints go.
    renewals: mpsc::Sender<Renewal>,
}

impl Files {
    /// Reads the files that members with `https://` need.
    fn read(config: &ClusterConfig) -> Result<Self, ServerError> {
        if !config.uses_tls() {
            return Ok(Self::default());
        }
        Ok(Self {
            authority: read_file("cluster.authority", &config.authority)?,
            certificate: read_file("cluster.certificate", &config.certificate)?,
            key: read_file("cluster.key", &config.key)?,
        })
    }

    /// How a member is connected to with these files.
    fn endpoint(&self, address: &str) -> Result<Endpoint, ServerError> {
        let endpoint = plain_endpoint(address)?;
        if !address.starts_with("https://") {
            return Ok(endpoint);
        }
        certificates("cluster.authority", &self.authority)?;
        let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(&self.authority));
        if !self.certificate.is_empty() {
            tls = tls.identity(Identity::from_pem(&self.certificate, &self.key));
        }
        let wrong = |error: tonic::transport::Error| ServerError::value("cluster", format!("`{address}`: {}", in_short(&error)));
        endpoint.tls_config(tls).map_err(wrong)
    }

    /// When the certificate expires, s since 1970; an error where etcd would not accept it.
    fn expires_s(&self, config: &ClusterConfig) -> Result<Option<u64>, ServerError> {
        if config.certificate.as_os_str().is_empty() || !config.uses_tls() {
            return Ok(None);
        }
        let (key, path) = ("cluster.certificate", config.certificate.display());
        let chain = certificates(key, &self.certificate)?;
        let expires_s = certificate::client_expiry_s(&chain[0], UnixTime::now());
        expires_s.map(Some).map_err(|reason| ServerError::Tls { key, reason: format!("the certificate in {path} {reason}") })
    }
}

impl ClusterFiles {
    /// Reads the files of a configuration; the members go to `renewals`, as they do whenever the files have changed.
    ///
    /// # Errors
    /// `ServerError::Value` for an address that is none, `ServerError::Tls` for a file that cannot be used.
    pub(super) fn read(config: &ClusterConfig, renewals: mpsc::Sender<Renewal>) -> Result<Self, ServerError> {
        let files = Files::read(config)?;
        let expires_s = files.expires_s(config)?;
        let read = Self { config: config.clone(), files, expires_s, renewals };
        read.renew(&read.files)?;
        Ok(read)
    }

    /// Has the members connected to anew with these files.
    fn renew(&self, files: &Files) -> Result<(), ServerError> {
        let endpoints =
            self.config.etcd.iter().map(|address| Ok((address, files.endpoint(address)?))).collect::<Result<Vec<_>, ServerError>>()?;
        let room = self.renewals.try_reserve_many(endpoints.len()).map_err(|error| ServerError::Value {
            key: "cluster.etcd",
            reason: format!("the renewed connections are not taken yet ({error}); tried again"),
        })?;
        // A member that is there already is replaced once the new connection is there.
        room.zip(endpoints).for_each(|(room, (address, endpoint))| room.send(Change::Insert(address.clone(), endpoint)));
        Ok(())
    }

    /// Reads the files again and connects anew when they have changed and are sound; says whether they have changed.
    ///
    /// # Errors
    /// As [`ClusterFiles::read`]; what was in force stays so.
    fn reread(&mut self) -> Result<bool, ServerError> {
        let files = Files::read(&self.config)?;
        if files == self.files {
            return Ok(false);
        }
        // One that expired while it was in force is no reason to keep an authority that was withdrawn.
        let expires_s = match files.certificate == self.files.certificate {
            true => self.expires_s,
            false => files.expires_s(&self.config)?,
        };
        self.renew(&files)?;
        (self.files, self.expires_s) = (files, expires_s);
        Ok(true)
    }

    /// Follows the files until the server stops, looking at them this often. What cannot be used is logged once, counted and told as long as it is so, and changes
    /// nothing.
    pub async fn follow(self, every: Duration, metrics: Arc<Metrics>, stopping: watch::Receiver<bool>) {
        let expires = |files: &Self| metrics.reloads().expires(Part::Cluster, files.expires_s.unwrap_or_default());
        expires(&self);
        let mut told = Rereading::of(Part::Cluster);
        reread("the certificates towards etcd", self, every, stopping, Self::reread, |files, result| {
            told.tell(result, metrics.reloads());
            expires(files);
        })
        .await;
    }
}

/// How servers connect to a member of etcd.
///
/// # Errors
/// `ServerError::Value` for an address that is none, `ServerError::Tls` for files that cannot be used.
pub fn etcd_endpoint(address: &str, config: &ClusterConfig) -> Result<Endpoint, ServerError> {
    let files = Files::read(config)?;
    files.expires_s(config)?;
    files.endpoint(address)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair, date_time_ymd};

    use super::*;

    /// Writes an authority, and a certificate of it with its key; gives when that expires.
    fn renew(folder: &Path, year: i32) {
        let mut params = CertificateParams::new(vec![]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().unwrap();
        std::fs::write(folder.join("ca.pem"), params.self_signed(&key).unwrap().pem()).unwrap();
        let issuer = Issuer::new(params, key);
        let mut params = CertificateParams::new(vec!["server".into()]).unwrap();
        params.not_after = date_time_ymd(year, 1, 1);
        let key = KeyPair::generate().unwrap();
        std::fs::write(folder.join("c.pem"), params.signed_by(&key, &issuer).unwrap().pem()).unwrap();
        std::fs::write(folder.join("c.key"), key.serialize_pem()).unwrap();
    }

    fn config(folder: &Path) -> ClusterConfig {
        let [authority, certificate, key] = ["ca.pem", "c.pem", "c.key"].map(|name| folder.join(name));
        let etcd = ["https://a:2379", "https://b:2379", "http://c:2379"].map(String::from).to_vec();
        ClusterConfig { etcd, authority, certificate, key, ..ClusterConfig::default() }
    }

    /// Goal: members are connected to anew when the files have changed and are sound, and only then. Method: the files of three members are replaced.
    #[tokio::test]
    async fn regress_changed_certificates_are_put_in_force_towards_etcd() {
        let folder = tempfile::tempdir().unwrap();
        renew(folder.path(), 2090);
        let (renewals, mut renewed) = mpsc::channel(4);
        let mut addresses = || -> Vec<String> {
            std::iter::from_fn(|| renewed.try_recv().ok())
                .map(|change| if let Change::Insert(address, _) = change { address } else { "removed".into() })
                .collect()
        };
        let mut files = ClusterFiles::read(&config(folder.path()), renewals).unwrap();
        let members = config(folder.path()).etcd;
        assert_eq!((addresses(), files.expires_s), (members.clone(), Some(3_786_912_000)), "2090-01-01");
        assert!(!files.reread().unwrap() && addresses().is_empty());

        renew(folder.path(), 2091);
        assert!(files.reread().unwrap());
        assert_eq!((addresses(), files.expires_s), (members.clone(), Some(3_818_448_000)), "2091-01-01");

        // A certificate without its key, one that has expired, and none at all.
        std::fs::write(folder.path().join("c.key"), KeyPair::generate().unwrap().serialize_pem()).unwrap();
        assert!(files.reread().is_err());
        renew(folder.path(), 2020);
        assert!(files.reread().unwrap_err().to_string().contains("expired"));
        std::fs::remove_file(folder.path().join("c.pem")).unwrap();
        assert!(files.reread().unwrap_err().to_string().contains("cluster.certificate"));
        assert_eq!((addresses(), files.expires_s), (vec![], Some(3_818_448_000)), "what was in force stays so");

        renew(folder.path(), 2092);
        assert!(files.reread().unwrap());
        assert_eq!(addresses(), members);
        // Nobody takes what was renewed: it is tried again.
        renew(folder.path(), 2093);
        assert!(files.reread().unwrap());
        renew(folder.path(), 2094);
        assert!(files.reread().unwrap_err().to_string().contains("tried again"));
        assert_eq!(addresses(), members);
        assert!(files.reread().unwrap());
    }
}
