//! `nesam serve`: the service until interrupted.

mod checked;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use nesam_model::{ModelBundle, Predictor};
use nesam_server::{Config, RunningServer, ZenohConfig, outlive_file_limit, second_interrupt, serve, start_workers, termination};

pub use self::checked::check_configuration;
use crate::args::BundleArgs;
use crate::bundle_path::bundle_dir;
use crate::environment::{OF_A_SERVER, restart_with};
use crate::failure::{Failure, OrFail};
use crate::logging::log_to_stderr;
use crate::output::say;
use crate::sources::{load_bundle, rounded};

/// Time that tasks get to end once the server has stopped.
const LEFT_BEHIND_AFTER: Duration = Duration::from_millis(200);

/// Options of `nesam serve`. They override the configuration file, which overrides the defaults.
#[derive(Args, Debug)]
#[command(
    after_help = "Environment:\n  RUST_LOG  What is logged on standard error: a level (error, warn, info, debug), or one for each\n            \
                        part of the program, as in info,zenoh=warn (the default) or warn,nesam_server=debug. The target nesam::audit is who was refused what."
)]
pub struct ServeArgs {
    #[command(flatten)]
    bundle: BundleArgs,
    /// Configuration file; deploy/config/default.toml documents every key
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Address of gRPC; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT")]
    grpc: Option<SocketAddr>,
    /// Address of the live page, metrics and status, which are then on whatever the file says; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT", conflicts_with = "no_http")]
    http: Option<SocketAddr>,
    /// Serve no live page, metrics and status
    #[arg(long)]
    no_http: bool,
    /// Zenoh endpoints to listen on, for instance tcp/0.0.0.0:7447; Zenoh is then on whatever the file says
    #[arg(long, value_name = "ENDPOINT,…", value_delimiter = ',', conflicts_with = "no_zenoh")]
    zenoh_listen: Option<Vec<String>>,
    /// Zenoh endpoints to connect to, for instance tcp/router:7447; Zenoh is then on whatever the file says
    #[arg(long, value_name = "ENDPOINT,…", value_delimiter = ',', conflicts_with = "no_zenoh")]
    zenoh_connect: Option<Vec<String>>,
    /// Take no part in a Zenoh network
    #[arg(long)]
    no_zenoh: bool,
    /// Fleet in the Zenoh keys nesam/v1/<fleet>/<vehicle>/...
    #[arg(long, value_name = "NAME")]
    fleet: Option<String>,
    /// Show the JSON reports of `nesam diagnose` in this folder on the live page
    #[arg(long, value_name = "DIR", conflicts_with = "no_http")]
    reports: Option<PathBuf>,
    /// Write all that the engine does into MCAP files in this folder, maps and answers included: repeat it with `nesam replay`, look at it with any
    /// MCAP viewer. Writing never delays an answer; what the disk cannot follow is dropped and counted
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Keep sessions and maps in this folder, so that a restarted server goes on with them. Opening, copying and closing a session or a map answers when
    /// the disk has it; each measurement is acknowledged as RECEIVED at once, and as DURABLE when it was committed and synced: when a buffer of the soil
    /// filter ends, at the latest after `store.interval_s`. Without it nothing outlives the process
    #[arg(long, value_name = "DIR", conflicts_with = "etcd")]
    store: Option<PathBuf>,
    /// Share sessions with other servers through these members of etcd, for instance http://etcd:2379: each session has one owner at a time, moves to the
    /// server that is asked for it, and outlives every one of them
    #[arg(long, value_name = "URL,…", value_delimiter = ',')]
    etcd: Option<Vec<String>>,
    /// Name of this server among those that share sessions; else its host and port
    #[arg(long, value_name = "NAME")]
    server_name: Option<String>,
    /// Round the network's products in rollouts to bf16, for processors with AMX or AVX-512 BF16; sums, physics and the soil filter stay in f32
    #[arg(long)]
    bf16: bool,
    /// Check configuration, certificates, fleet file, folders, addresses and bundle, say what is wrong and to whom the service would be open, and serve
    /// nothing
    #[arg(long)]
    check: bool,
}

/// Runs the command.
pub fn run(args: &ServeArgs) -> Result<(), Failure> {
    restart_with(&OF_A_SERVER)?;
    let mut config = configuration(args)?;
    log_to_stderr("info");
    let served = bundle_dir(args.bundle.bundle.as_deref())?;
    let bundle = load_bundle(Some(&served))?;
    if config.diagnosis.bundle.as_os_str().is_empty() {
        config.diagnosis.bundle = std::path::absolute(&served).or_failed()?;
    }
    if args.check {
        return checked::checked(&config, bundle);
    }
    start_workers(&config.workers).or_failed()?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().or_failed()?;
    let ended = runtime.block_on(serve_until_stopped(config, bundle));
    // A start that was broken off, or what a second ctrl-c did not wait for, is left behind.
    runtime.shutdown_timeout(LEFT_BEHIND_AFTER);
    ended
}

/// Serves until a signal comes. A second ctrl-c ends it without waiting for anything.
async fn serve_until_stopped(config: Config, bundle: ModelBundle) -> Result<(), Failure> {
    outlive_file_limit().or_failed()?;
    // The signals are caught before anything is started, so that a server can be stopped at once.
    let mut signal = tokio::spawn(termination());
    let again = tokio::spawn(second_interrupt());
    let (zenoh, kept, soil) = (config.zenoh.clone(), kept(&config), fleet_soil(&config));
    let (server, bundle) = tokio::select! {
        started = start(config, bundle) => started?,
        _ = &mut signal => {
            say!("stopped before it had started");
            return Ok(());
        }
    };
    announce(&server, &bundle, &zenoh);
    say!("store {kept}");
    soil.iter().for_each(|soil| say!("soil  {soil}"));
    say!("ready; ctrl-c stops");
    let stop = async {
        let _ = signal.await;
    };
    let lost = tokio::select! {
        lost = server.run_until(stop) => lost,
        _ = again => {
            let cost = "running requests were cut off, and what was not durable is lost";
            return Err(Failure::Failed(format!("ended at once by a second ctrl-c: {cost}")));
        }
    };
    if lost > 0 {
        return Err(Failure::Failed(format!(
            "the store did not take the last changes of {lost} sessions, maps and cells of the soil map: they are lost"
        )));
    }
    say!("stopped");
    Ok(())
}

/// Starts a server on a bundle.
pub async fn start(config: Config, bundle: ModelBundle) -> Result<(RunningServer, Arc<ModelBundle>), Failure> {
    let bundle = Arc::new(bundle);
    let predictor = rounded(Arc::new(Predictor::new(Arc::clone(&bundle)).or_input()?), config.workers.bf16, "workers.bf16")?;
    // A port that is taken or a value out of range is for the caller to change.
    Ok((serve(config, predictor).await.or_input()?, bundle))
}

/// The configuration that file and options ask for, checked.
fn configuration(args: &ServeArgs) -> Result<Config, Failure> {
    let mut config = match &args.config {
        Some(file) => Config::read(file).or_input()?,
        None => Config::default(),
    };
    override_network(args, &mut config)?;
    if let Some(folder) = &args.record {
        config.recording.enabled = true;
        config.recording.directory.clone_from(folder);
    }
    if let Some(folder) = &args.store {
        config.store.enabled = true;
        config.store.directory.clone_from(folder);
    }
    config.workers.bf16 |= args.bf16;
    if let Some(members) = &args.etcd {
        config.cluster.etcd.clone_from(members);
    }
    if let Some(name) = &args.server_name {
        config.cluster.name.clone_from(name);
    }
    config.check().map_err(|error| match &args.config {
        Some(file) => Failure::input(format!("{}, with the options of the command: {error}", file.display())),
        None => Failure::input(error.to_string()),
    })?;
    Ok(config)
}

/// Puts the options of gRPC, HTTP and Zenoh in the place of what the file says. An address switches on what it is for.
///
/// # Errors
/// Wrong usage: reports for a page that is off.
fn override_network(args: &ServeArgs, config: &mut Config) -> Result<(), Failure> {
    config.grpc.listen = args.grpc.unwrap_or(config.grpc.listen);
    config.http.listen = args.http.unwrap_or(config.http.listen);
    config.http.enabled = (config.http.enabled || args.http.is_some()) && !args.no_http;
    let endpoints = args.zenoh_listen.is_some() || args.zenoh_connect.is_some();
    config.zenoh.enabled = (config.zenoh.enabled || endpoints) && !args.no_zenoh;
    for (given, kept) in [(&args.zenoh_listen, &mut config.zenoh.listen), (&args.zenoh_connect, &mut config.zenoh.connect)] {
        if let Some(endpoints) = given {
            kept.clone_from(endpoints);
        }
    }
    if let Some(fleet) = &args.fleet {
        config.zenoh.fleet.clone_from(fleet);
    }
    if let Some(folder) = &args.reports {
        if !config.http.enabled {
            let way = "the file has `http.enabled = false`; switch the page on with --http ADDRESS:PORT";
            return Err(Failure::input(format!("--reports {}: the live page is off, as {way}", folder.display())));
        }
        config.http.reports.clone_from(folder);
    }
    Ok(())
}

/// Where sessions are kept.
fn kept(config: &Config) -> String {
    let within = format!("measurements are durable within {} s", config.store.interval_s);
    match (config.cluster.enabled(), config.store.enabled) {
        (true, _) => format!("etcd {} below {}, shared; {within}", config.cluster.etcd.join(","), config.cluster.prefix),
        (false, true) => format!("{}; {within}", config.store.directory.display()),
        (false, false) => "none; sessions end with this process".into(),
    }
}

/// Who has the soil map of the fleet, and for how long; `None` without one.
fn fleet_soil(config: &Config) -> Option<String> {
    let told = match (config.zenoh.enabled, config.fleet_soil.exchange_s > 0.0) {
        (true, true) => format!("told to the other servers of fleet `{}`", config.zenoh.fleet),
        (true, false) => "of this server alone, as `fleet_soil.exchange_s` is 0".into(),
        (false, _) => "of this server alone, as `zenoh` is off".into(),
    };
    let kept = if config.store.enabled { "kept in the store" } else { "not kept by this process" };
    config.fleet_soil.enabled.then(|| format!("map of the fleet, {told}; {kept}"))
}

/// Says on standard output where the service listens; scripts read these lines.
fn announce(server: &RunningServer, bundle: &ModelBundle, zenoh: &ZenohConfig) {
    say!("nesam {} with bundle {} {}", env!("CARGO_PKG_VERSION"), bundle.name, bundle.hash);
    say!("grpc  {}", server.grpc_addr);
    if let Some(http) = server.http_addr {
        say!("http  http://{http}/");
    }
    if let Some(health) = server.health_addr {
        say!("health http://{health}/health");
    }
    if zenoh.enabled {
        say!("zenoh {} keys nesam/v1/{}/<vehicle>/...", [&zenoh.listen[..], &zenoh.connect[..]].concat().join(","), zenoh.fleet);
    }
    for part in server.recorder().iter().flat_map(|recorder| recorder.parts()) {
        say!("record {}", part.display());
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        args: ServeArgs,
    }

    #[test]
    fn property_an_address_switches_on_what_the_file_has_off() {
        // Goal: no option is passed over silently. Method: a file in which HTTP and Zenoh are off, with and without options for them.
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("off.toml");
        std::fs::write(&file, "[http]\nenabled = false\n[zenoh]\nenabled = false\n").unwrap();
        let asked = |options: &[&str]| {
            let line = [&["serve", "--config", file.to_str().unwrap()], options].concat();
            configuration(&Line::parse_from(line).args).map(|config| (config.http.enabled, config.zenoh.enabled, config))
        };
        for (options, http, zenoh) in [
            (&["--http", "127.0.0.1:8080"][..], true, false),
            (&[], false, false),
            (&["--zenoh-listen", "tcp/127.0.0.1:7448"], false, true),
            (&["--zenoh-connect", "tcp/router:7447"], false, true),
            (&["--no-http", "--zenoh-connect", "tcp/router:7447"], false, true),
            (&["--no-zenoh", "--http", "127.0.0.1:8080"], true, false),
        ] {
            let (has_http, has_zenoh, _) = asked(options).unwrap();
            assert_eq!((has_http, has_zenoh), (http, zenoh), "{options:?}");
        }
        let (_, _, config) = asked(&["--http", "127.0.0.1:8080", "--zenoh-listen", "tcp/127.0.0.1:7448", "--reports", "reports"]).unwrap();
        assert_eq!((config.http.listen.port(), config.zenoh.listen.join(",")), (8080, "tcp/127.0.0.1:7448".into()));
        assert!(asked(&["--reports", "reports"]).unwrap_err().to_string().contains("--http"));
        let plain = configuration(&Line::parse_from(["serve", "--no-http", "--no-zenoh"]).args).unwrap();
        assert!(!plain.http.enabled && !plain.zenoh.enabled);
    }
}
