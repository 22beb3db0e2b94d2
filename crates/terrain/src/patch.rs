//! Vehicle-aligned patches: what the encoders see.

use crate::geometry::Pose2;
use crate::world_map::WorldMap;

/// Pixels along each side of a patch (paper §III-A: 128 x 128).
pub const PATCH_PX: usize = 128;

/// Distance between neighbouring pixels of a patch, m (chosen: 12.8 m of ground at the resolution of the maps).
pub const PATCH_RESOLUTION_M: f64 = 0.1;

/// Part of a cell that forgives f32 rounding at the outermost points.
const SLACK: f32 = 1e-3;

const PIXELS: usize = PATCH_PX * PATCH_PX;

/// One observation of the terrain around the vehicle, normalised to [-1, 1].
///
/// Row 0 is furthest ahead, column 0 furthest left; the vehicle stands in the centre, between pixels 63 and 64.
#[derive(Clone, Debug, PartialEq)]
pub struct Patch {
    /// Elevation relative to the ground under the centre, (row, column), normalised.
    pub elevation: Vec<f32>,
    /// Colours, (channel = 3, row, column), normalised; all zero on a map without semantics.
    pub semantic: Vec<f32>,
    /// Share of the pixels that lie on the map and on known ground (holes up to 0.5 m from it included), 0..=1.
    pub known_share: f32,
}

impl Patch {
    /// An empty patch, to be reused between calls of [`sample_patch`].
    pub fn new() -> Self {
        Self { elevation: vec![0.0; PIXELS], semantic: vec![0.0; 3 * PIXELS], known_share: 0.0 }
    }
}

impl Default for Patch {
    fn default() -> Self {
        Self::new()
    }
}

/// Global normalisation of patches to [-1, 1] (paper §IV-A).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatchScale {
    /// Relative elevation that becomes 1, m.
    pub elevation_half_range_m: f32,
    /// Colour that becomes 0, per channel, on the scale 0..=255 of the image.
    pub semantic_mean: [f32; 3],
    /// Colour difference that becomes 1, per channel, on the same scale.
    pub semantic_half_range: [f32; 3],
    /// Sees borders between colours smoothed over about 0.4 m, so that tokens can be interpolated between poses; `false` = as the map has them.
    pub smooth_semantics: bool,
}

impl Default for PatchScale {
    /// 3 m of relief (18 degrees over the 9 m to a corner of the patch), and the whole colour range.
    fn default() -> Self {
        Self { elevation_half_range_m: 3.0, semantic_mean: [127.5; 3], semantic_half_range: [127.5; 3], smooth_semantics: false }
    }
}

/// The patch as an affine walk over the grid: cell coordinates of pixel (0, 0), and what one column and one row add.
///
/// Coordinates count from `base`, a cell near the patch, and are positive, so that f32 resolves a thousandth of a cell wherever the map lies.
struct Walk {
    base: [i64; 2],
    start: [f32; 2],
    per_column: [f32; 2],
    per_row: [f32; 2],
    /// First and last cell of the map, along x and y.
    low: [f32; 2],
    high: [f32; 2],
}

impl Walk {
    fn new(map: &WorldMap, pose: Pose2) -> Self {
        let step = PATCH_RESOLUTION_M / map.geometry().resolution_m;
        let size = [map.geometry().width, map.geometry().height];
        let (sin, cos) = pose.yaw_rad.sin_cos();
        // The walk spans less than `reach` cells on either side of the centre.
        let reach = (PATCH_PX as f64 * step).ceil() + 1.0;
        // Further than that beyond a border every pixel is off the map whatever the distance, and takes the same border value.
        let centre = map.geometry().to_grid(pose.x_m, pose.y_m);
        let centre = [0, 1].map(|k| centre[k].clamp(-2.0 * reach, size[k] as f64 + 2.0 * reach));
        // One row down is one step back, one column right is one step to the right.
        let per_row = [-step * cos, -step * sin];
        let per_column = [step * sin, -step * cos];
        let half = (PATCH_PX as f64 - 1.0) / 2.0;
        let first = [0, 1].map(|k| centre[k] - half * (per_row[k] + per_column[k]));
        let base = [0, 1].map(|k| ((centre[k] - reach).floor() as i64).min(size[k] as i64 - 2));
        Self {
            base,
            start: [0, 1].map(|k| (first[k] - base[k] as f64) as f32),
            per_column: per_column.map(|v| v as f32),
            per_row: per_row.map(|v| v as f32),
            low: [0, 1].map(|k| -base[k] as f32),
            high: [0, 1].map(|k| (size[k] as i64 - 1 - base[k]) as f32),
        }
    }

    /// Cells of one row of the patch, clamped to the border; returns how many pixels are off the map.
    #[inline(always)]
    fn row(&self, row: usize, width: usize, cells: &mut RowCells) -> u32 {
        let [u0, v0] = [0, 1].map(|k| self.start[k] + row as f32 * self.per_row[k]);
        let [du, dv] = self.per_column;
        let ([u_low, v_low], [u_high, v_high]) = (self.low, self.high);
        // The sum is a valid index although `base` may be negative: wrapping 32-bit arithmetic keeps the loop in lanes.
        let base = (self.base[1] * width as i64 + self.base[0]) as u32;
        let mut off_map = 0;
        for column in 0..PATCH_PX {
            let u = u0 + column as f32 * du;
            let v = v0 + column as f32 * dv;
            let off = (u < u_low - SLACK) | (u > u_high + SLACK) | (v < v_low - SLACK) | (v > v_high + SLACK);
            off_map += u32::from(off);
            let (u, v) = (u.max(u_low).min(u_high), v.max(v_low).min(v_high));
            let (west, south) = (u.floor().min(u_high - 1.0), v.floor().min(v_high - 1.0));
            cells.index[column] = base.wrapping_add(whole(south).wrapping_mul(width as u32)).wrapping_add(whole(west));
            cells.east[column] = u - west;
            cells.north[column] = v - south;
        }
        off_map
    }

    /// As [`Walk::row`] on a map with holes that are not known; pixels next to one count too, once.
    fn row_with_holes(&self, row: usize, map: &WorldMap, cells: &mut RowCells) -> usize {
        let width = map.geometry().width;
        self.row(row, width, cells);
        let start = [0, 1].map(|k| self.start[k] + row as f32 * self.per_row[k]);
        let off_map = |column: usize| {
            (0..2).any(|k| {
                let at = start[k] + column as f32 * self.per_column[k];
                at < self.low[k] - SLACK || at > self.high[k] + SLACK
            })
        };
        let unknown = |column: &usize| off_map(*column) || !map.surface.is_known(cells.index[*column] as usize, width);
        (0..PATCH_PX).filter(unknown).count()
    }
}

/// The integer in a float that holds one, 0 <= x < 2^22: the low bits of x + 2^23. Unlike `as`, it stays in lanes.
#[inline(always)]
fn whole(x: f32) -> u32 {
    (x + 8_388_608.0).to_bits() & 0x007f_ffff
}

/// Cells and fractions of one row of a patch.
struct RowCells {
    index: [u32; PATCH_PX],
    east: [f32; PATCH_PX],
    north: [f32; PATCH_PX],
}

/// Four corner values (south-west, south-east, north-west, north-east) of one row of a patch.
struct Corners<T> {
    sw: [T; PATCH_PX],
    se: [T; PATCH_PX],
    nw: [T; PATCH_PX],
    ne: [T; PATCH_PX],
}

impl<T: Copy> Corners<T> {
    fn new(zero: T) -> Self {
        Self { sw: [zero; PATCH_PX], se: [zero; PATCH_PX], nw: [zero; PATCH_PX], ne: [zero; PATCH_PX] }
    }

    /// Gathers the corners of a row from a layer of the given width.
    #[inline(always)]
    fn gather(&mut self, layer: &[T], width: usize, cells: &RowCells) {
        for column in 0..PATCH_PX {
            let at = cells.index[column] as usize;
            let south = &layer[at..at + 2];
            let north = &layer[at + width..at + width + 2];
            self.sw[column] = south[0];
            self.se[column] = south[1];
            self.nw[column] = north[0];
            self.ne[column] = north[1];
        }
    }
}

/// Samples the patch around a pose (paper §III-A: the observation m_k at the predicted pose).
///
/// Bilinear. Elevation is relative to the ground under the centre, divided by the half range and clamped to [-1, 1]; colours are
/// shifted, scaled and clamped per channel. Pixels off the map take the nearest border value and pixels at holes heights
/// from around; off the map and further than 0.5 m from known ground they count out of `known_share`. A pose that is not finite
/// gives a patch at the origin of the map with `known_share` 0.
/// Nothing is allocated when the patch is reused.
pub fn sample_patch(map: &WorldMap, pose: Pose2, scale: &PatchScale, patch: &mut Patch) {
    patch.elevation.resize(PIXELS, 0.0);
    patch.semantic.resize(3 * PIXELS, 0.0);
    let finite = pose.x_m.is_finite() && pose.y_m.is_finite() && pose.yaw_rad.is_finite();
    let [x_m, y_m] = map.geometry().to_world(0, 0);
    let pose = if finite { pose } else { Pose2 { x_m, y_m, yaw_rad: 0.0 } };

    let width = map.geometry().width;
    let walk = Walk::new(map, pose);
    let centre_m = map.nearest_height_m(pose.x_m, pose.y_m) as f32;
    let per_elevation = 1.0 / scale.elevation_half_range_m;
    let colour = map.patch_colours(scale.smooth_semantics);
    let per_colour = scale.semantic_half_range.map(|half| 1.0 / half);

    let mut cells = RowCells { index: [0; PATCH_PX], east: [0.0; PATCH_PX], north: [0.0; PATCH_PX] };
    let mut heights = Corners::new(0.0f32);
    let mut colours = Corners::new(0u32);
    let mut unknown = 0;
    for row in 0..PATCH_PX {
        unknown += match &map.surface.known {
            None => walk.row(row, width, &mut cells) as usize,
            Some(_) => walk.row_with_holes(row, map, &mut cells),
        };
        heights.gather(&map.surface.height_m, width, &cells);
        let out = &mut patch.elevation[row * PATCH_PX..(row + 1) * PATCH_PX];
        mix_heights(&heights, &cells, centre_m, per_elevation, out);
        let Some(colour) = colour else { continue };
        colours.gather(colour, width, &cells);
        for (channel, per_unit) in per_colour.into_iter().enumerate() {
            let at = channel * PIXELS + row * PATCH_PX;
            let out = &mut patch.semantic[at..at + PATCH_PX];
            mix_colours(&colours, &cells, 8 * channel as u32, scale.semantic_mean[channel], per_unit, out);
        }
    }
    if colour.is_none() {
        patch.semantic.fill(0.0);
    }
    patch.known_share = if finite { 1.0 - unknown as f32 / PIXELS as f32 } else { 0.0 };
}

#[inline(always)]
fn mix_heights(z: &Corners<f32>, cells: &RowCells, centre_m: f32, per_unit: f32, out: &mut [f32]) {
    for (column, out) in out[..PATCH_PX].iter_mut().enumerate() {
        let south = z.sw[column] + cells.east[column] * (z.se[column] - z.sw[column]);
        let north = z.nw[column] + cells.east[column] * (z.ne[column] - z.nw[column]);
        let height = south + cells.north[column] * (north - south);
        *out = ((height - centre_m) * per_unit).clamp(-1.0, 1.0);
    }
}

#[inline(always)]
fn mix_colours(c: &Corners<u32>, cells: &RowCells, shift: u32, mean: f32, per_unit: f32, out: &mut [f32]) {
    let channel = |packed: u32| ((packed >> shift) & 255) as i32 as f32;
    for (column, out) in out[..PATCH_PX].iter_mut().enumerate() {
        let (sw, se) = (channel(c.sw[column]), channel(c.se[column]));
        let (nw, ne) = (channel(c.nw[column]), channel(c.ne[column]));
        let south = sw + cells.east[column] * (se - sw);
        let north = nw + cells.east[column] * (ne - nw);
        let value = south + cells.north[column] * (north - south);
        *out = ((value - mean) * per_unit).clamp(-1.0, 1.0);
    }
}
