//! Soil and alarms over Zenoh: each change of an estimate is published on `.../<vehicle>/soil`, each change of the map of the fleet on `.../soil_map`
//! (what this server knows) and, for the other servers, on a key of its own ([`super::sharing`]), each alarm on `.../<vehicle>/alarm`.

use nesam_engine::Event;
use tokio::sync::broadcast::{self, error::RecvError};
use tokio::sync::mpsc;

use super::sharing::Sharing;
use super::{Outgoing, encode, keys};
use crate::convert::{alarm_message, fleet_soil_map, soil_estimate};

/// Hands every change over to the publisher, as long as there are events and a publisher.
pub async fn publish_changes(
    mut events: broadcast::Receiver<Event>,
    fleet: String,
    sharing: Option<Sharing>,
    sender: mpsc::Sender<Outgoing>,
) {
    loop {
        match events.recv().await {
            Ok(Event::SoilChanged { session, vehicle, soil, provenance }) => {
                let key = keys::of_vehicle(&fleet, &vehicle, "soil");
                if sender.send((key, encode(&soil_estimate(&session, &soil, &provenance)))).await.is_err() {
                    return;
                }
            }
            Ok(Event::FleetSoilChanged { cell_m, cell, own }) => {
                let known = (keys::of_fleet(&fleet, "soil_map"), encode(&fleet_soil_map(cell_m, std::slice::from_ref(&*cell))));
                for message in [known].into_iter().chain(sharing.iter().map(|sharing| sharing.changed(cell_m, &own))) {
                    if sender.send(message).await.is_err() {
                        return;
                    }
                }
            }
            Ok(Event::AlarmChanged { session, vehicle, alarm, .. }) => {
                let key = keys::of_vehicle(&fleet, &vehicle, "alarm");
                if sender.send((key, encode(&alarm_message(&session, &vehicle, &alarm)))).await.is_err() {
                    return;
                }
            }
            Ok(_) => {}
            Err(RecvError::Lagged(missed)) => tracing::warn!(missed, "changes of the soil or alarms were not published"),
            Err(RecvError::Closed) => return,
        }
    }
}
