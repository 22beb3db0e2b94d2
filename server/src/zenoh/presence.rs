//! Who is there: liveliness tokens of the vehicles, the token and the status of this server.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ::zenoh::sample::{Sample, SampleKind};
use nesam_engine::check_name;
use nesam_proto::v1 as pb;
use tokio::sync::{Notify, mpsc};

use super::neighbours::Neighbours;
use super::{Outgoing, encode, keys};
use crate::convert::{alarm_message, effect_messages};
use crate::grpc::Edge;

/// Pause after a status, in which vehicles that come and go make one more and not one each.
const CHANGES_EVERY: Duration = Duration::from_millis(100);
/// Tokens that are remembered; a network that shows more is not one of vehicles.
const VEHICLES_MAX: usize = 4096;

/// Who is in the network: the vehicles whose liveliness token is there, and whom this server is connected to. Shared between Zenoh, gRPC and the metrics.
#[derive(Clone, Debug, Default)]
pub struct Presence {
    /// Routers and peers.
    pub neighbours: Neighbours,
    alive: Arc<Mutex<BTreeSet<String>>>,
    changed: Arc<Notify>,
}

impl Presence {
    /// Whether a vehicle is there.
    pub fn is_alive(&self, vehicle: &str) -> bool {
        self.alive.lock().is_ok_and(|alive| alive.contains(vehicle))
    }

    /// The vehicles that are there, by name.
    pub fn vehicles(&self) -> Vec<String> {
        self.alive.lock().map(|alive| alive.iter().cloned().collect()).unwrap_or_default()
    }

    /// Number of vehicles that are there.
    pub fn count(&self) -> usize {
        self.alive.lock().map_or(0, |alive| alive.len())
    }

    /// Nobody is seen from outside of the network.
    pub fn forget(&self) {
        self.vehicles().iter().for_each(|vehicle| self.note(vehicle, false));
        self.neighbours.forget();
    }

    fn note(&self, vehicle: &str, alive: bool) {
        // A token that no vehicle can have is none.
        if check_name("vehicle_id", vehicle).is_err() {
            return;
        }
        let Ok(mut vehicles) = self.alive.lock() else { return };
        let changed = if alive { vehicles.len() < VEHICLES_MAX && vehicles.insert(vehicle.into()) } else { vehicles.remove(vehicle) };
        drop(vehicles);
        if changed {
            tracing::info!(vehicle, alive, "vehicle token");
            self.changed.notify_one();
        }
    }
}

/// Holds the token of this server and watches those of the vehicles, including those that are there already.
pub async fn declare(
    session: &::zenoh::Session,
    fleet: &str,
    name: &str,
    presence: Presence,
) -> Result<::zenoh::liveliness::LivelinessToken, ::zenoh::Error> {
    let watcher = session.liveliness().declare_subscriber(keys::all_vehicles(fleet, "alive")).history(true);
    let watcher =
        watcher.callback(move |sample: Sample| presence.note(keys::vehicle(sample.key_expr().as_str()), sample.kind() == SampleKind::Put));
    watcher.background().await?;
    session.liveliness().declare_token(keys::of_server(fleet, name, "alive")).await
}

/// Publishes the status of this server at an interval and when a vehicle comes or goes, as long as there is a publisher: all of it for operators, and what names
/// neither sessions nor vehicles for everybody.
pub async fn publish_status(
    edge: Edge,
    presence: Presence,
    fleet: String,
    name: String,
    interval: Duration,
    sender: mpsc::Sender<Outgoing>,
) {
    let [about_key, status_key] = ["about", "status"].map(|topic| keys::of_server(&fleet, &name, topic));
    let started = Instant::now();
    let mut tick = tokio::time::interval(interval);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            _ = tick.tick() => {}
            () = presence.changed.notified() => {}
        }
        let bundle = edge.predictor.bundle();
        let about = pb::ServerStatus {
            name: name.clone(),
            uptime_s: started.elapsed().as_secs_f64(),
            bundle_name: bundle.name.clone(),
            bundle_hash: bundle.hash.clone(),
            ..Default::default()
        };
        if sender.send((about_key.clone(), encode(&about))).await.is_err() {
            return;
        }
        // An engine that is too busy to list its sessions says nothing this time.
        let Ok(views) = edge.engine.list(edge.stream_budget()).await else { continue };
        let sessions = views.iter().map(|view| pb::SessionStatus {
            session_id: view.session.clone(),
            vehicle_id: view.vehicle.clone(),
            last_stamp_ns: view.last_stamp_ns,
            history_epoch: view.provenance.history_epoch,
            soil_epoch: view.provenance.soil_epoch,
            vehicle_alive: presence.is_alive(&view.vehicle),
            effects: effect_messages(&view.effects),
            alarm: view.alarm.as_ref().map(|alarm| alarm_message(&view.session, &view.vehicle, alarm)),
        });
        let status = pb::ServerStatus { sessions: sessions.collect(), vehicles_alive: presence.vehicles(), ..about };
        if sender.send((status_key.clone(), encode(&status))).await.is_err() {
            return;
        }
        tokio::time::sleep(CHANGES_EVERY).await;
    }
}
