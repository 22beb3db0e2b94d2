//! Measurements over Zenoh: subscriber on `.../measurement`, answers on `.../status`.

use std::sync::Arc;

use ::zenoh::sample::{Sample, SampleKind};
use nesam_engine::{Command, EngineError, MeasureAnswer};
use nesam_proto::v1 as pb;
use tokio::sync::mpsc;

use super::{MEASUREMENT_BYTES_MAX, Outgoing, decode, encode, keys};
use crate::call::{measured, unmeasured};
use crate::cluster::{Brought, Standing};
use crate::convert::{measurement, measurement_answer};
use crate::grpc::Edge;
use crate::telemetry::Transport;

/// Where the answer to one measurement goes.
#[derive(Clone)]
struct ReturnPath {
    edge: Edge,
    sender: mpsc::Sender<Outgoing>,
    status_key: String,
    message: pb::Measurement,
    session: String,
    vehicle: String,
}

/// Feeds every measurement of the fleet to the engine, in order of arrival.
pub async fn declare(session: &::zenoh::Session, fleet: &str, edge: Edge, sender: mpsc::Sender<Outgoing>) -> Result<(), ::zenoh::Error> {
    let fleet: Arc<str> = fleet.into();
    let subscriber = session.declare_subscriber(keys::all_vehicles(&fleet, "measurement")).callback({
        let fleet = fleet.clone();
        move |sample| receive(&edge, &sender, &fleet, &sample)
    });
    subscriber.background().await
}

/// Runs on a thread of Zenoh, so it only hands over.
fn receive(edge: &Edge, sender: &mpsc::Sender<Outgoing>, fleet: &str, sample: &Sample) {
    edge.engine.metrics().request(Transport::Zenoh, "measurement");
    let vehicle = keys::vehicle(sample.key_expr().as_str());
    let decoded = match sample.kind() {
        SampleKind::Put => decode::<pb::Measurement>("nesam.v1.Measurement", &sample.payload().to_bytes(), MEASUREMENT_BYTES_MAX),
        SampleKind::Delete => Err(EngineError::invalid("", "a key that is deleted carries no measurement; put one")),
    };
    let (message, undecodable) = decoded.map_or_else(|error| (pb::Measurement::default(), Some(error)), |message| (message, None));
    let session = if message.session_id.is_empty() { vehicle.to_string() } else { message.session_id.clone() };
    let path = ReturnPath {
        edge: edge.clone(),
        sender: sender.clone(),
        status_key: keys::of_vehicle(fleet, vehicle, "status"),
        message,
        session: session.clone(),
        vehicle: vehicle.into(),
    };
    let measurement = match undecodable.map_or_else(|| measurement(&path.message), Err) {
        Ok(_) if !path.is_ours() => return,
        // The run of another vehicle's session is not told either: the engine refuses that one.
        Ok(measurement) if path.is_foreign() => Ok(measurement),
        decoded => decoded.and_then(|measurement| edge.check_run(&session, path.message.run).map(|()| measurement)),
    };
    match measurement {
        Ok(measurement) => {
            let command = Command::Measure { session, vehicle: Some(vehicle.into()), measurement };
            let mut submission = edge.engine.submission(command, move |answer| path.answer(measured(answer)));
            // The vehicle of the key, which rights are given by: the session is whatever the sender says.
            submission.share = Some(vehicle.into());
            edge.engine.handle().submit(submission);
        }
        Err(error) => refuse(edge, session, path, error),
    }
}

/// Answers a measurement that never reaches the engine; where there is room the session is read in its place, so that the answer tells where it stands.
fn refuse(edge: &Edge, session: String, path: ReturnPath, error: EngineError) {
    if !edge.engine.has_room() {
        return path.answer(Err(error));
    }
    edge.engine.handle().submit(edge.engine.submission(Command::Get { session }, move |answer| {
        let error = unmeasured(error, Some(&path.vehicle), answer);
        path.answer(Err(error));
    }));
}

impl ReturnPath {
    /// Whether this server answers. Every server hears every measurement: the owner of the session takes it, the others pass over it, and where there is
    /// no owner they race for the session; what was not answered meanwhile the vehicle sends again.
    fn is_ours(&self) -> bool {
        let Some(cluster) = &self.edge.cluster else { return true };
        let standing = cluster.standing(&self.session);
        if standing == Standing::Lost {
            let (cluster, path) = (cluster.clone(), self.clone());
            self.edge.runtime.spawn(async move {
                if let Some(Brought::Nowhere) = cluster.search(&path.session, &path.vehicle, path.edge.stream_budget()).await {
                    let error = EngineError::UnknownSession { session: path.session.clone() };
                    path.answer(Err(error));
                }
            });
        }
        standing == Standing::Here
    }

    /// See [`Directory::is_foreign`](crate::access::Directory::is_foreign).
    fn is_foreign(&self) -> bool {
        self.edge.access.directory.is_foreign(&self.session, &self.vehicle)
    }

    /// Counts and publishes the answer.
    fn answer(self, result: Result<MeasureAnswer, EngineError>) {
        self.edge.engine.metrics().measurement(Transport::Zenoh, result.as_ref().map_or("rejected", |m| m.outcome.label()));
        let (run, durable_place) = if self.is_foreign() { (0, 0) } else { self.edge.durable_place(&self.session) };
        let answer = pb::MeasurementAnswer { run, durable_place, ..measurement_answer(&self.message, &self.session, result) };
        if self.sender.try_send((self.status_key, encode(&answer))).is_err() {
            self.edge.engine.metrics().measurement(Transport::Zenoh, "answer_dropped");
        }
    }
}
