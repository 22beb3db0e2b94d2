//! nesam.v1.Sessions.

use nesam_engine::{AppliedEffects, EngineError, Event, SessionView};
use nesam_proto::v1 as pb;
use tonic::{Request, Response, Status};

use super::news::{News, tell};
use super::{Edge, ReplyStream};
use crate::access::Wish;
use crate::convert::{alarm_message, applied_effects, image_bytes, open_session, session_image, session_view, to_status};
use crate::store::Key;
use crate::telemetry::Transport;

/// Opens, reads, lists, copies, moves and closes sessions.
pub struct Service(pub Edge);

impl Edge {
    /// A session as message, with what the Zenoh network says of its vehicle.
    fn session(&self, view: &SessionView) -> pb::Session {
        let vehicle_alive = self.presence.as_ref().map(|presence| presence.is_alive(&view.vehicle));
        let (run, durable_place) = self.durable_place(&view.session);
        pb::Session { vehicle_alive, run, durable_place, ..session_view(view, &self.predictor.bundle().vehicle) }
    }

    /// Puts effects on a session; `None` takes them away.
    async fn set_effects<T>(
        &self,
        method: &'static str,
        request: &Request<T>,
        session: &str,
        effects: Option<AppliedEffects>,
    ) -> Result<Response<pb::Session>, Status> {
        self.engine.metrics().request(Transport::Grpc, method);
        let budget = self.budget(request);
        self.allow(request, Wish::ApplyEffects(session)).await?;
        if effects.as_ref().is_some_and(|given| given.effects.is_empty()) {
            return Err(to_status(EngineError::invalid("effects", "is empty; RevertEffects takes effects away")));
        }
        let view = self.engine.set_effects(session, effects.unwrap_or_default(), budget).await.map_err(|error| self.status(error))?;
        let ids: Vec<&str> = view.effects.effects.iter().map(|e| e.id.as_str()).collect();
        tracing::info!(session, effects = ids.join(","), source = view.effects.source, "effects of a session changed");
        self.settled(Key::Session(view.session.clone()), budget).await?;
        Ok(Response::new(self.session(&view)))
    }
}

#[tonic::async_trait]
impl pb::sessions_server::Sessions for Service {
    type WatchAlarmsStream = ReplyStream<pb::Alarm>;

    async fn open(&self, request: Request<pb::OpenSessionRequest>) -> Result<Response<pb::Session>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "open");
        let budget = self.0.budget(&request);
        let pb::OpenSessionRequest { vehicle_id: vehicle, session_id: session, .. } = request.get_ref();
        let name = if session.is_empty() { vehicle } else { session };
        self.0.allow(&request, Wish::OpenSession { vehicle, session: name }).await?;
        let open = open_session(request.get_ref()).map_err(to_status)?;
        self.0.bring_map(&open.map, budget).await?;
        let view = self.0.begin("session_id", name, budget, self.0.engine.open(open, budget)).await?;
        tracing::info!(session = view.session, vehicle = view.vehicle, "session opened");
        self.0.settled(Key::Session(view.session.clone()), budget).await?;
        Ok(Response::new(self.0.session(&view)))
    }

    async fn get(&self, request: Request<pb::GetSessionRequest>) -> Result<Response<pb::Session>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "get");
        self.0.allow(&request, Wish::ReadSession(&request.get_ref().session_id)).await?;
        let view = self.0.engine.get(&request.get_ref().session_id, self.0.budget(&request)).await.map_err(|error| self.0.status(error))?;
        Ok(Response::new(self.0.session(&view)))
    }

    async fn list(&self, request: Request<pb::ListSessionsRequest>) -> Result<Response<pb::ListSessionsReply>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "list");
        let caller = self.0.access.caller(&request)?;
        let views = self.0.engine.list(self.0.budget(&request)).await.map_err(to_status)?;
        let seen = views.iter().filter(|view| caller.sees(&view.vehicle));
        Ok(Response::new(pb::ListSessionsReply { sessions: seen.map(|view| self.0.session(view)).collect() }))
    }

    async fn fork(&self, request: Request<pb::ForkSessionRequest>) -> Result<Response<pb::Session>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "fork");
        let budget = self.0.budget(&request);
        let caller = self.0.access.caller(&request)?;
        let pb::ForkSessionRequest { session_id, new_session_id } = request.into_inner();
        if let Some(vehicle) = self.0.allow_caller(&caller, Wish::ChangeSession(&session_id), budget).await? {
            caller.may(Wish::OpenSession { vehicle: &vehicle, session: &new_session_id })?;
        }
        caller.changes(Wish::ChangeSession(&session_id));
        let copy = self.0.engine.fork(&session_id, &new_session_id, budget);
        let view = self.0.begin("new_session_id", &new_session_id, budget, copy).await?;
        tracing::info!(session = session_id, copy = view.session, "session copied");
        self.0.settled(Key::Session(view.session.clone()), budget).await?;
        Ok(Response::new(self.0.session(&view)))
    }

    async fn export(&self, request: Request<pb::ExportSessionRequest>) -> Result<Response<pb::ExportSessionReply>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "export");
        self.0.allow(&request, Wish::ReadSession(&request.get_ref().session_id)).await?;
        let image =
            self.0.engine.export(&request.get_ref().session_id, self.0.budget(&request)).await.map_err(|error| self.0.status(error))?;
        Ok(Response::new(pb::ExportSessionReply { image: image_bytes(&image).into() }))
    }

    async fn import(&self, request: Request<pb::ImportSessionRequest>) -> Result<Response<pb::Session>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "import");
        let budget = self.0.budget(&request);
        let caller = self.0.access.caller(&request)?;
        let pb::ImportSessionRequest { image, session_id } = request.into_inner();
        let image = session_image(&image).map_err(to_status)?;
        let name = if session_id.is_empty() { &image.session } else { &session_id };
        caller.may(Wish::OpenSession { vehicle: &image.vehicle, session: name })?;
        if image.effects != AppliedEffects::default() {
            // Anybody can write an image: its checksum tells damage, not who made it.
            let refused =
                |status: Status| Status::new(status.code(), format!("the image says which effects the vehicle has: {}", status.message()));
            caller.may_with(Wish::ApplyEffects(name), &image.vehicle).map_err(refused)?;
        }
        caller.changes(Wish::OpenSession { vehicle: &image.vehicle, session: name });
        if let Some((map, _)) = &image.map {
            self.0.bring_map(map, budget).await?;
        }
        let name = name.clone();
        let view = self.0.begin("session_id", &name, budget, self.0.engine.import(image, &session_id, budget)).await?;
        tracing::info!(session = view.session, vehicle = view.vehicle, "session imported");
        self.0.settled(Key::Session(view.session.clone()), budget).await?;
        Ok(Response::new(self.0.session(&view)))
    }

    async fn apply_effects(&self, request: Request<pb::ApplyEffectsRequest>) -> Result<Response<pb::Session>, Status> {
        let pb::ApplyEffectsRequest { session_id, source, effects } = request.get_ref();
        let applied = applied_effects(source, effects);
        self.0.set_effects("apply_effects", &request, session_id, Some(applied)).await
    }

    async fn revert_effects(&self, request: Request<pb::RevertEffectsRequest>) -> Result<Response<pb::Session>, Status> {
        self.0.set_effects("revert_effects", &request, &request.get_ref().session_id, None).await
    }

    async fn watch_alarms(&self, request: Request<pb::WatchAlarmsRequest>) -> Result<Response<Self::WatchAlarmsStream>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "watch_alarms");
        let news = News {
            of_event: |session, event| match event {
                Event::AlarmChanged { session: of, vehicle, alarm, .. } if of == session => Some(alarm_message(session, &vehicle, &alarm)),
                _ => None,
            },
            of_session: |session, view| view.alarm.as_ref().map(|alarm| alarm_message(session, &view.vehicle, alarm)),
        };
        tell(self.0.clone(), &request, request.get_ref().session_id.clone(), news).await
    }

    async fn close(&self, request: Request<pb::CloseSessionRequest>) -> Result<Response<pb::CloseSessionReply>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "close");
        let budget = self.0.budget(&request);
        self.0.allow(&request, Wish::ChangeSession(&request.get_ref().session_id)).await?;
        let session = request.into_inner().session_id;
        self.0.engine.close(&session, budget).await.map_err(|error| self.0.status(error))?;
        tracing::info!(session, "session closed");
        self.0.settled(Key::Session(session), budget).await?;
        Ok(Response::new(pb::CloseSessionReply {}))
    }
}
