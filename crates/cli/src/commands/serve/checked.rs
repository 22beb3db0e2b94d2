//! `nesam serve --check`: what a configuration serves to whom, and what keeps it from starting.

use std::net::TcpListener;
use std::path::Path;
use std::sync::Arc;

use nesam_model::{ModelBundle, Predictor};
use nesam_server::store::RedbStore;
use nesam_server::{Config, DiagnosisConfig, ServerError, access, etcd_endpoint, is_loopback_endpoint, is_tls_endpoint};

use super::super::check::verdict;
use super::{fleet_soil, kept};
use crate::failure::{Failure, OrFail};
use crate::output::say;
use crate::sources::rounded;

/// Says what would be served. Ports are not tried, a store is not opened and etcd is not asked: all may be in use by the server that this configuration is meant for.
pub fn checked(config: &Config, bundle: ModelBundle) -> Result<(), Failure> {
    let doubts = doubts(config)?;
    say!("bundle {} {}", bundle.name, bundle.hash);
    let predictor = rounded(Arc::new(Predictor::new(Arc::new(bundle)).or_input()?), config.workers.bf16, "workers.bf16")?;
    config.ros2.check_for(&predictor.bundle().vehicle).or_input()?;
    say!("path   {}", predictor.path().as_str());
    say!(
        "grpc   {}, {}",
        config.grpc.listen,
        match (!config.tls.certificate.as_os_str().is_empty(), config.tls.restricts()) {
            (false, _) => "no TLS: everybody on the way reads and changes everything",
            (true, false) => "TLS; whoever reaches the port may do everything",
            (true, true) => "mutual TLS; clients have the rights of the fleet file",
        }
    );
    say!("http   {}", http(config));
    zenoh(config).iter().for_each(|endpoint| say!("zenoh  {endpoint}"));
    for machine in config.ros2.vehicles.iter().filter(|_| config.ros2.enabled) {
        say!("ros2   {}: {}, {} ({})", machine.vehicle, machine.odometry_topic(), machine.command_topic(), machine.command_type);
    }
    say!("store  {}", kept(config));
    fleet_soil(config).iter().for_each(|soil| say!("soil   {soil}"));
    doubts.iter().for_each(|doubt| say!("doubt  {doubt}"));
    say!("{}", verdict(0, doubts.len()));
    Ok(())
}

/// Reads a configuration file and the files that it names, and tries its folders and addresses. Gives what may be a mistake.
///
/// # Errors
/// What keeps a server from starting.
pub fn check_configuration(path: &Path) -> Result<Vec<String>, Failure> {
    doubts(&Config::load(path).or_input()?)
}

fn doubts(config: &Config) -> Result<Vec<String>, Failure> {
    let (tls, _) = access::load(&config.tls).or_input()?;
    for (key, address) in config.addresses().or_input()? {
        // Any port tells whether the address is one of this machine.
        let mut any_port = address;
        any_port.set_port(0);
        TcpListener::bind(any_port).map_err(|source| ServerError::Listen { address, key, source }).or_input()?;
    }
    let folders = [
        ("store.directory", config.store.enabled, &config.store.directory),
        ("recording.directory", config.recording.enabled, &config.recording.directory),
    ];
    for (key, _, folder) in folders.into_iter().filter(|(_, used, _)| *used) {
        writable(folder).map_err(|error| Failure::input(format!("`{key}` {}: {error}", folder.display())))?;
    }
    if config.store.enabled {
        RedbStore::look(&config.store.directory).map_err(|source| ServerError::Store { source }).or_input()?;
    }
    for address in &config.cluster.etcd {
        etcd_endpoint(address, &config.cluster).or_input()?;
    }
    let mut doubts = tls.map_or_else(Vec::new, |tls| tls.on_zenoh(config.zenoh.uses_tls()).doubts());
    let reports = &config.http.reports;
    if config.http.enabled && !reports.as_os_str().is_empty() && !reports.exists() {
        doubts.push(format!("`http.reports` {}: does not exist; the page shows its reports once it does", reports.display()));
    }
    // Diagnoses are made of recordings.
    let folder = &config.diagnosis.directory;
    if config.recording.enabled
        && let Err(error) = writable(folder)
    {
        doubts.push(format!("`diagnosis.directory` {}: {error}; no diagnosis can be started", folder.display()));
    }
    doubts.extend(doubts_of_diagnoses(&config.diagnosis));
    Ok(doubts)
}

/// What a diagnosis would miss, where some can be started.
fn doubts_of_diagnoses(config: &DiagnosisConfig) -> Vec<String> {
    let missing = |key: &str, path: &Path| format!("`{key}` {}: does not exist; diagnoses fail", path.display());
    let program = Some(&config.executable).filter(|program| !program.as_os_str().is_empty() && !is_program(program));
    let bundle = Some(&config.bundle).filter(|folder| !folder.as_os_str().is_empty() && !folder.is_dir());
    let doubts =
        [program.map(|program| missing("diagnosis.executable", program)), bundle.map(|folder| missing("diagnosis.bundle", folder))];
    if config.at_once > 0 { doubts.into_iter().flatten().collect() } else { Vec::new() }
}

/// Whether the system finds a program: a name alone is looked for in the folders of `PATH`.
fn is_program(program: &Path) -> bool {
    if program.components().count() > 1 {
        return program.is_file();
    }
    let folders = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&folders).any(|folder| folder.join(program).is_file())
}

/// Tries whether a folder can be made and written to, and leaves nothing.
fn writable(folder: &Path) -> std::io::Result<()> {
    let folder = std::path::absolute(folder)?;
    let there = folder.ancestors().find(|path| path.exists()).unwrap_or(&folder);
    let probe = there.join(format!(".nesam-check-{}", std::process::id()));
    std::fs::create_dir(&probe)?;
    std::fs::remove_dir(&probe)
}

/// Where HTTP is served, and who reads it.
fn http(config: &Config) -> String {
    let who = if config.http.listen.ip().is_loopback() { "whoever has an account on this machine" } else { "everybody on the way" };
    match config.http.enabled {
        true => format!("{}, no TLS: {who} reads positions, maps and soils of all sessions", config.http.listen),
        false => "off".into(),
    }
}

/// The endpoints of Zenoh, and who speaks there.
fn zenoh(config: &Config) -> Vec<String> {
    let (listen, connect) = (&config.zenoh.listen, &config.zenoh.connect);
    if !config.zenoh.enabled || (listen.is_empty() && connect.is_empty()) {
        return vec!["off".into()];
    }
    let rights = if config.tls.restricts() { ", whatever the fleet file says" } else { "" };
    let open = |who: &str| format!("no TLS: {who} feeds sessions and predicts in the name of every vehicle{rights}");
    let of = |endpoint: &String, by_certificate: &str| match (is_tls_endpoint(endpoint), is_loopback_endpoint(endpoint)) {
        (true, _) => format!("{endpoint}, mutual TLS; {by_certificate}"),
        (false, true) => format!("{endpoint}, {}", open("whoever has an account on this machine")),
        (false, false) => format!("{endpoint}, {}", open("everybody on the way")),
    };
    let listens = listen.iter().map(|endpoint| of(endpoint, "members have the keys that the fleet file says"));
    listens.chain(connect.iter().map(|endpoint| of(endpoint, "its router says who has which keys"))).collect()
}
