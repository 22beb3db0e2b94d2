//! The immutable, versioned map of a world.

use std::sync::OnceLock;

use nesam_physics::SOIL_DIM;
use sha2::{Digest, Sha256};

use crate::colours::{pack, smooth_again, smoothed, unpack};
use crate::error::TerrainError;
use crate::geometry::{Bilinear, GridGeometry};
use crate::patch::PatchScale;
use crate::surface::Surface;

/// Prior knowledge about one semantic class: its colour and the range of each soil parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct SoilClassRange {
    /// Class name, e.g. `dry_sand`.
    pub name: String,
    /// Palette colour in the semantic image, where the world states one.
    pub colour: Option<[u8; 3]>,
    /// Lower bounds, SI and rad, in the order k_phi, k_c, n, c, phi, k_shear.
    pub low: [f64; SOIL_DIM],
    /// Upper bounds, same order.
    pub high: [f64; SOIL_DIM],
}

/// What the source of a map says of it. It is carried, and nothing is computed from it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MapSource {
    /// Instant that the map was made at, ns of the vehicle's clock, where it is told.
    pub stamp_ns: Option<i64>,
    /// Frame that the source names; empty = World.
    pub frame: String,
}

/// Ground under a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ground {
    /// Height of the undeformed surface, World z, m.
    pub height_m: f64,
    /// dz/dx along World x, smoothed over about a wheel footprint, -.
    pub slope_x: f64,
    /// dz/dy along World y, -.
    pub slope_y: f64,
}

/// Elevation and semantics of a world on one regular grid, row 0 in the south.
///
/// A map never changes: [`WorldMap::with_tile`] gives a new map with the next version, so a prediction can name the version it used
/// and share the map without a lock. Holes are filled from the ground around them. Up to 0.5 m from a known cell that counts as known;
/// further in, patches see it and [`WorldMap::height_m`] and [`WorldMap::ground`] answer `None`. The layers are hashed and given back
/// with their holes.
#[derive(Debug)]
pub struct WorldMap {
    id: String,
    version: u64,
    hash: String,
    geometry: GridGeometry,
    pub(crate) surface: Surface,
    /// Colours packed as r | g << 8 | b << 16.
    pub(crate) colour: Option<Vec<u32>>,
    /// The same without hard borders, made when it is first asked for.
    smooth_colour: OnceLock<Vec<u32>>,
    soil_classes: Vec<SoilClassRange>,
    source: MapSource,
}

impl WorldMap {
    /// Builds a map from layers in memory, both row-major with row 0 in the south; a NaN elevation is a hole.
    ///
    /// # Errors
    /// `TerrainError::Layers` naming the field (and row and column) when the geometry is not usable, a layer has another number of
    /// cells than the geometry, an elevation is infinite or beyond 10 km, or no elevation is known at all.
    pub fn from_layers(
        id: &str,
        version: u64,
        geometry: GridGeometry,
        elevation_m: Vec<f32>,
        semantic_rgb: Option<Vec<[u8; 3]>>,
    ) -> Result<Self, TerrainError> {
        let wrong = |field, reason| TerrainError::Layers { id: id.to_string(), field, reason };
        geometry.check().map_err(|(field, reason)| wrong(field, reason))?;
        if elevation_m.len() != geometry.cells() {
            let reason = format!("{} cells, the geometry asks for {}", elevation_m.len(), geometry.cells());
            return Err(wrong("elevation_m", reason));
        }
        if let Some(rgb) = &semantic_rgb
            && rgb.len() != geometry.cells()
        {
            let reason = format!("{} cells, the geometry asks for {}", rgb.len(), geometry.cells());
            return Err(wrong("semantic_rgb", reason));
        }
        Self::checked(id, version, geometry, elevation_m, semantic_rgb.map(|rgb| rgb.into_iter().map(pack).collect()))
    }

    /// A map of layers that have as many cells as the geometry, with its colours packed.
    fn checked(
        id: &str,
        version: u64,
        geometry: GridGeometry,
        elevation_m: Vec<f32>,
        colour: Option<Vec<u32>>,
    ) -> Result<Self, TerrainError> {
        let wrong = |field, reason| TerrainError::Layers { id: id.to_string(), field, reason };
        if let Some(at) = elevation_m.iter().position(|z| z.is_infinite() || z.abs() > 1e4) {
            let (row, column) = (at / geometry.width, at % geometry.width);
            let reason = format!("{} m at row {row}, column {column} is beyond 10 km", elevation_m[at]);
            return Err(wrong("elevation_m", reason));
        }
        let hash = hash_layers(&geometry, &elevation_m, colour.as_deref());
        let surface =
            Surface::new(&geometry, elevation_m).ok_or_else(|| wrong("elevation_m", "no cell is known (all are holes)".into()))?;
        let (smooth_colour, soil_classes, source) = (OnceLock::new(), Vec::new(), MapSource::default());
        Ok(Self { id: id.into(), version, hash, geometry, surface, colour, smooth_colour, soil_classes, source })
    }

    /// The same map with the prior soil ranges of its semantic classes.
    pub fn with_soil_classes(mut self, soil_classes: Vec<SoilClassRange>) -> Self {
        self.soil_classes = soil_classes;
        self
    }

    /// The same map with what its source says of it; the hash stays.
    pub fn with_source(mut self, source: MapSource) -> Self {
        self.source = source;
        self
    }

    /// A copy in which one rectangle is replaced, with the next version; `self` stays as it is.
    ///
    /// `column0`, `row0` are the south-west cell of the tile; layers are row-major, row 0 in the south; a NaN elevation makes a hole.
    /// Without semantics in the tile the old colours stay.
    ///
    /// # Errors
    /// `TerrainError::Layers` naming the field when the tile is empty or leaves the map, a layer has the wrong number of cells,
    /// the tile has semantics but the map has none, there is no next version, or the patched map is not valid.
    pub fn with_tile(
        &self,
        column0: usize,
        row0: usize,
        width: usize,
        height: usize,
        elevation_m: &[f32],
        semantic_rgb: Option<&[[u8; 3]]>,
    ) -> Result<Self, TerrainError> {
        let wrong = |field, reason| TerrainError::Layers { id: self.id.clone(), field, reason };
        let GridGeometry { width: map_width, height: map_height, .. } = self.geometry;
        for (field, start, side, limit) in [("tile width", column0, width, map_width), ("tile height", row0, height, map_height)] {
            if side == 0 || start.checked_add(side).is_none_or(|end| end > limit) {
                return Err(wrong(field, format!("{side} cells from cell {start} do not fit in {limit} cells")));
            }
        }
        if elevation_m.len() != width * height {
            let reason = format!("{} cells, the tile has {width} x {height}", elevation_m.len());
            return Err(wrong("tile elevation_m", reason));
        }
        if let Some(rgb) = semantic_rgb {
            if self.colour.is_none() {
                return Err(wrong("tile semantic_rgb", "the map has no semantic layer to patch".into()));
            }
            if rgb.len() != width * height {
                let reason = format!("{} cells, the tile has {width} x {height}", rgb.len());
                return Err(wrong("tile semantic_rgb", reason));
            }
        }
        let Some(version) = self.version.checked_add(1) else {
            return Err(wrong(
                "version",
                format!("{} is the last, no patch can follow; upload the map anew under another id", self.version),
            ));
        };
        let mut elevation = self.elevation_m();
        let mut colour = self.colour.clone();
        for row in 0..height {
            let to = (row0 + row) * map_width + column0;
            let from = row * width..(row + 1) * width;
            elevation[to..to + width].copy_from_slice(&elevation_m[from.clone()]);
            if let (Some(map), Some(tile)) = (colour.as_mut(), semantic_rgb) {
                map[to..to + width].iter_mut().zip(&tile[from]).for_each(|(map, tile)| *map = pack(*tile));
            }
        }
        let patched = Self::checked(&self.id, version, self.geometry, elevation, colour)?;
        if let (Some(smooth), Some(colour)) = (self.smooth_colour.get(), &patched.colour) {
            let mut smooth = smooth.clone();
            if semantic_rgb.is_some() {
                smooth_again(&self.geometry, colour, column0..column0 + width, row0..row0 + height, &mut smooth);
            }
            let _ = patched.smooth_colour.set(smooth);
        }
        Ok(patched.with_soil_classes(self.soil_classes.clone()).with_source(self.source.clone()))
    }

    /// The map seen in a mirror: y becomes -y. What drives on it with mirrored commands moves as the mirror image.
    pub fn mirrored(&self) -> Self {
        let GridGeometry { origin_m: [x_m, y_m], resolution_m, width, height } = self.geometry;
        let north_m = y_m + resolution_m * (height - 1) as f64;
        let elevation = flipped(&self.elevation_m(), width);
        let semantic = self.semantic_rgb().map(|rgb| flipped(&rgb, width));
        let geometry = GridGeometry { origin_m: [x_m, -north_m], ..self.geometry };
        let mirrored =
            Self::from_layers(&self.id, self.version, geometry, elevation, semantic).expect("a valid map stays valid; this is a bug");
        mirrored.with_soil_classes(self.soil_classes.clone())
    }

    /// The same heights as a map that shows no colours.
    pub fn without_colours(&self) -> Self {
        let bare = Self::checked(&self.id, self.version, self.geometry, self.elevation_m(), None);
        bare.expect("a valid map stays valid; this is a bug").with_source(self.source.clone())
    }

    /// World id.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Version; grows by one with each patched tile.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// SHA-256 (hex) over geometry and layers: equal content has an equal hash, whatever id and version.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// What its source says of it.
    pub fn source(&self) -> &MapSource {
        &self.source
    }

    /// The grid.
    pub fn geometry(&self) -> &GridGeometry {
        &self.geometry
    }

    /// Whether there is a semantic layer.
    pub fn has_semantics(&self) -> bool {
        self.colour.is_some()
    }

    /// Prior soil ranges of the semantic classes; empty where the world states none.
    pub fn soil_classes(&self) -> &[SoilClassRange] {
        &self.soil_classes
    }

    /// The semantic class of the nearest cell, by the palette colour nearest to the cell's (images are not clean); `None` off the map, without a
    /// semantic layer or without a palette.
    pub fn soil_class(&self, x_m: f64, y_m: f64) -> Option<&SoilClassRange> {
        self.soil_class_index(x_m, y_m).map(|index| &self.soil_classes[index])
    }

    /// The same as an index into [`WorldMap::soil_classes`].
    pub fn soil_class_index(&self, x_m: f64, y_m: f64) -> Option<usize> {
        let colour = self.colour.as_ref().filter(|_| self.geometry.contains(x_m, y_m))?;
        let [column, row] = self.geometry.to_grid(x_m, y_m).map(|v| v.round().max(0.0) as usize);
        let [r, g, b] = unpack(colour[row * self.geometry.width + column]);
        let distance = |p: [u8; 3]| (0..3).map(|i| (i32::from(p[i]) - i32::from([r, g, b][i])).pow(2)).sum::<i32>();
        let coloured = self.soil_classes.iter().enumerate().filter_map(|(index, class)| Some((index, distance(class.colour?))));
        coloured.min_by_key(|(_, away)| *away).map(|(index, _)| index)
    }

    /// Elevation layer as given, row-major, row 0 in the south, NaN = hole, m.
    pub fn elevation_m(&self) -> Vec<f32> {
        (0..self.surface.height_m.len()).map(|cell| self.cell_elevation_m(cell)).collect()
    }

    /// The same of one cell, by its index in that layer, m; NaN = hole. For whoever needs some cells of a large map.
    ///
    /// # Panics
    /// When the map has no such cell.
    #[inline]
    pub fn cell_elevation_m(&self, cell: usize) -> f32 {
        let given = self.surface.given.as_ref().is_none_or(|given| given[cell]);
        if given { self.surface.height_m[cell] } else { f32::NAN }
    }

    /// Semantic layer as given, row-major, row 0 in the south.
    pub fn semantic_rgb(&self) -> Option<Vec<[u8; 3]>> {
        self.colour.as_ref().map(|c| c.iter().map(|p| unpack(*p)).collect())
    }

    /// The same of one cell, by its index in that layer; `None` without semantics.
    ///
    /// # Panics
    /// When the map has no such cell.
    #[inline]
    pub fn cell_rgb(&self, cell: usize) -> Option<[u8; 3]> {
        self.colour.as_ref().map(|colour| unpack(colour[cell]))
    }

    /// Whether the point lies on the map (holes included).
    pub fn contains(&self, x_m: f64, y_m: f64) -> bool {
        self.geometry.contains(x_m, y_m)
    }

    /// Makes ready what patches of this scale see, which takes up to a second for a large map; else whoever samples the first patch waits for it. A map that
    /// is patched after that is ready too.
    pub fn make_ready(&self, scale: &PatchScale) {
        self.patch_colours(scale.smooth_semantics);
    }

    /// Packed colours as patches see them: as they are, or with borders smoothed over about 0.4 m (see [`crate::PatchScale::smooth_semantics`]).
    pub(crate) fn patch_colours(&self, smooth: bool) -> Option<&[u32]> {
        let colour = self.colour.as_ref()?;
        Some(if smooth { self.smooth_colour.get_or_init(|| smoothed(&self.geometry, colour)) } else { colour })
    }

    /// Bilinear height, m; `None` off the map or where one of the four cells around is further than 0.5 m from known ground.
    #[inline]
    pub fn height_m(&self, x_m: f64, y_m: f64) -> Option<f64> {
        self.lookup(x_m, y_m).map(|at| self.surface.height(at, self.geometry.width))
    }

    /// Bilinear height and the slope smoothed over about a wheel footprint (0.3 m); `None` as for [`WorldMap::height_m`].
    #[inline]
    pub fn ground(&self, x_m: f64, y_m: f64) -> Option<Ground> {
        let at = self.lookup(x_m, y_m)?;
        let [slope_x, slope_y] = self.surface.slope(at, self.geometry.width);
        Some(Ground { height_m: self.surface.height(at, self.geometry.width), slope_x, slope_y })
    }

    /// Height with all holes filled and points off the map clamped to the border, m; a fallback where any height beats none.
    pub fn nearest_height_m(&self, x_m: f64, y_m: f64) -> f64 {
        self.surface.height(self.geometry.bilinear(x_m, y_m), self.geometry.width)
    }

    #[inline]
    fn lookup(&self, x_m: f64, y_m: f64) -> Option<Bilinear> {
        if !self.geometry.contains(x_m, y_m) {
            return None;
        }
        let at = self.geometry.bilinear(x_m, y_m);
        self.surface.is_known(at.index, self.geometry.width).then_some(at)
    }
}

/// Rows in reverse order.
fn flipped<T: Copy>(cells: &[T], width: usize) -> Vec<T> {
    cells.chunks(width).rev().flatten().copied().collect()
}

/// SHA-256 over geometry, elevation (every NaN as one bit pattern) and colours.
fn hash_layers(geometry: &GridGeometry, elevation_m: &[f32], colour: Option<&[u32]>) -> String {
    let mut hash = Sha256::new();
    hash.update(b"nesam.world/1");
    for value in [geometry.origin_m[0], geometry.origin_m[1], geometry.resolution_m] {
        hash.update(value.to_le_bytes());
    }
    hash.update((geometry.width as u64).to_le_bytes());
    hash.update((geometry.height as u64).to_le_bytes());
    let mut row = Vec::with_capacity(geometry.width * 4);
    for cells in elevation_m.chunks(geometry.width) {
        row.clear();
        for z in cells {
            let canonical = if z.is_nan() { f32::NAN } else { *z };
            row.extend_from_slice(&canonical.to_le_bytes());
        }
        hash.update(&row);
    }
    hash.update([u8::from(colour.is_some())]);
    for cells in colour.unwrap_or_default().chunks(geometry.width) {
        row.clear();
        row.extend(cells.iter().flat_map(|c| c.to_le_bytes()));
        hash.update(&row);
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}
