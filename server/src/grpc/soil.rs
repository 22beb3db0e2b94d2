//! nesam.v1.Soil.

use nesam_engine::{EngineError, Event};
use nesam_proto::v1 as pb;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};

use super::{Edge, ReplyStream, stopped};
use crate::access::Wish;
use crate::convert::{fleet_soil_map, soil_estimate, to_status};
use crate::telemetry::Transport;

/// Tells watchers what is learned of the soil.
pub struct Service(pub Edge);

#[tonic::async_trait]
impl pb::soil_server::Soil for Service {
    type WatchStream = ReplyStream<pb::SoilEstimate>;

    async fn watch(&self, request: Request<pb::WatchSoilRequest>) -> Result<Response<Self::WatchStream>, Status> {
        let edge = self.0.clone();
        edge.engine.metrics().request(Transport::Grpc, "watch_soil");
        edge.allow(&request, Wish::ReadSession(&request.get_ref().session_id))?;
        // Listening starts before reading, so that no change falls between the two.
        let events = edge.events.subscribe();
        let session = request.into_inner().session_id;
        let view = edge.engine.get(&session, edge.stream_budget()).await.map_err(to_status)?;
        let (sender, receiver) = mpsc::channel(16);
        let _ = sender.try_send(Ok(soil_estimate(&session, &view.soil)));
        tokio::spawn(forward(edge, session, events, sender));
        Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
    }

    async fn map(&self, request: Request<pb::FleetSoilRequest>) -> Result<Response<pb::FleetSoilMap>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "fleet_soil");
        // Every member of the fleet reads what the fleet has learned.
        self.0.access.caller(&request)?;
        let (cell_m, cells) = self.0.engine.fleet_soil(&request.get_ref().map_id, self.0.budget(&request)).await.map_err(to_status)?;
        Ok(Response::new(fleet_soil_map(cell_m, &cells)))
    }
}

/// Sends the changes of one session until it closes, the watcher leaves or the server stops.
async fn forward(
    edge: Edge,
    session: String,
    mut events: broadcast::Receiver<Event>,
    sender: mpsc::Sender<Result<pb::SoilEstimate, Status>>,
) {
    let stop = stopped(edge.stopping.clone());
    tokio::pin!(stop);
    loop {
        let event = tokio::select! {
            event = events.recv() => event,
            () = sender.closed() => return,
            () = &mut stop => {
                let _ = sender.send(Err(Status::unavailable(EngineError::Stopped.to_string()))).await;
                return;
            }
        };
        let soil = match event {
            Ok(Event::SoilChanged { session: changed, soil, .. }) if changed == session => *soil,
            Ok(Event::SessionClosed { session: closed, .. }) if closed == session => return,
            Ok(_) => continue,
            // Too slow a watcher misses changes in between, never the newest.
            Err(RecvError::Lagged(_)) => match edge.engine.get(&session, edge.stream_budget()).await {
                Ok(view) => view.soil,
                Err(_) => return,
            },
            Err(RecvError::Closed) => return,
        };
        if sender.send(Ok(soil_estimate(&session, &soil))).await.is_err() {
            return;
        }
    }
}
