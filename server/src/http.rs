//! HTTP: `/metrics` for Prometheus, `/status` as JSON, `/health` for load balancers, and the pages of `web`.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use axum::{Json, Router};
use serde_json::json;

use crate::access::Refusals;
use crate::clock::MonotonicClock;
use crate::cluster::{Cluster, ClusterCounts};
use crate::grpc::Edge;
use crate::recording::Recorder;
use crate::store::StoreCounts;
use crate::web::Live;
use crate::zenoh::{Neighbours, Presence};

/// What the HTTP side reads.
#[derive(Clone)]
pub(crate) struct HttpState {
    pub edge: Edge,
    pub clock: MonotonicClock,
    pub recorder: Option<Arc<Recorder>>,
    pub live: Live,
}

const STATUS_DEADLINE: Duration = Duration::from_secs(5);

/// The router.
pub(crate) fn router(state: HttpState) -> Router {
    Router::new()
        .route("/metrics", get(metrics))
        .route("/status", get(status))
        .route("/health", get(health))
        .merge(crate::web::routes())
        .with_state(state)
}

/// `/health` alone.
pub(crate) fn health_router(edge: Edge) -> Router {
    Router::new().route("/health", get(async move || health_of(&edge)))
}

async fn metrics(State(state): State<HttpState>) -> Response {
    let (commands, predictions) = state.edge.engine.handle().waiting();
    let mut text = state.edge.engine.metrics().render(commands, predictions);
    text += &metric("nesam_uptime_seconds", "gauge", "Time since the start.", state.clock.elapsed().as_secs_f64());
    if let Some(recorder) = &state.recorder {
        let counts = recorder.counts();
        for (name, help, value) in [
            ("commands", "Commands in the file of the recording; those of the last half second are not counted yet.", counts.recorded),
            (
                "dropped_commands",
                "Commands missing in the recording because the disk could not follow or a limit was reached.",
                counts.dropped,
            ),
            ("bytes", "Bytes written to the recording.", counts.bytes),
        ] {
            text += &metric(&format!("nesam_recording_{name}_total"), "counter", help, value);
        }
        let help = "1 when nothing is recorded any more: the disk failed or a limit is reached.";
        text += &metric("nesam_recording_ended", "gauge", help, u8::from(counts.ended));
    }
    if let Some(keeper) = &state.edge.keeper {
        text += &store_metrics(&keeper.counts());
    }
    text += &refusal_metrics(&state.edge.access.refusals);
    let sessions = state.edge.access.directory.count();
    text += &metric("nesam_sessions", "gauge", "Open sessions.", sessions);
    // A server that is alone owns whatever it has.
    let alone = ClusterCounts { leased: true, held: sessions, ..Default::default() };
    text += &cluster_metrics(&state.edge.cluster.as_ref().map_or(alone, Cluster::counts));
    let alive = state.edge.presence.as_ref().map_or(0, Presence::count);
    text += &metric("nesam_vehicles_alive", "gauge", "Vehicles whose Zenoh liveliness token is there.", alive);
    text += &neighbour_metrics(&state.edge.presence.map_or_else(Neighbours::default, |presence| presence.neighbours));
    ([("content-type", "text/plain; version=0.0.4; charset=utf-8")], text).into_response()
}

fn store_metrics(counts: &StoreCounts) -> String {
    let StoreCounts { commits, failures, bytes, commit_s, waiting, oldest_s, set_aside } = *counts;
    [
        ("commits_total", "counter", "Commits of sessions and maps to the store.", commits as f64),
        ("failures_total", "counter", "Commits that the store did not take; they are tried again.", failures as f64),
        ("bytes_total", "counter", "Bytes of sessions and maps committed.", bytes as f64),
        ("commit_seconds_total", "counter", "Time of all commits together.", commit_s),
        ("waiting", "gauge", "Sessions and maps that are not durable yet.", waiting as f64),
        ("set_aside", "gauge", "Sessions of the store that the server could not read at its start; the log names them.", set_aside as f64),
        ("oldest_waiting_seconds", "gauge", "Time for which the oldest change that is not durable has waited; 0 = none waits.", oldest_s),
    ]
    .map(|(name, kind, help, value)| metric(&format!("nesam_store_{name}"), kind, help, value))
    .concat()
}

fn neighbour_metrics(neighbours: &Neighbours) -> String {
    let name = "nesam_zenoh_neighbours";
    let lines = neighbours.counts().map(|(kind, count)| format!("{name}{{kind=\"{kind}\"}} {count}\n")).concat();
    let help = "1 while `zenoh.connect` names somebody and no router or peer is connected.";
    let alone = metric("nesam_zenoh_alone", "gauge", help, u8::from(neighbours.is_alone()));
    format!("# HELP {name} Zenoh routers and peers that this server is connected to.\n# TYPE {name} gauge\n{lines}{alone}")
}

/// Each from the start, so that the first one is an increase.
fn refusal_metrics(refusals: &Refusals) -> String {
    let name = "nesam_refusals_total";
    let lines = refusals.counts().map(|(reason, count)| format!("{name}{{reason=\"{reason}\"}} {count}\n")).concat();
    format!("# HELP {name} What was refused for want of a certificate, an identity or a right.\n# TYPE {name} counter\n{lines}")
}

/// One metric without labels, as Prometheus reads it.
fn metric(name: &str, kind: &str, help: &str, value: impl core::fmt::Display) -> String {
    format!("# HELP {name} {help}\n# TYPE {name} {kind}\n{name} {value}\n")
}

fn cluster_metrics(counts: &ClusterCounts) -> String {
    let ClusterCounts { held, taken, handed_over, lost, leased, others, other_bundles } = *counts;
    [
        ("sessions", "gauge", "Sessions whose owner this server is.", held as u64),
        ("taken_total", "counter", "Sessions that came from another server.", taken),
        ("handed_over_total", "counter", "Sessions that another server asked for.", handed_over),
        ("lost_total", "counter", "Sessions lost with the lease or to another server.", lost),
        ("leased", "gauge", "Whether this server may answer for its sessions: 1 while etcd hears it.", u64::from(leased)),
        ("servers", "gauge", "Servers that share sessions, this one among them.", others as u64 + 1),
        (
            "other_bundles",
            "gauge",
            "Servers that share sessions and answer with another bundle, to and from which no session can move.",
            other_bundles as u64,
        ),
    ]
    .map(|(name, kind, help, value)| metric(&format!("nesam_cluster_{name}"), kind, help, value))
    .concat()
}

async fn health(State(state): State<HttpState>) -> StatusCode {
    health_of(&state.edge)
}

/// Whether requests should come here: not while the server stops, and not without a lease.
fn health_of(edge: &Edge) -> StatusCode {
    let leased = edge.cluster.as_ref().is_none_or(Cluster::is_leased);
    if *edge.stopping.borrow() || !leased { StatusCode::SERVICE_UNAVAILABLE } else { StatusCode::OK }
}

async fn status(State(state): State<HttpState>) -> Response {
    let sessions = match state.edge.engine.list(STATUS_DEADLINE).await {
        Ok(sessions) => sessions,
        Err(error) => return (StatusCode::SERVICE_UNAVAILABLE, error.to_string()).into_response(),
    };
    let bundle = state.edge.predictor.bundle();
    let (commands, predictions) = state.edge.engine.handle().waiting();
    let sessions: Vec<_> = sessions
        .iter()
        .map(|s| {
            json!({
                "session": s.session,
                "vehicle": s.vehicle,
                "map": s.provenance.map.as_ref().map(|(id, version, _)| json!({"id": id, "version": version})),
                "history_steps": s.history_steps,
                "history_epoch": s.provenance.history_epoch,
                "soil_epoch": s.provenance.soil_epoch,
                "vehicle_alive": state.edge.presence.as_ref().map(|presence| presence.is_alive(&s.vehicle)),
                "position_m": s.newest.as_ref().map(|n| n.state.position_m),
            })
        })
        .collect();
    let body = json!({
        "schema": "nesam.status/1",
        "version": env!("CARGO_PKG_VERSION"),
        "uptime_s": state.clock.elapsed().as_secs_f64(),
        "bundle": {"name": bundle.name, "hash": bundle.hash, "vehicle": bundle.vehicle.name},
        "waiting": {"commands": commands, "predictions": predictions},
        "predictions": state.edge.engine.metrics().predictions(),
        "recording": state.recorder.as_ref().map(|recorder| {
            let counts = recorder.counts();
            json!({"files": recorder.parts(), "commands": counts.recorded, "dropped_commands": counts.dropped, "bytes": counts.bytes, "ended": counts.ended})
        }),
        "sessions": sessions,
    });
    Json(body).into_response()
}
