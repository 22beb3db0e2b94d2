//! Sharing of the projection W_c among neighbouring cells of the terrain context.
//!
//! A context has 9216 values, so W_c holds four fifths of all weights, and with a few hundred drives they learn places by heart. Cells of
//! an n × n block that share one weight act as one cell with the block's mean: W_c stays a linear map of the whole context, as the paper has
//! it, with n² times fewer numbers to learn.

use nesam_model::dims::{CONTEXT, FEATURE_CHANNELS, FEATURE_PX, FEATURES};

/// Blocks of n × n cells in both feature maps.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pooling {
    cells: usize,
    /// Block of every value of a context.
    block_of: Vec<u32>,
}

impl Pooling {
    /// Blocks of `cells` × `cells`; `None` when they do not tile the 16 × 16 feature maps.
    pub fn new(cells: usize) -> Option<Self> {
        if cells == 0 || !FEATURE_PX.is_multiple_of(cells) {
            return None;
        }
        let blocks = FEATURE_PX / cells;
        let block_of = (0..CONTEXT).map(|i| {
            let (map, value) = (i / FEATURES, i % FEATURES);
            let (cell, channel) = (value / FEATURE_CHANNELS, value % FEATURE_CHANNELS);
            let (row, column) = (cell / FEATURE_PX / cells, cell % FEATURE_PX / cells);
            (((map * blocks + row) * blocks + column) * FEATURE_CHANNELS + channel) as u32
        });
        Some(Self { cells, block_of: block_of.collect() })
    }

    /// Cells along a side of a block.
    pub fn cells(&self) -> usize {
        self.cells
    }

    /// Values of a pooled context.
    pub fn width(&self) -> usize {
        CONTEXT / (self.cells * self.cells)
    }

    /// Sum over each block: (9216) -> (width).
    pub fn sum(&self, context: &[f32]) -> Vec<f32> {
        let mut sums = vec![0.0; self.width()];
        for (value, block) in context.iter().zip(&self.block_of) {
            sums[*block as usize] += value;
        }
        sums
    }

    /// Mean over each block: (9216) -> (width).
    pub fn mean(&self, context: &[f32]) -> Vec<f32> {
        let share = 1.0 / (self.cells * self.cells) as f32;
        self.sum(context).into_iter().map(|sum| sum * share).collect()
    }

    /// The value of its block for every cell: (width) -> (9216).
    pub fn spread<'a>(&'a self, pooled: &'a [f32]) -> impl Iterator<Item = f32> + 'a {
        self.block_of.iter().map(|block| pooled[*block as usize])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_blocks_hold_neighbours_of_one_channel_and_one_map() {
        let pooling = Pooling::new(4).unwrap();
        let at = |map: usize, row: usize, column: usize, channel: usize| {
            map * FEATURES + (row * FEATURE_PX + column) * FEATURE_CHANNELS + channel
        };
        let mut context = vec![0.0; CONTEXT];
        for (row, column) in (4..8).flat_map(|row| (8..12).map(move |column| (row, column))) {
            context[at(1, row, column, 3)] = 2.0;
        }
        let mean = pooling.mean(&context);
        assert_eq!(mean.iter().filter(|v| **v != 0.0).collect::<Vec<_>>(), [&2.0]);
        assert_eq!(pooling.sum(&context).iter().sum::<f32>(), 32.0);
        assert!(pooling.spread(&mean).eq(context));
    }

    #[test]
    fn property_single_cells_change_nothing_and_odd_blocks_are_refused() {
        let pooling = Pooling::new(1).unwrap();
        let context: Vec<f32> = (0..CONTEXT).map(|i| i as f32).collect();
        assert_eq!(pooling.mean(&context), context);
        assert!(Pooling::new(3).is_none() && Pooling::new(0).is_none() && Pooling::new(32).is_none());
    }
}
