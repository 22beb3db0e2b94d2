//! nesam.v1.Soil.

use nesam_engine::Event;
use nesam_proto::v1 as pb;
use tonic::{Request, Response, Status};

use super::news::{News, tell};
use super::{Edge, ReplyStream};
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
        let news = News {
            of_event: |session, event| match event {
                Event::SoilChanged { session: changed, soil, provenance, .. } if changed == session => {
                    Some(soil_estimate(session, &soil, &provenance))
                }
                _ => None,
            },
            of_session: |session, view| Some(soil_estimate(session, &view.soil, &view.provenance)),
        };
        tell(edge, &request, request.get_ref().session_id.clone(), news).await
    }

    async fn map(&self, request: Request<pb::FleetSoilRequest>) -> Result<Response<pb::FleetSoilMap>, Status> {
        self.0.engine.metrics().request(Transport::Grpc, "fleet_soil");
        // Every member of the fleet reads what the fleet has learned.
        self.0.access.caller(&request)?;
        let (cell_m, cells) = self.0.engine.fleet_soil(&request.get_ref().map_id, self.0.budget(&request)).await.map_err(to_status)?;
        Ok(Response::new(fleet_soil_map(cell_m, &cells)))
    }
}
