//! The live page: map, vehicles, rollouts, soil, consistency, latency, alarms, diagnoses; static files inside the binary and a stream of updates.
//!
//! ```text
//! EngineClient ── answers as they pass ──► Feed (bounded, lossy) ──► Painter (own thread, 8 Hz) ──► broadcast (lossy) ──► pages, server-sent events
//! ```

mod alarms;
mod feed;
mod frame;
mod live;
mod notes;
mod painter;
mod reports;
mod terrain;

use axum::Router;
use axum::http::header;
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;

pub(crate) use alarms::Raised;
pub(crate) use feed::Feed;
pub(crate) use live::Live;
pub use reports::shown_reports;

use crate::http::HttpState;

/// What the page may load: itself, and nothing from elsewhere.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const JS: &str = "text/javascript; charset=utf-8";

/// Path, type and text of every file of the page.
static ASSETS: [(&str, &str, &str); 8] = [
    ("/", HTML, include_str!("assets/index.html")),
    ("/live.css", CSS, include_str!("assets/live.css")),
    ("/live.js", JS, include_str!("assets/live.js")),
    ("/store.js", JS, include_str!("assets/store.js")),
    ("/map.js", JS, include_str!("assets/map.js")),
    ("/ground.js", JS, include_str!("assets/ground.js")),
    ("/plots.js", JS, include_str!("assets/plots.js")),
    ("/panels.js", JS, include_str!("assets/panels.js")),
];

/// Routes of the page.
pub(crate) fn routes() -> Router<HttpState> {
    let files =
        ASSETS.iter().fold(Router::new(), |router, (path, kind, text)| router.route(path, get(move || async move { asset(kind, text) })));
    files
        .route("/live/events", get(live::events))
        .route("/live/map/{id}", get(terrain::description))
        .route("/live/map/{id}/elevation", get(terrain::elevation))
        .route("/live/map/{id}/semantics", get(terrain::semantics))
}

fn asset(kind: &'static str, text: &'static str) -> Response {
    let headers = [
        (header::CONTENT_TYPE, kind),
        (header::CACHE_CONTROL, "no-cache"),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
    ];
    (headers, text).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn property_the_page_loads_nothing_from_elsewhere() {
        for (path, _, text) in ASSETS {
            let text = text.replace("http://www.w3.org/", "");
            for outside in ["http://", "https://", "@import", "eval("] {
                assert!(!text.contains(outside), "{path} has `{outside}`");
            }
        }
        let imported = |text: &str, path: &str| text.contains(&format!("\"{path}\"")) || text.contains(&format!("\".{path}\""));
        for (path, ..) in ASSETS.iter().filter(|(path, ..)| *path != "/") {
            assert!(ASSETS.iter().any(|(_, _, text)| imported(text, path)), "nothing loads {path}");
        }
    }
}
