//! nesam.v1.Measurements.

use nesam_engine::{Command, EngineError};
use nesam_proto::v1 as pb;
use tokio::sync::mpsc;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming};

use super::{Edge, ReplyStream, stopped};
use crate::call::{EngineClient, Pending, measured};
use crate::convert::{measurement, measurement_answer};
use crate::telemetry::Transport;

/// Feeds sessions.
pub struct Service(pub Edge);

/// A measurement on its way: in the engine's queue, or refused before.
type InFlight = (pb::Measurement, Result<Pending, EngineError>);

#[tonic::async_trait]
impl pb::measurements_server::Measurements for Service {
    type StreamStream = ReplyStream<pb::MeasurementAnswer>;

    async fn stream(&self, request: Request<Streaming<pb::Measurement>>) -> Result<Response<Self::StreamStream>, Status> {
        let edge = self.0.clone();
        let (sender, receiver) = mpsc::channel(edge.config.measurements_in_flight_max);
        tokio::spawn(submit_all(edge.clone(), request.into_inner(), sender));
        let engine = edge.engine;
        let answers = ReceiverStream::new(receiver).then(move |item: Result<InFlight, Status>| {
            let engine = engine.clone();
            async move {
                match item {
                    Ok(in_flight) => Ok(answer(&engine, in_flight).await),
                    Err(status) => Err(status),
                }
            }
        });
        Ok(Response::new(Box::pin(answers)))
    }
}

/// Puts measurements into the queue in order of arrival, without waiting for their answers.
async fn submit_all(edge: Edge, mut inbound: Streaming<pb::Measurement>, sender: mpsc::Sender<Result<InFlight, Status>>) {
    let stop = stopped(edge.stopping.clone());
    tokio::pin!(stop);
    loop {
        let item = tokio::select! {
            item = inbound.next() => item,
            () = &mut stop => Some(Err(Status::unavailable(EngineError::Stopped.to_string()))),
        };
        let Some(item) = item else { return };
        let item = item.map(|message| {
            let pending = measurement(&message).map(|measurement| {
                let command = Command::Measure { session: message.session_id.clone(), vehicle: None, measurement };
                edge.engine.submit(command, edge.stream_budget())
            });
            (message, pending)
        });
        let last = item.is_err();
        if sender.send(item).await.is_err() || last {
            return;
        }
    }
}

async fn answer(engine: &EngineClient, (message, pending): InFlight) -> pb::MeasurementAnswer {
    let result = match pending {
        Ok(pending) => measured(pending.await),
        Err(error) => Err(error),
    };
    engine.metrics().measurement(Transport::Grpc, result.as_ref().map_or("rejected", |m| m.outcome.label()));
    measurement_answer(&message, &message.session_id, result)
}
