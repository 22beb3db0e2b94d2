//! The vehicle's side over Zenoh: publishes measurements, hears their answers, says that it is there, may ask for predictions.

use std::time::Duration;

use nesam_proto::pieces::{Pieces, head};
use nesam_proto::v1;
use prost::Message as _;
use zenoh::bytes::ZBytes;
use zenoh::handlers::{RingChannel, RingChannelHandler};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;

use crate::error::ClientError;
use crate::prediction::{Candidates, Prediction};
use crate::tls::Tls;

/// Answers that wait unread at most: more than five seconds at 200 Hz.
const UNREAD_MAX: usize = 1024;

/// A vehicle in a Zenoh network. Needs a multi-thread tokio runtime.
///
/// Answers to measurements need not be read. Where more than 1024 are unread, the oldest of them go: who has to count them reads them as they come.
#[derive(Debug)]
pub struct ZenohVehicle {
    session: zenoh::Session,
    measurement_key: String,
    predict_key: String,
    answers: Subscriber<RingChannelHandler<Sample>>,
    /// Tells the network that this vehicle is there; goes with it.
    _alive: LivelinessToken,
}

fn failed(error: impl core::fmt::Display) -> ClientError {
    ClientError::Zenoh { reason: error.to_string() }
}

/// A client of one endpoint.
fn client_of(endpoint: &str) -> Result<zenoh::Config, ClientError> {
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", "\"client\"").map_err(failed)?;
    config.insert_json5("scouting/multicast/enabled", "false").map_err(failed)?;
    config.insert_json5("connect/endpoints", &format!("[{endpoint:?}]")).map_err(failed)?;
    Ok(config)
}

/// Nothing goes past the socket of this session.
fn no_shared_memory(config: &mut zenoh::Config) -> Result<(), ClientError> {
    config.insert_json5("transport/shared_memory/enabled", "false").map_err(failed)
}

/// What an error reply says: the service tells a `PredictError`, Zenoh itself a text, for example that nobody has answered in time.
fn refusal(payload: &[u8]) -> ClientError {
    match v1::PredictError::decode(payload) {
        Ok(v1::PredictError { code, field, message, .. }) => ClientError::Refused { code: code.into(), field, message, retry_after: None },
        Err(_) => failed(String::from_utf8_lossy(payload)),
    }
}

/// The bytes of a payload where they lie, in shared memory or as received.
fn in_place(payload: &ZBytes) -> Pieces {
    Pieces::lent(payload, payload.slices().count(), |payload, at| payload.slices().nth(at).unwrap_or_default())
}

/// The commands behind the rest as they lie in the message: the network copies them once.
fn in_pieces(mut request: v1::PredictRequest) -> ZBytes {
    let controls = std::mem::take(&mut request.controls);
    let mut message = ZBytes::writer();
    message.append(head(&request, v1::PredictRequest::CONTROLS, controls.len()).into());
    message.append(controls.into());
    message.finish()
}

impl ZenohVehicle {
    /// Joins the network as a client of the router or server at `endpoint`, e.g. `tcp/127.0.0.1:7447`. Nothing is searched for by multicast. Large messages
    /// go through shared memory where the other side is on this host and can.
    ///
    /// # Errors
    /// `ClientError::Zenoh` when nobody answers there.
    pub async fn connect(endpoint: &str, fleet: &str, vehicle: &str) -> Result<Self, ClientError> {
        Self::join(client_of(endpoint)?, fleet, vehicle).await
    }

    /// As [`ZenohVehicle::connect`], but everything goes through the socket, also where both sides are on one host and could share memory.
    ///
    /// # Errors
    /// As [`ZenohVehicle::connect`].
    pub async fn connect_through_socket(endpoint: &str, fleet: &str, vehicle: &str) -> Result<Self, ClientError> {
        let mut config = client_of(endpoint)?;
        no_shared_memory(&mut config)?;
        Self::join(config, fleet, vehicle).await
    }

    /// As [`ZenohVehicle::connect`], to an endpoint `tls/...`. The common name of the certificate is who this vehicle is, `nesam:vehicle:<vehicle>`; the
    /// name of the endpoint's host has to stand in the router's certificate.
    ///
    /// # Errors
    /// `ClientError::Zenoh` when nobody answers there or either side does not trust the other.
    pub async fn connect_tls(endpoint: &str, fleet: &str, vehicle: &str, tls: &Tls) -> Result<Self, ClientError> {
        let mut config = client_of(endpoint)?;
        no_shared_memory(&mut config)?;
        tls.configure_zenoh(&mut config).map_err(failed)?;
        Self::join(config, fleet, vehicle).await
    }

    async fn join(config: zenoh::Config, fleet: &str, vehicle: &str) -> Result<Self, ClientError> {
        let session = zenoh::open(config).await.map_err(failed)?;
        let key = |topic: &str| format!("nesam/v1/{fleet}/{vehicle}/{topic}");
        // A channel that makes Zenoh's thread wait for a reader would hold up the replies to predictions too.
        let answers = session.declare_subscriber(key("status")).with(RingChannel::new(UNREAD_MAX)).await.map_err(failed)?;
        let alive = session.liveliness().declare_token(key("alive")).await.map_err(failed)?;
        Ok(Self { session, measurement_key: key("measurement"), predict_key: key("predict"), answers, _alive: alive })
    }

    /// Publishes a measurement; waits while the network is congested rather than losing it.
    ///
    /// # Errors
    /// `ClientError::Zenoh` when the session is closed.
    pub async fn publish(&self, measurement: &v1::Measurement) -> Result<(), ClientError> {
        self.publish_bytes(measurement.encode_to_vec()).await
    }

    /// Publishes a ready payload on the measurement key.
    ///
    /// # Errors
    /// As [`ZenohVehicle::publish`].
    pub async fn publish_bytes(&self, payload: Vec<u8>) -> Result<(), ClientError> {
        let put = self.session.put(self.measurement_key.as_str(), payload).congestion_control(CongestionControl::Block);
        put.await.map_err(failed)
    }

    /// The next answer to a measurement of this vehicle, the oldest of the last 1024 that are unread; `None` after `timeout`. An answer tells the `sequence` of
    /// its measurement, by which a reader sees that some are missing.
    ///
    /// # Errors
    /// `ClientError::Protocol` when the payload is no answer.
    pub async fn answer(&self, timeout: Duration) -> Result<Option<v1::MeasurementAnswer>, ClientError> {
        let Ok(sample) = tokio::time::timeout(timeout, self.answers.recv_async()).await else { return Ok(None) };
        let payload = sample.map_err(failed)?.payload().to_bytes().into_owned();
        let answer = v1::MeasurementAnswer::decode(payload.as_slice());
        answer.map(Some).map_err(|error| ClientError::protocol(error.to_string()))
    }

    /// Waits until somebody listens to the measurements of this vehicle.
    ///
    /// # Errors
    /// `ClientError::Zenoh` when nobody does within `timeout`.
    pub async fn wait_for_service(&self, timeout: Duration) -> Result<(), ClientError> {
        let publisher = self.session.declare_publisher(self.measurement_key.clone()).await.map_err(failed)?;
        let deadline = tokio::time::Instant::now() + timeout;
        while !publisher.matching_status().await.map_err(failed)?.matching() {
            if tokio::time::Instant::now() > deadline {
                return Err(failed(format!("nobody listens to {}", self.measurement_key)));
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        Ok(())
    }

    /// Asks the service for a prediction over Zenoh.
    ///
    /// # Errors
    /// `ClientError::Refused` with the service's reason, `ClientError::Zenoh` when nobody answers.
    pub async fn predict(&self, candidates: &Candidates) -> Result<Prediction, ClientError> {
        let payload = in_pieces(candidates.to_message());
        let replies = self.session.get(self.predict_key.as_str()).payload(payload).await.map_err(failed)?;
        let reply = replies.recv_async().await.map_err(|_| failed("nobody answers predictions"))?;
        match reply.result() {
            Ok(sample) => {
                let reply = v1::PredictReply::decode(in_place(sample.payload()));
                Prediction::from_message(&reply.map_err(|error| ClientError::protocol(error.to_string()))?)
            }
            Err(error) => Err(refusal(&error.payload().to_bytes())),
        }
    }

    /// Leaves the network.
    ///
    /// # Errors
    /// `ClientError::Zenoh`.
    pub async fn close(self) -> Result<(), ClientError> {
        self.session.close().await.map_err(failed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: who is not answered in time is told so. Method: an error reply of the service, and the text that Zenoh replies with when the time of a query is over.
    #[test]
    fn regress_a_query_that_zenoh_gives_up_is_no_protocol_error() {
        let said = v1::PredictError { code: tonic::Code::NotFound.into(), field: "session_id".into(), ..Default::default() };
        let refused = refusal(&said.encode_to_vec());
        assert_eq!((refused.code(), refused.field()), (Some(tonic::Code::NotFound), "session_id"));
        assert!(matches!(refusal(b"Timeout"), ClientError::Zenoh { reason } if reason == "Timeout"));
    }
}
