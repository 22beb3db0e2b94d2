//! One token through the Transformer in f64 or duals.

use nesam_physics::{STATE_DIM, WHEELS};

use crate::dims::*;
use crate::fused::{Block, Dense, FusedTransformer, Prefix};
use crate::tangent::Number;

/// Keys and values of the steps so far: per block (steps, 128).
#[derive(Clone, Debug)]
pub struct ExactCache<T> {
    keys: Vec<Vec<T>>,
    values: Vec<Vec<T>>,
    steps: usize,
}

impl<T: Number> ExactCache<T> {
    /// Nothing yet.
    pub fn new() -> Self {
        Self { keys: vec![Vec::new(); BLOCKS], values: vec![Vec::new(); BLOCKS], steps: 0 }
    }
}

impl ExactCache<f64> {
    /// The first steps of this cache as constants.
    pub fn first<T: Number>(&self, steps: usize) -> ExactCache<T> {
        let constants =
            |rows: &Vec<Vec<f64>>| rows.iter().map(|block| block[..steps * HIDDEN].iter().map(|v| T::lit(*v)).collect()).collect();
        ExactCache { keys: constants(&self.keys), values: constants(&self.values), steps }
    }
}

/// The weights of the fast path, used one token at a time.
#[derive(Clone, Copy, Debug)]
pub struct ExactTransformer<'a>(pub &'a FusedTransformer);

/// y = W x + b.
fn linear<T: Number>(dense: &Dense, x: &[T]) -> Vec<T> {
    let inputs = x.len();
    let row = |(bias, row): (&f32, &[f32])| {
        let mut sum = T::lit(f64::from(*bias));
        row.iter().zip(x).for_each(|(weight, x)| sum.add_scaled(f64::from(*weight), x));
        sum
    };
    dense.bias.iter().zip(dense.weight.chunks_exact(inputs)).map(row).collect()
}

/// Layer normalisation over the features.
fn layer_norm<T: Number>(x: &[T], dense: &Dense) -> Vec<T> {
    let share = T::lit(1.0 / x.len() as f64);
    let sum = |numbers: &mut dyn Iterator<Item = T>| numbers.fold(T::lit(0.0), |sum, v| sum + v) * share;
    let mean = sum(&mut x.iter().copied());
    let variance = sum(&mut x.iter().map(|v| (*v - mean).sqr()));
    let inverse = T::lit(1.0) / (variance + T::lit(f64::from(NORM_EPS))).sqrt();
    let scaled = |(v, (weight, bias)): (&T, (&f32, &f32))| {
        let mut out = T::lit(f64::from(*bias));
        out.add_scaled(f64::from(*weight), &((*v - mean) * inverse));
        out
    };
    x.iter().zip(dense.weight.iter().zip(&dense.bias)).map(scaled).collect()
}

/// GELU, tanh form, as x σ(2 √(2/π) (x + 0.044715 x³)).
fn gelu<T: Number>(x: T) -> T {
    let inner = x + x * x * x * T::lit(0.044_715);
    // e^40 is far beyond where σ is 0 or 1.
    let exponent = (inner * T::lit(-2.0 * 0.797_884_6)).max(T::lit(-40.0)).min(T::lit(40.0));
    x / (T::lit(1.0) + exponent.exp())
}

fn add<T: Number>(x: &mut [T], y: &[T]) {
    x.iter_mut().zip(y).for_each(|(x, y)| *x = *x + *y);
}

impl ExactTransformer<'_> {
    /// One step: scaled entries and the context token W_c c in, raw sinkage (4) and raw residual (12) out; extends the cache.
    pub fn step<T: Number>(
        &self,
        prefix: &Prefix,
        cache: &mut ExactCache<T>,
        entries: &[T; STATE_CONTROL],
        context: &[f32],
    ) -> ([T; WHEELS], [T; STATE_DIM]) {
        let position = (HISTORY - 1 + cache.steps).min(POSITIONS - 1);
        let mut x = linear(&self.0.token, entries);
        for (o, x) in x.iter_mut().enumerate() {
            *x = *x + T::lit(f64::from(context[o]) + f64::from(self.0.position[position * HIDDEN + o]));
        }
        for (index, block) in self.0.blocks.iter().enumerate() {
            let qkv = linear(&block.qkv, &layer_norm(&x, &block.norm1));
            cache.keys[index].extend_from_slice(&qkv[HIDDEN..2 * HIDDEN]);
            cache.values[index].extend_from_slice(&qkv[2 * HIDDEN..]);
            let attended = attend(&qkv[..HIDDEN], prefix, cache, index);
            finish(block, &mut x, &attended);
        }
        cache.steps += 1;
        let normal = layer_norm(&x, &self.0.norm);
        let (sinkage, residual) = (linear(&self.0.sinkage, &normal), linear(&self.0.residual, &normal));
        (core::array::from_fn(|i| sinkage[i]), core::array::from_fn(|i| residual[i]))
    }
}

/// Output projection and feed-forward network, both added to x.
fn finish<T: Number>(block: &Block, x: &mut [T], attended: &[T]) {
    add(x, &linear(&block.out, attended));
    let mut hidden = linear(&block.up, &layer_norm(x, &block.norm2));
    hidden.iter_mut().for_each(|h| *h = gelu(*h));
    add(x, &linear(&block.down, &hidden));
}

/// Attention of one token over the measured history (constants) and the steps so far, its own included.
fn attend<T: Number>(query: &[T], prefix: &Prefix, cache: &ExactCache<T>, block: usize) -> Vec<T> {
    let scale = T::lit(1.0 / (HEAD_DIM as f64).sqrt());
    let mut attended = vec![T::lit(0.0); HIDDEN];
    let at = |token: usize, from: usize| token * HIDDEN + from..token * HIDDEN + from + HEAD_DIM;
    for from in (0..HIDDEN).step_by(HEAD_DIM) {
        let query = &query[from..from + HEAD_DIM];
        let of_history = (0..prefix.tokens).map(|t| {
            let mut sum = T::lit(0.0);
            prefix.keys[block][at(t, from)].iter().zip(query).for_each(|(k, q)| sum.add_scaled(f64::from(*k), q));
            sum * scale
        });
        let own = cache.keys[block].chunks_exact(HIDDEN).map(|key| {
            let pairs = key[from..from + HEAD_DIM].iter().zip(query);
            pairs.fold(T::lit(0.0), |sum, (k, q)| sum + *k * *q) * scale
        });
        let mut weights: Vec<T> = of_history.chain(own).collect();
        let top = T::lit(weights.iter().map(|w| w.value()).fold(f64::NEG_INFINITY, f64::max));
        weights.iter_mut().for_each(|w| *w = (*w - top).exp());
        let inverse = T::lit(1.0) / weights.iter().fold(T::lit(0.0), |sum, w| sum + *w);
        let out = &mut attended[from..from + HEAD_DIM];
        let (history, own) = weights.split_at(prefix.tokens);
        for (t, weight) in history.iter().enumerate() {
            let values = &prefix.values[block][at(t, from)];
            out.iter_mut().zip(values).for_each(|(o, v)| o.add_scaled(f64::from(*v), weight));
        }
        for (weight, value) in own.iter().zip(cache.values[block].chunks_exact(HIDDEN)) {
            out.iter_mut().zip(&value[from..from + HEAD_DIM]).for_each(|(o, v)| *o = *o + *v * *weight);
        }
        out.iter_mut().for_each(|o| *o = *o * inverse);
    }
    attended
}
