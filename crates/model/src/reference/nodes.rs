//! Activations, layer normalisation and softmax as single nodes of candle's graph, in vectors (those of the build's target: closures are not inlined into wider ones).
//!
//! candle keeps every operation as a node and adds up the gradient of each in an array of its own: a normalisation written in its operations is ten nodes, whose
//! passes over memory take longer than what they compute. On a GPU, for which these have no kernels, the same is written in candle's operations.

use candle_core::{CpuStorage, CustomOp1, CustomOp2, CustomOp3, D, Layout, Result, Shape, Tensor, bail};

use super::host::{from_values, values};
use crate::dims::NORM_EPS;
use crate::fused::{Kernel, LANES, Path, Vector, exp, gelu, gelu_slope, silu, silu_slope};

/// An activation of the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// GELU, tanh form.
    Gelu,
    /// SiLU.
    Silu,
}

/// The activation of x + bias, same shape: x (rows, width), bias (width).
///
/// # Errors
/// A candle error when shapes disagree.
pub fn activate(x: &Tensor, bias: &Tensor, activation: Activation) -> Result<Tensor> {
    let (_, width) = x.dims2()?;
    if bias.dim(0)? != width {
        bail!("activation: rows of {width} and biases of {:?}", bias.shape());
    }
    if x.device().is_cpu() { x.contiguous()?.apply_op2(bias, Activate(activation)) } else { in_operations::activate(x, bias, activation) }
}

/// Layer normalisation over the last dimension, same shape; `weight` and `bias` have its size, a multiple of sixteen.
///
/// # Errors
/// A candle error when shapes disagree.
pub fn layer_norm(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let width = weight.dim(0)?;
    if x.dim(D::Minus1)? != width || bias.dim(0)? != width || width % LANES != 0 {
        bail!("layer norm: {:?} by weights of {width} and biases of {:?}", x.shape(), bias.shape());
    }
    if x.device().is_cpu() { x.contiguous()?.apply_op3(weight, bias, LayerNorm) } else { in_operations::layer_norm(x, weight, bias) }
}

/// Softmax of `scale` · x over the last dimension.
///
/// # Errors
/// A candle error when the tensor is not of f32.
pub fn softmax(x: &Tensor, scale: f32) -> Result<Tensor> {
    if !x.device().is_cpu() {
        return in_operations::softmax(x, scale);
    }
    x.contiguous()?.apply_op1(Softmax { scale, width: x.dim(D::Minus1)? })
}

/// The same in candle's operations: what a GPU runs, and what the nodes are tested against.
mod in_operations {
    use super::{Activation, D, NORM_EPS, Result, Tensor};

    pub fn activate(x: &Tensor, bias: &Tensor, activation: Activation) -> Result<Tensor> {
        let x = x.broadcast_add(bias)?;
        match activation {
            Activation::Gelu => x.gelu(),
            Activation::Silu => x.silu(),
        }
    }

    pub fn layer_norm(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
        let centred = x.broadcast_sub(&x.mean_keepdim(D::Minus1)?)?;
        let variance = centred.sqr()?.mean_keepdim(D::Minus1)?;
        let normal = centred.broadcast_div(&(variance + f64::from(NORM_EPS))?.sqrt()?)?;
        normal.broadcast_mul(weight)?.broadcast_add(bias)
    }

    pub fn softmax(x: &Tensor, scale: f32) -> Result<Tensor> {
        let x = (x * f64::from(scale))?;
        let shifted = x.broadcast_sub(&x.max_keepdim(D::Minus1)?.detach())?.exp()?;
        shifted.broadcast_div(&shifted.sum_keepdim(D::Minus1)?)
    }
}

/// Calls `f` for sixteen values of each of the inputs at a time, and stores what it makes of them; past the end the inputs are 0.
#[inline(always)]
fn by_vectors<V: Vector, const N: usize>(inputs: [&[f32]; N], out: &mut [f32], f: impl Fn([V; N]) -> V) {
    let whole = out.len() / LANES * LANES;
    let (body, tail) = out.split_at_mut(whole);
    for (at, out) in body.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
        f(inputs.map(|input| V::load(&input.as_chunks::<LANES>().0[at]))).store(out);
    }
    if !tail.is_empty() {
        let last = inputs.map(|input| {
            let mut padded = [0.0; LANES];
            padded[..tail.len()].copy_from_slice(&input[whole..]);
            V::load(&padded)
        });
        let mut result = [0.0; LANES];
        f(last).store(&mut result);
        tail.copy_from_slice(&result[..tail.len()]);
    }
}

/// Sum over the lanes, in their order.
#[inline(always)]
fn total<V: Vector>(x: V) -> f32 {
    let mut lanes = [0.0; LANES];
    x.store(&mut lanes);
    lanes.iter().sum()
}

/// Shares of a softmax of `scale` · x over each `width` numbers.
pub(super) fn shares(scale: f32, width: usize, x: &[f32], out: &mut [f32]) {
    Path::run_on_target(Shares { scale, width, x, out });
}

/// Gradient by the numbers of one softmax of `scale` · x, given its shares and the gradient by them.
pub(super) fn softmax_gradient(scale: f32, shares: &[f32], upstream: &[f32], out: &mut [f32]) {
    let mean: f32 = upstream.iter().zip(shares).map(|(upstream, share)| upstream * share).sum();
    for ((out, share), upstream) in out.iter_mut().zip(shares).zip(upstream) {
        *out = scale * share * (upstream - mean);
    }
}

struct Activate(Activation);

struct Activated<'a> {
    activation: Activation,
    x: &'a [f32],
    bias: &'a [f32],
    out: &'a mut [f32],
}

impl Kernel for Activated<'_> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector>(self) {
        let width = self.bias.len();
        for (x, out) in self.x.chunks_exact(width).zip(self.out.chunks_exact_mut(width)) {
            match self.activation {
                Activation::Gelu => by_vectors::<V, 2>([x, self.bias], out, |[x, bias]| gelu(x.add(bias))),
                Activation::Silu => by_vectors::<V, 2>([x, self.bias], out, |[x, bias]| silu(x.add(bias))),
            }
        }
    }
}

/// Gradients by the rows, then one row more: that by the biases.
struct ActivatedGradient<'a> {
    activation: Activation,
    x: &'a [f32],
    bias: &'a [f32],
    upstream: &'a [f32],
    out: &'a mut [f32],
}

impl Kernel for ActivatedGradient<'_> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector>(self) {
        let width = self.bias.len();
        let (rows, by_bias) = self.out.split_at_mut(self.x.len());
        for ((x, upstream), out) in self.x.chunks_exact(width).zip(self.upstream.chunks_exact(width)).zip(rows.chunks_exact_mut(width)) {
            let inputs = [x, self.bias, upstream];
            match self.activation {
                Activation::Gelu => by_vectors::<V, 3>(inputs, out, |[x, bias, upstream]| gelu_slope(x.add(bias)).mul(upstream)),
                Activation::Silu => by_vectors::<V, 3>(inputs, out, |[x, bias, upstream]| silu_slope(x.add(bias)).mul(upstream)),
            }
            by_bias.iter_mut().zip(out).for_each(|(sum, own)| *sum += *own);
        }
    }
}

impl CustomOp2 for Activate {
    fn name(&self) -> &'static str {
        "activation"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout, bias: &CpuStorage, bias_layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (x, bias) = (values(x, layout)?, values(bias, bias_layout)?);
        let mut out = vec![0.0; x.len()];
        Path::run_on_target(Activated { activation: self.0, x, bias, out: &mut out });
        Ok((CpuStorage::F32(out), layout.shape().clone()))
    }

    fn bwd(&self, x: &Tensor, bias: &Tensor, _res: &Tensor, grad: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (rows, width) = x.dims2()?;
        let all = from_values([x, bias, grad], (rows + 1, width), |[x, bias, upstream]| {
            let mut out = vec![0.0; x.len() + bias.len()];
            Path::run_on_target(ActivatedGradient { activation: self.0, x, bias, upstream, out: &mut out });
            out
        })?;
        Ok((Some(all.narrow(0, 0, rows)?), Some(all.narrow(0, rows, 1)?.squeeze(0)?)))
    }
}

struct LayerNorm;

/// Mean of a row and the inverse of its standard deviation.
#[inline(always)]
fn moments<V: Vector>(row: &[[f32; LANES]]) -> [V; 2] {
    let share = 1.0 / (LANES * row.len()) as f32;
    let mean = V::splat(share * total(row.iter().fold(V::splat(0.0), |sum, x| sum.add(V::load(x)))));
    let squares = row.iter().fold(V::splat(0.0), |sum, x| {
        let away = V::load(x).sub(mean);
        away.mul_add(away, sum)
    });
    [mean, V::splat(1.0 / (share * total(squares) + NORM_EPS).sqrt())]
}

struct Normalised<'a> {
    x: &'a [f32],
    weight: &'a [f32],
    bias: &'a [f32],
    out: &'a mut [f32],
}

impl Kernel for Normalised<'_> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector>(self) {
        let width = self.weight.len();
        let (weight, bias) = (self.weight.as_chunks::<LANES>().0, self.bias.as_chunks::<LANES>().0);
        for (x, out) in self.x.chunks_exact(width).zip(self.out.chunks_exact_mut(width)) {
            let x = x.as_chunks::<LANES>().0;
            let [mean, inverse] = moments::<V>(x);
            for (i, out) in out.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
                V::load(&x[i]).sub(mean).mul(inverse).mul_add(V::load(&weight[i]), V::load(&bias[i])).store(out);
            }
        }
    }
}

/// Gradients by the rows, then two rows more: those by the weights and by the biases.
struct NormalisedGradient<'a> {
    x: &'a [f32],
    weight: &'a [f32],
    upstream: &'a [f32],
    out: &'a mut [f32],
}

impl Kernel for NormalisedGradient<'_> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector>(self) {
        let width = self.weight.len();
        let weight = self.weight.as_chunks::<LANES>().0;
        let (rows, own) = self.out.split_at_mut(self.x.len());
        let (by_weight, by_bias) = own.split_at_mut(width);
        let (by_weight, by_bias) = (by_weight.as_chunks_mut::<LANES>().0, by_bias.as_chunks_mut::<LANES>().0);
        let share = 1.0 / width as f32;
        for ((x, upstream), out) in self.x.chunks_exact(width).zip(self.upstream.chunks_exact(width)).zip(rows.chunks_exact_mut(width)) {
            let (x, upstream) = (x.as_chunks::<LANES>().0, upstream.as_chunks::<LANES>().0);
            let [mean, inverse] = moments::<V>(x);
            let normal = |i: usize| V::load(&x[i]).sub(mean).mul(inverse);
            let (mut sum, mut along) = (V::splat(0.0), V::splat(0.0));
            for i in 0..x.len() {
                let (upstream, normal) = (V::load(&upstream[i]), normal(i));
                upstream.mul_add(normal, V::load(&by_weight[i])).store(&mut by_weight[i]);
                upstream.add(V::load(&by_bias[i])).store(&mut by_bias[i]);
                let weighted = upstream.mul(V::load(&weight[i]));
                sum = sum.add(weighted);
                along = weighted.mul_add(normal, along);
            }
            let (level, along) = (V::splat(share * total(sum)), V::splat(-share * total(along)));
            for (i, out) in out.as_chunks_mut::<LANES>().0.iter_mut().enumerate() {
                let weighted = V::load(&upstream[i]).mul(V::load(&weight[i]));
                normal(i).mul_add(along, weighted.sub(level)).mul(inverse).store(out);
            }
        }
    }
}

impl CustomOp3 for LayerNorm {
    fn name(&self) -> &'static str {
        "layer-norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let x = values(x, layout)?;
        let mut out = vec![0.0; x.len()];
        Path::run_on_target(Normalised { x, weight: values(weight, weight_layout)?, bias: values(bias, bias_layout)?, out: &mut out });
        Ok((CpuStorage::F32(out), layout.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _bias: &Tensor,
        _res: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let width = weight.dim(0)?;
        let rows = x.elem_count() / width;
        let all = from_values([x, weight, grad], (rows + 2, width), |[x, weight, upstream]| {
            let mut out = vec![0.0; x.len() + 2 * weight.len()];
            Path::run_on_target(NormalisedGradient { x, weight, upstream, out: &mut out });
            out
        })?;
        let own = |row: usize| all.narrow(0, rows + row, 1)?.squeeze(0);
        Ok((Some(all.narrow(0, 0, rows)?.reshape(x.shape())?), Some(own(0)?), Some(own(1)?)))
    }
}

struct Softmax {
    scale: f32,
    width: usize,
}

struct Shares<'a> {
    scale: f32,
    width: usize,
    x: &'a [f32],
    out: &'a mut [f32],
}

impl Kernel for Shares<'_> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector>(self) {
        let scale = V::splat(self.scale);
        for (x, out) in self.x.chunks_exact(self.width).zip(self.out.chunks_exact_mut(self.width)) {
            let top = V::splat(x.iter().copied().fold(f32::NEG_INFINITY, f32::max));
            by_vectors::<V, 1>([x], out, |[x]| exp(x.sub(top).mul(scale)));
            let share = 1.0 / out.iter().sum::<f32>();
            out.iter_mut().for_each(|value| *value *= share);
        }
    }
}

impl CustomOp1 for Softmax {
    fn name(&self) -> &'static str {
        "softmax"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = values(storage, layout)?;
        let mut out = vec![0.0; x.len()];
        shares(self.scale, self.width, x, &mut out);
        Ok((CpuStorage::F32(out), layout.shape().clone()))
    }

    fn bwd(&self, _arg: &Tensor, res: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        from_values([res, grad], res.shape(), |[shares, upstream]| {
            let mut out = vec![0.0; shares.len()];
            let rows = shares.chunks_exact(self.width).zip(upstream.chunks_exact(self.width)).zip(out.chunks_exact_mut(self.width));
            rows.for_each(|((shares, upstream), out)| softmax_gradient(self.scale, shares, upstream, out));
            out
        })
        .map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    /// Values and gradients of a node and of the same in candle's operations, at random points, against each other.
    fn check(what: &str, shape: &[usize], node: impl Fn(&[Var]) -> Result<Tensor>, plain: impl Fn(&[Var]) -> Result<Tensor>, more: &[Var]) {
        let apart = |a: &Tensor, b: &Tensor| (a - b).and_then(|d| d.abs()?.max_all()?.to_scalar::<f32>()).expect("readable");
        let x = Var::randn(0f32, 2f32, shape, &Device::Cpu).expect("a tensor");
        let all: Vec<Var> = core::iter::once(x).chain(more.iter().cloned()).collect();
        let (own, other) = (node(&all).expect("runs"), plain(&all).expect("runs"));
        assert!(apart(&own, &other) < 3e-6, "{what}: values {} apart", apart(&own, &other));
        let upstream = Tensor::randn(0f32, 1f32, own.shape(), &Device::Cpu).expect("a tensor");
        let pulled = |y: &Tensor| (y * &upstream).and_then(|y| y.sum_all()?.backward()).expect("differentiable");
        let (own, other) = (pulled(&own), pulled(&other));
        for (i, var) in all.iter().enumerate() {
            let (own, other) = (own.get(var).expect("it takes part"), other.get(var).expect("it takes part"));
            let size = other.abs().and_then(|a| a.max_all()?.to_scalar::<f32>()).expect("readable");
            assert!(apart(own, other) < 2e-5 * size.max(1.0), "{what}, argument {i}: gradients {} apart of {size}", apart(own, other));
        }
    }

    #[test]
    fn analytic_nodes_are_what_candle_makes_of_the_formulas() {
        let own = |mean: f32, width: usize| Var::randn(mean, 0.5f32, width, &Device::Cpu).expect("a tensor");
        for shape in [[15, 64], [7, 33], [1, 16], [2, 3]] {
            let bias = [own(0.0, shape[1])];
            for activation in [Activation::Gelu, Activation::Silu] {
                let node = |x: &[Var]| activate(&x[0], &x[1], activation);
                check(&format!("{activation:?}"), &shape, node, |x| in_operations::activate(&x[0], &x[1], activation), &bias);
            }
        }
        for shape in [&[3, 5, 64][..], &[7, 33], &[1, 16], &[2, 3]] {
            check("softmax", shape, |x| softmax(&x[0], 0.3), |x| in_operations::softmax(&x[0], 0.3), &[]);
        }
        for shape in [&[3, 5, 64][..], &[9, 16], &[1, 128]] {
            let width = shape[shape.len() - 1];
            let plain = |x: &[Var]| in_operations::layer_norm(&x[0], &x[1], &x[2]);
            check("layer norm", shape, |x| layer_norm(&x[0], &x[1], &x[2]), plain, &[own(1.0, width), own(0.0, width)]);
        }
    }
}
