//! Where evidence belongs.

/// What the ground looks like: red, green and blue of the semantic map; black where it has none.
pub type Colour = [u8; 3];

/// Width of a colour bin, levels. Images are textured: exact colours would make every pixel a class of its own.
const BIN: u8 = 16;

/// A cell of the map and a colour bin in it. Ordered, so that everything that walks over cells does so in the same order.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CellKey {
    /// World map that the vehicle drives on.
    pub map: String,
    /// Colour under the vehicle, the middle of its bin.
    pub colour: Colour,
    /// floor(x / cell) and floor(y / cell) in World.
    pub cell: [i32; 2],
}

impl CellKey {
    /// The cell at a position in World, m.
    pub fn at(map: &str, colour: Colour, position_m: [f64; 2], cell_m: f64) -> Self {
        let colour = colour.map(|level| level / BIN * BIN + BIN / 2);
        // A float beyond the range of the integer becomes its end.
        Self { map: map.into(), colour, cell: position_m.map(|v| (v / cell_m).floor() as i32) }
    }

    /// Middle of the cell, m.
    pub fn centre_m(&self, cell_m: f64) -> [f64; 2] {
        self.cell.map(|index| (f64::from(index) + 0.5) * cell_m)
    }
}
