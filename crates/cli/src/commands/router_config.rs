//! `nesam router-config`: the configuration of a Zenoh router that guards a fleet.

use std::path::PathBuf;

use clap::Args;
use nesam_server::access::FleetFile;
use nesam_server::{Config, LinkFiles, is_tls_endpoint, router_config};

use crate::failure::{Failure, OrFail};
use crate::output::{note, say};

/// Options of `nesam router-config`. Paths of certificates are written as they are given: the router reads them.
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
    let files = LinkFiles { certificate: &args.certificate, key: &args.key, authority: &args.authority };
    let servers = args.config.as_deref().map(Config::load).transpose().or_input()?.unwrap_or_default();
    let config = router_config(&members, &args.fleet, &servers, &args.listen, files);
    say!("{}", serde_json::to_string_pretty(&config).or_failed()?);
    Ok(())
}
