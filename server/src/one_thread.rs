//! The same services over connections that somebody else makes, on one thread: for simulations of networks, crashes and time.

use std::sync::Arc;
use std::time::Duration;

use nesam_engine::EngineHandle;
use nesam_model::Predictor;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{broadcast, watch};
use tokio_stream::Stream;
use tonic::transport::server::Connected;
use tonic_health::server::HealthReporter;

use crate::access::Access;
use crate::call::EngineClient;
use crate::clock::MonotonicClock;
use crate::config::Config;
use crate::error::ServerError;
use crate::expiry::expire_sessions;
use crate::grpc::Edge;
use crate::serve::{EVENTS_KEPT, ended, engine_of, event_sink, router};
use crate::store::{Keeper, SessionStore, restore};
use crate::telemetry::Metrics;
use crate::web::Live;

/// Serves gRPC on the calling task and those that it spawns, over `connections` until they end, with the sessions of `store`. Dropping it is a crash.
///
/// Everything is as in [`serve`](crate::serve) but threads: a command is executed by the task that submits it, the store is written by a task, and time is that of
/// tokio. HTTP, Zenoh, TLS, recordings and clusters are left out, whatever the configuration says.
///
/// # Errors
/// `ServerError` naming the configuration key at fault, or what the store holds that cannot be used.
pub async fn serve_on_one_thread<C>(
    config: Config,
    predictor: Arc<Predictor>,
    connections: impl Stream<Item = std::io::Result<C>>,
    store: Box<dyn SessionStore>,
) -> Result<(), ServerError>
where
    C: AsyncRead + AsyncWrite + Connected<ConnectInfo: Clone + Send + Sync> + Unpin + Send + 'static,
{
    config.check()?;
    let (events, _) = broadcast::channel(EVENTS_KEPT);
    let (metrics, access) = (Arc::new(Metrics::default()), Access::default());
    let keeper = Arc::new(Keeper::new(Duration::from_secs_f64(config.store.interval_s)));
    let (live, _) = Live::new(&config.http);
    let sink = event_sink(events.clone(), metrics.clone(), Some(keeper.clone()), access.directory.clone(), live.feed);
    let handle = EngineHandle::unthreaded(engine_of(&config, &predictor, sink)?, Arc::new(MonotonicClock::default()), None);
    let failed = |source| ServerError::Store { source };
    let restored = restore(&store.load().map_err(failed)?, &handle, keeper.soil_of()).map_err(failed)?;
    tokio::spawn(keeper.clone().keep(store, handle.clone(), restored));
    // Nobody says that it stops: it ends with its connections.
    let (_stop, stopping) = watch::channel(false);
    let engine = EngineClient::new(handle, metrics, access.directory.clone());
    let edge = Edge { keeper: Some(keeper), ..Edge::alone(engine, predictor, config.grpc, access, events, stopping) };
    tokio::spawn(expire_sessions(edge.clone()));
    ended(router(&edge, &HealthReporter::new()).serve_with_incoming(connections)).await;
    Ok(())
}
