//! Arithmetic on blocks of sixteen samples: one row per feature, one column per sample.
//!
//! Every sample is a lane of its own from the first to the last operation, so a sample's numbers do not depend on its neighbours.

use wide::f32x8;

/// Samples computed together.
pub const LANES: usize = 16;
/// One feature of sixteen samples.
pub type Lane = [f32; LANES];

/// y = W x + b: `weight` (out, in) row-major, `x` (in) lanes, `y` (out) lanes.
pub fn linear(weight: &[f32], bias: &[f32], x: &[Lane], y: &mut [Lane]) {
    const ROWS: usize = 4;
    let inputs = x.len();
    let whole = y.len() / ROWS * ROWS;
    for o in (0..whole).step_by(ROWS) {
        let rows: [&[f32]; ROWS] = core::array::from_fn(|r| &weight[(o + r) * inputs..(o + r + 1) * inputs]);
        let mut acc: [Lane; ROWS] = core::array::from_fn(|r| [bias[o + r]; LANES]);
        for (i, x) in x.iter().enumerate() {
            for r in 0..ROWS {
                let w = rows[r][i];
                for l in 0..LANES {
                    acc[r][l] = w.mul_add(x[l], acc[r][l]);
                }
            }
        }
        y[o..o + ROWS].copy_from_slice(&acc);
    }
    for o in whole..y.len() {
        let mut acc = [bias[o]; LANES];
        for (i, x) in x.iter().enumerate() {
            let w = weight[o * inputs + i];
            for l in 0..LANES {
                acc[l] = w.mul_add(x[l], acc[l]);
            }
        }
        y[o] = acc;
    }
}

/// Layer normalisation over the features.
pub fn layer_norm(x: &[Lane], weight: &[f32], bias: &[f32], eps: f32, y: &mut [Lane]) {
    let n = x.len() as f32;
    let mut mean = [0f32; LANES];
    for row in x {
        for l in 0..LANES {
            mean[l] += row[l];
        }
    }
    let mean = mean.map(|m| m / n);
    let mut variance = [0f32; LANES];
    for row in x {
        for l in 0..LANES {
            let d = row[l] - mean[l];
            variance[l] = d.mul_add(d, variance[l]);
        }
    }
    let inverse = variance.map(|v| 1.0 / (v / n + eps).sqrt());
    for (i, (row, out)) in x.iter().zip(y.iter_mut()).enumerate() {
        for l in 0..LANES {
            out[l] = ((row[l] - mean[l]) * inverse[l]).mul_add(weight[i], bias[i]);
        }
    }
}

/// x += y.
pub fn add_assign(x: &mut [Lane], y: &[Lane]) {
    for (x, y) in x.iter_mut().zip(y) {
        for l in 0..LANES {
            x[l] += y[l];
        }
    }
}

/// Applies a function of eight lanes to each half of a lane.
#[inline(always)]
pub fn map_halves(lane: &mut Lane, f: impl Fn(f32x8) -> f32x8) {
    for half in lane.as_chunks_mut::<8>().0 {
        *half = f(f32x8::from(*half)).to_array();
    }
}

/// GELU, tanh form: x σ(2 √(2/π) (x + 0.044715 x³)).
pub fn gelu(x: &mut [Lane]) {
    let scale = f32x8::splat(-2.0 * 0.797_884_6);
    let cubic = f32x8::splat(0.044_715);
    for lane in x {
        map_halves(lane, |x| {
            let inner = (x * x * x).mul_add(cubic, x);
            x / (f32x8::ONE + (inner * scale).exp())
        });
    }
}

/// Softmax over the rows of `scores`, lane by lane.
pub fn softmax(scores: &mut [Lane]) {
    let mut top = [f32::NEG_INFINITY; LANES];
    for row in scores.iter() {
        for l in 0..LANES {
            top[l] = top[l].max(row[l]);
        }
    }
    let mut total = [0f32; LANES];
    for row in scores.iter_mut() {
        for l in 0..LANES {
            row[l] -= top[l];
        }
        map_halves(row, f32x8::exp);
        for l in 0..LANES {
            total[l] += row[l];
        }
    }
    let inverse = total.map(|t| 1.0 / t);
    for row in scores {
        for l in 0..LANES {
            row[l] *= inverse[l];
        }
    }
}
