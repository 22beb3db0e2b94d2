//! Maps: uploaded in tiles, patched by tile, described without their layers.

use nesam_engine::{EngineError, Limits, check_name};
use nesam_proto::v1 as pb;
use nesam_terrain::{GridGeometry, MapSource, ORIGIN_MAX_M, TerrainError, WorldMap};

use super::{decode_f32, unsigned_zero};

/// Longest name of a frame, bytes.
const FRAME_LENGTH_MAX: usize = 64;

/// A map that is being uploaded.
#[derive(Debug)]
pub struct MapBuilder {
    id: String,
    version: u64,
    geometry: GridGeometry,
    source: MapSource,
    elevation_m: Vec<f32>,
    semantic_rgb: Option<Vec<[u8; 3]>>,
}

/// A tile whose lengths fit its size.
struct Tile {
    row: usize,
    column: usize,
    rows: usize,
    columns: usize,
    elevation_m: Vec<f32>,
    semantic_rgb: Option<Vec<[u8; 3]>>,
}

/// A tile inside a map of the given geometry.
fn tile(message: &pb::MapTile, geometry: &GridGeometry, semantic: bool) -> Result<Tile, EngineError> {
    let sides =
        [("tile.rows", message.row, message.rows, geometry.height), ("tile.columns", message.column, message.columns, geometry.width)];
    for (field, first, side, limit) in sides {
        if side == 0 || u64::from(first) + u64::from(side) > limit as u64 {
            return Err(EngineError::invalid(field, format!("{side} cells from cell {first} do not fit in the {limit} cells of the map")));
        }
    }
    let (rows, columns) = (message.rows as usize, message.columns as usize);
    let cells = rows * columns;
    let elevation_m = decode_f32("tile.elevation_m", &message.elevation_m, cells)?;
    let expected = if semantic { 3 * cells } else { 0 };
    if message.semantic_rgb.len() != expected {
        let reason = format!(
            "has {} bytes, {expected} are needed ({})",
            message.semantic_rgb.len(),
            if semantic { "3 for each cell" } else { "the map has no colours" }
        );
        return Err(EngineError::invalid("tile.semantic_rgb", reason));
    }
    let semantic_rgb = semantic.then(|| message.semantic_rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect());
    Ok(Tile { row: message.row as usize, column: message.column as usize, rows, columns, elevation_m, semantic_rgb })
}

impl MapBuilder {
    /// Starts with the header; cells are holes until a tile covers them.
    ///
    /// # Errors
    /// `Invalid` naming the field of the header, before anything is allocated.
    pub fn new(header: &pb::MapHeader, limits: &Limits) -> Result<Self, EngineError> {
        check_name("header.map_id", &header.map_id)?;
        if header.version == 0 {
            return Err(EngineError::invalid("header.version", "is 0, versions start at 1"));
        }
        let (width, height) = (header.width as usize, header.height as usize);
        let cells = u64::from(header.width) * u64::from(header.height);
        let fits = usize::try_from(cells).is_ok_and(|cells| cells <= limits.map_cells_max);
        if width < 2 || height < 2 || !fits {
            let reason = format!("{width} x {height} cells; at least 2 x 2 and at most {} cells are allowed", limits.map_cells_max);
            return Err(EngineError::invalid("header.width", reason));
        }
        let geometry = GridGeometry {
            origin_m: [header.origin_x_m, header.origin_y_m].map(unsigned_zero),
            resolution_m: header.resolution_m,
            width,
            height,
        };
        for (field, value) in [
            ("header.origin_x_m", header.origin_x_m),
            ("header.origin_y_m", header.origin_y_m),
            ("header.resolution_m", header.resolution_m),
        ] {
            if !value.is_finite() {
                return Err(EngineError::invalid(field, format!("is {value}, a finite number is needed")));
            }
            if value.abs() > ORIGIN_MAX_M {
                return Err(EngineError::invalid(field, format!("is {value}, allowed are up to {ORIGIN_MAX_M:e} m")));
            }
        }
        if header.frame.len() > FRAME_LENGTH_MAX {
            let reason = format!("has {} bytes, at most {FRAME_LENGTH_MAX} are allowed", header.frame.len());
            return Err(EngineError::invalid("header.frame", reason));
        }
        Ok(Self {
            id: header.map_id.clone(),
            version: header.version,
            geometry,
            source: MapSource { stamp_ns: header.stamp_ns, frame: header.frame.clone() },
            elevation_m: vec![f32::NAN; width * height],
            semantic_rgb: header.semantic.then(|| vec![[0; 3]; width * height]),
        })
    }

    /// Adds a tile; a later tile replaces what an earlier one said.
    ///
    /// # Errors
    /// `Invalid` naming the field of the tile.
    pub fn add(&mut self, message: &pb::MapTile) -> Result<(), EngineError> {
        let tile = tile(message, &self.geometry, self.semantic_rgb.is_some())?;
        for row in 0..tile.rows {
            let to = (tile.row + row) * self.geometry.width + tile.column;
            let from = row * tile.columns..(row + 1) * tile.columns;
            self.elevation_m[to..to + tile.columns].copy_from_slice(&tile.elevation_m[from.clone()]);
            if let (Some(map), Some(tile_rgb)) = (&mut self.semantic_rgb, &tile.semantic_rgb) {
                map[to..to + tile.columns].copy_from_slice(&tile_rgb[from]);
            }
        }
        Ok(())
    }

    /// Makes the map. Takes up to a second for a large one.
    ///
    /// # Errors
    /// `Invalid` naming what is wrong with the layers.
    pub fn finish(self) -> Result<WorldMap, EngineError> {
        let map = WorldMap::from_layers(&self.id, self.version, self.geometry, self.elevation_m, self.semantic_rgb);
        map.map(|map| map.with_source(self.source)).map_err(layers)
    }
}

/// A copy of a map with one rectangle replaced, with the next version.
///
/// # Errors
/// `Invalid` naming the field of the tile.
pub fn patched(map: &WorldMap, message: &pb::MapTile) -> Result<WorldMap, EngineError> {
    let with_colours = map.has_semantics() && !message.semantic_rgb.is_empty();
    let tile = tile(message, map.geometry(), with_colours)?;
    map.with_tile(tile.column, tile.row, tile.columns, tile.rows, &tile.elevation_m, tile.semantic_rgb.as_deref()).map_err(layers)
}

/// An error of a map by the field of the request that it is about: layers come in tiles, all else in the header.
fn layers(error: TerrainError) -> EngineError {
    match error {
        TerrainError::Layers { field: "version", reason, .. } => EngineError::invalid("base_version", reason),
        TerrainError::Layers { field, reason, .. } => match field.trim_start_matches("tile ") {
            layer @ ("elevation_m" | "semantic_rgb") => EngineError::invalid(format!("tile.{layer}"), reason),
            side => EngineError::invalid(format!("header.{side}"), reason),
        },
        other => EngineError::invalid("header", other.to_string()),
    }
}

/// A map without its layers.
pub fn description(map: &WorldMap) -> pb::MapDescription {
    let (geometry, source) = (map.geometry(), map.source());
    pb::MapDescription {
        map_id: map.id().into(),
        version: map.version(),
        hash: map.hash().into(),
        origin_x_m: geometry.origin_m[0],
        origin_y_m: geometry.origin_m[1],
        resolution_m: geometry.resolution_m,
        width: geometry.width as u32,
        height: geometry.height as u32,
        semantic: map.has_semantics(),
        stamp_ns: source.stamp_ns,
        frame: source.frame.clone(),
    }
}
