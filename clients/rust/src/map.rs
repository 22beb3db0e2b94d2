//! Maps to upload.

use nesam_proto::packed::pack;
use nesam_proto::v1;

use crate::error::ClientError;

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
    /// Instant that the map was made at, ns of the vehicle's clock, where it is told; carried, and nothing is computed from it.
    pub stamp_ns: Option<i64>,
    /// Frame that the source of the map names, at most 64 bytes; empty = World. Carried in the same way.
    pub frame: String,
}

impl MapLayers {
    /// INVALID_ARGUMENT when a layer does not have the size that width and height say.
    pub(crate) fn check(&self) -> Result<(), ClientError> {
        let layers = [("elevation_m", Some(self.elevation_m.len())), ("semantic_rgb", self.semantic_rgb.as_ref().map(Vec::len))];
        let cells = self.width.checked_mul(self.height);
        match layers.into_iter().find(|(_, size)| size.is_some() && *size != cells) {
            Some((field, size)) => Err(ClientError::Refused {
                code: tonic::Code::InvalidArgument,
                field: field.into(),
                message: format!("`{field}`: has {} values, height x width is {} x {}", size.unwrap_or_default(), self.height, self.width),
                retry_after: None,
            }),
            None => Ok(()),
        }
    }

    /// The messages of an upload: header, then tiles of whole rows.
    ///
    /// # Panics
    /// When a layer is smaller than width and height say.
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
            stamp_ns: self.stamp_ns,
            frame: self.frame.clone(),
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

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// Goal: layers that do not fit are refused and nothing panics. Method: one value too few and too many in each layer, a size that overflows.
    #[test]
    fn analytic_layers_that_do_not_fit_are_refused() {
        let sound = MapLayers {
            id: "m".into(),
            version: 1,
            origin_m: [0.0; 2],
            resolution_m: 0.5,
            width: 3,
            height: 2,
            elevation_m: vec![0.0; 6],
            semantic_rgb: Some(vec![[0; 3]; 6]),
            stamp_ns: None,
            frame: String::new(),
        };
        sound.check().unwrap();
        MapLayers { semantic_rgb: None, ..sound.clone() }.check().unwrap();
        for size in [5, 7] {
            let elevation = MapLayers { elevation_m: vec![0.0; size], ..sound.clone() }.check().unwrap_err();
            assert_eq!((elevation.code(), elevation.field()), (Some(tonic::Code::InvalidArgument), "elevation_m"));
            let colours = MapLayers { semantic_rgb: Some(vec![[0; 3]; size]), ..sound.clone() }.check().unwrap_err();
            assert_eq!((colours.code(), colours.field()), (Some(tonic::Code::InvalidArgument), "semantic_rgb"));
        }
        assert_eq!(MapLayers { width: usize::MAX, ..sound }.check().unwrap_err().field(), "elevation_m");
    }
}
