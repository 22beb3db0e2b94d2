//! A bus that joins the network anew when its certificates or the rights of the fleet change, as Zenoh reads both only then.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;
use tokio_rustls::rustls::ServerConfig;

use super::{Bus, BusConfig, Presence};
use crate::error::ServerError;
use crate::grpc::Edge;

/// Pause after the network could not be joined anew.
const RETRY_AFTER: Duration = Duration::from_secs(1);

/// A bus and the task that renews it.
pub(crate) struct RenewedBus {
    stop: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

/// What it takes to join.
struct Joining {
    config: BusConfig,
    edge: Edge,
}

impl RenewedBus {
    /// Joins the network, and joins it anew after each of `changes`, where the bus uses TLS.
    ///
    /// # Errors
    /// `ServerError` when it cannot be joined the first time.
    pub async fn start(config: BusConfig, edge: Edge, changes: Option<watch::Receiver<Arc<ServerConfig>>>) -> Result<Self, ServerError> {
        let bus = Bus::start(&config, &edge).await?;
        let changes = changes.filter(|_| config.zenoh.uses_tls());
        let (stop, stopped) = oneshot::channel();
        let task = tokio::spawn(Joining { config, edge }.renew(bus, changes, stopped));
        Ok(Self { stop, task })
    }

    /// Leaves the network.
    pub async fn stop(self) {
        let _ = self.stop.send(());
        if self.task.await.is_err() {
            tracing::error!("the task of the bus panicked; this is a bug");
        }
    }
}

impl Joining {
    async fn renew(self, bus: Bus, mut changes: Option<watch::Receiver<Arc<ServerConfig>>>, mut stopped: oneshot::Receiver<()>) {
        let mut joined = Some(bus);
        loop {
            tokio::select! {
                _ = &mut stopped => break,
                () = changed(&mut changes) => {}
                () = tokio::time::sleep(RETRY_AFTER), if joined.is_none() => {}
            }
            // A port belongs to one session at a time.
            if let Some(bus) = joined.take() {
                bus.stop().await;
                self.edge.presence.iter().for_each(Presence::forget);
            }
            match Bus::start(&self.config, &self.edge).await {
                Ok(bus) => {
                    tracing::info!(target: "nesam::audit", "zenoh joined anew with changed certificates or rights");
                    joined = Some(bus);
                }
                Err(error) => tracing::error!(target: "nesam::audit", %error, "zenoh is left and not joined anew; tried again"),
            }
        }
        if let Some(bus) = joined {
            bus.stop().await;
        }
    }
}

/// Resolves at the next change; never where nothing can change any more.
async fn changed(changes: &mut Option<watch::Receiver<Arc<ServerConfig>>>) {
    if let Some(receiver) = changes
        && receiver.changed().await.is_ok()
    {
        return;
    }
    *changes = None;
    std::future::pending().await
}
