//! The gRPC services: one file each, handlers that convert, ask the engine and convert back.

mod deadline;
mod measurements;
mod news;
mod prediction;
mod sessions;
mod soil;
mod terrain;

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use nesam_engine::Event;
use nesam_model::Predictor;
use nesam_proto::v1 as pb;
use tokio::sync::{Semaphore, broadcast, watch};
use tokio_stream::Stream;
use tonic::Status;
use tonic::service::Routes;

use crate::access::{Access, Wish};
use crate::call::EngineClient;
use crate::config::GrpcConfig;
use crate::store::{Keeper, Key};
use crate::zenoh::Presence;

pub(crate) use prediction::predict;

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
    /// The store's side; `None` without a store.
    pub keeper: Option<Arc<Keeper>>,
    /// Who may do what.
    pub access: Access,
}

impl Edge {
    /// Time that a request may take: what the client allows, at most the configured deadline.
    pub fn budget<T>(&self, request: &tonic::Request<T>) -> Duration {
        deadline::budget(request.metadata(), Duration::from_secs_f64(self.config.deadline_s))
    }

    /// Refuses a request whose sender has no right to it; gives the vehicle of the session that it is about.
    ///
    /// # Errors
    /// UNAUTHENTICATED, PERMISSION_DENIED or NOT_FOUND.
    pub fn allow<T>(&self, request: &tonic::Request<T>, wish: Wish<'_>) -> Result<Option<Arc<str>>, Status> {
        self.access.caller(request).and_then(|caller| caller.may(wish))
    }

    /// Accepted measurements of a session that are on stable storage; 0 without a store.
    pub fn durable_place(&self, session: &str) -> u64 {
        self.keeper.as_ref().map_or(0, |keeper| keeper.durable(session))
    }

    /// Resolves when the change that was just made is on stable storage, at once without a store.
    ///
    /// # Errors
    /// UNAVAILABLE when the store did not take it within `budget`; the change is made nevertheless.
    pub async fn settled(&self, key: Key, budget: Duration) -> Result<(), Status> {
        let Some(keeper) = &self.keeper else { return Ok(()) };
        if keeper.settled(&key, budget).await {
            return Ok(());
        }
        Err(Status::unavailable("done, but the store did not take it in time: it is not durable yet; look again before asking again"))
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
    let controls = 8 * edge.engine.handle().limits().sample_steps_max + SMALL_MESSAGE;
    let tiles = edge.config.tile_bytes_max;
    Routes::new(pb::sessions_server::SessionsServer::new(sessions::Service(edge.clone())).max_decoding_message_size(IMAGE_BYTES_MAX))
        .add_service(pb::prediction_server::PredictionServer::new(prediction::Service(edge.clone())).max_decoding_message_size(controls))
        .add_service(
            pb::measurements_server::MeasurementsServer::new(measurements::Service(edge.clone())).max_decoding_message_size(SMALL_MESSAGE),
        )
        .add_service(pb::terrain_server::TerrainServer::new(terrain::Service(edge.clone())).max_decoding_message_size(tiles))
        .add_service(pb::soil_server::SoilServer::new(soil::Service(edge.clone())).max_decoding_message_size(SMALL_MESSAGE))
}
