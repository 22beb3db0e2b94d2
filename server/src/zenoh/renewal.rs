//! A bus that joins the network anew when its certificates or the rights of the fleet change, as Zenoh reads both only then.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{oneshot, watch};
use tokio::task::JoinHandle;

use super::{Bus, BusConfig, Presence};
use crate::access::TlsFiles;
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
    pub async fn start(config: BusConfig, edge: Edge, changes: Option<watch::Receiver<Arc<TlsFiles>>>) -> Result<Self, ServerError> {
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
    async fn renew(self, bus: Bus, mut changes: Option<watch::Receiver<Arc<TlsFiles>>>, mut stopped: oneshot::Receiver<()>) {
        let mut joined = Some(bus);
        let (mut due, mut said) = (false, false);
        loop {
            tokio::select! {
                _ = &mut stopped => break,
                () = changed(&mut changes) => due = true,
                () = tokio::time::sleep(RETRY_AFTER), if due => {}
            }
            // Zenoh reads the files itself: it is not left for files that it could not join with.
            let sound = self.reads_what_is_in_force(&changes).await;
            if !sound && joined.is_some() {
                if !said {
                    tracing::error!(target: "nesam::audit", "rights have changed, but the files of `[tls]` cannot be used: zenoh is joined anew once they can be");
                }
                said = true;
                continue;
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
            (due, said) = (joined.is_none(), false);
        }
        if let Some(bus) = joined {
            bus.stop().await;
        }
    }

    /// Whether the files hold what is in force.
    async fn reads_what_is_in_force(&self, changes: &Option<watch::Receiver<Arc<TlsFiles>>>) -> bool {
        let Some(in_force) = changes.as_ref().map(|files| files.borrow().clone()) else { return true };
        let config = self.config.tls.clone();
        let read = tokio::task::spawn_blocking(move || TlsFiles::read(&config));
        read.await.is_ok_and(|files| files.is_ok_and(|files| files == *in_force))
    }
}

/// Resolves at the next change; never where nothing can change any more.
async fn changed(changes: &mut Option<watch::Receiver<Arc<TlsFiles>>>) {
    if let Some(receiver) = changes
        && receiver.changed().await.is_ok()
    {
        return;
    }
    *changes = None;
    std::future::pending().await
}
