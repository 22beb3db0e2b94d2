//! The causal Transformer over blocks of samples, with the history shared by all of them.

use super::bf16::{self, Bf16Buffers, PackedBf16};
use super::elementary::tanh;
use super::kernels::{After, PANEL, Packed, Row, add_rows, layer_norm, linear, linear_of, own_scores, own_values, softmax};
use super::prefix::Prefix;
use super::vector::{Kernel, Lane, Path, Vector};
use crate::ModelError;
use crate::dims::*;
use crate::precision::Precision;
use crate::weights::Weights;
use nesam_physics::{STATE_DIM, WHEELS};

/// Values that the heads give for a sample: raw residual, then tanh of the raw sinkage.
const HEAD_VALUES: usize = STATE_DIM + WHEELS;
/// 1 / √(head width): what scores are scaled by.
pub(crate) const SCORE_SCALE: f32 = 0.176_776_7;

#[derive(Clone, Debug)]
pub(crate) struct Dense {
    pub(crate) weight: Vec<f32>,
    pub(crate) bias: Vec<f32>,
    packed: Packed,
    /// The weights in bf16, where they are to be used.
    rounded: Option<PackedBf16>,
}

impl Dense {
    fn new(weight: &[f32], bias: &[f32]) -> Self {
        Self { weight: weight.to_vec(), bias: bias.to_vec(), packed: Packed::from_rows(weight, bias), rounded: None }
    }

    /// y = W x + b, or what `after` makes of it; `y` in parts that lie anywhere, each of a multiple of 64 rows.
    #[inline(always)]
    fn apply<V: Vector, const H: usize>(&self, after: After, x: &[Row<H>], y: &mut [&mut [Row<H>]], buffers: &mut Bf16Buffers) {
        match &self.rounded {
            Some(rounded) => {
                let groups = y.iter_mut().flat_map(|part| part.chunks_exact_mut(bf16::OUTPUTS));
                bf16::linear::<V, H>(rounded, after, x, groups, buffers);
            }
            None => linear_of::<V, H, _>(&self.packed, after, x, y.iter_mut().flat_map(|part| part.chunks_exact_mut(PANEL))),
        }
    }
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
    heads: Packed,
    path: Path,
    precision: Precision,
}

/// What the network says of a block of samples.
#[derive(Clone, Debug)]
pub struct Said<const H: usize> {
    /// tanh of the raw sinkage of each wheel.
    pub sinkage: [Row<H>; WHEELS],
    /// Raw state residual.
    pub residual: [Row<H>; STATE_DIM],
}

/// Keys and values of the rollout of one block of 16 H samples: per Transformer block (steps, 128) rows; and the buffers of a step.
#[derive(Clone, Debug)]
pub struct BlockCache<const H: usize> {
    keys: [Vec<Row<H>>; BLOCKS],
    values: [Vec<Row<H>>; BLOCKS],
    room: usize,
    steps: usize,
    remembers: bool,
    buffers: Buffers<H>,
}

#[derive(Clone, Debug)]
struct Buffers<const H: usize> {
    x: Vec<Row<H>>,
    normal: Vec<Row<H>>,
    queries: Vec<Row<H>>,
    attended: Vec<Row<H>>,
    hidden: Vec<Row<H>>,
    scores: Vec<Row<H>>,
    rounded: Bf16Buffers,
}

impl<const H: usize> Default for BlockCache<H> {
    /// A cache without room; [`Self::restart`] makes some.
    fn default() -> Self {
        let rows = |count: usize| vec![[Lane::ZERO; H]; count];
        Self {
            keys: Default::default(),
            values: Default::default(),
            room: 0,
            steps: 0,
            remembers: false,
            buffers: Buffers {
                x: rows(HIDDEN),
                normal: rows(HIDDEN),
                queries: rows(HIDDEN),
                attended: rows(HIDDEN),
                hidden: rows(FEED_FORWARD),
                scores: rows(POSITIONS),
                rounded: Bf16Buffers::default(),
            },
        }
    }
}

impl<const H: usize> BlockCache<H> {
    /// An empty cache with room for `horizon` steps; one that does not remember holds a single step at a time.
    pub fn new(horizon: usize, remembers: bool) -> Self {
        let mut cache = Self::default();
        cache.restart(horizon, remembers);
        cache
    }

    /// Forgets the steps, for another block of samples, and makes room for `horizon` new ones.
    pub fn restart(&mut self, horizon: usize, remembers: bool) {
        (self.room, self.steps, self.remembers) = (if remembers { horizon } else { 1 }, 0, remembers);
        for rows in self.keys.iter_mut().chain(&mut self.values) {
            if rows.len() < self.room * HIDDEN {
                rows.resize(self.room * HIDDEN, [Lane::ZERO; H]);
            }
        }
    }

    /// What the heads were given at the last step of one of the 16 samples of a lane.
    pub fn hidden(&self, lane: usize) -> [f32; HIDDEN] {
        core::array::from_fn(|i| self.buffers.normal[i][0].0[lane])
    }
}

impl FusedTransformer {
    /// From the arrays of the bundle, for the fastest path of this processor.
    ///
    /// # Errors
    /// `ModelError::Weights` naming the array at fault.
    pub fn new(weights: &Weights) -> Result<Self, ModelError> {
        let dense = |name: &str, shape: &[usize]| -> Result<Dense, ModelError> {
            Ok(Dense::new(weights.get(&format!("{name}.weight"), shape)?, weights.get(&format!("{name}.bias"), &shape[..1])?))
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
        let sinkage = dense("sinkage", &[WHEELS, HIDDEN])?;
        let residual = dense("residual", &[STATE_DIM, HIDDEN])?;
        let heads = Packed::from_rows(&[&residual.weight[..], &sinkage.weight].concat(), &[&residual.bias[..], &sinkage.bias].concat());
        Ok(Self {
            token: Dense::new(weights.get("token.state.weight", &[HIDDEN, STATE_CONTROL])?, weights.get("token.bias", &[HIDDEN])?),
            position: weights.get("position", &[POSITIONS, HIDDEN])?.to_vec(),
            blocks,
            norm: dense("norm", &[HIDDEN])?,
            sinkage,
            residual,
            heads,
            path: Path::fastest(),
            precision: Precision::F32,
        })
    }

    /// The same on another path.
    pub fn on(&self, path: Path) -> Self {
        Self { path, ..self.clone() }
    }

    /// The same in this precision, on the fastest path for it. In bf16 the matrices of the blocks and what they are multiplied with are rounded in every step;
    /// tokens, attention, normalisation and heads are not.
    pub fn in_precision(&self, precision: Precision) -> Self {
        let mut other = Self { precision, path: precision.fastest_path(), ..self.clone() };
        for block in &mut other.blocks {
            for dense in [&mut block.qkv, &mut block.out, &mut block.up, &mut block.down] {
                dense.rounded = precision.order().map(|order| PackedBf16::from_rows(order, &dense.weight, &dense.bias));
            }
        }
        other
    }

    /// What its products are rounded to.
    pub fn precision(&self) -> Precision {
        self.precision
    }

    /// Instructions that it runs on.
    pub fn path(&self) -> Path {
        self.path
    }

    /// Embedding of a position.
    pub(super) fn position(&self, position: usize) -> &[f32] {
        let at = position.min(POSITIONS - 1) * HIDDEN;
        &self.position[at..at + HIDDEN]
    }

    /// One step of a block of samples: scaled entries (14) and context tokens W_c c (128) in, what the network says out; extends the cache.
    pub fn step<const H: usize>(
        &self,
        prefix: &Prefix,
        cache: &mut BlockCache<H>,
        entries: &[Row<H>; STATE_CONTROL],
        context: &[Row<H>; HIDDEN],
    ) -> Said<H> {
        if !cache.remembers {
            cache.steps = 0;
        }
        assert!(cache.steps < cache.room, "a rollout has no more steps than its cache has room for; this is a bug");
        self.path.run_with_bf16(Step { network: self, prefix, cache, entries, context })
    }
}

/// One step of a block of samples.
struct Step<'a, const H: usize> {
    network: &'a FusedTransformer,
    prefix: &'a Prefix,
    cache: &'a mut BlockCache<H>,
    entries: &'a [Row<H>; STATE_CONTROL],
    context: &'a [Row<H>; HIDDEN],
}

impl<const H: usize> Kernel for Step<'_, H> {
    type Output = Said<H>;
    #[inline(always)]
    fn run<V: Vector>(self) -> Said<H> {
        let Self { network, prefix, cache, entries, context } = self;
        let step = cache.steps;
        let BlockCache { keys, values, buffers, .. } = cache;
        let Buffers { x, normal, queries, attended, hidden, scores, rounded } = buffers;
        embed::<V, H>(network, Some(HISTORY - 1 + step), entries, context, x);
        for (index, block) in network.blocks.iter().enumerate() {
            let own = step * HIDDEN..(step + 1) * HIDDEN;
            project::<V, H>(block, x, normal, [queries, &mut keys[index][own.clone()], &mut values[index][own.clone()]], rounded);
            let (keys, values) = (&keys[index][..own.end], &values[index][..own.end]);
            for head in 0..HEADS {
                attend::<V, H>(head, queries, prefix, index, keys, values, scores, attended);
            }
            finish::<V, H>(block, x, attended, normal, hidden, rounded);
        }
        cache.steps += 1;
        layer_norm::<V, H>(x, &network.norm.weight, &network.norm.bias, NORM_EPS, normal);
        let mut said = [[Lane::ZERO; H]; HEAD_VALUES];
        linear::<V, H>(&network.heads, After::Store, normal, &mut said);
        let mut sinkage = [[Lane::ZERO; H]; WHEELS];
        for (wheel, raw) in sinkage.iter_mut().zip(&said[STATE_DIM..]) {
            for h in 0..H {
                tanh(V::load(&raw[h].0)).store(&mut wheel[h].0);
            }
        }
        let mut residual = [[Lane::ZERO; H]; STATE_DIM];
        residual.copy_from_slice(&said[..STATE_DIM]);
        Said { sinkage, residual }
    }
}

/// x = W_s entries + b + W_c c + position; without a position, that of each lane stands in `context` already.
#[inline(always)]
pub(super) fn embed<V: Vector, const H: usize>(
    network: &FusedTransformer,
    position: Option<usize>,
    entries: &[Row<H>; STATE_CONTROL],
    context: &[Row<H>; HIDDEN],
    x: &mut [Row<H>],
) {
    linear::<V, H>(&network.token.packed, After::Store, entries, x);
    add_rows::<V, H>(x, context);
    let Some(position) = position else { return };
    for (x, position) in x.iter_mut().zip(network.position(position)) {
        for h in 0..H {
            V::load(&x[h].0).add(V::splat(*position)).store(&mut x[h].0);
        }
    }
}

/// Queries, keys and values (128 each) of pre-normalised hidden states.
#[inline(always)]
pub(super) fn project<V: Vector, const H: usize>(
    block: &Block,
    x: &[Row<H>],
    normal: &mut [Row<H>],
    mut qkv: [&mut [Row<H>]; 3],
    rounded: &mut Bf16Buffers,
) {
    layer_norm::<V, H>(x, &block.norm1.weight, &block.norm1.bias, NORM_EPS, normal);
    block.qkv.apply::<V, H>(After::Store, normal, &mut qkv, rounded);
}

/// Output projection and feed-forward network, both added to x.
#[inline(always)]
pub(super) fn finish<V: Vector, const H: usize>(
    block: &Block,
    x: &mut [Row<H>],
    attended: &[Row<H>],
    normal: &mut [Row<H>],
    hidden: &mut [Row<H>],
    rounded: &mut Bf16Buffers,
) {
    block.out.apply::<V, H>(After::Add, attended, &mut [x], rounded);
    layer_norm::<V, H>(x, &block.norm2.weight, &block.norm2.bias, NORM_EPS, normal);
    block.up.apply::<V, H>(After::Gelu, normal, &mut [hidden], rounded);
    block.down.apply::<V, H>(After::Add, hidden, &mut [x], rounded);
}

/// Attention of one head of a block of samples over the shared history and their own steps.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn attend<V: Vector, const H: usize>(
    head: usize,
    queries: &[Row<H>],
    prefix: &Prefix,
    block: usize,
    keys: &[Row<H>],
    values: &[Row<H>],
    scores: &mut [Row<H>],
    attended: &mut [Row<H>],
) {
    let features = head * HEAD_DIM..(head + 1) * HEAD_DIM;
    let query = &queries[features.clone()];
    let out = &mut attended[features.clone()];
    let (shared, own) = (prefix.tokens, keys.len() / HIDDEN);
    if shared > 0 {
        // The last panel may reach into the rows of the own steps, which are written after it.
        linear::<V, H>(&prefix.shared_keys[block][head], After::Store, query, scores);
    }
    own_scores::<V, H>(&keys[features.start..], HIDDEN, query, &mut scores[shared..shared + own]);
    softmax::<V, H>(&mut scores[..shared + own], SCORE_SCALE);
    if shared > 0 {
        linear::<V, H>(&prefix.shared_values[block][head], After::Store, &scores[..shared], out);
    } else {
        out.fill([Lane::ZERO; H]);
    }
    own_values::<V, H>(&values[features.start..], HIDDEN, &scores[shared..shared + own], out);
}
