//! World maps for the page: what they are as JSON, their layers as bytes, thinned to what a screen shows.

use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use bytes::Bytes;
use nesam_engine::EngineError;
use nesam_terrain::WorldMap;
use serde_json::json;
use tokio::sync::Mutex;

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

/// The lowest and the highest, m; holes do not count.
fn range(heights: &[f32]) -> [f32; 2] {
    let finite = heights.iter().filter(|h| h.is_finite());
    let [low, high] = finite.fold([f32::INFINITY, f32::NEG_INFINITY], |[l, h], z| [l.min(*z), h.max(*z)]);
    if low <= high { [low, high] } else { [0.0, 0.0] }
}

/// What a page shows of the layers of a map.
#[derive(Debug)]
struct Picture {
    /// Of the map's layers.
    hash: String,
    /// Of the heights that are shown.
    height_range_m: [f32; 2],
    /// Heights as 16-bit little-endian shares of the range, row 0 in the south; 65535 is a hole.
    elevation: Bytes,
    /// Colours as red, green, blue, row 0 in the south; empty without semantics.
    semantics: Bytes,
}

impl Picture {
    fn of(map: &WorldMap) -> Self {
        let heights: Vec<f32> = cells(map).map(|cell| map.cell_elevation_m(cell)).collect();
        let [low, high] = range(&heights);
        let span = (high - low).max(f32::MIN_POSITIVE);
        let share = |z: &f32| if z.is_finite() { ((z - low) / span * f32::from(HOLE - 1)).round() as u16 } else { HOLE };
        Self {
            hash: map.hash().into(),
            height_range_m: [low, high],
            elevation: heights.iter().flat_map(|z| share(z).to_le_bytes()).collect::<Vec<u8>>().into(),
            semantics: cells(map).filter_map(|cell| map.cell_rgb(cell)).flatten().collect::<Vec<u8>>().into(),
        }
    }
}

/// Makes pictures one at a time, on a thread of its own: the threads of the runtime serve vehicles. The last one is kept, as a page asks for its parts one after
/// the other and other pages for the same ones. Clones share it.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pictures(Arc<Mutex<Option<Arc<Picture>>>>);

impl Pictures {
    async fn of(&self, map: Arc<WorldMap>) -> Result<Arc<Picture>, Response> {
        let mut last = Arc::clone(&self.0).lock_owned().await;
        if let Some(picture) = last.as_ref().filter(|picture| picture.hash == map.hash()) {
            return Ok(Arc::clone(picture));
        }
        // The thread holds the lock, also for somebody who has left meanwhile: no second one begins beside it.
        let made = tokio::task::spawn_blocking(move || Arc::clone(last.insert(Arc::new(Picture::of(&map)))));
        made.await.map_err(|_| (StatusCode::INTERNAL_SERVER_ERROR, "the map could not be drawn; this is a bug").into_response())
    }
}

/// A map and what is shown of it.
async fn shown(state: &HttpState, id: &str) -> Result<(Arc<WorldMap>, Arc<Picture>), Response> {
    let map = state.edge.engine.get_map(id, WAIT).await.map_err(|error| {
        let code = match error {
            EngineError::UnknownMap { .. } => StatusCode::NOT_FOUND,
            _ => StatusCode::SERVICE_UNAVAILABLE,
        };
        (code, error.to_string()).into_response()
    })?;
    let picture = state.live.pictures.of(Arc::clone(&map)).await?;
    Ok((map, picture))
}

/// Size, place and heights of a map.
pub(crate) async fn description(State(state): State<HttpState>, Path(id): Path<String>) -> Result<Response, Response> {
    let (map, picture) = shown(&state, &id).await?;
    let (every, [columns, rows]) = thinned(&map);
    let geometry = map.geometry();
    let classes: Vec<_> = map.soil_classes().iter().map(|c| json!({"name": c.name, "colour": c.colour})).collect();
    let described = Json(json!({
        "id": map.id(),
        "version": map.version(),
        "origin_m": geometry.origin_m,
        "resolution_m": geometry.resolution_m * every as f64,
        "columns": columns,
        "rows": rows,
        "height_range_m": picture.height_range_m,
        "semantics": map.has_semantics(),
        "classes": classes,
    }));
    Ok(described.into_response())
}

fn bytes(body: &Bytes) -> Response {
    ([(header::CONTENT_TYPE, "application/octet-stream"), (header::CACHE_CONTROL, "no-cache")], body.clone()).into_response()
}

/// [`Picture::elevation`].
pub(crate) async fn elevation(State(state): State<HttpState>, Path(id): Path<String>) -> Result<Response, Response> {
    Ok(bytes(&shown(&state, &id).await?.1.elevation))
}

/// [`Picture::semantics`].
pub(crate) async fn semantics(State(state): State<HttpState>, Path(id): Path<String>) -> Result<Response, Response> {
    Ok(bytes(&shown(&state, &id).await?.1.semantics))
}

#[cfg(test)]
mod tests {
    use nesam_terrain::GridGeometry;

    use super::*;

    const GEOMETRY: GridGeometry = GridGeometry { origin_m: [0.0, 0.0], resolution_m: 0.1, width: 1000, height: 3 };

    /// A slope up to the east, each cell with a colour of its own; `change` is done to its heights.
    fn map(change: impl FnOnce(&mut [f32])) -> Arc<WorldMap> {
        let mut heights: Vec<f32> = (0..GEOMETRY.cells()).map(|i| (i % GEOMETRY.width) as f32 / 999.0).collect();
        change(&mut heights);
        let colours = (0..GEOMETRY.cells()).map(|i| [(i % 251) as u8, (i / 251) as u8, 7]).collect();
        Arc::new(WorldMap::from_layers("m", 1, GEOMETRY, heights, Some(colours)).expect("the layers fit"))
    }

    #[test]
    fn analytic_what_is_shown_is_what_the_cells_that_are_taken_say() {
        let map = map(|heights| heights[0] = f32::NAN);
        assert_eq!(thinned(&map), (2, [500, 2]));
        let Picture { height_range_m: [low, high], elevation, semantics, .. } = Picture::of(&map);
        let value = |i: usize| u16::from_le_bytes([elevation[2 * i], elevation[2 * i + 1]]);
        assert_eq!((elevation.len(), value(0)), (2 * 500 * 2, HOLE));
        assert_eq!((value(500), value(499), value(999)), (0, HOLE - 1, HOLE - 1), "the range is that of what is shown");
        let middle = f32::from(value(250)) / f32::from(HOLE - 1);
        assert!((low + middle * (high - low) - 500.0 / 999.0).abs() < 1e-4, "{middle}");
        // The second row that is taken is the third of the map.
        let layer = map.semantic_rgb().expect("it has colours");
        let taken = [0, 2].into_iter().flat_map(|row| (0..500).map(move |column| row * 1000 + 2 * column));
        assert_eq!(semantics, taken.flat_map(|cell| layer[cell]).collect::<Vec<u8>>());
    }

    /// On a runtime of one thread: whoever drew on it would be done when first looked at.
    #[tokio::test]
    async fn regress_maps_are_drawn_beside_the_runtime_and_once() {
        let (pictures, map) = (Pictures::default(), map(|_| ()));
        let drawn = pictures.of(Arc::clone(&map));
        tokio::pin!(drawn);
        tokio::select! {
            biased;
            _ = &mut drawn => panic!("it was drawn by the thread that asked"),
            () = std::future::ready(()) => {}
        }
        let first = drawn.await.expect("it is drawn");
        assert!(Arc::ptr_eq(&first, &pictures.of(map).await.expect("it is kept")));
        let other = self::map(|heights| heights[2] = 5.0);
        let second = pictures.of(other).await.expect("it is drawn");
        assert_ne!((&first.hash, &first.elevation), (&second.hash, &second.elevation), "another map is drawn anew");
    }
}
