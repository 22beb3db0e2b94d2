//! The elevation layer prepared for lookups: holes filled, slopes ready.

use std::collections::VecDeque;

use crate::geometry::{Bilinear, GridGeometry};

/// Side of the square over which slopes are smoothed, about the footprint of a wheel, m (chosen).
const FOOTPRINT_M: f64 = 0.3;

/// Heights, slopes and the mask of known cells, all row-major with row 0 in the south.
#[derive(Debug)]
pub(crate) struct Surface {
    /// Height with holes filled, m.
    pub(crate) height_m: Vec<f32>,
    /// dz/dx, dz/dy at each cell.
    pub(crate) slope: Vec<[f32; 2]>,
    /// True where the height is known; `None` when all are.
    pub(crate) known: Option<Vec<bool>>,
}

impl Surface {
    /// Whether the four cells around a lookup are known.
    #[inline]
    pub(crate) fn is_known(&self, index: usize, width: usize) -> bool {
        self.known.as_ref().is_none_or(|k| k[index] && k[index + 1] && k[index + width] && k[index + width + 1])
    }

    /// Bilinear height, m.
    #[inline]
    pub(crate) fn height(&self, at: Bilinear, width: usize) -> f64 {
        let z = |i: usize| f64::from(self.height_m[i]);
        mix(at, z(at.index), z(at.index + 1), z(at.index + width), z(at.index + width + 1))
    }

    /// Bilinear slope.
    #[inline]
    pub(crate) fn slope(&self, at: Bilinear, width: usize) -> [f64; 2] {
        let [sw, se] = [self.slope[at.index], self.slope[at.index + 1]];
        let [nw, ne] = [self.slope[at.index + width], self.slope[at.index + width + 1]];
        [0, 1].map(|k| mix(at, f64::from(sw[k]), f64::from(se[k]), f64::from(nw[k]), f64::from(ne[k])))
    }
}

/// Bilinear interpolation between the corners south-west, south-east, north-west, north-east.
#[inline]
fn mix(at: Bilinear, sw: f64, se: f64, nw: f64, ne: f64) -> f64 {
    let south = sw + at.east * (se - sw);
    let north = nw + at.east * (ne - nw);
    south + at.north * (north - south)
}

/// Fills holes with the nearest known height (in city-block distance) and returns the mask; `None` when nothing is known.
pub(crate) fn fill_holes(geometry: &GridGeometry, mut height_m: Vec<f32>) -> Option<(Vec<f32>, Option<Vec<bool>>)> {
    if !height_m.iter().any(|z| z.is_nan()) {
        return Some((height_m, None));
    }
    let known: Vec<bool> = height_m.iter().map(|z| !z.is_nan()).collect();
    let mut filled = known.clone();
    // Breadth first from all known cells at once: each hole is reached first from a nearest one.
    let mut front: VecDeque<usize> = (0..known.len()).filter(|i| known[*i]).collect();
    if front.is_empty() {
        return None;
    }
    let (width, height) = (geometry.width, geometry.height);
    while let Some(at) = front.pop_front() {
        let (row, column) = (at / width, at % width);
        let neighbours = [
            (column > 0).then(|| at - 1),
            (column + 1 < width).then(|| at + 1),
            (row > 0).then(|| at - width),
            (row + 1 < height).then(|| at + width),
        ];
        for next in neighbours.into_iter().flatten() {
            if !filled[next] {
                filled[next] = true;
                height_m[next] = height_m[at];
                front.push_back(next);
            }
        }
    }
    Some((height_m, Some(known)))
}

/// Slopes at each cell: central differences over the footprint, averaged over three lines across it; one-sided at the border.
pub(crate) fn footprint_slopes(geometry: &GridGeometry, height_m: &[f32]) -> Vec<[f32; 2]> {
    let (width, height) = (geometry.width, geometry.height);
    let reach = ((FOOTPRINT_M / 2.0 / geometry.resolution_m).round() as usize).max(1);
    let mut slopes = Vec::with_capacity(height_m.len());
    for row in 0..height {
        let (south, north) = (row.saturating_sub(reach), (row + reach).min(height - 1));
        let rise_y = geometry.resolution_m as f32 * (north - south) as f32 * 3.0;
        for column in 0..width {
            let (west, east) = (column.saturating_sub(reach), (column + reach).min(width - 1));
            let rise_x = geometry.resolution_m as f32 * (east - west) as f32 * 3.0;
            let z = |r: usize, c: usize| height_m[r * width + c];
            let x: f32 = [south, row, north].iter().map(|r| z(*r, east) - z(*r, west)).sum();
            let y: f32 = [west, column, east].iter().map(|c| z(north, *c) - z(south, *c)).sum();
            slopes.push([x / rise_x, y / rise_y]);
        }
    }
    slopes
}
