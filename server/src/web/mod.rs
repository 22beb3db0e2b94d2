//! Pages for people. The live page is served from here; for now there is a pointer to what exists.

use axum::Router;
use axum::response::Html;
use axum::routing::get;

const INDEX: &str = "<!doctype html><meta charset=utf-8><title>nesam</title>\
<h1>nesam</h1><ul><li><a href=\"/status\">status</a> (JSON)<li><a href=\"/metrics\">metrics</a> (Prometheus)</ul>\n";

/// Routes of the pages.
pub fn routes<S: Clone + Send + Sync + 'static>() -> Router<S> {
    Router::new().route("/", get(|| async { Html(INDEX) }))
}
