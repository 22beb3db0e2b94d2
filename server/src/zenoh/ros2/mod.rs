//! Machines that speak ROS 2 with rmw_zenoh, without a bridge between: their odometry and commands are measurements ([`machine`], [`reading`]), and they hear of
//! the soil and of how the service is in standard messages ([`telling`]). This server is a node of their graph.

mod machine;
mod reading;
mod telling;

use std::sync::Arc;

use ::zenoh::liveliness::LivelinessToken;
use ::zenoh::sample::{Sample, SampleKind};
use nesam_engine::EngineError;
use nesam_ros2::graph::{End, Node};
use nesam_ros2::messages::{MessageType, ODOMETRY};

use self::machine::Machine;
pub use self::telling::DIAGNOSTICS;
use crate::config::{Ros2Config, Ros2Vehicle};
use crate::grpc::Edge;

/// This server in the graph of ROS 2. Dropping it leaves the graph.
pub struct Graph {
    telling: tokio::task::JoinHandle<()>,
    _tokens: Vec<LivelinessToken>,
}

impl Drop for Graph {
    fn drop(&mut self) {
        self.telling.abort();
    }
}

/// Joins the graph: subscribes to the topics of the machines, and tells them what is known.
pub async fn join(session: &::zenoh::Session, config: &Ros2Config, edge: &Edge) -> Result<Graph, ::zenoh::Error> {
    let node = Node { domain: config.domain(), session: session.zid().to_string(), name: config.node.clone() };
    let mut joining = Joining { session, tokens: vec![session.liveliness().declare_token(node.token()).await?], node };
    let machines: Vec<Arc<Machine>> = config.vehicles.iter().map(|vehicle| Arc::new(Machine::new(vehicle.clone(), config, edge))).collect();
    for machine in &machines {
        let Ros2Vehicle { vehicle, .. } = &machine.config;
        let (odometry, command) = (machine.config.odometry_topic(), machine.config.command_topic());
        // First what it is told: the first odometry comes with a command then.
        joining.subscribe(&command, machine.kind.message(), machine.clone(), Machine::told).await?;
        joining.subscribe(&odometry, ODOMETRY, machine.clone(), Machine::moved).await?;
        tracing::info!(vehicle, odometry, command, "machine of ROS 2 listened to");
    }
    let telling = telling::Telling::declare(&mut joining, edge.clone(), config, machines).await?;
    Ok(Graph { telling, _tokens: joining.tokens })
}

/// A node that is being built up.
struct Joining<'a> {
    session: &'a ::zenoh::Session,
    node: Node,
    tokens: Vec<LivelinessToken>,
}

impl Joining<'_> {
    async fn subscribe(
        &mut self,
        topic: &str,
        kind: MessageType,
        machine: Arc<Machine>,
        hear: fn(&Arc<Machine>, Result<&[u8], EngineError>),
    ) -> Result<(), ::zenoh::Error> {
        let subscriber = self.session.declare_subscriber(self.node.domain.key_of_any_version(topic, kind));
        let subscriber = subscriber.callback(move |sample: Sample| match sample.kind() {
            SampleKind::Put if sample.payload().len() > super::MEASUREMENT_BYTES_MAX => {
                let reason =
                    format!("a message of {} bytes is above the limit of {}", sample.payload().len(), super::MEASUREMENT_BYTES_MAX);
                hear(&machine, Err(EngineError::invalid("", reason)));
            }
            SampleKind::Put => hear(&machine, Ok(&sample.payload().to_bytes())),
            SampleKind::Delete => {}
        });
        subscriber.background().await?;
        self.announce(End::Subscription, topic, kind).await.map(drop)
    }

    /// Shows one end of a topic in the graph; gives its token.
    async fn announce(&mut self, end: End, topic: &str, kind: MessageType) -> Result<String, ::zenoh::Error> {
        let number = u32::try_from(self.tokens.len()).expect("a configuration has not so many machines; this is a bug");
        let token = self.node.end_token(number, end, topic, kind);
        self.tokens.push(self.session.liveliness().declare_token(token.clone()).await?);
        Ok(token)
    }
}
