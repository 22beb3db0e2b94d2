//! nesam.v1.Sessions.

use nesam_proto::v1 as pb;
use tonic::{Request, Response, Status};

use super::Edge;
use crate::convert::{open_session, session_view, to_status};
use crate::telemetry::Transport;

/// Opens, reads, lists, copies and closes sessions.
pub struct Service(pub Edge);

#[tonic::async_trait]
impl pb::sessions_server::Sessions for Service {
    async fn open(&self, request: Request<pb::OpenSessionRequest>) -> Result<Response<pb::Session>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "open");
        let budget = self.0.budget(&request);
        let open = open_session(request.get_ref()).map_err(to_status)?;
        let view = self.0.engine.open(open, budget).await.map_err(to_status)?;
        tracing::info!(session = view.session, vehicle = view.vehicle, "session opened");
        Ok(Response::new(session_view(&view, &self.0.predictor.bundle().vehicle)))
    }

    async fn get(&self, request: Request<pb::GetSessionRequest>) -> Result<Response<pb::Session>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "get");
        let view = self.0.engine.get(&request.get_ref().session_id, self.0.budget(&request)).await.map_err(to_status)?;
        Ok(Response::new(session_view(&view, &self.0.predictor.bundle().vehicle)))
    }

    async fn list(&self, request: Request<pb::ListSessionsRequest>) -> Result<Response<pb::ListSessionsReply>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "list");
        let views = self.0.engine.list(self.0.budget(&request)).await.map_err(to_status)?;
        let vehicle = &self.0.predictor.bundle().vehicle;
        Ok(Response::new(pb::ListSessionsReply { sessions: views.iter().map(|view| session_view(view, vehicle)).collect() }))
    }

    async fn fork(&self, request: Request<pb::ForkSessionRequest>) -> Result<Response<pb::Session>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "fork");
        let budget = self.0.budget(&request);
        let pb::ForkSessionRequest { session_id, new_session_id } = request.into_inner();
        let view = self.0.engine.fork(&session_id, &new_session_id, budget).await.map_err(to_status)?;
        tracing::info!(session = session_id, copy = view.session, "session copied");
        Ok(Response::new(session_view(&view, &self.0.predictor.bundle().vehicle)))
    }

    async fn close(&self, request: Request<pb::CloseSessionRequest>) -> Result<Response<pb::CloseSessionReply>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "close");
        let session = &request.get_ref().session_id;
        self.0.engine.close(session, self.0.budget(&request)).await.map_err(to_status)?;
        tracing::info!(session, "session closed");
        Ok(Response::new(pb::CloseSessionReply {}))
    }
}
