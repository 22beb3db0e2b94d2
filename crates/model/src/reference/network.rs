//! Token projection, causal Transformer, heads and soil prior as candle tensors.

use candle_core::{Device, Result, Tensor, Var, bail};

use super::attention::{Shared, attend_first, attend_next};
use super::image::{Conv, im2col};
use super::nodes::{Activation, activate, layer_norm, softmax};
use crate::dims::*;
use crate::fused::SCORE_SCALE;
use crate::soil_coordinates::{LOGARITHMIC, span};
use crate::weights::Weights;
use nesam_physics::{SOIL_DIM, STATE_DIM, WHEELS};

/// x Wᵀ + b over the last dimension: (rows, in) -> (rows, out), weight (out, in).
///
/// # Errors
/// A candle error when shapes disagree.
pub fn linear(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    x.matmul(&weight.t()?)?.broadcast_add(bias)
}

/// θ (rows, 6) of raw coordinates (rows, 6): see `soil_coordinates`.
///
/// # Errors
/// A candle error when the last dimension is not six.
pub fn soil_from_raw(raw: &Tensor) -> Result<Tensor> {
    let share = ((raw.neg()?.exp()? + 1.0)?).recip()?;
    let columns: Vec<Tensor> = (0..SOIL_DIM)
        .map(|i| {
            let (low, high) = span(i);
            let value = share.narrow(1, i, 1)?.affine(high - low, low)?;
            if LOGARITHMIC[i] { value.exp() } else { Ok(value) }
        })
        .collect::<Result<_>>()?;
    Tensor::cat(&columns, 1)
}

/// What the tokens so far have left behind, for those to come.
#[derive(Default)]
pub struct KvCache {
    blocks: [Past; BLOCKS],
}

/// The past of one block.
#[derive(Default)]
struct Past {
    /// Keys and values, each (batch, heads, positions, head width).
    tokens: Option<(Tensor, Tensor)>,
    /// The same and those of the steps, once single tokens follow on a processor.
    memory: Option<Shared>,
}

impl KvCache {
    /// Nothing yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Forgets all.
    pub fn clear(&mut self) {
        *self = Self::default();
    }
}

impl Past {
    /// Attention of `new` tokens of each of `batch` rows, queries, keys and values (batch · new, 384), over the past and each other as far as the mask
    /// lets them: (batch · new, 128). They become part of the past.
    fn attend(&mut self, qkv: &Tensor, batch: usize, new: usize, mask: Option<&Tensor>) -> Result<Tensor> {
        if new == 1 && mask.is_none() && qkv.device().is_cpu() {
            return match &self.memory {
                Some(memory) => attend_next(qkv, memory),
                None => {
                    let (attended, memory) = attend_first(qkv, self.tokens.as_ref())?;
                    self.memory = Some(memory);
                    Ok(attended)
                }
            };
        }
        if self.memory.is_some() {
            bail!("attention: after single tokens only single ones can follow");
        }
        let qkv = qkv.reshape((batch, new, 3, HEADS, HEAD_DIM))?;
        let part = |i: usize| qkv.narrow(2, i, 1)?.squeeze(2)?.transpose(1, 2)?.contiguous();
        let (q, mut k, mut v) = (part(0)?, part(1)?, part(2)?);
        if let Some((old_k, old_v)) = &self.tokens {
            k = Tensor::cat(&[old_k, &k], 2)?.contiguous()?;
            v = Tensor::cat(&[old_v, &v], 2)?.contiguous()?;
        }
        let mut scores = q.matmul(&k.transpose(2, 3)?)?;
        if let Some(mask) = mask {
            scores = scores.broadcast_add(mask)?;
        }
        let attended = softmax(&scores, SCORE_SCALE)?.matmul(&v)?.transpose(1, 2)?.reshape((batch * new, HIDDEN))?;
        self.tokens = Some((k, v));
        Ok(attended)
    }
}

struct Block {
    norm1: [Tensor; 2],
    qkv: [Tensor; 2],
    out: [Tensor; 2],
    norm2: [Tensor; 2],
    up: [Tensor; 2],
    down: [Tensor; 2],
}

/// The soil prior h_θ (paper §IV-B): two convolutions of stride 2 (the paper does not state the stride), mean, two-layer perceptron.
pub struct SoilPriorHead {
    conv1: [Tensor; 2],
    conv2: [Tensor; 2],
    hidden: [Tensor; 2],
    out: [Tensor; 2],
}

/// All trainable tensors of the kinodynamic model.
pub struct Network {
    /// Trainable variables by name, in the order of the names.
    pub variables: Vec<(String, Var)>,
    token_state: Tensor,
    token_context: Tensor,
    token_bias: Tensor,
    position: Tensor,
    blocks: Vec<Block>,
    norm: [Tensor; 2],
    sinkage: [Tensor; 2],
    residual: [Tensor; 2],
    /// Soil prior.
    pub soil: SoilPriorHead,
}

/// Names and shapes of every trainable array of the kinodynamic model.
pub fn trainable_shapes() -> Vec<(String, Vec<usize>)> {
    let mut shapes: Vec<(String, Vec<usize>)> = vec![
        ("token.state.weight".into(), vec![HIDDEN, STATE_CONTROL]),
        ("token.context.weight".into(), vec![HIDDEN, CONTEXT]),
        ("token.bias".into(), vec![HIDDEN]),
        ("position".into(), vec![POSITIONS, HIDDEN]),
    ];
    let mut layer = |name: String, out: usize, input: usize| {
        shapes.push((format!("{name}.weight"), vec![out, input]));
        shapes.push((format!("{name}.bias"), vec![out]));
    };
    for b in 0..BLOCKS {
        layer(format!("block{b}.qkv"), 3 * HIDDEN, HIDDEN);
        layer(format!("block{b}.out"), HIDDEN, HIDDEN);
        layer(format!("block{b}.up"), FEED_FORWARD, HIDDEN);
        layer(format!("block{b}.down"), HIDDEN, FEED_FORWARD);
    }
    layer("sinkage".into(), WHEELS, HIDDEN);
    layer("residual".into(), STATE_DIM, HIDDEN);
    layer("soil.conv1".into(), 32, 9 * FEATURE_CHANNELS);
    layer("soil.conv2".into(), 64, 9 * 32);
    layer("soil.hidden".into(), 64, 64);
    layer("soil.out".into(), SOIL_DIM, 64);
    for name in ["block0.norm1", "block0.norm2", "block1.norm1", "block1.norm2", "norm"] {
        shapes.push((format!("{name}.weight"), vec![HIDDEN]));
        shapes.push((format!("{name}.bias"), vec![HIDDEN]));
    }
    shapes
}

impl Network {
    /// Trainable variables from weights, on a device.
    ///
    /// # Errors
    /// `ModelError::Weights` when an array is absent or has another shape.
    pub fn from_weights(weights: &Weights, device: &Device) -> std::result::Result<Self, crate::ModelError> {
        let mut variables = Vec::new();
        for (name, shape) in trainable_shapes() {
            let values = weights.get(&name, &shape)?;
            variables.push((name, Var::from_tensor(&Tensor::from_slice(values, shape, device)?)?));
        }
        let find = |name: &str| {
            let (_, var) = variables.iter().find(|(n, _)| n == name).expect("every name is listed; this is a bug");
            var.as_tensor().clone()
        };
        let pair = |name: &str| [find(&format!("{name}.weight")), find(&format!("{name}.bias"))];
        let blocks = (0..BLOCKS)
            .map(|b| Block {
                norm1: pair(&format!("block{b}.norm1")),
                qkv: pair(&format!("block{b}.qkv")),
                out: pair(&format!("block{b}.out")),
                norm2: pair(&format!("block{b}.norm2")),
                up: pair(&format!("block{b}.up")),
                down: pair(&format!("block{b}.down")),
            })
            .collect();
        Ok(Self {
            token_state: find("token.state.weight"),
            token_context: find("token.context.weight"),
            token_bias: find("token.bias"),
            position: find("position"),
            blocks,
            norm: pair("norm"),
            sinkage: pair("sinkage"),
            residual: pair("residual"),
            soil: SoilPriorHead {
                conv1: pair("soil.conv1"),
                conv2: pair("soil.conv2"),
                hidden: pair("soil.hidden"),
                out: pair("soil.out"),
            },
            variables,
        })
    }

    /// The current values of the variables.
    ///
    /// # Errors
    /// A candle error when a tensor cannot be read.
    pub fn to_weights(&self) -> Result<Weights> {
        let mut weights = Weights::default();
        for (name, var) in &self.variables {
            weights.insert(name.clone(), var.dims(), var.flatten_all()?.to_vec1()?);
        }
        Ok(weights)
    }

    /// Where the variables are.
    pub fn device(&self) -> &Device {
        self.token_bias.device()
    }

    /// W_c, (128, context = 9216).
    pub fn token_context(&self) -> &Tensor {
        &self.token_context
    }

    /// Embedding of tokens: scaled state and control entries (rows, 14) and W_c c (rows, 128) -> (rows, 128), without position.
    ///
    /// # Errors
    /// A candle error when shapes disagree.
    pub fn embed(&self, entries: &Tensor, context_token: &Tensor) -> Result<Tensor> {
        linear(entries, &self.token_state, &self.token_bias)? + context_token
    }

    /// Rows `from .. from + n` of the positional embedding, (n, 128).
    ///
    /// # Errors
    /// A candle error past position 64.
    pub fn positions(&self, from: usize, n: usize) -> Result<Tensor> {
        self.position.narrow(0, from, n)
    }

    /// Runs `x` (batch, new, 128), already with positions, through the causal Transformer, extending the cache.
    ///
    /// `mask` (batch or 1, 1, new, cached + new) is added to the scores before they are scaled; `None` lets every new token see everything.
    ///
    /// # Errors
    /// A candle error when shapes disagree.
    pub fn transformer(&self, x: &Tensor, cache: &mut KvCache, mask: Option<&Tensor>) -> Result<Tensor> {
        let (batch, new, _) = x.dims3()?;
        let mut x = x.reshape((batch * new, HIDDEN))?;
        for (block, past) in self.blocks.iter().zip(&mut cache.blocks) {
            let normal = layer_norm(&x, &block.norm1[0], &block.norm1[1])?;
            let attended = past.attend(&linear(&normal, &block.qkv[0], &block.qkv[1])?, batch, new, mask)?;
            x = (x + linear(&attended, &block.out[0], &block.out[1])?)?;
            let normal = layer_norm(&x, &block.norm2[0], &block.norm2[1])?;
            let hidden = activate(&normal.matmul(&block.up[0].t()?)?, &block.up[1], Activation::Gelu)?;
            x = (x + linear(&hidden, &block.down[0], &block.down[1])?)?;
        }
        layer_norm(&x, &self.norm[0], &self.norm[1])?.reshape((batch, new, HIDDEN))
    }

    /// Heads: hidden (rows, 128) -> raw sinkage (rows, 4) and raw residual (rows, 12).
    ///
    /// # Errors
    /// A candle error when shapes disagree.
    pub fn heads(&self, hidden: &Tensor) -> Result<(Tensor, Tensor)> {
        Ok((linear(hidden, &self.sinkage[0], &self.sinkage[1])?, linear(hidden, &self.residual[0], &self.residual[1])?))
    }
}

impl SoilPriorHead {
    /// Raw soil coordinates (rows, 6) of semantic features (rows, 16, 16, 18).
    ///
    /// # Errors
    /// A candle error when shapes disagree.
    pub fn raw(&self, features: &Tensor) -> Result<Tensor> {
        let silu = |x: &Tensor, [weight, bias]: &[Tensor; 2]| activate(&x.matmul(&weight.t()?)?, bias, Activation::Silu);
        let (first, second) =
            (Conv { px: FEATURE_PX, channels: FEATURE_CHANNELS, stride: 2 }, Conv { px: FEATURE_PX / 2, channels: 32, stride: 2 });
        let (rows, half) = (features.dim(0)?, first.out_px());
        let h = silu(&im2col(features, first)?, &self.conv1)?.reshape((rows, half, half, 32))?;
        let h = silu(&im2col(&h, second)?, &self.conv2)?;
        let pooled = h.reshape((rows, second.out_px() * second.out_px(), 64))?.mean(1)?;
        linear(&silu(&pooled, &self.hidden)?, &self.out[0], &self.out[1])
    }
}

/// Additive causal mask (1, 1, n, n): 0 where a token may look, -1e9 ahead of it.
pub fn causal_mask(n: usize, device: &Device) -> Result<Tensor> {
    let values: Vec<f32> = (0..n * n).map(|i| if i % n > i / n { -1e9 } else { 0.0 }).collect();
    Tensor::from_vec(values, (1, 1, n, n), device)
}
