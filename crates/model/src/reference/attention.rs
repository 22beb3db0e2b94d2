//! Attention of the steps of a rollout, each as one node of candle's graph.
//!
//! In candle's own operations every step copies all keys and values before it into longer arrays, and the gradient of each of these arrays is an array again.
//! Here the steps share one memory. A node adds its own keys and values to it on the way forward. On the way back it adds to the gradients of all that it looked
//! at, and takes those of its own, which are complete by then: every later step depends on this one through the state, so candle pulls it back first.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use candle_core::{CpuStorage, CustomOp1, CustomOp3, Layout, Result, Shape, Tensor, bail};

use super::host::{from_values, values};
use super::nodes::{shares, softmax_gradient};
use crate::dims::{HEAD_DIM, HEADS, HIDDEN};
use crate::fused::SCORE_SCALE as SCALE;

/// Queries, keys and values of a token.
const QKV: usize = 3 * HIDDEN;
/// Keys and values of a token.
const KV: usize = 2 * HIDDEN;

/// Keys and values of a row, and their gradients: (tokens, 2 · 128).
#[derive(Debug, Default)]
struct Remembered {
    kv: Vec<f32>,
    gradients: Vec<f32>,
}

/// What the steps of a rollout have in common in one block of the network.
#[derive(Debug)]
pub struct Memory {
    rows: Vec<Remembered>,
}

/// A memory that nodes share.
pub type Shared = Arc<Mutex<Memory>>;

fn locked(memory: &Shared) -> MutexGuard<'_, Memory> {
    memory.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Attention of one new token of each row, (rows, 384) of queries, keys and values -> (rows, 128), over the memory and itself.
///
/// # Errors
/// A candle error when the rows are others than those of the memory.
pub fn attend_next(qkv: &Tensor, memory: &Shared) -> Result<Tensor> {
    let step = locked(memory).rows.first().map_or(0, |row| row.kv.len() / KV);
    qkv.contiguous()?.apply_op1(Attend { memory: memory.clone(), step })
}

/// The same for the first token after `prefix`, keys and values (rows, heads, tokens, head width) that were attended to before; begins a memory.
///
/// # Errors
/// A candle error when shapes disagree.
pub fn attend_first(qkv: &Tensor, prefix: Option<&(Tensor, Tensor)>) -> Result<(Tensor, Shared)> {
    let rows = (0..qkv.dim(0)?).map(|_| Remembered::default()).collect();
    let memory: Shared = Arc::new(Mutex::new(Memory { rows }));
    let Some((keys, values)) = prefix else { return Ok((attend_next(qkv, &memory)?, memory)) };
    let op = Attend { memory: memory.clone(), step: keys.dim(2)? };
    Ok((qkv.contiguous()?.apply_op3(&keys.contiguous()?, &values.contiguous()?, op)?, memory))
}

/// The token at place `step` of the memory.
struct Attend {
    memory: Shared,
    step: usize,
}

/// Part of a head in 128 numbers.
fn head(all: &[f32], head: usize) -> &[f32; HEAD_DIM] {
    all[head * HEAD_DIM..].first_chunk().expect("a head lies inside; this is a bug")
}

fn head_mut(all: &mut [f32], head: usize) -> &mut [f32; HEAD_DIM] {
    all[head * HEAD_DIM..].first_chunk_mut().expect("a head lies inside; this is a bug")
}

/// Σ a b, eight sums at a time.
fn dot(a: &[f32; HEAD_DIM], b: &[f32; HEAD_DIM]) -> f32 {
    let mut sums = [0f32; 8];
    for (a, b) in a.as_chunks::<8>().0.iter().zip(b.as_chunks::<8>().0) {
        for l in 0..8 {
            sums[l] = a[l].mul_add(b[l], sums[l]);
        }
    }
    sums.iter().sum()
}

/// y += s x.
fn add_scaled(y: &mut [f32; HEAD_DIM], s: f32, x: &[f32; HEAD_DIM]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y = s.mul_add(*x, *y);
    }
}

/// Share that a head pays to each token; `scores` is room for as many.
fn attention(h: usize, query: &[f32], kv: &[f32], scores: &mut Vec<f32>, paid: &mut Vec<f32>) {
    scores.clear();
    scores.extend(kv.chunks_exact(KV).map(|kv| dot(head(query, h), head(kv, h))));
    paid.resize(scores.len(), 0.0);
    shares(SCALE, scores.len(), scores, paid);
}

impl Attend {
    fn forward(&self, qkv: &[f32]) -> Result<(CpuStorage, Shape)> {
        let mut memory = locked(&self.memory);
        let rows = memory.rows.len();
        if qkv.len() != rows * QKV {
            bail!("attention: {} values for {rows} rows of {QKV}", qkv.len());
        }
        let mut out = vec![0f32; rows * HIDDEN];
        let (mut scores, mut paid) = (Vec::new(), Vec::new());
        for ((row, qkv), out) in memory.rows.iter_mut().zip(qkv.chunks_exact(QKV)).zip(out.chunks_exact_mut(HIDDEN)) {
            row.kv.truncate(self.step * KV);
            row.kv.extend_from_slice(&qkv[HIDDEN..]);
            for h in 0..HEADS {
                attention(h, qkv, &row.kv, &mut scores, &mut paid);
                for (kv, share) in row.kv.chunks_exact(KV).zip(&paid) {
                    add_scaled(head_mut(out, h), *share, head(&kv[HIDDEN..], h));
                }
            }
        }
        Ok((CpuStorage::F32(out), Shape::from((rows, HIDDEN))))
    }

    fn backward(&self, qkv: &Tensor, grad: &Tensor) -> Result<Tensor> {
        from_values([qkv, grad], qkv.shape(), |[qkv, grad]| self.gradient(qkv, grad))
    }

    /// Gradient by queries, keys and values, given that by what came of them.
    fn gradient(&self, qkv: &[f32], grad: &[f32]) -> Vec<f32> {
        let mut memory = locked(&self.memory);
        let mut out = vec![0f32; qkv.len()];
        let (mut scores, mut paid, mut by_share) = (Vec::new(), Vec::new(), Vec::new());
        let tokens = self.step + 1;
        let each = memory.rows.iter_mut().zip(qkv.chunks_exact(QKV)).zip(grad.chunks_exact(HIDDEN)).zip(out.chunks_exact_mut(QKV));
        for (((row, qkv), grad), out) in each {
            let kv = &row.kv[..tokens * KV];
            row.gradients.resize(row.gradients.len().max(kv.len()), 0.0);
            for h in 0..HEADS {
                let (query, upstream) = (head(qkv, h), head(grad, h));
                attention(h, qkv, kv, &mut scores, &mut paid);
                by_share.clear();
                by_share.extend(kv.chunks_exact(KV).map(|kv| dot(upstream, head(&kv[HIDDEN..], h))));
                // The scores have done their work: what they were is now the gradient by them.
                softmax_gradient(SCALE, &paid, &by_share, &mut scores);
                let tokens = kv.chunks_exact(KV).zip(row.gradients.chunks_exact_mut(KV)).zip(scores.iter().zip(&paid));
                for ((kv, gradients), (by_score, share)) in tokens {
                    add_scaled(head_mut(out, h), *by_score, head(kv, h));
                    add_scaled(head_mut(gradients, h), *by_score, query);
                    add_scaled(head_mut(&mut gradients[HIDDEN..], h), *share, upstream);
                }
            }
            // Complete now, and taken, so that a graph can be pulled back again.
            let own = &mut row.gradients[self.step * KV..tokens * KV];
            out[HIDDEN..].copy_from_slice(own);
            own.fill(0.0);
        }
        out
    }
}

impl CustomOp1 for Attend {
    fn name(&self) -> &'static str {
        "attention-step"
    }

    fn cpu_fwd(&self, qkv: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        self.forward(values(qkv, layout)?)
    }

    fn bwd(&self, qkv: &Tensor, _res: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        self.backward(qkv, grad).map(Some)
    }
}

impl CustomOp3 for Attend {
    fn name(&self) -> &'static str {
        "attention-first-step"
    }

    fn cpu_fwd(
        &self,
        qkv: &CpuStorage,
        layout: &Layout,
        keys: &CpuStorage,
        keys_layout: &Layout,
        of_values: &CpuStorage,
        values_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let parts = [values(keys, keys_layout)?, values(of_values, values_layout)?];
        for (r, row) in locked(&self.memory).rows.iter_mut().enumerate() {
            row.kv.resize(self.step * KV, 0.0);
            each_part(self.step, r, |at, in_row| row.kv[in_row..in_row + HEAD_DIM].copy_from_slice(&parts[at.0][at.1..at.1 + HEAD_DIM]));
        }
        self.forward(values(qkv, layout)?)
    }

    fn bwd(
        &self,
        qkv: &Tensor,
        keys: &Tensor,
        _values: &Tensor,
        _res: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let own = self.backward(qkv, grad)?;
        let mut parts = [vec![0f32; keys.elem_count()], vec![0f32; keys.elem_count()]];
        for (r, row) in locked(&self.memory).rows.iter_mut().enumerate() {
            let gradients = std::mem::take(&mut row.gradients);
            each_part(self.step, r, |at, in_row| parts[at.0][at.1..at.1 + HEAD_DIM].copy_from_slice(&gradients[in_row..in_row + HEAD_DIM]));
        }
        let [by_keys, by_values] = parts.map(|part| Tensor::from_vec(part, keys.shape(), keys.device()));
        Ok((Some(own), Some(by_keys?), Some(by_values?)))
    }
}

/// Calls `f((keys or values, place in (rows, heads, tokens, head width)), place in the memory of the row)` for each head of each token of a prefix.
fn each_part(tokens: usize, row: usize, mut f: impl FnMut((usize, usize), usize)) {
    for part in 0..2 {
        for h in 0..HEADS {
            for token in 0..tokens {
                f((part, ((row * HEADS + h) * tokens + token) * HEAD_DIM), token * KV + part * HIDDEN + h * HEAD_DIM);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{D, Device, Var};

    /// Attention of the last of some tokens, in candle's operations: queries (rows, 128), keys and values (rows, tokens, 128).
    fn plain(query: &Tensor, keys: &Tensor, values: &Tensor) -> Result<Tensor> {
        let rows = query.dim(0)?;
        let heads = |x: &Tensor, tokens: usize| x.reshape((rows, tokens, HEADS, HEAD_DIM))?.transpose(1, 2)?.contiguous();
        let tokens = keys.dim(1)?;
        let scores = heads(query, 1)?.matmul(&heads(keys, tokens)?.transpose(2, 3)?)?;
        let weights = (scores * f64::from(SCALE))?.exp()?;
        let weights = weights.broadcast_div(&weights.sum_keepdim(D::Minus1)?)?;
        weights.matmul(&heads(values, tokens)?)?.transpose(1, 2)?.reshape((rows, HIDDEN))
    }

    /// Three steps, each of which depends on the one before, with and without a prefix: values and gradients against the same in candle's operations.
    #[test]
    fn analytic_steps_share_their_memory_both_ways() -> Result<()> {
        const ROWS: usize = 3;
        for tokens in [0, 5] {
            let device = Device::Cpu;
            let start = Var::randn(0f32, 0.5f32, (ROWS, QKV), &device)?;
            let mix = Var::randn(0f32, 0.1f32, (HIDDEN, QKV), &device)?;
            let prefix = [
                Var::randn(0f32, 1f32, (ROWS, tokens.max(1), HIDDEN), &device)?,
                Var::randn(0f32, 1f32, (ROWS, tokens.max(1), HIDDEN), &device)?,
            ];
            let heads = |x: &Tensor| x.reshape((ROWS, tokens.max(1), HEADS, HEAD_DIM))?.transpose(1, 2)?.contiguous();
            let own = || -> Result<Tensor> {
                let given = if tokens > 0 { Some((heads(&prefix[0])?, heads(&prefix[1])?)) } else { None };
                let (mut out, memory) = attend_first(&start, given.as_ref())?;
                let mut all = out.clone();
                for _ in 0..2 {
                    out = attend_next(&(start.as_tensor() + out.matmul(&mix)?)?, &memory)?;
                    all = (all + &out)?;
                }
                Ok(all)
            };
            let candle = || -> Result<Tensor> {
                let part = |x: &Tensor, i: usize| x.narrow(1, i * HIDDEN, HIDDEN)?.unsqueeze(1);
                let (mut keys, mut values) = (Vec::new(), Vec::new());
                if tokens > 0 {
                    keys.push(prefix[0].as_tensor().clone());
                    values.push(prefix[1].as_tensor().clone());
                }
                let (mut qkv, mut all) = (start.as_tensor().clone(), Tensor::zeros((ROWS, HIDDEN), candle_core::DType::F32, &device)?);
                for _ in 0..3 {
                    keys.push(part(&qkv, 1)?);
                    values.push(part(&qkv, 2)?);
                    let out = plain(&qkv.narrow(1, 0, HIDDEN)?.contiguous()?, &Tensor::cat(&keys, 1)?, &Tensor::cat(&values, 1)?)?;
                    all = (all + &out)?;
                    qkv = (start.as_tensor() + out.matmul(&mix)?)?;
                }
                Ok(all)
            };
            let apart = |a: &Tensor, b: &Tensor| -> Result<f32> { (a - b)?.abs()?.max_all()?.to_scalar() };
            let (own, candle) = (own()?, candle()?);
            assert!(apart(&own, &candle)? < 1e-5, "after {tokens} tokens: {}", apart(&own, &candle)?);
            let upstream = Tensor::randn(0f32, 1f32, own.shape(), &device)?;
            let expected = (&candle * &upstream)?.sum_all()?.backward()?;
            // Twice: what was taken must not be there a second time.
            for _ in 0..2 {
                let found = (&own * &upstream)?.sum_all()?.backward()?;
                let shared = if tokens > 0 { &prefix[..] } else { &[] };
                for (i, var) in [&start, &mix].into_iter().chain(shared).enumerate() {
                    let (found, expected) = (found.get(var).expect("it takes part"), expected.get(var).expect("it takes part"));
                    assert!(apart(found, expected)? < 3e-5, "after {tokens} tokens, argument {i}: {}", apart(found, expected)?);
                }
            }
        }
        Ok(())
    }
}
