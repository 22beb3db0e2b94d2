//! Goal: what is wrong with the certificate keeps no right in force, and what is wrong with the fleet file keeps no certificate out. Method: the files of
//! credentials are replaced one by one, as whoever renews and revokes does.

use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};

use super::*;
use crate::telemetry::Reloads;

const FLEET: &str = "servers = [\"alpha\"]\n[vehicles.truck]\n";

/// A folder with the files of `[tls]`.
struct Folder {
    files: tempfile::TempDir,
    issuer: Issuer<'static, KeyPair>,
}

impl Folder {
    fn new() -> Self {
        let mut params = CertificateParams::new(vec![]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().unwrap();
        let authority = params.self_signed(&key).unwrap().pem();
        let folder = Self { files: tempfile::tempdir().unwrap(), issuer: Issuer::new(params, key) };
        folder.write("ca.pem", &authority);
        folder.write("fleet.toml", FLEET);
        folder.renew("nesam:server:alpha");
        folder
    }

    fn write(&self, name: &str, text: &str) {
        std::fs::write(self.files.path().join(name), text).unwrap();
    }

    /// A certificate of this common name, and its key.
    fn renew(&self, common_name: &str) {
        let mut params = CertificateParams::new(vec!["localhost".into()]).unwrap();
        params.distinguished_name.push(DnType::CommonName, common_name);
        let key = KeyPair::generate().unwrap();
        self.write("server.pem", &params.signed_by(&key, &self.issuer).unwrap().pem());
        self.write("server.key", &key.serialize_pem());
    }

    fn credentials(&self) -> Credentials {
        let [certificate, key, client_ca, fleet] =
            ["server.pem", "server.key", "ca.pem", "fleet.toml"].map(|name| self.files.path().join(name));
        Credentials::read(&TlsConfig { certificate, key, client_ca, fleet, ..TlsConfig::default() }).unwrap()
    }
}

#[test]
fn regress_certificates_and_rights_change_each_by_itself() {
    let folder = Folder::new();
    let mut credentials = folder.credentials();
    let (rights, files) = (credentials.rights().unwrap(), credentials.files());
    let knows = |vehicle: &str| rights.borrow().knows(&Identity::Vehicle(vehicle.into()));
    assert!(matches!((credentials.reread_tls(), credentials.reread_rights()), (Ok(false), Ok(false))));

    // Half a renewal: the key is new, the certificate is not. A vehicle is revoked meanwhile.
    folder.write("server.key", &KeyPair::generate().unwrap().serialize_pem());
    folder.write("fleet.toml", &FLEET.replace("truck", "other"));
    assert!(credentials.reread_tls().unwrap_err().to_string().contains("tls.key"));
    assert!(credentials.reread_rights().unwrap() && !knows("truck") && knows("other"));
    assert!(files.has_changed().unwrap(), "who reads the rights with the files hears of it");

    // A certificate that cannot be read at all is no reason either.
    std::fs::remove_file(folder.files.path().join("server.pem")).unwrap();
    folder.write("fleet.toml", FLEET);
    assert!(credentials.reread_tls().unwrap_err().to_string().contains("tls.certificate"));
    assert!(credentials.reread_rights().unwrap() && knows("truck"));

    // A fleet file that cannot be used keeps no certificate out, and changes no right.
    let before = credentials.files().borrow().clone();
    folder.renew("nesam:server:alpha");
    folder.write("fleet.toml", "[vehicle.x]\n");
    assert!(credentials.reread_tls().unwrap() && *before != **credentials.files().borrow());
    assert!(credentials.reread_rights().unwrap_err().to_string().contains("tls.fleet"));
    assert!(knows("truck"));
}

/// Goal: an alert on files that cannot be used does not end before they can be. Method: the same problem found again and again, then another one, then none.
#[test]
fn regress_files_are_unusable_until_they_can_be_used() {
    let (reloads, mut rights) = (Reloads::default(), Rereading::of(Part::Rights));
    let told = || {
        let mut text = String::new();
        reloads.render(&mut text);
        let value = |of: &str| text.lines().find_map(|line| line.strip_prefix(of)).unwrap().trim().parse::<u64>().unwrap();
        let failed = value("nesam_credentials_reloads_total{part=\"rights\",result=\"failed\"}");
        (failed, value("nesam_credentials_unusable{part=\"rights\"}"), value("nesam_credentials_unusable{part=\"certificate\"}"))
    };
    assert_eq!(told(), (0, 0, 0));
    for (problem, expected) in [("a", 1), ("a", 1), ("b", 2), ("b", 2)] {
        assert!(!rights.tell(Err(unusable("tls.fleet", problem)), &reloads));
        assert_eq!(told(), (expected, 1, 0), "counted once, there as long as it lasts");
    }
    assert!(!rights.tell(Ok(false), &reloads), "the file before is back");
    assert_eq!(told(), (2, 0, 0));
    assert!(rights.tell(Ok(true), &reloads));
}

/// Goal: a key with a passphrase is told as what it is. Method: the heads of both forms of such files.
#[test]
fn regress_an_encrypted_key_is_told_from_none() {
    let folder = Folder::new();
    let mut credentials = folder.credentials();
    let mut refused = |text: &str| {
        folder.write("server.key", text);
        credentials.reread_tls().unwrap_err().to_string()
    };
    for (head, more) in [("ENCRYPTED PRIVATE KEY", ""), ("RSA PRIVATE KEY", "Proc-Type: 4,ENCRYPTED\nDEK-Info: AES-256-CBC,00\n\n")] {
        let said = refused(&format!("-----BEGIN {head}-----\n{more}MIIB\n-----END {head}-----\n"));
        assert!(said.contains("tls.key") && said.contains("is encrypted") && said.contains("openssl pkey"), "{said}");
    }
    assert!(refused("MIIB").contains("holds no private key in PEM"));
}

#[test]
fn regress_a_common_name_that_routers_refuse_is_a_doubt_on_zenoh() {
    let folder = Folder::new();
    assert_eq!(folder.credentials().on_zenoh(true).doubts(), [""; 0]);
    for name in ["nesam:server:beta", "nesam:vehicle:truck", "server.example", ""] {
        folder.renew(name);
        assert_eq!(folder.credentials().doubts(), [""; 0], "not shown on Zenoh");
        let doubts = folder.credentials().on_zenoh(true).doubts();
        assert!(doubts.len() == 1 && doubts[0].contains(&format!("`{name}`")) && doubts[0].contains("servers"), "{doubts:?}");
    }
}
