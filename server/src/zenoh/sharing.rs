//! The soil map of the fleet on several servers: each tells the others what was brought to it, on `.../server/<server>/soil_map`.
//!
//! A cell that changed is published at once. What a server missed, because it was not there yet or a message was lost, it asks for: at the start and after
//! `fleet_soil.exchange_s` again. The answer holds what others have told too, so what was brought to a server that died is not lost with it.

use std::sync::Arc;
use std::time::Duration;

use ::zenoh::query::QueryTarget;
use nesam_engine::{Command, EngineError, FleetCell, FleetShare};
use nesam_proto::v1 as pb;

use super::{decode, encode, keys};
use crate::convert::SoilTeller;
use crate::grpc::Edge;
use crate::telemetry::Transport;

/// Largest message of another server, bytes: a hundred thousand cells.
const SHARES_BYTES_MAX: usize = 64 << 20;
/// Cells that the engine takes in one command, few enough that a measurement does not wait for long.
const CELLS_AT_ONCE: usize = 512;
/// Wait for the answers of the other servers.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);

/// The exchange with the other servers of a fleet.
#[derive(Clone)]
pub struct Sharing {
    edge: Edge,
    /// Key of this server.
    key: Arc<str>,
    soil: Arc<SoilTeller>,
}

impl Sharing {
    /// Of the server that holds a name in a fleet.
    pub fn new(edge: &Edge, fleet: &str, name: &str) -> Self {
        let key = keys::of_server(fleet, name, "soil_map").into();
        Self { edge: edge.clone(), key, soil: SoilTeller::new(edge.run, &edge.predictor.bundle().hash).into() }
    }

    /// Listens to the other servers and answers them; returns what asks them, to be run for as long as this server is in the network.
    pub async fn declare(
        &self,
        session: &::zenoh::Session,
        fleet: &str,
        every: Duration,
    ) -> Result<impl Future<Output = ()> + Send + use<>, ::zenoh::Error> {
        let all = keys::of_server(fleet, "*", "soil_map");
        let hearer = self.clone();
        session.declare_subscriber(all.as_str()).callback(move |sample| hearer.hear(&sample.payload().to_bytes())).background().await?;
        let teller = self.clone();
        let runtime = tokio::runtime::Handle::current();
        let queryable = session.declare_queryable(&*self.key).callback(move |query| {
            teller.edge.engine.metrics().request(Transport::Zenoh, "soil_map");
            runtime.spawn(teller.clone().answer(query));
        });
        queryable.background().await?;
        let (asker, session) = (self.clone(), session.clone());
        Ok(async move {
            loop {
                asker.ask(&session, &all).await;
                tokio::time::sleep(every).await;
            }
        })
    }

    /// The message that tells of a cell that changed here.
    pub fn changed(&self, cell_m: f64, own: &FleetCell) -> (String, Vec<u8>) {
        (self.key.to_string(), encode(&self.soil.tell_cell(cell_m, own)))
    }

    async fn answer(self, query: ::zenoh::query::Query) {
        let Ok((cell_m, shares)) = self.edge.engine.fleet_shares(self.edge.stream_budget()).await else { return };
        // The asker's key may name all servers; the answer comes from this one.
        let answered = query.reply(&*self.key, encode(&self.soil.tell(cell_m, &shares))).await;
        if let Err(error) = answered {
            tracing::warn!(%error, "the soil map was not told");
        }
    }

    async fn ask(&self, session: &::zenoh::Session, all: &str) {
        let replies = match session.get(all).target(QueryTarget::All).timeout(ANSWER_WITHIN).await {
            Ok(replies) => replies,
            Err(error) => return tracing::warn!(%error, "the other servers were not asked for their soil maps"),
        };
        while let Ok(reply) = replies.recv_async().await {
            if let Ok(sample) = reply.result() {
                self.hear(&sample.payload().to_bytes());
            }
        }
    }

    /// Hands over to the engine what another server tells. Runs on threads of Zenoh too.
    fn hear(&self, payload: &[u8]) {
        match self.heard(payload) {
            Ok(commands) => {
                for command in commands {
                    let submission = self.edge.engine.submission(command, |answer| {
                        if let Err(error) = answer.result {
                            tracing::warn!(%error, "what another server tells of the soil was not taken");
                        }
                    });
                    self.edge.engine.handle().submit(submission);
                }
            }
            Err(error) => tracing::warn!(%error, "what another server tells of the soil was not taken"),
        }
    }

    /// The commands that take it, short ones, so that none holds up a measurement; none if there is nothing in it for this server.
    fn heard(&self, payload: &[u8]) -> Result<Vec<Command>, EngineError> {
        let message: pb::FleetSoilShares = decode("nesam.v1.FleetSoilShares", payload, SHARES_BYTES_MAX)?;
        let cell_m = message.cell_m;
        let command = |service: &str, cells: &[FleetCell]| Command::HearFleetSoil {
            cell_m,
            shares: vec![FleetShare { service: service.into(), cells: cells.to_vec() }],
        };
        let shares = self.soil.hear(&message)?;
        let parts = shares.iter().flat_map(|share| share.cells.chunks(CELLS_AT_ONCE).map(|cells| (share.service.as_str(), cells)));
        Ok(parts.map(|(service, cells)| command(service, cells)).collect())
    }
}
