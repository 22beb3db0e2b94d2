//! The gRPC client.

use std::time::Duration;

use nesam_proto::v1;
use tokio_stream::wrappers::ReceiverStream;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};

use crate::error::ClientError;
use crate::known_states::{KnownStates, Waiting};
use crate::map::MapLayers;
use crate::measure::{MeasurementStream, WAITING_MAX};
use crate::prediction::{Candidates, Prediction};
use crate::tls::Tls;

/// Largest reply accepted, bytes: the soil map of a fleet takes 25 MiB at the default limits of a server, a prediction 64 for each of 131 072 sample-steps.
const REPLY_BYTES_MAX: usize = 64 << 20;

/// Time between keep-alive pings and longest wait for the answer to one, as in the other clients: a server that has gone without a word is noticed after 40 s, also
/// while a stream rests.
const KEEPALIVE: Duration = Duration::from_secs(20);

/// Metadata by which a proxy in front of several servers keeps the calls of a vehicle together.
const VEHICLE: &str = "x-vehicle-id";

/// Adds the vehicle to every call.
#[derive(Clone, Debug, Default)]
struct Route(Option<MetadataValue<Ascii>>);

impl Interceptor for Route {
    fn call(&mut self, mut request: tonic::Request<()>) -> Result<tonic::Request<()>, tonic::Status> {
        if let Some(vehicle) = &self.0 {
            request.metadata_mut().insert(VEHICLE, vehicle.clone());
        }
        Ok(request)
    }
}

type Routed = InterceptedService<Channel, Route>;

/// A connection to a service. Cheap to clone; clones share the connection.
#[derive(Clone, Debug)]
pub struct Client {
    channel: Channel,
    route: Route,
    known: KnownStates,
}

impl Client {
    /// Connects, e.g. to `http://127.0.0.1:50051`.
    ///
    /// # Errors
    /// `ClientError::Connect` when the address is wrong or nobody answers there.
    pub async fn connect(address: &str) -> Result<Self, ClientError> {
        Self::connect_over(address, None, KEEPALIVE).await
    }

    /// Connects over TLS, e.g. to `https://server:50051`.
    ///
    /// # Errors
    /// `ClientError::Connect` as [`Client::connect`], or when the handshake fails.
    pub async fn connect_tls(address: &str, tls: &Tls) -> Result<Self, ClientError> {
        Self::connect_over(address, Some(tls), KEEPALIVE).await
    }

    /// A client over a connection that somebody else made.
    pub fn over(channel: Channel) -> Self {
        Self { channel, route: Route::default(), known: KnownStates::default() }
    }

    async fn connect_over(address: &str, tls: Option<&Tls>, keepalive: Duration) -> Result<Self, ClientError> {
        let failed = |source| ClientError::Connect { address: address.into(), source };
        let endpoint = Endpoint::from_shared(address.to_string()).map_err(failed)?;
        let endpoint = endpoint
            .tcp_nodelay(true)
            .initial_stream_window_size(nesam_proto::STREAM_WINDOW_BYTES)
            .initial_connection_window_size(nesam_proto::CONNECTION_WINDOW_BYTES)
            .max_frame_size(nesam_proto::FRAME_BYTES_MAX)
            .http2_keep_alive_interval(keepalive)
            .keep_alive_timeout(keepalive)
            .keep_alive_while_idle(true);
        let endpoint = match tls {
            Some(tls) => endpoint.tls_config(tls.config()).map_err(failed)?,
            None => endpoint,
        };
        Ok(Self::over(endpoint.connect().await.map_err(failed)?))
    }

    /// The same connection, working for one vehicle: a proxy in front of several servers keeps its calls together (metadata `x-vehicle-id`).
    ///
    /// # Errors
    /// `ClientError::Refused` for a name that no header can hold.
    pub fn for_vehicle(mut self, vehicle_id: &str) -> Result<Self, ClientError> {
        let value = vehicle_id.parse().map_err(|_| ClientError::Refused {
            code: tonic::Code::InvalidArgument,
            field: "vehicle_id".into(),
            message: format!("vehicle id `{}`: letters, digits, _ . and - are allowed", vehicle_id.escape_debug()),
            retry_after: None,
        })?;
        self.route = Route(Some(value));
        Ok(self)
    }

    /// The connection, for generated clients of the same server (health, reflection).
    pub fn channel(&self) -> Channel {
        self.channel.clone()
    }

    fn routed(&self) -> Routed {
        InterceptedService::new(self.channel.clone(), self.route.clone())
    }

    fn sessions(&self) -> v1::sessions_client::SessionsClient<Routed> {
        v1::sessions_client::SessionsClient::new(self.routed())
    }

    fn terrain(&self) -> v1::terrain_client::TerrainClient<Routed> {
        v1::terrain_client::TerrainClient::new(self.routed())
    }

    fn prediction(&self) -> v1::prediction_client::PredictionClient<Routed> {
        v1::prediction_client::PredictionClient::new(self.routed()).max_decoding_message_size(REPLY_BYTES_MAX)
    }

    fn soil(&self) -> v1::soil_client::SoilClient<Routed> {
        v1::soil_client::SoilClient::new(self.routed()).max_decoding_message_size(REPLY_BYTES_MAX)
    }

    /// Opens a session.
    ///
    /// # Errors
    /// `ClientError::Refused` with the service's reason, as all methods below.
    pub async fn open_session(&mut self, request: v1::OpenSessionRequest) -> Result<v1::Session, ClientError> {
        let session = self.sessions().open(request).await?.into_inner();
        self.known.opened(&session.session_id);
        Ok(session)
    }

    /// Reads a session.
    pub async fn session(&mut self, session: &str) -> Result<v1::Session, ClientError> {
        Ok(self.sessions().get(v1::GetSessionRequest { session_id: session.into() }).await?.into_inner())
    }

    /// Lists the open sessions of the server that answers: of servers that share sessions each lists those that it owns.
    pub async fn list_sessions(&mut self) -> Result<Vec<v1::Session>, ClientError> {
        Ok(self.sessions().list(v1::ListSessionsRequest {}).await?.into_inner().sessions)
    }

    /// Copies a session under another name.
    pub async fn fork_session(&mut self, session: &str, copy: &str) -> Result<v1::Session, ClientError> {
        let request = v1::ForkSessionRequest { session_id: session.into(), new_session_id: copy.into() };
        let session = self.sessions().fork(request).await?.into_inner();
        self.known.opened(&session.session_id);
        Ok(session)
    }

    /// Everything that a session remembers, for [`Client::import_session`] here or elsewhere.
    pub async fn export_session(&mut self, session: &str) -> Result<Vec<u8>, ClientError> {
        let request = v1::ExportSessionRequest { session_id: session.into() };
        Ok(self.sessions().export(request).await?.into_inner().image.into())
    }

    /// Opens a session from an export; an empty name keeps that of the exported one.
    pub async fn import_session(&mut self, image: Vec<u8>, session: &str) -> Result<v1::Session, ClientError> {
        let request = v1::ImportSessionRequest { image: image.into(), session_id: session.into() };
        let session = self.sessions().import(request).await?.into_inner();
        self.known.opened(&session.session_id);
        Ok(session)
    }

    /// Puts physical effects on a session, in place of those that were applied before; `source` says where they come from.
    pub async fn apply_effects(&mut self, session: &str, source: &str, effects: Vec<v1::Effect>) -> Result<v1::Session, ClientError> {
        let request = v1::ApplyEffectsRequest { session_id: session.into(), source: source.into(), effects };
        Ok(self.sessions().apply_effects(request).await?.into_inner())
    }

    /// Takes the applied effects from a session.
    pub async fn revert_effects(&mut self, session: &str) -> Result<v1::Session, ClientError> {
        Ok(self.sessions().revert_effects(v1::RevertEffectsRequest { session_id: session.into() }).await?.into_inner())
    }

    /// Watches the alarms of a session: the active one first, then every one that is raised or cleared.
    pub async fn watch_alarms(&mut self, session: &str) -> Result<tonic::Streaming<v1::Alarm>, ClientError> {
        Ok(self.sessions().watch_alarms(v1::WatchAlarmsRequest { session_id: session.into() }).await?.into_inner())
    }

    /// Starts a diagnosis of what was recorded of a session, and hears how it goes: the start, progress, at last the report. Dropping the stream ends it.
    pub async fn diagnose(&mut self, request: v1::StartDiagnosisRequest) -> Result<tonic::Streaming<v1::DiagnosisEvent>, ClientError> {
        let client = v1::diagnosis_client::DiagnosisClient::new(self.routed());
        Ok(client.max_decoding_message_size(REPLY_BYTES_MAX).start(request).await?.into_inner())
    }

    /// Closes a session.
    pub async fn close_session(&mut self, session: &str) -> Result<(), ClientError> {
        self.sessions().close(v1::CloseSessionRequest { session_id: session.into() }).await?;
        self.known.forget(session);
        Ok(())
    }

    /// Uploads a map in tiles. INVALID_ARGUMENT without a call when a layer does not have the size that width and height say.
    pub async fn upload_map(&mut self, map: &MapLayers) -> Result<v1::MapDescription, ClientError> {
        map.check()?;
        self.upload_messages(map.messages()).await
    }

    /// Uploads a map from ready messages.
    pub async fn upload_messages(&mut self, messages: Vec<v1::UploadMapRequest>) -> Result<v1::MapDescription, ClientError> {
        Ok(self.terrain().upload_map(tokio_stream::iter(messages)).await?.into_inner())
    }

    /// Replaces a rectangle of a map.
    pub async fn patch_tile(&mut self, request: v1::PatchTileRequest) -> Result<v1::MapDescription, ClientError> {
        Ok(self.terrain().patch_tile(request).await?.into_inner())
    }

    /// Describes a map.
    pub async fn map(&mut self, map: &str) -> Result<v1::MapDescription, ClientError> {
        Ok(self.terrain().get(v1::GetMapRequest { map_id: map.into() }).await?.into_inner())
    }

    /// Lists the maps of the server that answers: of servers that share sessions each lists those that it holds.
    pub async fn list_maps(&mut self) -> Result<Vec<v1::MapDescription>, ClientError> {
        Ok(self.terrain().list(v1::ListMapsRequest {}).await?.into_inner().maps)
    }

    /// Forgets a map.
    pub async fn delete_map(&mut self, map: &str) -> Result<(), ClientError> {
        self.terrain().delete(v1::DeleteMapRequest { map_id: map.into() }).await?;
        Ok(())
    }

    /// Opens a stream of measurements.
    pub async fn measure(&mut self) -> Result<MeasurementStream, ClientError> {
        let (sender, receiver) = tokio::sync::mpsc::channel(WAITING_MAX);
        let mut client = v1::measurements_client::MeasurementsClient::new(self.routed());
        let answers = client.stream(ReceiverStream::new(receiver)).await?.into_inner();
        Ok(MeasurementStream::new(sender, answers, self.known.clone()))
    }

    /// Sends measurements and collects their answers.
    pub async fn feed(&mut self, measurements: Vec<v1::Measurement>) -> Result<Vec<v1::MeasurementAnswer>, ClientError> {
        let mut client = v1::measurements_client::MeasurementsClient::new(self.routed());
        let mut waiting = Waiting::new(self.known.clone());
        measurements.iter().for_each(|measurement| waiting.push(measurement));
        let mut answers = Vec::with_capacity(measurements.len());
        let mut inbound = client.stream(tokio_stream::iter(measurements)).await?.into_inner();
        while let Some(answer) = inbound.message().await? {
            waiting.answered(&answer);
            answers.push(answer);
        }
        Ok(answers)
    }

    /// Rolls candidates out. A [`Candidates::fallback`] answers where the service is overloaded or away; without a deadline it is never late.
    pub async fn predict(&mut self, candidates: Candidates) -> Result<Prediction, ClientError> {
        self.predict_within(candidates, None).await
    }

    /// Rolls candidates out within a deadline, which also holds while there is no connection. A [`Candidates::fallback`] answers where the service does not in
    /// time, is overloaded or away, or knows no measurement that is new enough for `start_stamp_ns`, and [`Prediction::computed_by`] says so.
    ///
    /// # Errors
    /// `ClientError::Refused` with the service's reason. A fallback leaves it where neither a start is given nor a state of the session is known, or
    /// the known one is too old: more than 3.2 s by the clock of this program, or more than 32 steps before `start_stamp_ns`.
    pub async fn predict_within(&mut self, candidates: Candidates, deadline: Option<Duration>) -> Result<Prediction, ClientError> {
        let mut request = tonic::Request::new(candidates.to_message());
        if let Some(deadline) = deadline {
            request.set_timeout(deadline);
        }
        let asked = self.known.ask();
        match self.ask(request, deadline).await {
            Ok(prediction) => {
                self.known.predicted(asked, &candidates, &prediction);
                Ok(prediction)
            }
            Err(error) => {
                self.known.refused(&candidates.session, &error);
                let known = self.known.of(&candidates.session);
                candidates.fallback.as_ref().and_then(|fallback| fallback.answer(&candidates, known, &error)).ok_or(error)
            }
        }
    }

    /// Asks for a prediction. The transport looks at the deadline once it has a connection, and one that is being made may take minutes.
    async fn ask(&mut self, request: tonic::Request<v1::PredictRequest>, deadline: Option<Duration>) -> Result<Prediction, ClientError> {
        let mut client = self.prediction();
        let reply = client.predict(request);
        let reply = match deadline {
            Some(deadline) => match tokio::time::timeout(deadline, reply).await {
                Ok(reply) => reply,
                Err(_) => Err(tonic::Status::deadline_exceeded("no answer came in time")),
            },
            None => reply.await,
        };
        Prediction::from_message(&reply?.into_inner())
    }

    /// Rolls a ready message out; the reply is not unpacked.
    pub async fn predict_message(&mut self, request: v1::PredictRequest) -> Result<v1::PredictReply, ClientError> {
        Ok(self.prediction().predict(request).await?.into_inner())
    }

    /// Sends requests over one stream and collects the replies, which may be errors one by one.
    pub async fn predict_stream(&mut self, requests: Vec<v1::PredictRequest>) -> Result<Vec<v1::PredictStreamReply>, ClientError> {
        let mut inbound = self.prediction().predict_stream(tokio_stream::iter(requests)).await?.into_inner();
        let mut replies = Vec::new();
        while let Some(reply) = inbound.message().await? {
            replies.push(reply);
        }
        Ok(replies)
    }

    /// What the fleet has learned of the ground; an empty name means all maps.
    pub async fn fleet_soil(&mut self, map: &str) -> Result<v1::FleetSoilMap, ClientError> {
        Ok(self.soil().map(v1::FleetSoilRequest { map_id: map.into() }).await?.into_inner())
    }

    /// Watches the soil estimate of a session.
    pub async fn watch_soil(&mut self, session: &str) -> Result<tonic::Streaming<v1::SoilEstimate>, ClientError> {
        Ok(self.soil().watch(v1::WatchSoilRequest { session_id: session.into() }).await?.into_inner())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// Goal: a server that has gone without a word is noticed by a call without a deadline. Method: a listener that takes connections and says nothing, pings
    /// every 50 ms instead of 20 s.
    #[tokio::test]
    async fn service_a_silent_server_is_noticed() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let silent = tokio::spawn(async move {
            let mut sockets = Vec::new();
            while let Ok((socket, _)) = listener.accept().await {
                sockets.push(socket);
            }
        });
        let mut client = Client::connect_over(&address, None, Duration::from_millis(50)).await.unwrap();
        let asked = tokio::time::timeout(Duration::from_secs(20), client.session("s")).await.expect("the call ends");
        assert_eq!(asked.unwrap_err().code(), Some(tonic::Code::Unavailable));
        silent.abort();
    }
}
