//! The arithmetic of the network: rows of features, blocks of samples in lanes.
//!
//! A row holds one feature of 16 H samples. Every sample is a lane of its own from the first to the last operation, so its numbers do not depend on its
//! neighbours, on H or on the path. Everything here is `#[inline(always)]`: it must end up inside a function that is compiled for the vectors' instructions.

use super::elementary::{exp, gelu, silu};
use super::vector::{Lane, Vector};

/// One feature of 16 H samples.
pub type Row<const H: usize> = [Lane; H];

/// Rows of weights that a tile computes together.
pub const PANEL: usize = 8;

/// A matrix packed for [`linear`]: panels of eight outputs, input by input; outputs beyond the last are zero.
#[derive(Clone, Debug, Default)]
pub struct Packed {
    /// (panels, inputs) of eight weights.
    panels: Vec<[f32; PANEL]>,
    bias: Vec<[f32; PANEL]>,
    inputs: usize,
}

impl Packed {
    /// From the weight of each (output, input) and the bias of each output.
    pub fn new(outputs: usize, inputs: usize, weight: impl Fn(usize, usize) -> f32, bias: impl Fn(usize) -> f32) -> Self {
        let panel = |panel: usize, value: &dyn Fn(usize) -> f32| {
            core::array::from_fn(|r| if panel * PANEL + r < outputs { value(panel * PANEL + r) } else { 0.0 })
        };
        let count = outputs.div_ceil(PANEL);
        Self {
            panels: (0..count * inputs).map(|i| panel(i / inputs, &|output| weight(output, i % inputs))).collect(),
            bias: (0..count).map(|p| panel(p, &bias)).collect(),
            inputs,
        }
    }

    /// From row-major weights (outputs, inputs) and biases (outputs).
    pub fn from_rows(weight: &[f32], bias: &[f32]) -> Self {
        let inputs = weight.len() / bias.len();
        Self::new(bias.len(), inputs, |o, i| weight[o * inputs + i], |o| bias[o])
    }

    /// Outputs, filled up to whole panels: the rows that [`linear`] writes.
    #[cfg(test)]
    pub fn padded_outputs(&self) -> usize {
        self.bias.len() * PANEL
    }
}

/// What becomes of the result of [`linear`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum After {
    /// y = W x + b.
    Store,
    /// y = GELU(W x + b).
    Gelu,
    /// y = SiLU(W x + b).
    Silu,
    /// y += W x + b.
    Add,
}

impl After {
    /// Stores what becomes of W x + b.
    #[inline(always)]
    pub fn store<V: Vector>(self, sum: V, y: &mut Lane) {
        let value = match self {
            Self::Store => sum,
            Self::Gelu => gelu(sum),
            Self::Silu => silu(sum),
            Self::Add => V::load(&y.0).add(sum),
        };
        value.store(&mut y.0);
    }
}

/// y = W x + b, or what `after` makes of it: `x` (inputs) rows, `y` (padded outputs) rows. Sums run over the inputs in order.
#[inline(always)]
pub fn linear<V: Vector, const H: usize>(matrix: &Packed, after: After, x: &[Row<H>], y: &mut [Row<H>]) {
    linear_of::<V, H, _>(matrix, after, &x[..matrix.inputs], y.chunks_exact_mut(PANEL));
}

/// The same with rows that lie anywhere: inputs as any collection that gives as many as the matrix has, outputs as panels of eight.
#[inline(always)]
pub fn linear_of<'a, V: Vector, const H: usize, X>(matrix: &Packed, after: After, x: X, y: impl Iterator<Item = &'a mut [Row<H>]>)
where
    X: IntoIterator<Item = &'a Row<H>> + Copy,
{
    let panels = matrix.panels.chunks_exact(matrix.inputs).zip(&matrix.bias).zip(y);
    for ((weights, bias), y) in panels {
        if V::WIDE {
            tile::<V, PANEL, H, H>(weights, bias, 0, 0, after, x, y);
        } else {
            // Half as many registers, each half as wide.
            for half in 0..H {
                tile::<V, 4, 1, H>(weights, bias, 0, half, after, x, y);
                tile::<V, 4, 1, H>(weights, bias, 4, half, after, x, y);
            }
        }
    }
}

/// R outputs from `first` of a panel for W of the H vectors of a row from `from`.
#[inline(always)]
fn tile<'a, V: Vector, const R: usize, const W: usize, const H: usize>(
    weights: &[[f32; PANEL]],
    bias: &[f32; PANEL],
    first: usize,
    from: usize,
    after: After,
    x: impl IntoIterator<Item = &'a Row<H>>,
    y: &mut [Row<H>],
) {
    let mut sums = [[V::splat(0.0); W]; R];
    for r in 0..R {
        sums[r] = [V::splat(bias[first + r]); W];
    }
    for (weights, x) in weights.iter().zip(x) {
        let mut inputs = [V::splat(0.0); W];
        for w in 0..W {
            inputs[w] = V::load(&x[from + w].0);
        }
        for r in 0..R {
            let weight = V::splat(weights[first + r]);
            for w in 0..W {
                sums[r][w] = weight.mul_add(inputs[w], sums[r][w]);
            }
        }
    }
    for r in 0..R {
        for w in 0..W {
            after.store(sums[r][w], &mut y[first + r][from + w]);
        }
    }
}

/// Layer normalisation over the features. `x`, `y` (features) rows; features are a multiple of four.
#[inline(always)]
pub fn layer_norm<V: Vector, const H: usize>(x: &[Row<H>], weight: &[f32], bias: &[f32], eps: f32, y: &mut [Row<H>]) {
    let share = V::splat(1.0 / x.len() as f32);
    for h in 0..H {
        // Four sums at a time, so that an add need not wait for the one before.
        let mut sums = [V::splat(0.0); 4];
        for rows in x.chunks_exact(4) {
            for i in 0..4 {
                sums[i] = sums[i].add(V::load(&rows[i][h].0));
            }
        }
        let mean = sums[0].add(sums[1]).add(sums[2].add(sums[3])).mul(share);
        let mut squares = [V::splat(0.0); 4];
        for rows in x.chunks_exact(4) {
            for i in 0..4 {
                let away = V::load(&rows[i][h].0).sub(mean);
                squares[i] = away.mul_add(away, squares[i]);
            }
        }
        let variance = squares[0].add(squares[1]).add(squares[2].add(squares[3])).mul(share);
        let inverse = V::splat(1.0).div(variance.add(V::splat(eps)).sqrt());
        for (((x, y), weight), bias) in x.iter().zip(y.iter_mut()).zip(weight).zip(bias) {
            V::load(&x[h].0).sub(mean).mul(inverse).mul_add(V::splat(*weight), V::splat(*bias)).store(&mut y[h].0);
        }
    }
}

/// y += row by row.
#[inline(always)]
pub fn add_rows<V: Vector, const H: usize>(y: &mut [Row<H>], x: &[Row<H>]) {
    for (y, x) in y.iter_mut().zip(x) {
        for h in 0..H {
            V::load(&y[h].0).add(V::load(&x[h].0)).store(&mut y[h].0);
        }
    }
}

/// Softmax of `scale` · scores over the rows, lane by lane.
#[inline(always)]
pub fn softmax<V: Vector, const H: usize>(scores: &mut [Row<H>], scale: f32) {
    let scale = V::splat(scale);
    for h in 0..H {
        let mut top = V::splat(f32::NEG_INFINITY);
        for row in scores.iter() {
            top = top.max(V::load(&row[h].0));
        }
        let mut total = V::splat(0.0);
        for row in scores.iter_mut() {
            let weight = exp(V::load(&row[h].0).sub(top).mul(scale));
            total = total.add(weight);
            weight.store(&mut row[h].0);
        }
        let share = V::splat(1.0).div(total);
        for row in scores.iter_mut() {
            V::load(&row[h].0).mul(share).store(&mut row[h].0);
        }
    }
}

/// scores(t) = Σ_d keys(t, d) query(d) of each sample's own keys: `keys` (tokens) by (stride) rows, of which the first `query.len()` count.
#[inline(always)]
pub fn own_scores<V: Vector, const H: usize>(keys: &[Row<H>], stride: usize, query: &[Row<H>], scores: &mut [Row<H>]) {
    if V::WIDE {
        scores_of::<V, H, H>(keys, stride, query, scores);
    } else {
        scores_of::<V, 1, H>(keys, stride, query, scores);
    }
}

/// The same for W of the H vectors of a row at a time.
#[inline(always)]
fn scores_of<V: Vector, const W: usize, const H: usize>(keys: &[Row<H>], stride: usize, query: &[Row<H>], scores: &mut [Row<H>]) {
    const T: usize = 4;
    for (group, scores) in scores.chunks_mut(T).enumerate() {
        // Past the last token the cache holds older numbers; their sums are not stored.
        let tokens: [&[Row<H>]; T] = core::array::from_fn(|t| {
            let at = (group * T + t.min(scores.len() - 1)) * stride;
            &keys[at..at + query.len()]
        });
        for from in (0..H).step_by(W) {
            let mut sums = [[V::splat(0.0); W]; T];
            for (d, query) in query.iter().enumerate() {
                for w in 0..W {
                    let query = V::load(&query[from + w].0);
                    for t in 0..T {
                        sums[t][w] = V::load(&tokens[t][d][from + w].0).mul_add(query, sums[t][w]);
                    }
                }
            }
            for (score, sums) in scores.iter_mut().zip(sums) {
                for w in 0..W {
                    sums[w].store(&mut score[from + w].0);
                }
            }
        }
    }
}

/// out(d) += Σ_t weights(t) values(t, d) of each sample's own values, laid out as the keys of [`own_scores`].
#[inline(always)]
pub fn own_values<V: Vector, const H: usize>(values: &[Row<H>], stride: usize, weights: &[Row<H>], out: &mut [Row<H>]) {
    if V::WIDE {
        values_of::<V, H, H>(values, stride, weights, out);
    } else {
        values_of::<V, 1, H>(values, stride, weights, out);
    }
}

/// The same for W of the H vectors of a row at a time.
#[inline(always)]
fn values_of<V: Vector, const W: usize, const H: usize>(values: &[Row<H>], stride: usize, weights: &[Row<H>], out: &mut [Row<H>]) {
    const D: usize = 8;
    for (group, out) in out.chunks_exact_mut(D).enumerate() {
        for from in (0..H).step_by(W) {
            let mut sums = [[V::splat(0.0); W]; D];
            for d in 0..D {
                for w in 0..W {
                    sums[d][w] = V::load(&out[d][from + w].0);
                }
            }
            for (t, weight) in weights.iter().enumerate() {
                let values = &values[t * stride + group * D..][..D];
                for w in 0..W {
                    let weight = V::load(&weight[from + w].0);
                    for d in 0..D {
                        sums[d][w] = V::load(&values[d][from + w].0).mul_add(weight, sums[d][w]);
                    }
                }
            }
            for d in 0..D {
                for w in 0..W {
                    sums[d][w].store(&mut out[d][from + w].0);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::vector::{Kernel, LANES, Path};
    use super::*;

    /// Numbers in (-1, 1), the same for the same seed.
    fn noise(seed: usize) -> impl FnMut() -> f32 {
        let mut state = seed as u32 * 747_796_405 + 1;
        move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / 8_388_608.0 - 1.0
        }
    }

    fn rows<const H: usize>(count: usize, next: &mut impl FnMut() -> f32) -> Vec<Row<H>> {
        (0..count).map(|_| core::array::from_fn(|_| Lane::from_fn(|_| next()))).collect()
    }

    /// Every kernel one after the other on rows of 16 H samples: linear with each ending, layer norm, attention over own keys and values.
    struct Everything<'a, const H: usize> {
        matrix: &'a Packed,
        x: &'a [Row<H>],
        y: &'a [Row<H>],
        weight: &'a [f32],
        tokens: usize,
    }

    impl<const H: usize> Kernel for Everything<'_, H> {
        type Output = Vec<Vec<Row<H>>>;
        #[inline(always)]
        fn run<V: Vector>(self) -> Self::Output {
            let mut out = Vec::new();
            for after in [After::Store, After::Gelu, After::Silu, After::Add] {
                let mut y = self.y.to_vec();
                linear::<V, H>(self.matrix, after, self.x, &mut y);
                out.push(y);
            }
            let mut normal = self.x.to_vec();
            layer_norm::<V, H>(self.x, self.weight, self.weight, 1e-5, &mut normal);
            out.push(normal);
            let stride = self.x.len() / self.tokens;
            let features = stride / 8 * 8;
            let mut scores = vec![[Lane::ZERO; H]; self.tokens];
            own_scores::<V, H>(self.x, stride, &self.x[..features], &mut scores);
            out.push(scores.clone());
            softmax::<V, H>(&mut scores, 0.5);
            out.push(scores.clone());
            let mut sums = self.x[..features].to_vec();
            own_values::<V, H>(self.x, stride, &scores, &mut sums);
            out.push(sums);
            out
        }
    }

    fn check<const H: usize>(outputs: usize, inputs: usize, tokens: usize) {
        let mut next = noise(outputs * 1000 + inputs * 10 + tokens + H);
        let weights: Vec<f32> = (0..outputs * inputs).map(|_| next()).collect();
        let bias: Vec<f32> = (0..outputs).map(|_| next()).collect();
        let matrix = Packed::from_rows(&weights, &bias);
        let (x, y) = (rows::<H>(inputs, &mut next), rows::<H>(matrix.padded_outputs(), &mut next));
        let weight: Vec<f32> = (0..inputs).map(|_| next()).collect();
        let everything = || Everything { matrix: &matrix, x: &x, y: &y, weight: &weight, tokens };
        let found = Path::run_on_target(everything());
        for path in Path::available() {
            // Without a fused multiply-add the target's path rounds twice.
            if cfg!(any(target_feature = "fma", target_arch = "aarch64")) {
                assert_eq!(
                    path.run(everything()),
                    found,
                    "{} and the target's path differ for {outputs} x {inputs}, H = {H}",
                    path.as_str()
                );
            }
        }
        for lane in 0..16 * H {
            let at = |rows: &[Row<H>], i: usize| f64::from(rows[i][lane / LANES][lane % LANES]);
            let close = |found: f64, expected: f64, what: &str| {
                assert!((found - expected).abs() < 1e-5 * (1.0 + expected.abs()) * (inputs as f64).sqrt(), "{what}: {found} {expected}");
            };
            for o in 0..outputs {
                let sum = f64::from(bias[o]) + (0..inputs).map(|i| f64::from(weights[o * inputs + i]) * at(&x, i)).sum::<f64>();
                close(at(&found[0], o), sum, "linear");
                close(at(&found[1], o), sum / (1.0 + (-1.595_769_2 * (sum + 0.044_715 * sum.powi(3))).exp()), "gelu");
                close(at(&found[2], o), sum / (1.0 + (-sum).exp()), "silu");
                close(at(&found[3], o), at(&y, o) + sum, "add");
            }
            let mean = (0..inputs).map(|i| at(&x, i)).sum::<f64>() / inputs as f64;
            let variance = (0..inputs).map(|i| (at(&x, i) - mean).powi(2)).sum::<f64>() / inputs as f64;
            for i in 0..inputs {
                let scaled = (at(&x, i) - mean) / (variance + 1e-5).sqrt() * f64::from(weight[i]) + f64::from(weight[i]);
                close(at(&found[4], i), scaled, "layer norm");
            }
            let stride = inputs / tokens;
            let features = stride / 8 * 8;
            let score = |t: usize| (0..features).map(|d| at(&x, t * stride + d) * at(&x, d)).sum::<f64>();
            let total: f64 = (0..tokens).map(|t| (0.5 * score(t)).exp()).sum();
            for t in 0..tokens {
                close(at(&found[5], t), score(t), "score");
                close(at(&found[6], t), (0.5 * score(t)).exp() / total, "softmax");
            }
            for d in 0..features {
                let sum: f64 = (0..tokens).map(|t| (0.5 * score(t)).exp() / total * at(&x, t * stride + d)).sum();
                close(at(&found[7], d), at(&x, d) + sum, "values");
            }
        }
    }

    #[test]
    fn analytic_kernels_equal_plain_sums_on_every_path() {
        for (outputs, inputs, tokens) in [(8, 32, 1), (16, 128, 4), (3, 40, 5), (24, 36, 3), (1, 64, 7), (128, 12, 1)] {
            check::<1>(outputs, inputs, tokens);
            check::<2>(outputs, inputs, tokens);
        }
    }
}
