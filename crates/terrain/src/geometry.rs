//! Where the cells of a map lie in World.

/// Planar pose in World: x, y in m, yaw in rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose2 {
    /// East, m.
    pub x_m: f64,
    /// North, m.
    pub y_m: f64,
    /// Heading, rad, counter-clockwise from east.
    pub yaw_rad: f64,
}

/// A regular grid, pixel-is-point: cell (column i, row j) is the point `origin + resolution * (i, j)`.
///
/// Row 0 is the SOUTH row (smallest y): storage order is the order of World, images are flipped when they are read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridGeometry {
    /// World position of cell (0, 0), the south-west corner, m.
    pub origin_m: [f64; 2],
    /// Distance between neighbouring cells, m.
    pub resolution_m: f64,
    /// Columns (along x).
    pub width: usize,
    /// Rows (along y).
    pub height: usize,
}

/// Most cells of one map: 4096 x 4096, i.e. 410 m at 0.1 m. A larger map would take more than 270 MB in memory; it is refused.
pub const MAX_CELLS: usize = 4096 * 4096;

/// Farthest origin of a map from that of World, along x and y, m; beyond it positions lose the digits that a cell needs.
pub const ORIGIN_MAX_M: f64 = 1e7;

impl GridGeometry {
    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.width * self.height
    }

    /// Grid coordinates (column, row) of a World point, in cells; may lie outside the grid.
    #[inline]
    pub fn to_grid(&self, x_m: f64, y_m: f64) -> [f64; 2] {
        [(x_m - self.origin_m[0]) / self.resolution_m, (y_m - self.origin_m[1]) / self.resolution_m]
    }

    /// World position of a cell, m.
    pub fn to_world(&self, column: usize, row: usize) -> [f64; 2] {
        [self.origin_m[0] + self.resolution_m * column as f64, self.origin_m[1] + self.resolution_m * row as f64]
    }

    /// Middle of the grid in World, m.
    #[inline]
    pub fn middle_m(&self) -> [f64; 2] {
        let half = |cells: usize| 0.5 * self.resolution_m * (cells - 1) as f64;
        [self.origin_m[0] + half(self.width), self.origin_m[1] + half(self.height)]
    }

    /// Whether a World point lies in the closed rectangle spanned by the cell points.
    ///
    /// A slack of 1e-9 cells keeps the outermost points inside in spite of rounding.
    #[inline]
    pub fn contains(&self, x_m: f64, y_m: f64) -> bool {
        const SLACK: f64 = 1e-9;
        let [u, v] = self.to_grid(x_m, y_m);
        // A NaN compares false and so is outside.
        u >= -SLACK && v >= -SLACK && u <= (self.width - 1) as f64 + SLACK && v <= (self.height - 1) as f64 + SLACK
    }

    /// Checks the geometry; the first wrong field and the reason otherwise.
    pub(crate) fn check(&self) -> Result<(), (&'static str, String)> {
        if !self.origin_m.iter().all(|o| o.is_finite() && o.abs() <= ORIGIN_MAX_M) {
            return Err(("origin_m", format!("{:?} is not finite or beyond {ORIGIN_MAX_M:e} m", self.origin_m)));
        }
        if !(self.resolution_m.is_finite() && self.resolution_m >= 1e-3 && self.resolution_m <= 1e3) {
            return Err(("resolution_m", format!("{} is outside 0.001..=1000 m", self.resolution_m)));
        }
        for (field, side) in [("width", self.width), ("height", self.height)] {
            if side < 2 {
                return Err((field, format!("{side} cells, at least 2 are needed")));
            }
        }
        if self.width.checked_mul(self.height).is_none_or(|n| n > MAX_CELLS) {
            return Err(("width", format!("{} x {} cells exceed the limit of {MAX_CELLS}", self.width, self.height)));
        }
        Ok(())
    }
}

/// The lower-left cell and the fractions of a bilinear lookup, clamped into the grid.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bilinear {
    /// Flat index of the south-west cell of the four.
    pub(crate) index: usize,
    /// Fraction towards east, 0..=1.
    pub(crate) east: f64,
    /// Fraction towards north, 0..=1.
    pub(crate) north: f64,
}

impl GridGeometry {
    /// Bilinear lookup at a World point; points outside are clamped to the border (NaN to the origin).
    #[inline]
    pub(crate) fn bilinear(&self, x_m: f64, y_m: f64) -> Bilinear {
        let [u, v] = self.to_grid(x_m, y_m);
        let (column, east) = split(u, self.width);
        let (row, north) = split(v, self.height);
        Bilinear { index: row * self.width + column, east, north }
    }
}

/// Splits a grid coordinate into a cell that has an upper neighbour, and the fraction towards it.
#[inline]
fn split(coordinate: f64, side: usize) -> (usize, f64) {
    // `max` before `min`: a NaN becomes 0.
    let clamped = coordinate.max(0.0).min((side - 1) as f64);
    let cell = (clamped as usize).min(side - 2);
    (cell, clamped - cell as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_grid_and_world_are_inverse() {
        let grid = GridGeometry { origin_m: [-40.0, -40.0], resolution_m: 0.1, width: 801, height: 801 };
        let [x, y] = grid.to_world(17, 700);
        let [u, v] = grid.to_grid(x, y);
        assert!((u - 17.0).abs() < 1e-9 && (v - 700.0).abs() < 1e-9);
        assert!(grid.contains(40.0, 40.0) && grid.contains(-40.0, -40.0));
        assert!(!grid.contains(40.01, 0.0) && !grid.contains(f64::NAN, 0.0));
    }

    #[test]
    fn analytic_bad_geometry_is_refused() {
        let good = GridGeometry { origin_m: [0.0, 0.0], resolution_m: 0.1, width: 10, height: 10 };
        assert!(good.check().is_ok());
        assert_eq!(GridGeometry { origin_m: [f64::NAN, 0.0], ..good }.check().unwrap_err().0, "origin_m");
        assert_eq!(GridGeometry { resolution_m: 0.0, ..good }.check().unwrap_err().0, "resolution_m");
        assert_eq!(GridGeometry { resolution_m: f64::INFINITY, ..good }.check().unwrap_err().0, "resolution_m");
        assert_eq!(GridGeometry { width: 1, ..good }.check().unwrap_err().0, "width");
        assert_eq!(GridGeometry { width: 1 << 40, height: 1 << 40, ..good }.check().unwrap_err().0, "width");
        assert_eq!(GridGeometry { width: 8192, height: 8192, ..good }.check().unwrap_err().0, "width");
    }
}
