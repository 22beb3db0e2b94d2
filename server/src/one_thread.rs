//! The same services over connections that somebody else makes, on one thread: for simulations of networks, crashes and time.

use std::sync::Arc;
use std::time::Duration;

use nesam_engine::EngineHandle;
use nesam_model::Predictor;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{broadcast, watch};
use tokio_stream::Stream;
use tonic::transport::Channel;
use tonic::transport::server::Connected;
use tonic_health::server::HealthReporter;

use crate::access::Access;
use crate::call::EngineClient;
use crate::clock::MonotonicClock;
use crate::cluster::{Cluster, Etcd};
use crate::config::Config;
use crate::error::ServerError;
use crate::expiry::expire_sessions;
use crate::grpc::Edge;
use crate::serve::{EVENTS_KEPT, ended, engine_of, event_sink, router};
use crate::store::{EtcdStore, Keeper, Restored, SessionStore, restore};
use crate::telemetry::Metrics;
use crate::web::Live;

/// Where a server on one thread has its sessions.
pub enum Sessions {
    /// In this store, alone.
    Alone(Box<dyn SessionStore>),
    /// In etcd at the end of this channel, with other servers.
    Shared(Channel),
}

/// Serves gRPC on the calling task and those that it spawns, over `connections` until they end. Dropping it is a crash.
///
/// Everything is as in [`serve`](crate::serve) but threads: a command is executed by the task that submits it, the store is written by a task, and time is that of
/// tokio. HTTP, Zenoh, TLS and recordings are left out, whatever the configuration says.
///
/// # Errors
/// `ServerError` naming the configuration key at fault, or what the store holds that cannot be used; also when etcd does not answer.
pub async fn serve_on_one_thread<C>(
    config: Config,
    predictor: Arc<Predictor>,
    connections: impl Stream<Item = std::io::Result<C>>,
    sessions: Sessions,
) -> Result<(), ServerError>
where
    C: AsyncRead + AsyncWrite + Connected<ConnectInfo: Clone + Send + Sync> + Unpin + Send + 'static,
{
    config.check()?;
    let (events, _) = broadcast::channel(EVENTS_KEPT);
    let (metrics, access) = (Arc::new(Metrics::default()), Access::default());
    let keeper = Arc::new(Keeper::new(Duration::from_secs_f64(config.store.interval_s)));
    let (live, _) = Live::new(&config);
    let sink = event_sink(events.clone(), metrics.clone(), Some(keeper.clone()), access.directory.clone(), live.feed);
    let handle = EngineHandle::unthreaded(engine_of(&config, &predictor, sink)?, Arc::new(MonotonicClock::default()), None);
    let engine = EngineClient::new(handle.clone(), metrics, access.directory.clone());
    let cluster = match sessions {
        Sessions::Alone(store) => {
            let failed = |source| ServerError::Store { source };
            let restored = restore(&store.load().map_err(failed)?, &handle, keeper.soil_of()).map_err(failed)?;
            tokio::spawn(keeper.clone().keep(store, handle, restored));
            None
        }
        Sessions::Shared(channel) => {
            let (address, bundle) = (config.grpc.listen.to_string(), predictor.bundle());
            let cluster = Cluster::start(Etcd::over(channel), &config.cluster, (address, bundle), engine.clone(), keeper.clone()).await?;
            let store = EtcdStore::new(cluster.clone(), tokio::runtime::Handle::current());
            tokio::spawn(keeper.clone().keep(Box::new(store), handle, Restored::default()));
            Some(cluster)
        }
    };
    // Nobody says that it stops: it ends with its connections.
    let (_stop, stopping) = watch::channel(false);
    let edge = Edge { keeper: Some(keeper), cluster, ..Edge::alone(engine, predictor, config.grpc, access, events, stopping) };
    tokio::spawn(expire_sessions(edge.clone()));
    ended(router(&edge, &HealthReporter::new()).serve_with_incoming(connections)).await;
    Ok(())
}
