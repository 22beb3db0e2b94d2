//! Starting and stopping everything together.

use std::net::SocketAddr;
use std::path::Path;
use std::pin::Pin;
use std::sync::Arc;
use std::task::Poll;
use std::time::Duration;

use nesam_engine::{Clock as _, Engine, EngineHandle, Event, EventSink, Tap};
use nesam_model::{ModelBundle, Predictor};
use nesam_proto::v1 as pb;
use tokio::net::{TcpListener, TcpSocket};
use tokio::sync::{broadcast, watch};
use tokio::task::JoinHandle;
use tonic::transport::server::Router;
use tonic_health::server::HealthReporter;

use crate::access::{self, Credentials, Directory};
use crate::call::EngineClient;
use crate::clock::{MonotonicClock, unix_ns};
use crate::cluster::{Cluster, ClusterFiles, Etcd};
use crate::config::{Config, GrpcConfig};
use crate::connection::Closing;
use crate::convert::SoilTeller;
use crate::diagnosis::Diagnoses;
use crate::error::ServerError;
use crate::expiry::expire_sessions;
use crate::grpc::{self, Edge, UntilStopped, stopped};
use crate::health::Health;
use crate::http::{self, HttpState};
use crate::http_connections::{self, HttpLimits};
use crate::listener::Entrance;
use crate::recording::{Recorder, RecordingHeader};
use crate::store::{Change, EtcdStore, Keeper, RedbStore, Restored, SessionStore as _, StoreError, restore, tell_stalls};
use crate::telemetry::Metrics;
use crate::web::{Feed, Live, Raised};
use crate::zenoh::{BusConfig, Presence, RenewedBus};

/// Events that a slow watcher may lag behind before it has to read anew.
pub(crate) const EVENTS_KEPT: usize = 1024;

/// Connections of HTTP at a time, beside those of live pages (chosen: an orchestrator and a few proxies ask one at a time each). More would take the file
/// descriptors of gRPC.
const ASKERS_MAX: usize = 64;
/// Connections that wait to be accepted; what is beyond waits a second and more before it tries again. A whole fleet comes at once after a restart.
const ARRIVALS: u32 = 1024;
/// Connections that a browser opens to one server.
const BROWSER_CONNECTIONS: usize = 6;
/// Longest wait at shutdown for the store, and for the recording: a disk that hangs must not keep the process (chosen: both after the usual `grpc.drain_s` within
/// the 30 s that `deploy` gives a server to stop).
const DISK_ENDS_WITHIN: Duration = Duration::from_secs(10);

/// What is served at one address, by its key.
type Listener = (&'static str, JoinHandle<()>);

/// A server that listens. Dropping it leaves its tasks running; end it with [`RunningServer::shutdown`].
pub struct RunningServer {
    /// Address of gRPC, with the port that was taken.
    pub grpc_addr: SocketAddr,
    /// Address of HTTP, if it is enabled.
    pub http_addr: Option<SocketAddr>,
    /// Address of `/health` alone, if there is one.
    pub health_addr: Option<SocketAddr>,
    handle: EngineHandle,
    metrics: Arc<Metrics>,
    health: Health,
    stop: watch::Sender<bool>,
    listeners: Vec<Listener>,
    bus: Option<RenewedBus>,
    recorder: Option<Arc<Recorder>>,
    keeper: Option<Arc<Keeper>>,
    cluster: Option<Cluster>,
    live: Live,
    drain: Duration,
}

impl core::fmt::Debug for RunningServer {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("RunningServer").field("grpc_addr", &self.grpc_addr).field("http_addr", &self.http_addr).finish_non_exhaustive()
    }
}

/// Starts the engine, gRPC, HTTP and Zenoh. Returns when all of them listen.
///
/// # Errors
/// `ServerError` naming the address or the configuration key at fault; nothing keeps running then.
pub async fn serve(config: Config, predictor: Arc<Predictor>) -> Result<RunningServer, ServerError> {
    config.check()?;
    let (tls, access) = access::load(&config.tls)?;
    let tls = tls.map(|tls| tls.on_zenoh(config.zenoh.uses_tls()));
    // Everything that can fail for want of an address comes before the first thread.
    let sockets = Sockets::bind(&config)?;
    let grpc_addr = local(&sockets.grpc, config.grpc.listen);
    let http_addr = sockets.http.as_ref().map(|listener| local(listener, config.http.listen));
    let health_addr = sockets.health.as_ref().and_then(|listener| listener.local_addr().ok());

    let (events, _) = broadcast::channel::<Event>(EVENTS_KEPT);
    let metrics = Arc::new(Metrics::default());
    // This life of the server, which those who hear from it tell from others.
    let run = unix_ns().unsigned_abs();
    let keeper = (config.store.enabled || config.cluster.enabled()).then(|| Arc::new(keeper_of(&config, &predictor, run)));
    let (live, passed) = Live::new(&config);
    let sink = event_sink(events.clone(), metrics.clone(), keeper.clone(), access.directory.clone(), live.feed.clone());
    let engine = engine_of(&config, &predictor, sink)?;
    let clock = MonotonicClock::default();
    let (recorder, tap) = start_recording(&config, &predictor, clock)?;
    let handle = EngineHandle::spawn_tapped(engine, Arc::new(clock), tap);
    let engine =
        EngineClient::new(handle.clone(), metrics.clone(), access.directory.clone()).shown_on(http_addr.map(|_| live.feed.clone()));
    let reload_every = Duration::from_secs_f64(config.tls.reload_s);
    let store_interval = Duration::from_secs_f64(config.store.interval_s);
    let (cluster, cluster_files) = match &keeper {
        Some(keeper) => match open_store(&config, (grpc_addr, predictor.bundle()), keeper, &engine).await {
            Ok(opened) => opened,
            Err(error) => {
                handle.stop();
                return Err(error);
            }
        },
        None => (None, None),
    };
    let (stop, stopping) = watch::channel(false);
    let drain = Duration::from_secs_f64(config.grpc.drain_s);
    let begins_within = Duration::from_secs_f64(config.tls.handshake_s);
    let watchers_max = config.http.watchers_max;
    let diagnoses = Some(Arc::new(Diagnoses::new(&config, recorder.clone(), live.clone())));
    let edge = Edge {
        diagnoses,
        presence: config.zenoh.enabled.then(Presence::default),
        run,
        keeper: keeper.clone(),
        cluster: cluster.clone(),
        ..Edge::alone(engine, predictor, config.grpc, access, events, stopping.clone())
    };
    let bus = match config.zenoh.enabled {
        true => {
            let network = BusConfig { zenoh: config.zenoh, ros2: config.ros2, fleet_soil: config.fleet_soil, tls: config.tls };
            match RenewedBus::start(network, edge.clone(), tls.as_ref().map(Credentials::files)).await {
                Ok(bus) => Some(bus),
                Err(error) => {
                    end_store(keeper, cluster).await;
                    handle.stop();
                    return Err(error);
                }
            }
        }
        false => None,
    };
    if http_addr.is_some() {
        live.start(&edge, clock, recorder.clone(), passed);
    }
    let state = HttpState { edge: edge.clone(), clock, recorder: recorder.clone(), live: live.clone() };
    let mut listeners = spawn_http((sockets.http, sockets.health), state, watchers_max, begins_within, &stopping);
    tokio::spawn(expire_sessions(edge.clone()));
    if let Some(files) = cluster_files {
        tokio::spawn(files.follow(reload_every, metrics.clone(), stopping.clone()));
    }
    if let Some(keeper) = &keeper {
        tokio::spawn(tell_stalls(keeper.clone(), store_interval, live.feed.clone(), stopping.clone()));
    }
    let health = Health::start(cluster.clone()).await;
    let secure = match (edge.access.is_restricted(), &tls) {
        (true, _) => "mutual TLS",
        (false, Some(_)) => "TLS, clients unknown",
        (false, None) => "none",
    };
    let closing = Closing { begins_within, reads_within: drain, stopping };
    listeners.push(("grpc.listen", spawn_grpc(sockets.grpc, tls, &edge, health.reporter(), closing)));
    tracing::info!(%grpc_addr, ?http_addr, zenoh = bus.is_some(), recording = recorder.is_some(), secure, "serving");
    Ok(RunningServer {
        grpc_addr,
        http_addr,
        health_addr,
        handle,
        metrics,
        health,
        stop,
        listeners,
        bus,
        recorder,
        keeper,
        cluster,
        live,
        drain,
    })
}

/// The keeper that the configuration asks for; it keeps the soil map of the fleet where no other server does.
fn keeper_of(config: &Config, predictor: &Predictor, run: u64) -> Keeper {
    let keeper = Keeper::new(Duration::from_secs_f64(config.store.interval_s));
    let of = SoilTeller::new(run, &predictor.bundle().hash);
    if config.fleet_soil.enabled && config.store.enabled { keeper.with_soil(of) } else { keeper }
}

/// The engine that the configuration asks for, whose events go to `sink`.
pub(crate) fn engine_of(config: &Config, predictor: &Arc<Predictor>, sink: EventSink) -> Result<Engine, ServerError> {
    let unusable =
        |error: &dyn std::fmt::Display| ServerError::SoilFilter { bundle: predictor.bundle().name.clone(), reason: error.to_string() };
    let engine = Engine::new(predictor.clone(), config.limits.clone()).map_err(|error| unusable(&error))?;
    let engine = match config.fleet_soil.enabled {
        true => engine.with_fleet_soil((&config.fleet_soil).into()),
        false => Ok(engine),
    };
    Ok(engine.map_err(|error| ServerError::value("fleet_soil", error.to_string()))?.with_events(sink))
}

/// The recording that the configuration asks for, and the tap that feeds it.
fn start_recording(
    config: &Config,
    predictor: &Predictor,
    clock: MonotonicClock,
) -> Result<(Option<Arc<Recorder>>, Option<Tap>), ServerError> {
    if !config.recording.enabled {
        return Ok((None, None));
    }
    let header = RecordingHeader::of_run(predictor, &config.limits, &config.fleet_soil, clock.now_ns());
    let started = Recorder::start(&config.recording, header, predictor.bundle().vehicle.clone());
    let (recorder, tap) = started.map_err(|source| ServerError::Recording { source })?;
    Ok((Some(Arc::new(recorder)), Some(tap)))
}

/// Where the engine's events go: counters, the directory of sessions, the store, the live page, watchers.
pub(crate) fn event_sink(
    watchers: broadcast::Sender<Event>,
    metrics: Arc<Metrics>,
    keeper: Option<Arc<Keeper>>,
    directory: Directory,
    page: Feed,
) -> EventSink {
    Box::new(move |event| {
        metrics.event(&event);
        directory.note(&event);
        if let Some(keeper) = &keeper {
            keeper.note(&event);
        }
        if let Event::AlarmChanged { session, alarm, .. } = &event {
            page.alarm(Raised::by_watch(session, alarm));
        }
        let watched = matches!(
            event,
            Event::SoilChanged { .. } | Event::FleetSoilChanged { .. } | Event::AlarmChanged { .. } | Event::SessionClosed { .. }
        );
        if watched {
            let _ = watchers.send(event);
        }
    })
}

/// Opens the store that the configuration asks for, gives the engine what it holds and starts the keeper. Where servers share sessions, gives this one among them
/// and what reads its certificates again.
async fn open_store(
    config: &Config,
    (grpc_addr, bundle): (SocketAddr, &ModelBundle),
    keeper: &Arc<Keeper>,
    engine: &EngineClient,
) -> Result<(Option<Cluster>, Option<ClusterFiles>), ServerError> {
    if !config.cluster.enabled() {
        let opened = open_folder(&config.store.directory, keeper, engine.handle()).await;
        return opened.map(|()| (None, None)).map_err(|source| ServerError::Store { source });
    }
    let (etcd, files) = Etcd::new(&config.cluster)?;
    let cluster = Cluster::start(etcd, &config.cluster, (grpc_addr.to_string(), bundle), engine.clone(), keeper.clone()).await?;
    let store = EtcdStore::new(cluster.clone(), tokio::runtime::Handle::current());
    if let Err(source) = keeper.start(Box::new(store), engine.handle().clone(), Restored::default()) {
        cluster.stop().await;
        return Err(ServerError::Store { source });
    }
    Ok((Some(cluster), Some(files).filter(|_| config.cluster.uses_tls())))
}

/// Commits what is left, then lets the sessions go: others may have them from now on. Gives how much the store did not take.
async fn end_store(keeper: Option<Arc<Keeper>>, cluster: Option<Cluster>) -> usize {
    let lost = match keeper {
        Some(keeper) => {
            let finishing = keeper.clone();
            // A panic there leaves nobody who could count, nor does a store that takes nothing and says nothing: something was lost.
            ended_within(DISK_ENDS_WITHIN, move || finishing.finish()).await.unwrap_or_else(|| keeper.counts().waiting.max(1))
        }
        None => 0,
    };
    if lost > 0 {
        tracing::error!(lost, "the store did not take the last changes of so many sessions, maps and cells of the soil map");
    }
    if let Some(cluster) = cluster {
        cluster.stop().await;
    }
    lost
}

/// What `work` on a disk gives, on a thread of its own; `None` when it panicked, and when it takes longer than a server may take to stop: it is left behind.
async fn ended_within<T: Send + 'static>(limit: Duration, work: impl FnOnce() -> T + Send + 'static) -> Option<T> {
    let ended = tokio::time::timeout(limit, tokio::task::spawn_blocking(work)).await;
    if ended.is_err() {
        tracing::error!(limit_s = limit.as_secs_f64(), "the disk hangs: it is not waited for any longer");
    }
    ended.ok()?.ok()
}

async fn open_folder(folder: &Path, keeper: &Arc<Keeper>, handle: &EngineHandle) -> Result<(), StoreError> {
    let (folder, keeper, handle) = (folder.to_path_buf(), keeper.clone(), handle.clone());
    let opened = tokio::task::spawn_blocking(move || {
        let mut store = RedbStore::open(&folder)?;
        let restored = restore(&store.load()?, &handle, keeper.soil_of())?;
        if !restored.faded.is_empty() {
            store.commit(&restored.faded.iter().cloned().map(Change::RemoveSoil).collect::<Vec<_>>())?;
        }
        tracing::info!(folder = %folder.display(), sessions = restored.accepted.len(), maps = restored.maps.len(), "store opened");
        keeper.start(Box::new(store), handle, restored)
    });
    opened
        .await
        .unwrap_or_else(|_| Err(StoreError::Content { what: "something".into(), reason: "reading it panicked; this is a bug".into() }))
}

/// The addresses that a server listens at.
struct Sockets {
    grpc: TcpListener,
    http: Option<TcpListener>,
    /// For `/health` alone.
    health: Option<TcpListener>,
}

impl Sockets {
    fn bind(config: &Config) -> Result<Self, ServerError> {
        let grpc = listen(config.grpc.listen, "grpc.listen")?;
        let http = match config.http.enabled {
            true => Some(listen(config.http.listen, "http.listen")?),
            false => None,
        };
        let health = match config.http.health_address()? {
            Some(address) => Some(listen(address, "http.health")?),
            None => None,
        };
        Ok(Self { grpc, http, health })
    }
}

fn listen(address: SocketAddr, key: &'static str) -> Result<TcpListener, ServerError> {
    let listening = || {
        let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
        // A server that starts again does not wait for the connections of the one before.
        socket.set_reuseaddr(true)?;
        socket.bind(address)?;
        socket.listen(ARRIVALS)
    };
    listening().map_err(|source| ServerError::Listen { address, key, source })
}

fn local(listener: &TcpListener, asked: SocketAddr) -> SocketAddr {
    listener.local_addr().unwrap_or(asked)
}

/// Connection settings of gRPC.
fn builder(config: &GrpcConfig) -> tonic::transport::Server {
    let keepalive = Duration::from_secs_f64(config.keepalive_s);
    tonic::transport::Server::builder()
        .max_concurrent_streams(config.streams_per_connection_max)
        .initial_stream_window_size(nesam_proto::STREAM_WINDOW_BYTES)
        .initial_connection_window_size(nesam_proto::CONNECTION_WINDOW_BYTES)
        .max_frame_size(nesam_proto::FRAME_BYTES_MAX)
        .http2_keepalive_interval(Some(keepalive))
        .http2_keepalive_timeout(Some(keepalive))
        .http2_max_pending_accept_reset_streams(Some(64))
}

/// All services, health and reflection (v1 and v1alpha).
pub(crate) fn router(edge: &Edge, health: &HealthReporter) -> Router {
    let health =
        tonic_health::pb::health_server::HealthServer::new(tonic_health::server::HealthService::from_health_reporter(health.clone()));
    let described = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(pb::FILE_DESCRIPTOR_SET)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let reflection = described().build_v1().expect("the committed descriptor set decodes; this is a bug");
    // For clients that know no other, as that of Python does.
    let reflection_v1alpha = described().build_v1alpha().expect("the committed descriptor set decodes; this is a bug");
    let stopping = || edge.stopping.clone();
    let routes = grpc::routes(edge)
        .add_service(UntilStopped { service: health, stopping: stopping() })
        .add_service(UntilStopped { service: reflection, stopping: stopping() })
        .add_service(UntilStopped { service: reflection_v1alpha, stopping: stopping() });
    builder(&edge.config).add_routes(routes)
}

/// Serves HTTP, and `/health` alone, where they are listened for.
fn spawn_http(
    (http, health): (Option<TcpListener>, Option<TcpListener>),
    state: HttpState,
    watchers_max: usize,
    asks_within: Duration,
    stopping: &watch::Receiver<bool>,
) -> Vec<Listener> {
    let serve = |listener, router, connections_max| {
        let limits = HttpLimits { asks_within, connections_max };
        tokio::spawn(http_connections::serve(listener, router, limits, stopping.clone()))
    };
    // Prometheus, scripts and the pages, each with what a browser opens to one server.
    let connections_max = ASKERS_MAX.saturating_add(watchers_max.saturating_mul(BROWSER_CONNECTIONS));
    let health = health.map(|listener| ("http.health", serve(listener, http::health_router(state.edge.clone()), ASKERS_MAX)));
    let http = http.map(|listener| ("http.listen", serve(listener, http::router(state), connections_max)));
    http.into_iter().chain(health).collect()
}

fn spawn_grpc(
    listener: TcpListener,
    credentials: Option<Credentials>,
    edge: &Edge,
    health: &HealthReporter,
    closing: Closing,
) -> JoinHandle<()> {
    let (router, stopping) = (router(edge, health), closing.stopping.clone());
    let entrance = Entrance { listener, places: edge.config.connections_max, closing };
    let Some(credentials) = credentials else {
        return tokio::spawn(ended(router.serve_with_incoming_shutdown(entrance.open(), stopped(stopping))));
    };
    let connections = entrance.with_tls(credentials.tls(), edge.access.refusals.clone());
    tokio::spawn(credentials.follow(edge.engine.metrics().clone(), stopping.clone()));
    tokio::spawn(ended(router.serve_with_incoming_shutdown(connections, stopped(stopping))))
}

pub(crate) async fn ended(serving: impl Future<Output = Result<(), tonic::transport::Error>>) {
    if let Err(error) = serving.await {
        tracing::error!(%error, "grpc ended");
    }
}

impl RunningServer {
    /// The engine's handle, for a demo or test in the same program.
    pub fn engine(&self) -> &EngineHandle {
        &self.handle
    }

    /// Counters of the server.
    pub fn metrics(&self) -> &Metrics {
        &self.metrics
    }

    /// The recording, where there is one.
    pub fn recorder(&self) -> Option<&Recorder> {
        self.recorder.as_deref()
    }

    /// Shows a report of a diagnosis (schema `nesam.diagnose/1`) on the live page; anything else is left out.
    pub fn show_diagnosis(&self, report: serde_json::Value) {
        self.live.reports.add(report);
    }

    /// Stops: health goes to NOT_SERVING, Zenoh leaves, streams end, running requests get `grpc.drain_s`, the engine finishes its measurements, the
    /// recording is written to its end. Sessions of a store are committed before the engine stops. A disk that hangs is not waited for longer than 10 s. Gives how
    /// many sessions, maps and cells of the soil map have changes that the store did not take, which are lost.
    pub async fn shutdown(mut self) -> usize {
        self.health.stop().await;
        if let Some(bus) = self.bus.take() {
            bus.stop().await;
        }
        let _ = self.stop.send(true);
        self.live.stop();
        let ended = async {
            for (_, task) in &mut self.listeners {
                let _ = task.await;
            }
        };
        if tokio::time::timeout(self.drain, ended).await.is_err() {
            tracing::warn!("requests still ran, or answers were still read, after the drain time and were cut off");
            self.listeners.iter().for_each(|(_, task)| task.abort());
        }
        let lost = end_store(self.keeper, self.cluster).await;
        let (handle, recorder) = (self.handle, self.recorder);
        let _ = tokio::task::spawn_blocking(move || handle.stop()).await;
        if let Some(recorder) = recorder {
            let finished = ended_within(DISK_ENDS_WITHIN, move || {
                recorder.join();
                let counts = recorder.counts();
                tracing::info!(commands = counts.recorded, dropped = counts.dropped, bytes = counts.bytes, "recording finished");
            });
            if finished.await.is_none() {
                tracing::error!("the end of the recording is missing");
            }
        }
        tracing::info!("stopped");
        lost
    }

    /// Serves until `signal` resolves, then shuts down; gives what [`RunningServer::shutdown`] does.
    ///
    /// # Panics
    /// When it has shut down because a listener had ended by itself: whoever started the server starts it anew, where a part of it would be missing.
    pub async fn run_until(mut self, signal: impl Future<Output = ()>) -> usize {
        let ended = tokio::select! {
            () = signal => None,
            key = first_ended(&mut self.listeners) => Some(key),
        };
        tracing::info!("stopping");
        let lost = self.shutdown().await;
        assert!(ended.is_none(), "the listener of `{}` ended by itself; this is a bug", ended.unwrap_or_default());
        lost
    }
}

/// Resolves with the key of the first listener that ends, which is none from then on.
async fn first_ended(listeners: &mut Vec<Listener>) -> &'static str {
    std::future::poll_fn(|context| match listeners.iter_mut().position(|(_, task)| Pin::new(task).poll(context).is_ready()) {
        Some(ended) => Poll::Ready(listeners.swap_remove(ended).0),
        None => Poll::Pending,
    })
    .await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn regress_a_listener_that_ends_by_itself_is_noticed() {
        let waits = || tokio::spawn(std::future::pending());
        let mut listeners: Vec<Listener> = vec![("grpc.listen", waits()), ("http.listen", waits())];
        assert!(tokio::time::timeout(Duration::from_millis(50), first_ended(&mut listeners)).await.is_err());
        listeners.push(("http.health", tokio::spawn(async { panic!("as a listener with a bug") })));
        assert_eq!(first_ended(&mut listeners).await, "http.health");
        assert_eq!(listeners.iter().map(|(key, _)| *key).collect::<Vec<_>>(), ["grpc.listen", "http.listen"], "the others go on");
    }

    /// Goal: a disk that hangs keeps no server from stopping. Method: work that ends long after the limit, work in time, and work that panics.
    #[tokio::test]
    async fn regress_a_disk_that_hangs_is_waited_for_no_longer_than_the_limit() {
        let (go_on, waits) = std::sync::mpsc::channel::<()>();
        let hangs = move || waits.recv().is_ok();
        assert_eq!(ended_within(Duration::from_millis(50), hangs).await, None);
        drop(go_on);
        let long = Duration::from_secs(60);
        assert_eq!(ended_within(long, || 3).await, Some(3));
        assert_eq!(ended_within(long, || -> usize { panic!("as a thread with a bug") }).await, None);
    }
}
