//! The gRPC services: one file each, handlers that convert, ask the engine and convert back.

mod arrives_in_time;
mod deadline;
mod diagnosis;
mod measurements;
mod news;
mod prediction;
mod refusals_timed;
mod sessions;
mod soil;
mod terrain;
mod until_stopped;
mod used;

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use nesam_engine::{EngineError, Event, SessionView, check_name};
use nesam_model::Predictor;
use nesam_proto::v1 as pb;
use tokio::sync::{Semaphore, broadcast, watch};
use tokio_stream::Stream;
use tonic::Status;
use tonic::service::Routes;

use crate::access::{Access, Caller, Wish};
use crate::call::EngineClient;
use crate::clock::unix_ns;
use crate::cluster::{Brought, Cluster, moved};
use crate::config::GrpcConfig;
use crate::convert::{predict_bytes_max, to_status};
use crate::diagnosis::Diagnoses;
use crate::store::{Keeper, Key};
use crate::zenoh::Presence;

use arrives_in_time::arrive_in_time;
pub use deadline::grpc_timeout;
pub(crate) use prediction::predict;
use refusals_timed::time_refusals;
pub(crate) use until_stopped::UntilStopped;

/// A stream of replies.
pub(crate) type ReplyStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Largest message without arrays, bytes.
const SMALL_MESSAGE: usize = 64 << 10;

/// What every service needs.
#[derive(Clone)]
pub(crate) struct Edge {
    pub engine: EngineClient,
    pub predictor: Arc<Predictor>,
    pub config: Arc<GrpcConfig>,
    pub events: broadcast::Sender<Event>,
    pub stopping: watch::Receiver<bool>,
    pub uploads: Arc<Semaphore>,
    /// Vehicles in the Zenoh network; `None` without one.
    pub presence: Option<Presence>,
    /// Tells this run of the server from others.
    pub run: u64,
    /// The store's side; `None` without a store.
    pub keeper: Option<Arc<Keeper>>,
    /// The servers that share sessions; `None` for a server that is alone.
    pub cluster: Option<Cluster>,
    /// Diagnoses of what was recorded; `None` for a server that starts none.
    pub diagnoses: Option<Arc<Diagnoses>>,
    /// For what a thread of the bus begins and does not wait for.
    pub runtime: tokio::runtime::Handle,
    /// Who may do what.
    pub access: Access,
}

impl Edge {
    /// Of a server without store, cluster, bus and diagnoses.
    pub fn alone(
        engine: EngineClient,
        predictor: Arc<Predictor>,
        config: GrpcConfig,
        access: Access,
        events: broadcast::Sender<Event>,
        stopping: watch::Receiver<bool>,
    ) -> Self {
        Self {
            engine,
            predictor,
            uploads: Arc::new(Semaphore::new(config.uploads_max)),
            config: Arc::new(config),
            events,
            stopping,
            presence: None,
            run: unix_ns().unsigned_abs(),
            keeper: None,
            cluster: None,
            diagnoses: None,
            runtime: tokio::runtime::Handle::current(),
            access,
        }
    }

    /// Time that a request may take: what the client allows, at most the configured deadline.
    pub fn budget<T>(&self, request: &tonic::Request<T>) -> Duration {
        deadline::budget(request.metadata(), Duration::from_secs_f64(self.config.deadline_s))
    }

    /// Refuses a request whose sender has no right to it and notes who changes something; gives the vehicle of the session that it is about. A session that another server has comes here.
    ///
    /// # Errors
    /// UNAUTHENTICATED, PERMISSION_DENIED or NOT_FOUND; UNAVAILABLE when the session does not come.
    pub async fn allow<T>(&self, request: &tonic::Request<T>, wish: Wish<'_>) -> Result<Option<Arc<str>>, Status> {
        let caller = self.access.caller(request)?;
        let vehicle = self.allow_caller(&caller, wish, self.budget(request)).await?;
        if !matches!(wish, Wish::ReadSession(_)) {
            caller.changes(wish);
        }
        Ok(vehicle)
    }

    /// The same for one message of a stream.
    ///
    /// # Errors
    /// As [`Edge::allow`].
    pub async fn allow_caller(&self, caller: &Caller, wish: Wish<'_>, budget: Duration) -> Result<Option<Arc<str>>, Status> {
        if let (Some(cluster), Some(session)) = (&self.cluster, wish.session())
            && cluster.bring(session, budget, |vehicle| caller.may_with(wish, vehicle)).await? == Brought::Nowhere
        {
            return Err(to_status(EngineError::UnknownSession { session: session.into() }));
        }
        caller.may(wish)
    }

    /// A refusal of the engine as status. A session that was brought here and that the engine does not have any more has moved.
    pub fn status(&self, error: EngineError) -> Status {
        match (&self.cluster, error) {
            (Some(_), EngineError::UnknownSession { session }) => moved(&session),
            (_, error) => to_status(error),
        }
    }

    /// Brings a map here that another server took, if there is such a map; an empty name is none.
    ///
    /// # Errors
    /// What keeps it from coming; DEADLINE_EXCEEDED.
    pub async fn bring_map(&self, map: &str, budget: Duration) -> Result<(), Status> {
        let Some(cluster) = self.cluster.as_ref().filter(|_| !map.is_empty()) else { return Ok(()) };
        tokio::time::timeout(budget, cluster.bring_map(map))
            .await
            .unwrap_or_else(|_| Err(Status::deadline_exceeded(format!("map `{map}` did not come from etcd in time"))))
    }

    /// Begins a session under a name that no server has yet; `field` asked for it.
    ///
    /// # Errors
    /// What `begin` says; ALREADY_EXISTS where another server has a session of that name; UNAVAILABLE when the name cannot be claimed.
    pub async fn begin(
        &self,
        field: &'static str,
        name: &str,
        budget: Duration,
        begin: impl Future<Output = Result<SessionView, EngineError>>,
    ) -> Result<SessionView, Status> {
        let (Some(cluster), Some(keeper)) = (&self.cluster, &self.keeper) else { return begin.await.map_err(to_status) };
        check_name(field, name).map_err(to_status)?;
        if self.access.directory.vehicle(name).is_none() {
            // One of this name may have been closed a moment ago: the name goes with the commit of that, and so would what begins under it before.
            keeper.settled(&Key::Session(name.into()), budget).await;
        }
        // The client may give up at any of these waits.
        let claim = cluster.claim(name, field, budget).await?;
        match begin.await {
            Ok(view) => {
                claim.begun();
                Ok(view)
            }
            Err(error) => {
                claim.give_back().await;
                Err(self.status(error))
            }
        }
    }

    /// Who counts the measurements of a session, and how many of them are on stable storage; 0 without a store.
    pub fn durable_place(&self, session: &str) -> (u64, u64) {
        let epoch = self.cluster.as_ref().map(|cluster| cluster.epoch(session).unwrap_or(0).unsigned_abs());
        (epoch.unwrap_or(self.run), self.keeper.as_ref().map_or(0, |keeper| keeper.durable(session)))
    }

    /// Refuses a measurement that was meant for another run: what the sender has sent to that one may be missing here.
    ///
    /// # Errors
    /// `EngineError::NotReady` for `run`.
    pub fn check_run(&self, session: &str, meant: u64) -> Result<(), EngineError> {
        if meant == 0 {
            return Ok(());
        }
        let (run, _) = self.durable_place(session);
        if meant == run {
            return Ok(());
        }
        let reason = format!("is {meant}, the session is at {run} now; first send again what was not durable");
        Err(EngineError::NotReady { field: "run".into(), reason })
    }

    /// Resolves when the change that was just made is on stable storage, at once without a store.
    ///
    /// # Errors
    /// UNAVAILABLE when the store did not take it within `budget`; the change is made nevertheless. UNAVAILABLE as well when the session has left for another
    /// server meanwhile: the change may be lost.
    pub async fn settled(&self, key: Key, budget: Duration) -> Result<(), Status> {
        let Some(keeper) = &self.keeper else { return Ok(()) };
        if keeper.settled(&key, budget).await {
            return Ok(());
        }
        match &key {
            Key::Session(session) if keeper.has_left(session) => Err(moved(session)),
            _ => Err(Status::unavailable(
                "done, but the store did not take it in time: it is not durable yet; look again before asking again",
            )),
        }
    }

    /// Time that one message of a stream may take.
    pub fn stream_budget(&self) -> Duration {
        Duration::from_secs_f64(self.config.deadline_s)
    }
}

/// Largest exported session, bytes.
const IMAGE_BYTES_MAX: usize = 256 << 10;

/// Resolves when the server stops.
pub(crate) async fn stopped(mut stopping: watch::Receiver<bool>) {
    let _ = stopping.wait_for(|stop| *stop).await;
}

/// All services behind one router, with their message limits.
pub(crate) fn routes(edge: &Edge) -> Routes {
    let queries = predict_bytes_max(edge.engine.handle().limits());
    let tiles = edge.config.tile_bytes_max;
    let routes =
        Routes::new(pb::sessions_server::SessionsServer::new(sessions::Service(edge.clone())).max_decoding_message_size(IMAGE_BYTES_MAX))
            .add_service(pb::prediction_server::PredictionServer::new(prediction::Service(edge.clone())).max_decoding_message_size(queries))
            .add_service(
                pb::measurements_server::MeasurementsServer::new(measurements::Service(edge.clone()))
                    .max_decoding_message_size(SMALL_MESSAGE),
            )
            .add_service(pb::terrain_server::TerrainServer::new(terrain::Service(edge.clone())).max_decoding_message_size(tiles))
            .add_service(pb::soil_server::SoilServer::new(soil::Service(edge.clone())).max_decoding_message_size(SMALL_MESSAGE))
            .add_service(
                pb::diagnosis_server::DiagnosisServer::new(diagnosis::Service(edge.clone())).max_decoding_message_size(SMALL_MESSAGE),
            );
    time_refusals(arrive_in_time(routes, edge.stream_budget()), edge.engine.metrics().clone())
}
