//! An authority that signs certificates, and a server that knows a fleet.

use std::path::{Path, PathBuf};

use nesam_client::{Client, ClientError, Tls};
use nesam_server::{Config, RunningServer, serve};
use rcgen::{BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, SanType, date_time_ymd};

use crate::stage::predictor;

pub const FLEET: &str = r#"
operators = ["control"]
servers = ["alpha", "beta"]
proxies = ["front"]
[vehicles.truck]
maps = ["local"]
[vehicles.other]
[planners.mission]
vehicles = ["truck"]
"#;

/// An authority that signs certificates.
pub struct Authority {
    pub pem: String,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    pub fn new() -> Self {
        let mut params = CertificateParams::new(vec![]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().unwrap();
        let pem = params.self_signed(&key).unwrap().pem();
        Self { pem, issuer: Issuer::new(params, key) }
    }

    /// Certificate and key for these names; `expired` = valid until a year ago. A name `nesam:...` is the common name too.
    pub fn sign(&self, names: &[SanType], expired: bool) -> (Vec<u8>, Vec<u8>) {
        let mut params = CertificateParams::new(vec![]).unwrap();
        params.subject_alt_names = names.to_vec();
        for name in names {
            if let SanType::URI(name) = name {
                params.distinguished_name.push(DnType::CommonName, name.to_string());
            }
        }
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        if expired {
            (params.not_before, params.not_after) = (date_time_ymd(2019, 1, 1), date_time_ymd(2020, 1, 1));
        }
        let key = KeyPair::generate().unwrap();
        let certificate = params.signed_by(&key, &self.issuer).unwrap();
        (certificate.pem().into_bytes(), key.serialize_pem().into_bytes())
    }

    /// What somebody of this name shows and trusts.
    pub fn tls(&self, name: &str) -> Tls {
        Tls { authority: self.pem.clone().into_bytes(), identity: Some(self.sign(&[uri(name)], false)), server_name: "localhost".into() }
    }
}

pub fn uri(text: &str) -> SanType {
    SanType::URI(text.try_into().unwrap())
}

pub fn dns(text: &str) -> SanType {
    SanType::DnsName(text.try_into().unwrap())
}

/// A file with these bytes.
pub fn written(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

/// A server that knows a fleet, and the folder with its files.
pub struct Stage {
    pub server: RunningServer,
    pub authority: Authority,
    pub files: tempfile::TempDir,
}

pub async fn secured() -> Stage {
    secured_with(|_| {}).await
}

/// A server with mutual TLS; `change` has the last word on its configuration.
pub async fn secured_with(change: impl FnOnce(&mut Config)) -> Stage {
    let (files, authority) = (tempfile::tempdir().unwrap(), Authority::new());
    let (certificate, key) = authority.sign(&[dns("localhost"), uri("nesam:server:alpha")], false);
    let write = |name: &str, bytes: &[u8]| written(files.path(), name, bytes);
    let mut config = Config::ephemeral();
    config.tls.certificate = write("server.pem", &certificate);
    config.tls.key = write("server.key", &key);
    config.tls.client_ca = write("ca.pem", authority.pem.as_bytes());
    config.tls.fleet = write("fleet.toml", FLEET.as_bytes());
    config.tls.handshake_s = 2.0;
    change(&mut config);
    let server = serve(config, predictor()).await.unwrap();
    Stage { server, authority, files }
}

impl Stage {
    /// Puts a file in the place of one of the server's, whole.
    pub fn replace(&self, name: &str, bytes: &[u8]) {
        let new = written(self.files.path(), "new", bytes);
        std::fs::rename(new, self.files.path().join(name)).unwrap();
    }

    /// A client that shows this.
    pub async fn connect(&self, identity: Option<(Vec<u8>, Vec<u8>)>) -> Result<Client, ClientError> {
        let tls = Tls { authority: self.authority.pem.clone().into_bytes(), identity, server_name: "localhost".into() };
        Client::connect_tls(&format!("https://{}", self.server.grpc_addr), &tls).await
    }

    /// A client whose certificate says this.
    pub async fn client(&self, name: &str) -> Client {
        self.connect(Some(self.authority.sign(&[uri(name)], false))).await.unwrap()
    }
}
