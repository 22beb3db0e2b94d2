//! The undeformed ground and its soil.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use serde_json::Value;

use crate::error::PlantError;

/// Distance of soil nodes, m: that of the reference simulator.
pub(crate) const NODE_M: f64 = 0.05;

/// Soil of one place: Bekker, Mohr-Coulomb, Janosi-Hanamoto; SI, angle in rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoilParameters {
    /// Frictional modulus of sinkage, N/m^(n+2).
    pub k_phi: f64,
    /// Cohesive modulus of sinkage, N/m^(n+1).
    pub k_c: f64,
    /// Sinkage exponent.
    pub n: f64,
    /// Cohesion, Pa.
    pub cohesion_pa: f64,
    /// Angle of internal friction, rad.
    pub friction_rad: f64,
    /// Shear deformation modulus, m.
    pub shear_m: f64,
}

/// Heights and soils of a world, at nodes 0.05 m apart; node (0, 0) is the south-west corner.
#[derive(Clone, Debug)]
pub struct Ground {
    origin_m: [f64; 2],
    columns: usize,
    rows: usize,
    /// Height and its two slopes at each node, row-major.
    surface: Vec<[f32; 3]>,
    /// Soil of each node, index into `soils`.
    soil_of: Vec<u8>,
    soils: Vec<SoilParameters>,
    region_ids: Vec<u8>,
}

impl Ground {
    /// Reads the elevation and the TRUE soil of a world folder (`gt_soil.json`, `gt_region.png`).
    ///
    /// # Errors
    /// `PlantError` naming the file and what was wrong with it.
    pub fn read(world_dir: &Path) -> Result<Self, PlantError> {
        let world_path = world_dir.join("world.json");
        let world = read_json(&world_path)?;
        let number = |pointer: &str| {
            let value = world.pointer(pointer).and_then(Value::as_f64).filter(|v| v.is_finite());
            value.ok_or_else(|| PlantError::content(&world_path, format!("`{pointer}` is not a number")))
        };
        let origin_m = [number("/origin_m/0")?, number("/origin_m/1")?];
        let resolution_m = number("/resolution_m")?;
        let (width, height) = (number("/width_px")? as usize, number("/height_px")? as usize);
        let (scale_m, offset_m) = (number("/elevation/scale_m")?, number("/elevation/offset_m")?);
        let gray = read_png(&world_dir.join("elevation.png"), width, height, 2)?;
        let heights: Vec<f64> = gray.chunks_exact(2).map(|b| offset_m + scale_m * f64::from(u16::from_be_bytes([b[0], b[1]]))).collect();
        let regions = read_png(&world_dir.join("gt_region.png"), width, height, 1)?;
        let (soils, region_ids) = read_soils(&world_dir.join("gt_soil.json"))?;
        let mut place = [u8::MAX; 256];
        region_ids.iter().enumerate().for_each(|(i, id)| place[usize::from(*id)] = i as u8);
        if let Some(id) = regions.iter().find(|id| place[usize::from(**id)] == u8::MAX) {
            return Err(PlantError::content(world_dir, format!("region {id} of gt_region.png has no soil")));
        }
        let per_pixel = resolution_m / NODE_M;
        let (columns, rows) = (((width - 1) as f64 * per_pixel) as usize + 1, ((height - 1) as f64 * per_pixel) as usize + 1);
        let height_at = |column: usize, row: usize| {
            let (x, y) = (column as f64 / per_pixel, row as f64 / per_pixel);
            let (i, j) = ((x as usize).min(width - 2), (y as usize).min(height - 2));
            let (a, b) = (x - i as f64, y - j as f64);
            let z = |di: usize, dj: usize| heights[(j + dj) * width + i + di];
            (1.0 - b) * ((1.0 - a) * z(0, 0) + a * z(1, 0)) + b * ((1.0 - a) * z(0, 1) + a * z(1, 1))
        };
        let soil_at = |column: usize, row: usize| {
            let pixel = |at: usize, count: usize| ((at as f64 / per_pixel).round() as usize).min(count - 1);
            place[usize::from(regions[pixel(row, height) * width + pixel(column, width)])]
        };
        Ok(Self::from_nodes(origin_m, columns, rows, height_at, soil_at, soils, region_ids))
    }

    /// Level or sloping ground of one soil: z = `slope` . (x, y), `extent_m` from the origin in each direction.
    pub fn plane(extent_m: f64, slope: [f64; 2], soil: SoilParameters) -> Self {
        let count = 2 * (extent_m / NODE_M) as usize + 1;
        let at = |i: usize| -extent_m + NODE_M * i as f64;
        let height = |column: usize, row: usize| slope[0] * at(column) + slope[1] * at(row);
        Self::from_nodes([-extent_m; 2], count, count, height, |_, _| 0, vec![soil], vec![0])
    }

    fn from_nodes(
        origin_m: [f64; 2],
        columns: usize,
        rows: usize,
        height_at: impl Fn(usize, usize) -> f64,
        soil_at: impl Fn(usize, usize) -> u8,
        soils: Vec<SoilParameters>,
        region_ids: Vec<u8>,
    ) -> Self {
        let heights: Vec<f64> = (0..rows * columns).map(|k| height_at(k % columns, k / columns)).collect();
        let z = |column: usize, row: usize| heights[row * columns + column];
        let surface = (0..rows * columns).map(|k| {
            let (c, r) = (k % columns, k / columns);
            let (west, east) = (c.saturating_sub(1), (c + 1).min(columns - 1));
            let (south, north) = (r.saturating_sub(1), (r + 1).min(rows - 1));
            let slope_x = (z(east, r) - z(west, r)) / (NODE_M * (east - west) as f64);
            let slope_y = (z(c, north) - z(c, south)) / (NODE_M * (north - south) as f64);
            [z(c, r) as f32, slope_x as f32, slope_y as f32]
        });
        let surface = surface.collect();
        let soil_of = (0..rows * columns).map(|k| soil_at(k % columns, k / columns)).collect();
        Self { origin_m, columns, rows, surface, soil_of, soils, region_ids }
    }

    /// Number of nodes.
    pub(crate) fn nodes(&self) -> usize {
        self.surface.len()
    }

    /// Columns and rows of nodes inside a box of World, both ends included; empty off the ground.
    pub(crate) fn range(&self, low: [f64; 2], high: [f64; 2]) -> [std::ops::Range<usize>; 2] {
        let along = |axis: usize, count: usize| {
            let first = ((low[axis] - self.origin_m[axis]) / NODE_M).ceil().max(0.0) as usize;
            let last = ((high[axis] - self.origin_m[axis]) / NODE_M).floor();
            first..if last < 0.0 { 0 } else { (last as usize + 1).min(count) }
        };
        [along(0, self.columns), along(1, self.rows)]
    }

    /// Index and World x, y of a node.
    pub(crate) fn node(&self, column: usize, row: usize) -> (usize, [f64; 2]) {
        let at = [self.origin_m[0] + NODE_M * column as f64, self.origin_m[1] + NODE_M * row as f64];
        (row * self.columns + column, at)
    }

    /// Height and slopes of a node before anything drove there.
    pub(crate) fn surface(&self, node: usize) -> [f64; 3] {
        self.surface[node].map(f64::from)
    }

    /// Soil of a node.
    pub(crate) fn soil(&self, node: usize) -> &SoilParameters {
        &self.soils[usize::from(self.soil_of[node])]
    }

    fn nearest(&self, x_m: f64, y_m: f64) -> Option<usize> {
        let column = ((x_m - self.origin_m[0]) / NODE_M).round();
        let row = ((y_m - self.origin_m[1]) / NODE_M).round();
        let inside = column >= 0.0 && row >= 0.0 && column < self.columns as f64 && row < self.rows as f64;
        inside.then(|| row as usize * self.columns + column as usize)
    }

    /// Undeformed height of the nearest node, m; `None` off the ground.
    pub fn height_m(&self, x_m: f64, y_m: f64) -> Option<f64> {
        self.nearest(x_m, y_m).map(|node| self.surface(node)[0])
    }

    /// Soil of the nearest node; `None` off the ground.
    pub fn soil_at(&self, x_m: f64, y_m: f64) -> Option<SoilParameters> {
        self.nearest(x_m, y_m).map(|node| *self.soil(node))
    }

    /// Region id of the nearest node, as in `gt_region.png`; `None` off the ground.
    pub fn region(&self, x_m: f64, y_m: f64) -> Option<u8> {
        self.nearest(x_m, y_m).map(|node| self.region_ids[usize::from(self.soil_of[node])])
    }
}

fn read_json(path: &Path) -> Result<Value, PlantError> {
    let text = std::fs::read(path).map_err(|source| PlantError::File { path: path.into(), source })?;
    serde_json::from_slice(&text).map_err(|e| PlantError::content(path, e.to_string()))
}

/// Rows from south to north.
fn read_png(path: &Path, width: usize, height: usize, bytes_per_pixel: usize) -> Result<Vec<u8>, PlantError> {
    let file = File::open(path).map_err(|source| PlantError::File { path: path.into(), source })?;
    let bad = |e: png::DecodingError| PlantError::content(path, e.to_string());
    let mut reader = png::Decoder::new(BufReader::new(file)).read_info().map_err(bad)?;
    let line = width * bytes_per_pixel;
    let size = reader.output_buffer_size().filter(|size| *size == line * height && width > 1 && height > 1);
    let size = size.ok_or_else(|| PlantError::content(path, format!("is not {width} x {height} pixels of {bytes_per_pixel} bytes")))?;
    let mut north_first = vec![0; size];
    reader.next_frame(&mut north_first).map_err(bad)?;
    Ok(north_first.chunks_exact(line).rev().flatten().copied().collect())
}

/// Soils and their region ids, in the order of the file.
fn read_soils(path: &Path) -> Result<(Vec<SoilParameters>, Vec<u8>), PlantError> {
    let json = read_json(path)?;
    let wrong = |key: &str| PlantError::content(path, format!("`{key}` is missing or not of the expected form"));
    let names = json.get("params").and_then(Value::as_array).ok_or_else(|| wrong("params"))?;
    let mut order = [0; 6];
    for (to, name) in order.iter_mut().zip(["Kphi", "Kc", "n", "c", "phi", "K"]) {
        *to = names.iter().position(|n| n.as_str() == Some(name)).ok_or_else(|| wrong("params"))?;
    }
    let regions = json.get("regions").and_then(Value::as_array).filter(|r| r.len() < 255).ok_or_else(|| wrong("regions"))?;
    let mut soils = Vec::with_capacity(regions.len());
    let mut ids = Vec::with_capacity(regions.len());
    for region in regions {
        let id = region.get("id").and_then(Value::as_u64).and_then(|id| u8::try_from(id).ok()).ok_or_else(|| wrong("regions.id"))?;
        let listed = region.get("soil").and_then(Value::as_array).ok_or_else(|| wrong("regions.soil"))?;
        let value = |i: usize| listed.get(order[i]).and_then(Value::as_f64).filter(|v| *v > 0.0).ok_or_else(|| wrong("regions.soil"));
        soils.push(SoilParameters {
            k_phi: value(0)?,
            k_c: value(1)?,
            n: value(2)?,
            cohesion_pa: value(3)?,
            friction_rad: value(4)?.to_radians(),
            shear_m: value(5)?,
        });
        ids.push(id);
    }
    Ok((soils, ids))
}
