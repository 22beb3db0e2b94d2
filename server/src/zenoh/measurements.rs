//! Measurements over Zenoh: subscriber on `.../measurement`, answers on `.../status`.

use std::sync::Arc;

use ::zenoh::sample::{Sample, SampleKind};
use nesam_engine::{EngineError, MeasureAnswer};
use nesam_proto::v1 as pb;
use tokio::sync::mpsc;

use super::arrival::Arrival;
use super::{MEASUREMENT_BYTES_MAX, Outgoing, decode, encode, keys};
use crate::convert::{measurement, measurement_answer};
use crate::grpc::Edge;
use crate::telemetry::Transport;

/// Where the answer to one measurement goes.
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
        SampleKind::Put => decode::<pb::Measurement>("nesam.v1.Measurement", &*sample.payload().to_bytes(), MEASUREMENT_BYTES_MAX),
        SampleKind::Delete => Err(EngineError::invalid("", "a key that is deleted carries no measurement; put one")),
    };
    let (message, undecodable) = decoded.map_or_else(|error| (pb::Measurement::default(), Some(error)), |message| (message, None));
    let read = undecodable.map_or_else(|| measurement(&message), Err);
    let session = if message.session_id.is_empty() { vehicle.to_string() } else { message.session_id.clone() };
    let run = message.run;
    let path = ReturnPath {
        edge: edge.clone(),
        sender: sender.clone(),
        status_key: keys::of_vehicle(fleet, vehicle, "status"),
        message,
        session: session.clone(),
        vehicle: vehicle.into(),
    };
    let answer = Box::new(move |result| path.answer(result));
    Arrival { edge: edge.clone(), session, vehicle: vehicle.into(), run, answer }.take(read);
}

impl ReturnPath {
    /// Counts and publishes the answer.
    fn answer(self, result: Result<MeasureAnswer, EngineError>) {
        self.edge.engine.metrics().measurement(Transport::Zenoh, result.as_ref().map_or("rejected", |m| m.outcome.label()));
        let foreign = self.edge.access.directory.is_foreign(&self.session, &self.vehicle);
        let (run, durable_place) = if foreign { (0, 0) } else { self.edge.durable_place(&self.session) };
        let answer = pb::MeasurementAnswer { run, durable_place, ..measurement_answer(&self.message, &self.session, result) };
        if self.sender.try_send((self.status_key, encode(&answer))).is_err() {
            self.edge.engine.metrics().answer_dropped();
        }
    }
}
