//! Soil estimates over Zenoh: each change is published on `.../soil`.

use nesam_engine::Event;
use tokio::sync::broadcast::{self, error::RecvError};
use tokio::sync::mpsc;

use super::{Outgoing, encode, keys};
use crate::convert::soil_estimate;

/// Hands every change over to the publisher, as long as there are events and a publisher.
pub async fn publish_changes(mut events: broadcast::Receiver<Event>, fleet: String, sender: mpsc::Sender<Outgoing>) {
    loop {
        match events.recv().await {
            Ok(Event::SoilChanged { session, vehicle, soil }) => {
                let key = keys::of_vehicle(&fleet, &vehicle, "soil");
                if sender.send((key, encode(&soil_estimate(&session, &soil)))).await.is_err() {
                    return;
                }
            }
            Ok(Event::SessionClosed { .. }) => {}
            Err(RecvError::Lagged(missed)) => tracing::warn!(missed, "changes of the soil were not published"),
            Err(RecvError::Closed) => return,
        }
    }
}
