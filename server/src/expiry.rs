//! Closing sessions that nobody uses any more.

use std::time::Duration;

use crate::grpc::{Edge, stopped};

/// Looks for idle sessions this often within the idle time, so that none stays a quarter longer than configured.
const LOOKS_PER_IDLE_TIME: f64 = 4.0;
/// Longest and shortest time between two looks, s.
const LOOK_EVERY_S: (f64, f64) = (0.05, 60.0);

/// Asks the engine to close idle sessions, again and again until the server stops. Time comes from here, as the engine has no clock to wake it.
pub(crate) async fn expire_sessions(edge: Edge) {
    let idle_s = edge.engine.handle().limits().session_idle_s;
    let mut looks = tokio::time::interval(Duration::from_secs_f64((idle_s / LOOKS_PER_IDLE_TIME).clamp(LOOK_EVERY_S.0, LOOK_EVERY_S.1)));
    looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let stop = stopped(edge.stopping.clone());
    tokio::pin!(stop);
    loop {
        tokio::select! {
            _ = looks.tick() => {}
            () = &mut stop => return,
        }
        match edge.engine.expire(edge.stream_budget()).await {
            Ok(sessions) => sessions.iter().for_each(|session| tracing::info!(session, idle_s, "idle session closed")),
            Err(error) => tracing::warn!(%error, "idle sessions not looked for"),
        }
    }
}
