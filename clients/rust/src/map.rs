//! Maps to upload.

use nesam_proto::packed::pack;
use nesam_proto::v1;

/// Rows of one tile are chosen so that a tile has about this many cells: 7 bytes each stay well below the message limit.
const TILE_CELLS: usize = 256 << 10;

/// A whole map: row-major layers with row 0 in the south.
#[derive(Clone, Debug, PartialEq)]
pub struct MapLayers {
    /// Name.
    pub id: String,
    /// Version, at least 1.
    pub version: u64,
    /// World position of cell (0, 0), m.
    pub origin_m: [f64; 2],
    /// Distance of neighbouring cells, m.
    pub resolution_m: f64,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Elevation, m; NaN = hole. (height, width).
    pub elevation_m: Vec<f32>,
    /// Colours of the semantic map. (height, width).
    pub semantic_rgb: Option<Vec<[u8; 3]>>,
}

impl MapLayers {
    /// The messages of an upload: header, then tiles of whole rows.
    pub fn messages(&self) -> Vec<v1::UploadMapRequest> {
        use v1::upload_map_request::Part;
        let header = v1::MapHeader {
            map_id: self.id.clone(),
            version: self.version,
            origin_x_m: self.origin_m[0],
            origin_y_m: self.origin_m[1],
            resolution_m: self.resolution_m,
            width: self.width as u32,
            height: self.height as u32,
            semantic: self.semantic_rgb.is_some(),
        };
        let rows_per_tile = (TILE_CELLS / self.width.max(1)).max(1);
        let tiles = (0..self.height).step_by(rows_per_tile).map(|row| Part::Tile(self.tile(row, rows_per_tile.min(self.height - row))));
        std::iter::once(Part::Header(header)).chain(tiles).map(|part| v1::UploadMapRequest { part: Some(part) }).collect()
    }

    fn tile(&self, row: usize, rows: usize) -> v1::MapTile {
        let cells = row * self.width..(row + rows) * self.width;
        let semantic_rgb = self.semantic_rgb.as_ref().map(|rgb| rgb[cells.clone()].concat()).unwrap_or_default();
        v1::MapTile {
            row: row as u32,
            column: 0,
            rows: rows as u32,
            columns: self.width as u32,
            elevation_m: pack(&self.elevation_m[cells]),
            semantic_rgb: semantic_rgb.into(),
        }
    }
}
