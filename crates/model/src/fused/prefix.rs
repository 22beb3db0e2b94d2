//! The measured history: encoded once per query, attended by all samples.

use super::bf16::Bf16Buffers;
use super::kernels::{Packed, Row};
use super::transformer::{Block, FusedTransformer, SCORE_SCALE, embed, finish, project};
use super::vector::{Kernel, LANES, Lane, Vector};
use crate::dims::*;

/// Keys and values of the measured history, computed once per query and shared by all samples: per block (positions, 128).
#[derive(Clone, Debug, Default)]
pub struct Prefix {
    pub(crate) keys: Vec<Vec<f32>>,
    pub(crate) values: Vec<Vec<f32>>,
    pub(crate) tokens: usize,
    /// Per block and head: keys as a matrix (tokens, 32), values as one (32, tokens).
    pub(super) shared_keys: Vec<Vec<Packed>>,
    pub(super) shared_values: Vec<Vec<Packed>>,
}

impl FusedTransformer {
    /// Encodes the measured history: `entries` and `contexts` oldest first, right-aligned so that the next token takes position 31.
    pub fn prefix(&self, entries: &[[f32; STATE_CONTROL]], contexts: &[[f32; HIDDEN]]) -> Prefix {
        let tokens = entries.len().min(HISTORY - 1);
        if tokens == 0 {
            return Prefix::default();
        }
        let (entries, contexts) = (&entries[entries.len() - tokens..], &contexts[contexts.len() - tokens..]);
        let first = HISTORY - 1 - tokens;
        let at = |l: usize| l.min(tokens - 1);
        let mut hidden: [Row<2>; HIDDEN] = [[Lane::ZERO; 2]; HIDDEN];
        // Tokens stand in lanes here; each has a position of its own.
        let entry_rows = core::array::from_fn(|i| core::array::from_fn(|h| Lane::from_fn(|l| entries[at(h * LANES + l)][i])));
        let context_rows = core::array::from_fn(|i| {
            core::array::from_fn(|h| Lane::from_fn(|l| contexts[at(h * LANES + l)][i] + self.position(first + at(h * LANES + l))[i]))
        });
        self.path().run(Embed { network: self, entries: &entry_rows, context: &context_rows, x: &mut hidden });
        let mut prefix = Prefix { tokens, ..Prefix::default() };
        for (index, block) in self.blocks.iter().enumerate() {
            let mut qkv = vec![[Lane::ZERO; 2]; 3 * HIDDEN];
            self.path().run(Project { block, x: &hidden, qkv: &mut qkv });
            let rows = |part: usize| -> Vec<f32> {
                (0..tokens * HIDDEN).map(|i| qkv[part * HIDDEN + i % HIDDEN][i / HIDDEN / LANES][i / HIDDEN % LANES]).collect()
            };
            let (queries, keys, values) = (rows(0), rows(1), rows(2));
            if index + 1 < BLOCKS {
                let mut attended = [[Lane::ZERO; 2]; HIDDEN];
                for token in 0..tokens {
                    attend_history(&queries, &keys, &values, token, |o, v| attended[o][token / LANES][token % LANES] = v);
                }
                self.path().run(Finish { block, x: &mut hidden, attended: &attended });
            }
            let of_heads = |pack: &dyn Fn(usize) -> Packed| (0..HEADS).map(|head| pack(head * HEAD_DIM)).collect();
            prefix.shared_keys.push(of_heads(&|from| Packed::new(tokens, HEAD_DIM, |t, d| keys[t * HIDDEN + from + d], |_| 0.0)));
            prefix.shared_values.push(of_heads(&|from| Packed::new(HEAD_DIM, tokens, |d, t| values[t * HIDDEN + from + d], |_| 0.0)));
            prefix.keys.push(keys);
            prefix.values.push(values);
        }
        prefix
    }
}

/// Causal attention of history token `t` over tokens 0..=t.
fn attend_history(queries: &[f32], keys: &[f32], values: &[f32], t: usize, mut store: impl FnMut(usize, f32)) {
    for head in 0..HEADS {
        let from = head * HEAD_DIM;
        let query = &queries[t * HIDDEN + from..t * HIDDEN + from + HEAD_DIM];
        let dot = |s: usize| {
            keys[s * HIDDEN + from..s * HIDDEN + from + HEAD_DIM].iter().zip(query).map(|(k, q)| k * q).sum::<f32>() * SCORE_SCALE
        };
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

struct Embed<'a> {
    network: &'a FusedTransformer,
    entries: &'a [Row<2>; STATE_CONTROL],
    context: &'a [Row<2>; HIDDEN],
    x: &'a mut [Row<2>],
}

impl Kernel for Embed<'_> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector>(self) {
        embed::<V, 2>(self.network, None, self.entries, self.context, self.x);
    }
}

struct Project<'a> {
    block: &'a Block,
    x: &'a [Row<2>],
    qkv: &'a mut [Row<2>],
}

impl Kernel for Project<'_> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector>(self) {
        let mut normal = [[Lane::ZERO; 2]; HIDDEN];
        let (queries, rest) = self.qkv.split_at_mut(HIDDEN);
        let (keys, values) = rest.split_at_mut(HIDDEN);
        project::<V, 2>(self.block, self.x, &mut normal, [queries, keys, values], &mut Bf16Buffers::default());
    }
}

struct Finish<'a> {
    block: &'a Block,
    x: &'a mut [Row<2>],
    attended: &'a [Row<2>],
}

impl Kernel for Finish<'_> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector>(self) {
        let (mut normal, mut hidden) = ([[Lane::ZERO; 2]; HIDDEN], [[Lane::ZERO; 2]; FEED_FORWARD]);
        finish::<V, 2>(self.block, self.x, self.attended, &mut normal, &mut hidden, &mut Bf16Buffers::default());
    }
}
