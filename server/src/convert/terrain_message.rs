//! Maps back to the messages that upload and patch them.

use nesam_proto::v1 as pb;
use nesam_terrain::WorldMap;

use super::{Precision, encode};

/// Cells of one tile at most, so that a message stays below two megabytes.
const TILE_CELLS_MAX: usize = 1 << 18;

/// Layers of a map, taken out once.
struct Layers {
    elevation_m: Vec<f32>,
    semantic_rgb: Option<Vec<[u8; 3]>>,
    width: usize,
}

impl Layers {
    fn of(map: &WorldMap) -> Self {
        Self { elevation_m: map.elevation_m(), semantic_rgb: map.semantic_rgb(), width: map.geometry().width }
    }

    /// The rectangle of `rows` x `columns` cells from (`row`, `column`).
    fn tile(&self, row: usize, column: usize, rows: usize, columns: usize) -> pb::MapTile {
        let cells = |row: usize| row * self.width + column..row * self.width + column + columns;
        let elevation_m: Vec<f32> = (row..row + rows).flat_map(|row| &self.elevation_m[cells(row)]).copied().collect();
        let semantic_rgb: Vec<u8> = match &self.semantic_rgb {
            Some(rgb) => (row..row + rows).flat_map(|row| rgb[cells(row)].as_flattened()).copied().collect(),
            None => Vec::new(),
        };
        pb::MapTile {
            row: row as u32,
            column: column as u32,
            rows: rows as u32,
            columns: columns as u32,
            elevation_m: encode(&elevation_m, Precision::F32),
            semantic_rgb: semantic_rgb.into(),
        }
    }

    /// Whether a cell looks the same in both; holes are equal.
    fn same(&self, other: &Self, cell: usize) -> bool {
        let (a, b) = (self.elevation_m[cell], other.elevation_m[cell]);
        let height = a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan());
        height && self.semantic_rgb.as_ref().map(|rgb| rgb[cell]) == other.semantic_rgb.as_ref().map(|rgb| rgb[cell])
    }
}

/// The messages that upload a map: the header, then tiles of whole rows.
pub(crate) fn upload(map: &WorldMap) -> Vec<pb::UploadMapRequest> {
    use pb::upload_map_request::Part;
    let (geometry, source) = (map.geometry(), map.source());
    let header = pb::MapHeader {
        map_id: map.id().into(),
        version: map.version(),
        origin_x_m: geometry.origin_m[0],
        origin_y_m: geometry.origin_m[1],
        resolution_m: geometry.resolution_m,
        width: geometry.width as u32,
        height: geometry.height as u32,
        semantic: map.has_semantics(),
        stamp_ns: source.stamp_ns,
        frame: source.frame.clone(),
    };
    let layers = Layers::of(map);
    let rows = (TILE_CELLS_MAX / geometry.width.max(1)).max(1);
    let tiles = (0..geometry.height).step_by(rows);
    let tiles = tiles.map(|row| Part::Tile(layers.tile(row, 0, rows.min(geometry.height - row), geometry.width)));
    std::iter::once(Part::Header(header)).chain(tiles).map(|part| pb::UploadMapRequest { part: Some(part) }).collect()
}

/// The smallest tile that makes the map `to` of `from`; `None` where they do not share a grid or a source, or one has colours and the other has not.
pub(crate) fn changed_tile(from: &WorldMap, to: &WorldMap) -> Option<pb::MapTile> {
    if from.geometry() != to.geometry() || from.source() != to.source() || from.has_semantics() != to.has_semantics() {
        return None;
    }
    let (old, new) = (Layers::of(from), Layers::of(to));
    // Without a change, a tile of the first cell does.
    let (mut rows, mut columns) = (None::<(usize, usize)>, None::<(usize, usize)>);
    for cell in (0..new.elevation_m.len()).filter(|cell| !new.same(&old, *cell)) {
        let (row, column) = (cell / new.width, cell % new.width);
        let grow = |range: Option<(usize, usize)>, at: usize| Some(range.map_or((at, at), |(low, high)| (low.min(at), high.max(at))));
        (rows, columns) = (grow(rows, row), grow(columns, column));
    }
    let ((top, bottom), (left, right)) = (rows.unwrap_or((0, 0)), columns.unwrap_or((0, 0)));
    Some(new.tile(top, left, bottom - top + 1, right - left + 1))
}

#[cfg(test)]
mod tests {
    use nesam_engine::Limits;
    use nesam_terrain::{GridGeometry, MapSource};

    use super::*;
    use crate::convert::{MapBuilder, patched};

    fn world(semantic: bool) -> WorldMap {
        let geometry = GridGeometry { origin_m: [-3.0, 1.0], resolution_m: 0.1, width: 700, height: 800 };
        let mut elevation_m: Vec<f32> = (0..geometry.cells()).map(|i| (i as f32 * 0.01).sin()).collect();
        elevation_m[4321] = f32::NAN;
        let rgb = semantic.then(|| (0..geometry.cells()).map(|i| [i as u8, (i >> 8) as u8, 7]).collect());
        let source = MapSource { stamp_ns: semantic.then_some(-5), frame: "odom".into() };
        WorldMap::from_layers("w", 3, geometry, elevation_m, rgb).unwrap().with_source(source)
    }

    #[test]
    fn property_an_uploaded_map_is_the_map() {
        for semantic in [true, false] {
            let map = world(semantic);
            let mut messages = upload(&map).into_iter();
            let Some(pb::upload_map_request::Part::Header(header)) = messages.next().unwrap().part else { panic!("no header first") };
            let mut builder = MapBuilder::new(&header, &Limits::default()).unwrap();
            let mut tiles = 0;
            for message in messages {
                let Some(pb::upload_map_request::Part::Tile(tile)) = message.part else { panic!("no tile") };
                builder.add(&tile).unwrap();
                tiles += 1;
            }
            let back = builder.finish().unwrap();
            assert_eq!((back.hash(), back.id(), back.version(), back.source()), (map.hash(), map.id(), map.version(), map.source()));
            assert!(tiles > 1);
        }
    }

    #[test]
    fn property_a_changed_tile_makes_the_other_map() {
        for semantic in [true, false] {
            let map = world(semantic);
            let rgb = semantic.then(|| vec![[1, 2, 3]; 6]);
            let next = map.with_tile(30, 500, 3, 2, &[0.5, f32::NAN, 0.25, 1.0, 2.0, 3.0], rgb.as_deref()).unwrap();
            let tile = changed_tile(&map, &next).unwrap();
            assert_eq!((tile.row, tile.column, tile.rows, tile.columns), (500, 30, 2, 3));
            let back = patched(&map, &tile).unwrap();
            assert_eq!((back.hash(), back.version(), back.source()), (next.hash(), 4, map.source()));
            let unchanged = changed_tile(&map, &map).unwrap();
            assert_eq!(patched(&map, &unchanged).unwrap().hash(), map.hash());
        }
    }
}
