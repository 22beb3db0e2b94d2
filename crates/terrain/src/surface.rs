//! The elevation layer prepared for lookups: holes filled, slopes ready.

use crate::geometry::{Bilinear, GridGeometry};
use crate::holes::{Filled, fill_holes};

/// Side of the square over which slopes are smoothed, about the footprint of a wheel, m (chosen).
const FOOTPRINT_M: f64 = 0.3;

/// Heights, slopes and the mask of known cells, all row-major with row 0 in the south.
#[derive(Debug)]
pub(crate) struct Surface {
    /// Height with holes filled, m.
    pub(crate) height_m: Vec<f32>,
    /// dz/dx, dz/dy at each cell.
    pub(crate) slope: Vec<[f32; 2]>,
    /// True where the height was given, no hole; `None` when all were.
    pub(crate) given: Option<Vec<bool>>,
    /// True where the height was given or is believed (see [`crate::holes`]); `None` when all are.
    pub(crate) known: Option<Vec<bool>>,
}

impl Surface {
    /// Fills the holes of a layer; `None` when nothing is given.
    pub(crate) fn new(geometry: &GridGeometry, elevation_m: Vec<f32>) -> Option<Self> {
        let Filled { height_m, given, known } = fill_holes(geometry, elevation_m)?;
        let slope = footprint_slopes(geometry, &height_m);
        Some(Self { height_m, slope, given, known })
    }

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

/// Slopes at each cell: central differences over the footprint, averaged over three lines across it; one-sided at the border.
fn footprint_slopes(geometry: &GridGeometry, height_m: &[f32]) -> Vec<[f32; 2]> {
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
