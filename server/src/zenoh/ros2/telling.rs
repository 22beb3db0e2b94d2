//! What machines are told: the soil at each change, and at an interval how well they are heard.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use ::zenoh::pubsub::Publisher;
use nesam_engine::{Event, SessionView, SoilEstimate};
use nesam_physics::{SOIL_DIM, SOIL_NAMES};
use nesam_ros2::graph::{End, attachment};
use nesam_ros2::messages::{
    DIAGNOSTIC_ARRAY, DiagnosticArray, DiagnosticStatus, Dimension, FLOAT64_MULTI_ARRAY, Float64MultiArray, Level, MessageType,
};
use sha2::{Digest as _, Sha256};
use tokio::sync::broadcast::{self, error::RecvError};

use super::Joining;
use super::machine::Machine;
use crate::clock::unix_ns;
use crate::config::Ros2Config;
use crate::grpc::Edge;

/// Topic of all diagnostics.
pub const DIAGNOSTICS: &str = "/diagnostics";
/// Rows of the soil.
const SOIL_ROWS: &str = "delta,standard_deviation,learned";

/// A topic that this server publishes on.
struct Topic {
    publisher: Publisher<'static>,
    id: [u8; 16],
    sent: AtomicI64,
}

impl Topic {
    async fn declare(joining: &mut Joining<'_>, topic: &str, kind: MessageType) -> Result<Self, ::zenoh::Error> {
        let publisher = joining.session.declare_publisher(joining.node.domain.key(topic, kind)).await?;
        let token = joining.announce(End::Publisher, topic, kind).await?;
        let mut id = [0; 16];
        id.copy_from_slice(&Sha256::digest(token)[..16]);
        Ok(Self { publisher, id, sent: AtomicI64::new(0) })
    }

    async fn send(&self, message: Vec<u8>) {
        let number = self.sent.fetch_add(1, Ordering::Relaxed) + 1;
        if let Err(error) = self.publisher.put(message).attachment(attachment(number, unix_ns(), self.id)).await {
            tracing::warn!(%error, key = %self.publisher.key_expr(), "not published");
        }
    }
}

/// Everything that is told.
pub struct Telling {
    edge: Edge,
    machines: Vec<(Arc<Machine>, Topic)>,
    diagnostics: Topic,
    interval: Duration,
}

impl Telling {
    /// Declares the topics and begins to tell.
    pub async fn declare(
        joining: &mut Joining<'_>,
        edge: Edge,
        config: &Ros2Config,
        machines: Vec<Arc<Machine>>,
    ) -> Result<tokio::task::JoinHandle<()>, ::zenoh::Error> {
        let mut with_topics = Vec::new();
        for machine in machines {
            let topic = Topic::declare(joining, &machine.config.soil_topic(), FLOAT64_MULTI_ARRAY).await?;
            with_topics.push((machine, topic));
        }
        let diagnostics = Topic::declare(joining, DIAGNOSTICS, DIAGNOSTIC_ARRAY).await?;
        let interval = Duration::from_secs_f64(config.diagnostics_interval_s);
        let events = edge.events.subscribe();
        Ok(tokio::spawn(Self { edge, machines: with_topics, diagnostics, interval }.run(events)))
    }

    async fn run(self, mut events: broadcast::Receiver<Event>) {
        let mut tick = tokio::time::interval(self.interval);
        tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                event = events.recv() => match event {
                    Ok(Event::SoilChanged { session, soil, .. }) => {
                        if let Some((_, topic)) = self.machines.iter().find(|(machine, _)| machine.config.vehicle == session) {
                            topic.send(soil_array(&soil).write()).await;
                        }
                    }
                    Ok(_) => {}
                    Err(RecvError::Lagged(missed)) => tracing::warn!(missed, "changes of the soil were not told to machines of ROS 2"),
                    Err(RecvError::Closed) => return,
                },
                _ = tick.tick() => self.tell_diagnostics().await,
            }
        }
    }

    async fn tell_diagnostics(&self) {
        let budget = self.edge.stream_budget();
        // An engine that is too busy to list its sessions says nothing of them this time.
        let views = self.edge.engine.list(budget).await.unwrap_or_default();
        let status = self.machines.iter().map(|(machine, _)| {
            status(machine, views.iter().find(|view| view.session == machine.config.vehicle), &self.edge.predictor.bundle().name)
        });
        self.diagnostics.send(DiagnosticArray { stamp_ns: unix_ns(), status: status.collect() }.write()).await;
    }
}

/// The correction of the soil prior: rows [`SOIL_ROWS`], a column for each parameter; a standard deviation is NaN while no filter runs, learned is 1 or 0.
fn soil_array(soil: &SoilEstimate) -> Float64MultiArray {
    let state = &soil.state;
    let learned = state.learned.map(|learned| f64::from(u8::from(learned)));
    let axis = |label: String, size: usize| Dimension { label, size: size as u32 };
    Float64MultiArray {
        dimensions: vec![axis(SOIL_ROWS.into(), 3), axis(SOIL_NAMES.join(","), SOIL_DIM)],
        data: [state.correction.delta, deviations(soil), learned].concat(),
    }
}

/// Standard deviations of the correction; NaN while no filter runs.
fn deviations(soil: &SoilEstimate) -> [f64; SOIL_DIM] {
    soil.state.variance.map_or([f64::NAN; SOIL_DIM], |variance| variance.map(f64::sqrt))
}

/// How a machine is.
fn status(machine: &Machine, session: Option<&SessionView>, bundle: &str) -> DiagnosticStatus {
    let heard = machine.heard();
    let (mut level, mut message) = heard.level();
    let mut values: Vec<(String, String)> = vec![("bundle".into(), bundle.into())];
    let mut add = |key: &str, value: String| values.push((key.into(), value));
    if let Some(view) = session {
        if let Some(alarm) = view.alarm.as_ref().filter(|_| level < Level::Error) {
            (level, message) = (level.max(Level::Warn), alarm.description());
        }
        add("history steps", view.history_steps.to_string());
        add("history epoch", view.provenance.history_epoch.to_string());
        add("soil epoch", view.provenance.soil_epoch.to_string());
        add("map", view.provenance.map.as_ref().map_or_else(|| "none: flat ground".into(), |(id, ..)| id.clone()));
        add("effects", view.effects.effects.iter().map(|effect| effect.id.as_str()).collect::<Vec<_>>().join(","));
        let (state, deviations) = (&view.soil.state, deviations(&view.soil));
        for (i, name) in SOIL_NAMES.iter().enumerate() {
            let told =
                if state.learned[i] { format!("{:+.4} ± {:.4}", state.correction.delta[i], deviations[i]) } else { "not learned".into() };
            add(&format!("soil {name}"), told);
        }
    }
    heard.counts().for_each(|(what, count)| add(what, count.to_string()));
    let vehicle = &machine.config.vehicle;
    DiagnosticStatus { level, name: format!("nesam: {vehicle}"), message, hardware_id: vehicle.clone(), values }
}
