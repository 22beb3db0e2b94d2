//! Products of weights and inputs that are both rounded to bf16, summed in f32.
//!
//! Half the bytes of weights, and instructions that take two or more products at once where the processor has them. What comes out differs from f32 by the
//! rounding of the inputs (eight bits of a number are kept); what the two orders of summation differ by is far below that.

use super::kernels::{After, Row};
use super::vector::{LANES, Lane, Order, TILE_PANELS, Tile, Vector};

/// Inputs of a tile.
const INPUTS: usize = 2 * LANES;
/// Outputs of the panels of a group.
pub const OUTPUTS: usize = TILE_PANELS * LANES;

/// A matrix packed for [`linear`]: groups of four panels of sixteen outputs; what is beyond the last output or input is zero.
#[derive(Clone, Debug)]
pub struct PackedBf16 {
    /// (groups, tiles of inputs) of four tiles.
    groups: Vec<[Tile; TILE_PANELS]>,
    bias: Vec<f32>,
    inputs: usize,
    order: Order,
}

/// Inputs of each vector as tiles, and sums of a group of outputs.
#[derive(Clone, Debug)]
pub struct Bf16Buffers {
    inputs: Vec<Tile>,
    sums: Box<[[Lane; LANES]; TILE_PANELS]>,
}

impl Default for Bf16Buffers {
    fn default() -> Self {
        Self { inputs: Vec::new(), sums: Box::new([[Lane::ZERO; LANES]; TILE_PANELS]) }
    }
}

/// The bits of the nearest bf16, of two as near the even one.
fn to_bf16(x: f32) -> u32 {
    u32::from(half::bf16::from_f32(x).to_bits())
}

impl PackedBf16 {
    /// From row-major weights (outputs, inputs) and biases (outputs), for sums in this order. Inputs are even in number.
    pub fn from_rows(order: Order, weight: &[f32], bias: &[f32]) -> Self {
        let inputs = weight.len() / bias.len();
        let of =
            |output: usize, input: usize| if output < bias.len() && input < inputs { to_bf16(weight[output * inputs + input]) } else { 0 };
        let tiles = inputs.div_ceil(INPUTS);
        let tile = |group: usize, tile: usize, panel: usize| {
            let pair = |output: usize, pair: usize| {
                let (output, input) = (group * OUTPUTS + panel * LANES + output, tile * INPUTS + 2 * pair);
                of(output, input) | of(output, input + 1) << 16
            };
            Tile(core::array::from_fn(|row| {
                core::array::from_fn(|column| match order {
                    Order::Tiles => pair(row, column),
                    Order::Pairs => pair(column, row),
                })
            }))
        };
        let groups = bias.len().div_ceil(OUTPUTS);
        Self {
            groups: (0..groups * tiles).map(|i| core::array::from_fn(|panel| tile(i / tiles, i % tiles, panel))).collect(),
            bias: bias.to_vec(),
            inputs,
            order,
        }
    }
}

/// y = W x + b, or what `after` makes of it: `x` (inputs) rows, `y` (outputs) rows in groups of [`OUTPUTS`].
#[inline(always)]
pub fn linear<'a, V: Vector, const H: usize>(
    matrix: &PackedBf16,
    after: After,
    x: &[Row<H>],
    y: impl Iterator<Item = &'a mut [Row<H>]>,
    buffers: &mut Bf16Buffers,
) {
    let tiles = matrix.inputs.div_ceil(INPUTS);
    buffers.inputs.resize(H * tiles, Tile::ZERO);
    for (h, inputs) in buffers.inputs.chunks_exact_mut(tiles).enumerate() {
        let mut rows = x[..matrix.inputs].chunks_exact(2);
        for to in inputs.iter_mut().flat_map(|tile| &mut tile.0) {
            match rows.next() {
                Some(rows) => V::load(&rows[0][h].0).store_pairs(V::load(&rows[1][h].0), to),
                None => *to = [0; LANES],
            }
        }
    }
    // A group of weights is read once and stays near the processor for the other vectors.
    let groups = matrix.groups.chunks_exact(tiles).zip(matrix.bias.chunks(OUTPUTS)).zip(y);
    for ((weights, bias), y) in groups {
        for (h, inputs) in buffers.inputs.chunks_exact(tiles).enumerate() {
            V::products(matrix.order, weights, inputs, &mut buffers.sums);
            for ((sum, bias), y) in buffers.sums.iter().flatten().zip(bias).zip(y.iter_mut()) {
                after.store(V::load(&sum.0).add(V::splat(*bias)), &mut y[h]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::vector::{Kernel, Path};
    use super::*;

    struct Linear<'a, const H: usize>(&'a PackedBf16, &'a [Row<H>], usize);

    impl<const H: usize> Kernel for Linear<'_, H> {
        type Output = Vec<Row<H>>;
        #[inline(always)]
        fn run<V: Vector>(self) -> Self::Output {
            let mut y = vec![[Lane([0.5; LANES]); H]; self.2];
            linear::<V, H>(self.0, After::Add, self.1, y.chunks_mut(OUTPUTS), &mut Bf16Buffers::default());
            y
        }
    }

    /// The sum of one output and sample, number by number as the manuals of the two instructions have it.
    fn by_the_manual(order: Order, products: &[f32]) -> f32 {
        match order {
            Order::Pairs => products.chunks(2).fold(0.0, |sum, pair| (sum + pair[1]) + pair[0]),
            Order::Tiles => products.chunks(INPUTS).fold(0.0, |sum, tile| {
                let every_second = |from: usize| tile[from..].iter().step_by(2).fold(0.0f32, |sum, product| sum + product);
                sum + (every_second(0) + every_second(1))
            }),
        }
    }

    fn check<const H: usize>(outputs: usize, inputs: usize) {
        let mut state = outputs as u32 * 7919 + inputs as u32;
        let mut noise = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / 8_388_608.0 - 1.0
        };
        let weight: Vec<f32> = (0..outputs * inputs).map(|_| noise()).collect();
        let bias: Vec<f32> = (0..outputs).map(|_| noise()).collect();
        let x: Vec<Row<H>> = (0..inputs).map(|_| core::array::from_fn(|_| Lane::from_fn(|_| noise()))).collect();
        let rounded = |x: f32| f32::from_bits(to_bf16(x) << 16);
        for order in [Order::Tiles, Order::Pairs] {
            let matrix = PackedBf16::from_rows(order, &weight, &bias);
            let paths = Path::available().into_iter().chain(Path::for_bf16().into_iter().map(|(_, path)| path));
            for path in paths {
                let found = path.run_with_bf16(Linear(&matrix, &x, outputs));
                for (o, row) in found.iter().enumerate() {
                    for (lane, found) in row.iter().flat_map(|row| row.0).enumerate() {
                        let sample = |i: usize| x[i][lane / LANES][lane % LANES];
                        let products: Vec<f32> = (0..inputs).map(|i| rounded(weight[o * inputs + i]) * rounded(sample(i))).collect();
                        let expected = 0.5 + (by_the_manual(order, &products) + bias[o]);
                        assert_eq!(
                            found.to_bits(),
                            expected.to_bits(),
                            "{} in the order of {order:?}: output {o}, sample {lane}",
                            path.as_str()
                        );
                        let in_f32: f64 = (0..inputs).map(|i| f64::from(weight[o * inputs + i]) * f64::from(sample(i))).sum();
                        let off = f64::from(found - 0.5 - bias[o]) - in_f32;
                        assert!(off.abs() < 0.01 * (inputs as f64).sqrt(), "output {o} is {off} from the sum of what was not rounded");
                    }
                }
            }
        }
    }

    #[test]
    fn analytic_sums_of_bf16_are_those_of_the_manuals_on_every_path() {
        for (outputs, inputs) in [(384, 128), (128, 256), (16, 32), (70, 34), (1, 2)] {
            check::<1>(outputs, inputs);
            check::<2>(outputs, inputs);
        }
    }
}
