//! The gRPC services: one file each, handlers that convert, ask the engine and convert back.

mod deadline;
mod measurements;
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

use crate::call::EngineClient;
use crate::config::GrpcConfig;
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
}

impl Edge {
    /// Time that a request may take: what the client allows, at most the configured deadline.
    pub fn budget<T>(&self, request: &tonic::Request<T>) -> Duration {
        deadline::budget(request.metadata(), Duration::from_secs_f64(self.config.deadline_s))
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
