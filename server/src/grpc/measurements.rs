//! nesam.v1.Measurements.

use nesam_engine::{Command, EngineError};
use nesam_proto::v1 as pb;
use tokio::sync::mpsc;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Request, Response, Status, Streaming};

use super::used::Used;
use super::{Edge, ReplyStream, stopped};
use crate::access::{Caller, Wish};
use crate::call::{Pending, measured, unmeasured};
use crate::cluster::moved;
use crate::convert::{measurement, measurement_answer};
use crate::telemetry::Transport;

/// Feeds sessions.
pub struct Service(pub Edge);

/// A measurement on its way: in the engine's queue, or refused before.
type InFlight = (pb::Measurement, Result<Pending, Refused>);

/// Why a measurement did not reach the engine.
enum Refused {
    /// By what it says; where there is room the session is read in its place, so that the answer tells where it stands.
    Invalid(EngineError, Option<Pending>),
    /// By the rights, or by where the session is.
    Status(Status),
}

#[tonic::async_trait]
impl pb::measurements_server::Measurements for Service {
    type StreamStream = ReplyStream<pb::MeasurementAnswer>;

    async fn stream(&self, request: Request<Streaming<pb::Measurement>>) -> Result<Response<Self::StreamStream>, Status> {
        let edge = self.0.clone();
        edge.engine.metrics().request(Transport::Grpc, "stream_measurements");
        let caller = edge.access.caller(&request)?;
        let (sender, receiver) = mpsc::channel(edge.config.measurements_in_flight_max);
        tokio::spawn(submit_all(edge.clone(), caller, request.into_inner(), sender));
        let answers = ReceiverStream::new(receiver).then(move |item: Result<InFlight, Status>| {
            let edge = edge.clone();
            async move {
                match item {
                    Ok(in_flight) => answer(&edge, in_flight).await,
                    Err(status) => Err(status),
                }
            }
        });
        Ok(Response::new(Box::pin(answers)))
    }
}

/// Puts measurements into the queue in order of arrival, without waiting for their answers.
async fn submit_all(edge: Edge, caller: Caller, mut inbound: Streaming<pb::Measurement>, sender: mpsc::Sender<Result<InFlight, Status>>) {
    let stop = stopped(edge.stopping.clone());
    tokio::pin!(stop);
    let mut used = Used::of(&edge);
    loop {
        let item = tokio::select! {
            item = inbound.next() => item,
            session = used.gone() => Some(Err(moved(&session))),
            () = &mut stop => Some(Err(Status::unavailable(EngineError::Stopped.to_string()))),
        };
        let Some(item) = item else { return };
        let item = match item {
            Ok(message) => match submit(&edge, &caller, &mut used, &message).await {
                // It is to be sent again, to whoever has the session.
                Err(Refused::Status(status)) if status.code() == Code::Unavailable => Err(status),
                pending => Ok((message, pending)),
            },
            Err(status) => Err(status),
        };
        let last = item.is_err();
        if sender.send(item).await.is_err() || last {
            return;
        }
    }
}

/// Puts one measurement into the queue. The engine looks once more whether the session belongs to the vehicle that the sender may feed.
async fn submit(edge: &Edge, caller: &Caller, used: &mut Used, message: &pb::Measurement) -> Result<Pending, Refused> {
    let vehicle = used.enter(edge, caller, Wish::ChangeSession(&message.session_id)).await.map_err(Refused::Status)?;
    let vehicle = vehicle.map(|vehicle| vehicle.to_string());
    let session = message.session_id.clone();
    let checked = measurement(message).and_then(|measurement| edge.check_run(&session, message.run).map(|()| measurement));
    match checked {
        Ok(measurement) => Ok(edge.engine.submit(Command::Measure { session, vehicle, measurement }, edge.stream_budget())),
        Err(error) => {
            let look = || edge.engine.submit(Command::Get { session }, edge.stream_budget());
            Err(Refused::Invalid(error, edge.engine.has_room().then(look)))
        }
    }
}

async fn answer(edge: &Edge, (message, pending): InFlight) -> Result<pb::MeasurementAnswer, Status> {
    let result = match pending {
        Ok(pending) => measured(pending.await),
        Err(Refused::Invalid(error, Some(session))) => Err(unmeasured(error, None, session.await)),
        Err(Refused::Invalid(error, None)) => Err(error),
        Err(Refused::Status(status)) => {
            edge.engine.metrics().measurement(Transport::Grpc, "rejected");
            let rejected = pb::Rejected { code: status.code().into(), field: "session_id".into(), message: status.message().into() };
            let (session_id, sequence, stamp_ns) = (message.session_id, message.sequence, message.stamp_ns);
            let outcome = Some(pb::measurement_answer::Outcome::Rejected(rejected));
            return Ok(pb::MeasurementAnswer { session_id, sequence, stamp_ns, outcome, ..Default::default() });
        }
    };
    if let (Some(_), Err(error @ EngineError::UnknownSession { .. })) = (&edge.cluster, &result) {
        return Err(edge.status(error.clone()));
    }
    edge.engine.metrics().measurement(Transport::Grpc, result.as_ref().map_or("rejected", |m| m.outcome.label()));
    let (run, durable_place) = edge.durable_place(&message.session_id);
    Ok(pb::MeasurementAnswer { run, durable_place, ..measurement_answer(&message, &message.session_id, result) })
}
