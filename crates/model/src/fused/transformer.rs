//! The causal Transformer over blocks of samples, with the history shared by all of them.

use crate::ModelError;
use crate::dims::*;
use crate::fused::lanes::{LANES, Lane, add_assign, gelu, layer_norm, linear, softmax};
use crate::weights::Weights;
use nesam_physics::{STATE_DIM, WHEELS};

#[derive(Clone, Debug)]
pub(crate) struct Dense {
    pub(crate) weight: Vec<f32>,
    pub(crate) bias: Vec<f32>,
}

#[derive(Clone, Debug)]
pub(crate) struct Block {
    pub(crate) norm1: Dense,
    pub(crate) qkv: Dense,
    pub(crate) out: Dense,
    pub(crate) norm2: Dense,
    pub(crate) up: Dense,
    pub(crate) down: Dense,
}

/// Weights of token embedding, Transformer and heads.
#[derive(Clone, Debug)]
pub struct FusedTransformer {
    pub(crate) token: Dense,
    pub(crate) position: Vec<f32>,
    pub(crate) blocks: Vec<Block>,
    pub(crate) norm: Dense,
    pub(crate) sinkage: Dense,
    pub(crate) residual: Dense,
}

/// Keys and values of the measured history, computed once per query and shared by all samples: per block (positions, 128).
#[derive(Clone, Debug, Default)]
pub struct Prefix {
    pub(crate) keys: Vec<Vec<f32>>,
    pub(crate) values: Vec<Vec<f32>>,
    pub(crate) tokens: usize,
}

/// Keys and values of the rollout of one block of samples: per Transformer block (steps, 128) lanes.
#[derive(Clone, Debug)]
pub struct BlockCache {
    keys: Vec<Vec<Lane>>,
    values: Vec<Vec<Lane>>,
    steps: usize,
    remembers: bool,
}

impl BlockCache {
    /// An empty cache with room for `horizon` steps; one that does not remember holds a single step at a time.
    pub fn new(horizon: usize, remembers: bool) -> Self {
        let steps = if remembers { horizon } else { 1 };
        let room = || (0..BLOCKS).map(|_| Vec::with_capacity(steps * HIDDEN)).collect();
        Self { keys: room(), values: room(), steps: 0, remembers }
    }

    fn clear(&mut self) {
        self.keys.iter_mut().chain(&mut self.values).for_each(Vec::clear);
        self.steps = 0;
    }
}

impl FusedTransformer {
    /// From the arrays of the bundle.
    ///
    /// # Errors
    /// `ModelError::Weights` naming the array at fault.
    pub fn new(weights: &Weights) -> Result<Self, ModelError> {
        let dense = |name: &str, shape: &[usize]| -> Result<Dense, ModelError> {
            Ok(Dense {
                weight: weights.get(&format!("{name}.weight"), shape)?.to_vec(),
                bias: weights.get(&format!("{name}.bias"), &shape[..1])?.to_vec(),
            })
        };
        let blocks = (0..BLOCKS)
            .map(|b| {
                let name = |part: &str| format!("block{b}.{part}");
                Ok(Block {
                    norm1: dense(&name("norm1"), &[HIDDEN])?,
                    qkv: dense(&name("qkv"), &[3 * HIDDEN, HIDDEN])?,
                    out: dense(&name("out"), &[HIDDEN, HIDDEN])?,
                    norm2: dense(&name("norm2"), &[HIDDEN])?,
                    up: dense(&name("up"), &[FEED_FORWARD, HIDDEN])?,
                    down: dense(&name("down"), &[HIDDEN, FEED_FORWARD])?,
                })
            })
            .collect::<Result<_, ModelError>>()?;
        Ok(Self {
            token: Dense {
                weight: weights.get("token.state.weight", &[HIDDEN, STATE_CONTROL])?.to_vec(),
                bias: weights.get("token.bias", &[HIDDEN])?.to_vec(),
            },
            position: weights.get("position", &[POSITIONS, HIDDEN])?.to_vec(),
            blocks,
            norm: dense("norm", &[HIDDEN])?,
            sinkage: dense("sinkage", &[WHEELS, HIDDEN])?,
            residual: dense("residual", &[STATE_DIM, HIDDEN])?,
        })
    }

    /// Embeds scaled entries and context tokens at a position: x = W_s entries + b + W_c c + position.
    fn embed(&self, entries: &[Lane; STATE_CONTROL], context: &[Lane; HIDDEN], position: impl Fn(usize) -> usize) -> Vec<Lane> {
        let mut x = vec![[0f32; LANES]; HIDDEN];
        linear(&self.token.weight, &self.token.bias, entries, &mut x);
        for (o, row) in x.iter_mut().enumerate() {
            for l in 0..LANES {
                row[l] += context[o][l] + self.position[position(l).min(POSITIONS - 1) * HIDDEN + o];
            }
        }
        x
    }

    /// Encodes the measured history: `entries` and `contexts` oldest first, right-aligned so that the next token takes position 31.
    pub fn prefix(&self, entries: &[[f32; STATE_CONTROL]], contexts: &[[f32; HIDDEN]]) -> Prefix {
        let tokens = entries.len().min(HISTORY - 1);
        let (entries, contexts) = (&entries[entries.len() - tokens..], &contexts[contexts.len() - tokens..]);
        let first = HISTORY - 1 - tokens;
        let lane = |chunk: usize, l: usize| (chunk * LANES + l).min(tokens.max(1) - 1);
        let chunks = tokens.div_ceil(LANES);
        let of_chunk = |chunk: usize| chunk * LANES..tokens.min((chunk + 1) * LANES);
        let mut hidden: Vec<Vec<Lane>> = (0..chunks)
            .map(|chunk| {
                let e = core::array::from_fn(|i| core::array::from_fn(|l| entries[lane(chunk, l)][i]));
                let c = core::array::from_fn(|i| core::array::from_fn(|l| contexts[lane(chunk, l)][i]));
                self.embed(&e, &c, |l| first + chunk * LANES + l)
            })
            .collect();
        let mut prefix = Prefix { tokens, ..Prefix::default() };
        for (index, block) in self.blocks.iter().enumerate() {
            let mut queries = vec![0f32; tokens * HIDDEN];
            let (mut keys, mut values) = (vec![0f32; tokens * HIDDEN], vec![0f32; tokens * HIDDEN]);
            for (chunk, x) in hidden.iter().enumerate() {
                let qkv = block.qkv(x);
                for (l, token) in of_chunk(chunk).enumerate() {
                    for (part, rows) in [&mut queries, &mut keys, &mut values].into_iter().enumerate() {
                        let row = &mut rows[token * HIDDEN..(token + 1) * HIDDEN];
                        row.iter_mut().zip(&qkv[part * HIDDEN..]).for_each(|(number, lane)| *number = lane[l]);
                    }
                }
            }
            if index + 1 < BLOCKS {
                for (chunk, x) in hidden.iter_mut().enumerate() {
                    let mut attended = vec![[0f32; LANES]; HIDDEN];
                    for (l, token) in of_chunk(chunk).enumerate() {
                        attend_history(&queries, &keys, &values, token, |o, v| attended[o][l] = v);
                    }
                    block.finish(x, &attended);
                }
            }
            prefix.keys.push(keys);
            prefix.values.push(values);
        }
        prefix
    }

    /// One step of a block of samples: returns raw sinkage (4) and raw residual (12), and extends the cache.
    pub fn step(
        &self,
        prefix: &Prefix,
        cache: &mut BlockCache,
        entries: &[Lane; STATE_CONTROL],
        context: &[Lane; HIDDEN],
    ) -> ([Lane; WHEELS], [Lane; STATE_DIM]) {
        if !cache.remembers {
            cache.clear();
        }
        let position = HISTORY - 1 + cache.steps;
        let mut x = self.embed(entries, context, |_| position);
        for (index, block) in self.blocks.iter().enumerate() {
            let qkv = block.qkv(&x);
            cache.keys[index].extend_from_slice(&qkv[HIDDEN..2 * HIDDEN]);
            cache.values[index].extend_from_slice(&qkv[2 * HIDDEN..]);
            let mut attended = vec![[0f32; LANES]; HIDDEN];
            for head in 0..HEADS {
                attend(head, &qkv, prefix, cache, index, &mut attended);
            }
            block.finish(&mut x, &attended);
        }
        cache.steps += 1;
        let mut normal = vec![[0f32; LANES]; HIDDEN];
        layer_norm(&x, &self.norm.weight, &self.norm.bias, NORM_EPS, &mut normal);
        let (mut sinkage, mut residual) = ([[0f32; LANES]; WHEELS], [[0f32; LANES]; STATE_DIM]);
        linear(&self.sinkage.weight, &self.sinkage.bias, &normal, &mut sinkage);
        linear(&self.residual.weight, &self.residual.bias, &normal, &mut residual);
        (sinkage, residual)
    }
}

impl Block {
    /// Queries, keys and values (384) of pre-normalised hidden states.
    fn qkv(&self, x: &[Lane]) -> Vec<Lane> {
        let mut normal = vec![[0f32; LANES]; HIDDEN];
        layer_norm(x, &self.norm1.weight, &self.norm1.bias, NORM_EPS, &mut normal);
        let mut qkv = vec![[0f32; LANES]; 3 * HIDDEN];
        linear(&self.qkv.weight, &self.qkv.bias, &normal, &mut qkv);
        qkv
    }

    /// Output projection and feed-forward network, both added to x.
    fn finish(&self, x: &mut [Lane], attended: &[Lane]) {
        let mut delta = vec![[0f32; LANES]; HIDDEN];
        linear(&self.out.weight, &self.out.bias, attended, &mut delta);
        add_assign(x, &delta);
        layer_norm(x, &self.norm2.weight, &self.norm2.bias, NORM_EPS, &mut delta);
        let mut hidden = vec![[0f32; LANES]; FEED_FORWARD];
        linear(&self.up.weight, &self.up.bias, &delta, &mut hidden);
        gelu(&mut hidden);
        linear(&self.down.weight, &self.down.bias, &hidden, &mut delta);
        add_assign(x, &delta);
    }
}

/// Attention of one head of a block of samples over the shared history and their own steps.
fn attend(head: usize, qkv: &[Lane], prefix: &Prefix, cache: &BlockCache, block: usize, attended: &mut [Lane]) {
    let from = head * HEAD_DIM;
    let scale = 1.0 / (HEAD_DIM as f32).sqrt();
    let query = &qkv[from..from + HEAD_DIM];
    let own_steps = cache.keys[block].len() / HIDDEN;
    let mut scores = vec![[0f32; LANES]; prefix.tokens + own_steps];
    for (t, score) in scores.iter_mut().enumerate() {
        let mut sum = [0f32; LANES];
        if t < prefix.tokens {
            let key = &prefix.keys[block][t * HIDDEN + from..t * HIDDEN + from + HEAD_DIM];
            for (k, q) in key.iter().zip(query) {
                for l in 0..LANES {
                    sum[l] = k.mul_add(q[l], sum[l]);
                }
            }
        } else {
            let at = (t - prefix.tokens) * HIDDEN + from;
            for (k, q) in cache.keys[block][at..at + HEAD_DIM].iter().zip(query) {
                for l in 0..LANES {
                    sum[l] = k[l].mul_add(q[l], sum[l]);
                }
            }
        }
        *score = sum.map(|s| s * scale);
    }
    softmax(&mut scores);
    let out = &mut attended[from..from + HEAD_DIM];
    for (t, weight) in scores.iter().enumerate() {
        if t < prefix.tokens {
            let value = &prefix.values[block][t * HIDDEN + from..t * HIDDEN + from + HEAD_DIM];
            for (v, o) in value.iter().zip(out.iter_mut()) {
                for l in 0..LANES {
                    o[l] = v.mul_add(weight[l], o[l]);
                }
            }
        } else {
            let at = (t - prefix.tokens) * HIDDEN + from;
            for (v, o) in cache.values[block][at..at + HEAD_DIM].iter().zip(out.iter_mut()) {
                for l in 0..LANES {
                    o[l] = v[l].mul_add(weight[l], o[l]);
                }
            }
        }
    }
}

/// Causal attention of history token `t` over tokens 0..=t.
fn attend_history(queries: &[f32], keys: &[f32], values: &[f32], t: usize, mut store: impl FnMut(usize, f32)) {
    let scale = 1.0 / (HEAD_DIM as f32).sqrt();
    for head in 0..HEADS {
        let from = head * HEAD_DIM;
        let query = &queries[t * HIDDEN + from..t * HIDDEN + from + HEAD_DIM];
        let dot =
            |s: usize| keys[s * HIDDEN + from..s * HIDDEN + from + HEAD_DIM].iter().zip(query).map(|(k, q)| k * q).sum::<f32>() * scale;
        let scores: Vec<f32> = (0..=t).map(dot).collect();
        let top = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let weights: Vec<f32> = scores.iter().map(|s| (s - top).exp()).collect();
        let total: f32 = weights.iter().sum();
        for o in 0..HEAD_DIM {
            let sum: f32 = weights.iter().enumerate().map(|(s, w)| w * values[s * HIDDEN + from + o]).sum();
            store(from + o, sum / total);
        }
    }
}
