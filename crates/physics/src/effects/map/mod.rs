//! Effects on the map: where the ground truly is.

mod map_offset;
mod map_tilt;

pub use map_offset::MapOffset;
pub use map_tilt::MapTilt;

/// What effects change of the map; all zero by default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MapTerms {
    /// True height over mapped height in the middle of the map, m.
    pub offset_m: f64,
    /// Tilt of the true ground against the map: (pitch about y, roll about x of World), rad.
    pub tilt_rad: [f64; 2],
}

impl MapTerms {
    /// True height (m) and slope along x and y of World of a mapped point, x and y from the middle of the map; as mapped without effects, bit for bit.
    #[inline]
    pub fn raised(&self, x_m: f64, y_m: f64, (height_m, slope): (f64, [f64; 2])) -> (f64, [f64; 2]) {
        if *self == Self::default() {
            return (height_m, slope);
        }
        let [pitch, roll] = self.tilt_rad;
        let (east, north) = (-pitch.tan(), roll.tan());
        (height_m + self.offset_m + east * x_m + north * y_m, [slope[0] + east, slope[1] + north])
    }
}
