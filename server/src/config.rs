//! The configuration. `deploy/config/default.toml` says the same with comments; a test keeps the two equal.

mod check;
mod cluster;
mod diagnosis;
mod ros2;
mod store;
mod tls;
mod zenoh;

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use figment::Figment;
use figment::providers::{Format, Serialized, Toml};
use nesam_engine::{FleetSoilSettings, Limits};
use serde::{Deserialize, Serialize};

pub use self::cluster::ClusterConfig;
pub use self::diagnosis::DiagnosisConfig;
pub use self::ros2::{Distribution, Ros2Config, Ros2Vehicle};
pub use self::store::StoreConfig;
pub use self::tls::TlsConfig;
pub use self::zenoh::{ZenohConfig, ZenohMode, is_loopback_endpoint, is_tls_endpoint};
use crate::error::ServerError;

/// Everything that can be configured. Unknown keys are refused.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// gRPC.
    pub grpc: GrpcConfig,
    /// TLS of gRPC and who its clients are.
    pub tls: TlsConfig,
    /// Metrics and status page.
    pub http: HttpConfig,
    /// Zenoh.
    pub zenoh: ZenohConfig,
    /// Machines that speak ROS 2 there.
    pub ros2: Ros2Config,
    /// Threads that compute predictions.
    pub workers: WorkersConfig,
    /// What is accepted and held at most.
    pub limits: Limits,
    /// Soil map of the fleet.
    pub fleet_soil: FleetSoilConfig,
    /// Recording.
    pub recording: RecordingConfig,
    /// Durable sessions.
    pub store: StoreConfig,
    /// Servers that share sessions.
    pub cluster: ClusterConfig,
    /// Diagnoses of what was recorded.
    pub diagnosis: DiagnosisConfig,
}

/// gRPC.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GrpcConfig {
    /// Address to listen on; port 0 takes a free one. Beyond loopback anybody who reaches the port can feed sessions.
    pub listen: SocketAddr,
    /// Longest wait of a request, s; a shorter deadline of its own counts, a longer one does not.
    pub deadline_s: f64,
    /// Longest duration of a map upload, s.
    pub upload_deadline_s: f64,
    /// Simultaneous map uploads; each holds a whole map in memory.
    pub uploads_max: usize,
    /// Largest message with map tiles, bytes.
    pub tile_bytes_max: usize,
    /// Connections at a time; more wait in the system until one ends.
    pub connections_max: usize,
    /// Simultaneous requests of one connection; more wait.
    pub streams_per_connection_max: u32,
    /// Measurements of one stream that may wait for their answers; then the stream is read no further.
    pub measurements_in_flight_max: usize,
    /// Interval of keep-alive pings, s; a peer that has gone is noticed after about twice this.
    pub keepalive_s: f64,
    /// Longest wait at shutdown for running requests, and for clients that still read their answers, s.
    pub drain_s: f64,
}

/// Metrics and status page.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HttpConfig {
    /// Whether to serve HTTP at all.
    pub enabled: bool,
    /// Address to listen on; port 0 takes a free one.
    pub listen: SocketAddr,
    /// Address for `/health` alone, which tells nothing of vehicles and so may be open to a proxy or an orchestrator where the rest may not; empty = none.
    pub health: String,
    /// Most live pages open at a time.
    pub watchers_max: usize,
    /// Folder with reports of `nesam diagnose --json` that the live page shows; empty = none.
    pub reports: PathBuf,
}

/// Threads that compute predictions. They belong to the process: `nesam serve` starts them, see [`crate::start_workers`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorkersConfig {
    /// Number of threads; 0 = one for each processor that this process may use.
    pub threads: usize,
    /// Whether each stays on a processor of its own.
    pub pinned: bool,
    /// Whether the network's products in rollouts are rounded to bf16: faster on processors that have instructions for it, refused on others.
    pub bf16: bool,
}

/// Soil map of the fleet; see `nesam_engine::FleetSoilSettings`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FleetSoilConfig {
    /// Whether sessions share what they learn of the ground.
    pub enabled: bool,
    /// Edge of a cell, m.
    pub cell_m: f64,
    /// Time after which evidence counts half, s.
    pub half_life_s: f64,
    /// Distance over which evidence loses the factor e, m.
    pub reach_m: f64,
    /// Distance between colours over which evidence loses the factor e, levels of 255.
    pub colour_reach: f64,
    /// Process noise, as share of the standard deviations of the prior.
    pub process_share: f64,
    /// Cells held at most, own and told by others.
    pub cells_max: usize,
    /// Pause after which a server asks the others of the Zenoh network for all that was brought to them, s; 0 = servers do not share their maps.
    pub exchange_s: f64,
}

/// Recording of everything that the engine does, for `nesam replay`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecordingConfig {
    /// Whether to record.
    pub enabled: bool,
    /// Folder for the files; made if needed.
    pub directory: PathBuf,
    /// Size at which a file is finished and the next one begun, bytes.
    pub part_bytes_max: u64,
    /// Size of all files of a run at which recording ends, bytes.
    pub bytes_max: u64,
    /// Commands and answers that may wait for the disk, bytes; more are dropped.
    pub queue_bytes_max: u64,
}

impl Default for GrpcConfig {
    fn default() -> Self {
        Self {
            listen: loopback(50051),
            deadline_s: 10.0,
            upload_deadline_s: 120.0,
            uploads_max: 2,
            tile_bytes_max: 4 << 20,
            connections_max: 4096,
            streams_per_connection_max: 256,
            measurements_in_flight_max: 256,
            keepalive_s: 20.0,
            drain_s: 5.0,
        }
    }
}

impl Default for HttpConfig {
    fn default() -> Self {
        Self { enabled: true, listen: loopback(50080), health: String::new(), watchers_max: 8, reports: PathBuf::new() }
    }
}

impl Default for FleetSoilConfig {
    fn default() -> Self {
        let s = FleetSoilSettings::default();
        Self {
            enabled: false,
            cell_m: s.cell_m,
            half_life_s: s.half_life_s,
            reach_m: s.reach_m,
            colour_reach: s.colour_reach,
            process_share: s.process_share,
            cells_max: s.cells_max,
            exchange_s: 30.0,
        }
    }
}

impl From<&FleetSoilConfig> for FleetSoilSettings {
    fn from(config: &FleetSoilConfig) -> Self {
        // Whole, so that no setting is forgotten.
        let FleetSoilConfig { enabled: _, exchange_s: _, cell_m, half_life_s, reach_m, colour_reach, process_share, cells_max } = *config;
        Self { cell_m, half_life_s, reach_m, colour_reach, process_share, cells_max }
    }
}

impl Default for RecordingConfig {
    fn default() -> Self {
        Self { enabled: false, directory: "recordings".into(), part_bytes_max: 1 << 30, bytes_max: 16 << 30, queue_bytes_max: 256 << 20 }
    }
}

impl HttpConfig {
    /// Where `/health` is served by itself; `None` = nowhere.
    ///
    /// # Errors
    /// `ServerError::Value` for something that is no address.
    pub fn health_address(&self) -> Result<Option<SocketAddr>, ServerError> {
        let wrong = |error| ServerError::value("http.health", format!("`{}`: {error}; expected for instance 0.0.0.0:50081", self.health));
        Some(&self.health).filter(|text| !text.is_empty()).map(|text| text.parse().map_err(wrong)).transpose()
    }
}

/// What is wrong with a file, each with its key: figment's own words name its profile as if it were a part of the key.
fn in_words(error: figment::Error) -> String {
    let one = |error: figment::Error| match error.path.is_empty() {
        true => error.kind.to_string(),
        false => format!("`{}`: {}", error.path.join("."), error.kind),
    };
    error.into_iter().map(one).collect::<Vec<_>>().join("; ")
}

fn loopback(port: u16) -> SocketAddr {
    (Ipv4Addr::LOCALHOST, port).into()
}

impl Config {
    /// The defaults, overridden by a TOML file.
    ///
    /// # Errors
    /// `ServerError::Config` when the file cannot be read, is not TOML, or has an unknown or mistyped key; `ServerError::Value` as [`Config::check`].
    pub fn load(path: &Path) -> Result<Self, ServerError> {
        let config = Self::read(path)?;
        config.check()?;
        Ok(config)
    }

    /// The same, not checked yet: for whoever overrides some of it and checks the whole.
    ///
    /// # Errors
    /// `ServerError::Config` as [`Config::load`].
    pub fn read(path: &Path) -> Result<Self, ServerError> {
        Figment::from(Serialized::defaults(Self::default()))
            .merge(Toml::file_exact(path))
            .extract()
            .map_err(|error| ServerError::Config { path: path.into(), reason: in_words(error) })
    }

    /// A configuration for tests and the demo: loopback, free ports, no Zenoh.
    pub fn ephemeral() -> Self {
        let mut config = Self::default();
        config.grpc.listen = loopback(0);
        config.http.listen = loopback(0);
        config.zenoh.enabled = false;
        config
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn repository() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().into()
    }

    #[test]
    fn regress_default_file_says_the_defaults() {
        let path = repository().join("deploy/config/default.toml");
        assert_eq!(Config::load(&path).unwrap(), Config::default());
        // Every key stands in the file, so that it documents all of them.
        let text = std::fs::read_to_string(&path).unwrap();
        let from_file: figment::value::Dict = Figment::from(Toml::string(&text)).extract().unwrap();
        let from_code: figment::value::Dict = Figment::from(Serialized::defaults(Config::default())).extract().unwrap();
        for (section, values) in &from_code {
            let file = from_file.get(section).and_then(|v| v.as_dict()).unwrap();
            for key in values.as_dict().unwrap().keys() {
                assert!(file.contains_key(key), "{section}.{key} is not in default.toml");
            }
        }
    }

    #[test]
    fn regress_wrong_files_are_refused_with_the_key() {
        let dir = std::env::temp_dir().join(format!("nesam-config-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        for (text, part) in [
            ("[grpc]\nlisten = 3\n", "default.toml: `grpc.listen`: invalid type"),
            ("[grpc]\nlisten = \"here\"\n", "default.toml: `grpc.listen`: "),
            ("[grpc]\nport = 3\n", "port"),
            ("[grpc]\nconnections_max = 9223372036854775807\n", "grpc.connections_max"),
            ("[grpc]\nmeasurements_in_flight_max = 1000001\n", "grpc.measurements_in_flight_max"),
            ("[grpc]\nuploads_max = 1000001\n", "`grpc.uploads_max`: is 1000001, at most 1000000 are allowed"),
            ("[http]\nwatchers_max = 1000001\n", "http.watchers_max"),
            ("[zenoh]\nmode = \"client\"\n", "zenoh.connect"),
            ("[limits]\nsessions_max = 0\n", "limits.sessions_max"),
            ("[limits]\nposition_max_m = nan\n", "limits.position_max_m"),
            ("[limits]\nspeed_max_m_s = -1.0\n", "limits.speed_max_m_s"),
            ("[limits]\nangular_speed_max_rad_s = inf\n", "limits.angular_speed_max_rad_s"),
            ("[limits]\nhorizon_max = 33\n", "`limits.horizon_max`: is 33, the model predicts 32 steps at most"),
            ("[http]\nreports = \"/dev/null\"\n", "`http.reports`: /dev/null is not a folder"),
            ("[zenoh]\nfleet = \"a/b\"\n", "configuration key `zenoh.fleet`: must be"),
            ("[zenoh]\nname = \"a/b\"\n", "zenoh.name"),
            ("[limits]\nreorder_window_s = 1.5\n", "limits.reorder_window_s"),
            ("[fleet_soil]\nreach_m = -1.0\n", "reach_m"),
            ("[fleet_soil]\nexchange_s = -1.0\n", "fleet_soil.exchange_s"),
            ("[zenoh]\nmode = \"king\"\n", "king"),
            ("[workers]\nthreads = 5000\n", "workers.threads"),
            ("[grpc]\ndeadline_s = -1.0\n", "grpc.deadline_s"),
            ("[store]\ninterval_s = 0.0\n", "store.interval_s"),
            ("[tls]\ncertificate = \"c\"\n", "tls.key"),
            ("[tls]\ncertificate = \"c\"\nkey = \"k\"\nclient_ca = \"a\"\n", "tls.fleet"),
            ("[tls]\ncertificate = \"c\"\nkey = \"k\"\nfleet = \"f\"\n", "tls.client_ca"),
            ("[tls]\ncertificate = \"c\"\nkey = \"k\"\nclient_ca = \"a\"\nfleet = \"f\"\n[http]\nlisten = \"0.0.0.0:1\"\n", "http.listen"),
            (
                "[tls]\ncertificate = \"c\"\nkey = \"k\"\nclient_ca = \"a\"\nfleet = \"f\"\n[zenoh]\nlisten = [\"tcp/0.0.0.0:7447\"]\n",
                "zenoh.listen",
            ),
            ("[http]\nhealth = \"everywhere\"\n", "http.health"),
            ("[http]\nlisten = \"127.0.0.1:50051\"\n", "`grpc.listen` has already"),
            ("[http]\nhealth = \"0.0.0.0:50080\"\n", "`http.listen` has already"),
            ("[zenoh]\nlisten = [\"tcp/[::]:50051\"]\n", "`grpc.listen` has already"),
            ("[zenoh]\nlisten = [\"garbage\"]\n", "zenoh.listen"),
            ("[zenoh]\nlisten = [\"tcp/0.0.0.0\"]\n", "zenoh.listen"),
            ("[zenoh]\nconnect = [\"ftp/router:7447\"]\n", "zenoh.connect"),
            ("[diagnosis]\nlimit_s = 0.0\n", "diagnosis.limit_s"),
            ("[diagnosis]\nthreads = 0\n", "diagnosis.threads"),
            ("[diagnosis]\nat_once = 5000\n", "diagnosis.at_once"),
            ("[diagnosis]\nkept_max = 0\n", "diagnosis.kept_max"),
            ("[cluster]\netcd = [\"etcd:2379\"]\n", "cluster.etcd"),
            ("[cluster]\netcd = [\"https://e:2379\"]\n", "cluster.authority"),
            ("[cluster]\netcd = [\"http://e:2379\"]\nlease_s = 0\n", "cluster.lease_s"),
            ("[cluster]\netcd = [\"http://e:2379\"]\nkey = \"k\"\n", "cluster.key"),
            ("[cluster]\netcd = [\"http://e:2379\"]\nprefix = \"a/\"\n", "cluster.prefix"),
            ("[cluster]\netcd = [\"http://e:2379\"]\n[store]\nenabled = true\n", "store.enabled"),
            ("not toml", "default.toml"),
        ] {
            let path = dir.join("default.toml");
            std::fs::write(&path, text).unwrap();
            let message = Config::load(&path).unwrap_err().to_string();
            assert!(message.contains(part), "{text:?}: {message}");
        }
        assert!(Config::load(&dir.join("absent.toml")).unwrap_err().to_string().contains("absent.toml"));
        std::fs::remove_dir_all(&dir).unwrap();
    }
}
