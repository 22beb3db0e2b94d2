//! World maps for the page: what they are as JSON, their layers as bytes, thinned to what a screen shows.

use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use nesam_engine::EngineError;
use nesam_terrain::WorldMap;
use serde_json::json;

use crate::http::HttpState;

/// Most cells along an edge.
const EDGE_MAX: usize = 640;
/// Elevation that means a hole.
const HOLE: u16 = u16::MAX;
const WAIT: Duration = Duration::from_secs(5);

/// Every how many cells one is taken, and how many there are then.
fn thinned(map: &WorldMap) -> (usize, [usize; 2]) {
    let geometry = map.geometry();
    let every = geometry.width.max(geometry.height).div_ceil(EDGE_MAX).max(1);
    (every, [geometry.width.div_ceil(every), geometry.height.div_ceil(every)])
}

/// Columns and rows that are taken, row 0 in the south, as indices of a layer.
fn cells(map: &WorldMap) -> impl Iterator<Item = usize> {
    let (every, [columns, rows]) = thinned(map);
    let width = map.geometry().width;
    (0..rows).flat_map(move |row| (0..columns).map(move |column| row * every * width + column * every))
}

fn range(heights: &[f32]) -> [f32; 2] {
    let finite = heights.iter().filter(|h| h.is_finite());
    let [low, high] = finite.fold([f32::INFINITY, f32::NEG_INFINITY], |[l, h], z| [l.min(*z), h.max(*z)]);
    if low <= high { [low, high] } else { [0.0, 0.0] }
}

async fn map_of(state: &HttpState, id: &str) -> Result<Arc<WorldMap>, Response> {
    state.edge.engine.get_map(id, WAIT).await.map_err(|error| {
        let code = match error {
            EngineError::UnknownMap { .. } => StatusCode::NOT_FOUND,
            _ => StatusCode::SERVICE_UNAVAILABLE,
        };
        (code, error.to_string()).into_response()
    })
}

/// Size, place and heights of a map.
pub(crate) async fn description(State(state): State<HttpState>, Path(id): Path<String>) -> Response {
    let map = match map_of(&state, &id).await {
        Ok(map) => map,
        Err(refusal) => return refusal,
    };
    let (every, [columns, rows]) = thinned(&map);
    let geometry = map.geometry();
    let classes: Vec<_> = map.soil_classes().iter().map(|c| json!({"name": c.name, "colour": c.colour})).collect();
    Json(json!({
        "id": map.id(),
        "version": map.version(),
        "origin_m": geometry.origin_m,
        "resolution_m": geometry.resolution_m * every as f64,
        "columns": columns,
        "rows": rows,
        "height_range_m": range(&map.elevation_m()),
        "semantics": map.has_semantics(),
        "classes": classes,
    }))
    .into_response()
}

fn bytes(body: Vec<u8>) -> Response {
    ([(header::CONTENT_TYPE, "application/octet-stream"), (header::CACHE_CONTROL, "no-cache")], body).into_response()
}

/// Heights as 16-bit little-endian shares of the range, row 0 in the south; 65535 is a hole.
pub(crate) async fn elevation(State(state): State<HttpState>, Path(id): Path<String>) -> Response {
    match map_of(&state, &id).await {
        Ok(map) => bytes(heights(&map)),
        Err(refusal) => refusal,
    }
}

fn heights(map: &WorldMap) -> Vec<u8> {
    let layer = map.elevation_m();
    let [low, high] = range(&layer);
    let span = (high - low).max(f32::MIN_POSITIVE);
    let share = |z: f32| if z.is_finite() { ((z - low) / span * f32::from(HOLE - 1)).round() as u16 } else { HOLE };
    cells(map).flat_map(|at| share(layer[at]).to_le_bytes()).collect()
}

/// Colours as red, green, blue, row 0 in the south; empty without semantics.
pub(crate) async fn semantics(State(state): State<HttpState>, Path(id): Path<String>) -> Response {
    match map_of(&state, &id).await {
        Ok(map) => bytes(map.semantic_rgb().map_or(Vec::new(), |layer| cells(&map).flat_map(|at| layer[at]).collect())),
        Err(refusal) => refusal,
    }
}

#[cfg(test)]
mod tests {
    use nesam_terrain::GridGeometry;

    use super::*;

    #[test]
    fn analytic_thinned_heights_are_those_of_their_cells() {
        let (width, height) = (1000, 3);
        let mut layer: Vec<f32> = (0..width * height).map(|i| (i % width) as f32 / 999.0).collect();
        layer[0] = f32::NAN;
        let geometry = GridGeometry { origin_m: [0.0, 0.0], resolution_m: 0.1, width, height };
        let map = WorldMap::from_layers("m", 1, geometry, layer, None).expect("the layers fit");
        assert_eq!(thinned(&map), (2, [500, 2]));
        let bytes = heights(&map);
        let value = |i: usize| u16::from_le_bytes([bytes[2 * i], bytes[2 * i + 1]]);
        assert_eq!((bytes.len(), value(0)), (2 * 500 * 2, HOLE));
        let middle = f32::from(value(250)) / f32::from(HOLE - 1);
        let [low, high] = range(&map.elevation_m());
        assert!((low + middle * (high - low) - 500.0 / 999.0).abs() < 1e-4, "{middle}");
    }
}
