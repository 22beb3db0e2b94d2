//! `nesam router-config`: the configuration of a Zenoh router that guards a fleet.

use std::fs::File;
use std::path::PathBuf;

use clap::Args;
use nesam_server::access::{self, FleetFile};
use nesam_server::{Config, LinkFiles, ServerError, TlsConfig, is_tls_endpoint, router_config};

use crate::failure::{Failure, OrFail};
use crate::output::{note, say};

/// Options of `nesam router-config`. Paths of certificates are written as they are given: the router reads them. Where they can be read here too, they are checked.
#[derive(Args, Debug)]
#[command(
    after_help = "Example:\n  nesam router-config --members fleet.toml --certificate router.pem --key router.key --authority fleet-ca.pem > router.json5\n  \
                        zenohd --config router.json5\n\nWho connects is who the common name (CN) of its certificate says: nesam:vehicle:<id>, nesam:planner:<name>,\n\
                        nesam:operator:<name> or nesam:server:<name>. Write it again and restart the router when the fleet file changes."
)]
pub struct RouterConfigArgs {
    /// Fleet file, as `tls.fleet` of `nesam serve`; deploy/config/fleet.toml explains it
    #[arg(long, value_name = "FILE.toml")]
    members: PathBuf,
    /// Fleet in the keys nesam/v1/<fleet>/<vehicle>/...
    #[arg(long, value_name = "NAME", default_value = "default")]
    fleet: String,
    /// Configuration of the servers, which says which topics of ROS 2 the vehicles use and how large messages may be; without it, none and 64 MiB
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Endpoints to listen on
    #[arg(long, value_name = "ENDPOINT,…", value_delimiter = ',', default_value = "tls/0.0.0.0:7447")]
    listen: Vec<String>,
    /// Certificate of the router with its chain; vehicles and servers look for the name of its host in it
    #[arg(long, value_name = "FILE.pem")]
    certificate: PathBuf,
    /// Its private key
    #[arg(long, value_name = "FILE.key")]
    key: PathBuf,
    /// Authority of everybody's certificates
    #[arg(long, value_name = "FILE.pem")]
    authority: PathBuf,
}

/// Runs the command.
pub fn run(args: &RouterConfigArgs) -> Result<(), Failure> {
    let named = |reason: &dyn std::fmt::Display| Failure::input(format!("{}: {reason}", args.members.display()));
    let text = std::fs::read_to_string(&args.members).map_err(|error| named(&error))?;
    let members = FleetFile::parse(&text).map_err(|reason| named(&reason))?;
    members.doubts().iter().for_each(|doubt| note!("{}: {doubt}", args.members.display()));
    nesam_engine::check_name("fleet", &args.fleet).or_input()?;
    if let Some(open) = args.listen.iter().find(|endpoint| !is_tls_endpoint(endpoint)) {
        return Err(Failure::input(format!("--listen {open}: only tls/... shows who connects")));
    }
    doubts_of_files(args, &members)?.iter().for_each(|doubt| note!("{doubt}"));
    let files = LinkFiles { certificate: &args.certificate, key: &args.key, authority: &args.authority };
    let servers = args.config.as_deref().map(Config::load).transpose().or_input()?.unwrap_or_default();
    let config = router_config(&members, &args.fleet, &servers, &args.listen, files);
    say!("{}", serde_json::to_string_pretty(&config).or_failed()?);
    Ok(())
}

/// Checks certificate, key and authority as `nesam serve` checks its own, where all can be read here. Gives what may be a mistake.
///
/// # Errors
/// Wrong input: the option whose file the router cannot use, and why.
fn doubts_of_files(args: &RouterConfigArgs, members: &FleetFile) -> Result<Vec<String>, Failure> {
    let unreadable = |file: &&PathBuf| File::open(file).err().map(|error| format!("{}: {error}", file.display()));
    if let Some(told) = [&args.certificate, &args.key, &args.authority].iter().find_map(unreadable) {
        return Ok(vec![format!("{told}; certificate, key and authority were not checked, the router has to read them")]);
    }
    let [certificate, key, client_ca, fleet] = [&args.certificate, &args.key, &args.authority, &args.members].map(Clone::clone);
    let tls = TlsConfig { certificate, key, client_ca, fleet, ..TlsConfig::default() };
    let (credentials, _) = access::load(&tls).map_err(|error| match error {
        ServerError::Tls { key, reason } => Failure::Input(of_options(&format!("{key}: {reason}"))),
        other => Failure::Input(other.to_string()),
    })?;
    let of_members = members.doubts();
    let doubts = credentials.map_or_else(Vec::new, |credentials| credentials.doubts());
    Ok(doubts.iter().filter(|doubt| !of_members.contains(doubt)).map(|doubt| of_options(doubt)).collect())
}

/// The options of this command in the place of the configuration keys of a server that stand for the same files.
fn of_options(told: &str) -> String {
    let names = [("tls.certificate", "--certificate"), ("tls.key", "--key"), ("tls.client_ca", "--authority"), ("tls.fleet", "--members")];
    names.iter().fold(told.to_string(), |told, (key, option)| told.replace(key, option))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};

    use super::*;

    /// Writes an authority, and a certificate of it with its key.
    fn write_files(folder: &Path) {
        let (authority_key, key) = (KeyPair::generate().unwrap(), KeyPair::generate().unwrap());
        let mut of_authority = CertificateParams::new(Vec::new()).unwrap();
        of_authority.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let authority = of_authority.self_signed(&authority_key).unwrap();
        let issuer = Issuer::new(of_authority, authority_key);
        let certificate = CertificateParams::new(vec!["localhost".into()]).unwrap().signed_by(&key, &issuer).unwrap();
        for (name, text) in [("ca.pem", authority.pem()), ("router.pem", certificate.pem()), ("router.key", key.serialize_pem())] {
            std::fs::write(folder.join(name), text).unwrap();
        }
        std::fs::write(folder.join("fleet.toml"), "[vehicles.a]\n").unwrap();
    }

    #[test]
    fn property_files_of_the_router_that_can_be_read_are_checked() {
        // Goal: a wrong key is found before the router is started. Method: sound files, one that is not there, and others in their places.
        let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let [own, other] = [0, 1].map(|i| folders[i].path());
        write_files(own);
        write_files(other);
        let members = FleetFile::parse("[vehicles.a]").unwrap();
        let doubts = |certificate: PathBuf, key: PathBuf, authority: PathBuf| {
            let args = RouterConfigArgs {
                members: own.join("fleet.toml"),
                fleet: "default".into(),
                config: None,
                listen: Vec::new(),
                certificate,
                key,
                authority,
            };
            doubts_of_files(&args, &members).map_err(|failure| failure.to_string())
        };
        let (certificate, key, authority) = (own.join("router.pem"), own.join("router.key"), own.join("ca.pem"));
        assert_eq!(doubts(certificate.clone(), key.clone(), authority.clone()), Ok(Vec::new()));
        let elsewhere = doubts(certificate.clone(), own.join("none.key"), authority.clone()).unwrap();
        assert!(elsewhere.len() == 1 && elsewhere[0].contains("none.key") && elsewhere[0].contains("not checked"), "{elsewhere:?}");
        let foreign = doubts(certificate.clone(), key.clone(), other.join("ca.pem")).unwrap();
        assert!(foreign.len() == 1 && foreign[0].contains("--authority") && !foreign[0].contains("tls."), "{foreign:?}");
        for (refused, option) in [
            (doubts(certificate.clone(), other.join("router.key"), authority.clone()), "--key"),
            (doubts(key.clone(), key.clone(), authority.clone()), "--certificate"),
            (doubts(certificate, key.clone(), key), "--authority"),
        ] {
            let told = refused.unwrap_err();
            assert!(told.starts_with(option) && !told.contains("tls."), "{told}");
        }
    }
}
