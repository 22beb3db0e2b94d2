//! Convolutions as matrix products, on images stored (batch, height, width, channels).
//!
//! candle's own convolution runs at a few percent of the machine; gathering the 3×3 neighbourhoods into rows and multiplying once uses its
//! fast matrix product for both passes.

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};

use super::host::{from_values, values};

/// Geometry of a 3×3 convolution with padding 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Conv {
    /// Input height and width (square).
    pub px: usize,
    /// Input channels.
    pub channels: usize,
    /// Stride, 1 or 2.
    pub stride: usize,
}

impl Conv {
    /// Output height and width.
    pub fn out_px(&self) -> usize {
        self.px.div_ceil(self.stride)
    }

    /// Values of one neighbourhood: 9 × channels, ordered (row, column, channel).
    pub fn row(&self) -> usize {
        9 * self.channels
    }

    /// Calls `f(row offset, image offset)` for each run of `channels` values that lies inside the image, by ascending row offset.
    fn for_each_run(&self, batch: usize, mut f: impl FnMut(usize, usize)) {
        let (px, c, out) = (self.px as isize, self.channels, self.out_px());
        for b in 0..batch {
            for oy in 0..out {
                for ox in 0..out {
                    let row = ((b * out + oy) * out + ox) * self.row();
                    for ky in 0..3 {
                        let y = (oy * self.stride) as isize + ky - 1;
                        if y < 0 || y >= px {
                            continue;
                        }
                        for kx in 0..3 {
                            let x = (ox * self.stride) as isize + kx - 1;
                            if x < 0 || x >= px {
                                continue;
                            }
                            f(row + ((ky * 3 + kx) as usize) * c, ((b as isize * px + y) * px + x) as usize * c);
                        }
                    }
                }
            }
        }
    }
}

struct Im2Col(Conv);

impl CustomOp1 for Im2Col {
    fn name(&self) -> &'static str {
        "im2col"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (conv, image) = (self.0, values(storage, layout)?);
        let batch = image.len() / (conv.px * conv.px * conv.channels);
        let rows = batch * conv.out_px() * conv.out_px();
        let mut out = Vec::with_capacity(rows * conv.row());
        // In the order of the rows, so that nothing is written twice.
        conv.for_each_run(batch, |row, at| {
            out.resize(row, 0.0);
            out.extend_from_slice(&image[at..at + conv.channels]);
        });
        out.resize(rows * conv.row(), 0.0);
        Ok((CpuStorage::F32(out), Shape::from((rows, conv.row()))))
    }

    fn bwd(&self, image: &Tensor, _res: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        let (conv, batch) = (self.0, image.dim(0)?);
        from_values([grad], image.shape(), |[rows]| {
            let mut image = vec![0f32; batch * conv.px * conv.px * conv.channels];
            let c = conv.channels;
            conv.for_each_run(batch, |row, at| {
                for (pixel, value) in image[at..at + c].iter_mut().zip(&rows[row..row + c]) {
                    *pixel += value;
                }
            });
            image
        })
        .map(Some)
    }
}

/// Neighbourhoods (batch · out · out, 9 · channels) of an image (batch, px, px, channels).
///
/// # Errors
/// A candle error when the image does not have the stated shape.
pub fn im2col(image: &Tensor, conv: Conv) -> Result<Tensor> {
    let (_, h, w, c) = image.dims4()?;
    if (h, w, c) != (conv.px, conv.px, conv.channels) {
        bail!("im2col: image is {h}×{w}×{c}, expected {0}×{0}×{1}", conv.px, conv.channels);
    }
    if image.device().is_cuda() { from_slices(image, conv) } else { image.contiguous()?.apply_op1(Im2Col(conv)) }
}

/// The same by candle's own operations, which a GPU has: nine shifted images side by side.
fn from_slices(image: &Tensor, conv: Conv) -> Result<Tensor> {
    let (batch, out) = (image.dim(0)?, conv.out_px());
    // One pixel around the image, and one more for the last stride.
    let padded = image.pad_with_zeros(1, 1, conv.stride)?.pad_with_zeros(2, 1, conv.stride)?;
    let every = |x: &Tensor, dim: usize, from: usize| -> Result<Tensor> {
        let x = x.narrow(dim, from, out * conv.stride)?;
        let mut shape = x.dims().to_vec();
        shape[dim] = out;
        shape.insert(dim + 1, conv.stride);
        x.contiguous()?.reshape(shape)?.narrow(dim + 1, 0, 1)?.squeeze(dim + 1)
    };
    let mut shifted = Vec::with_capacity(9);
    for ky in 0..3 {
        let rows = every(&padded, 1, ky)?;
        for kx in 0..3 {
            shifted.push(every(&rows, 2, kx)?);
        }
    }
    Tensor::cat(&shifted, 3)?.reshape((batch * out * out, conv.row()))
}

/// 3×3 convolution, padding 1: (batch, px, px, channels) -> (batch, out, out, filters); weight (filters, 9 · channels).
///
/// # Errors
/// A candle error when shapes disagree.
pub fn conv2d(image: &Tensor, conv: Conv, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let batch = image.dim(0)?;
    let rows = im2col(image, conv)?.matmul(&weight.t()?)?.broadcast_add(bias)?;
    rows.reshape((batch, conv.out_px(), conv.out_px(), weight.dim(0)?))
}

/// (batch, px, px, 4 c) -> (batch, 2 px, 2 px, c): the up-sampling of the decoders.
///
/// # Errors
/// A candle error when the channels are no multiple of four.
pub fn pixel_shuffle(image: &Tensor) -> Result<Tensor> {
    let (b, h, w, c4) = image.dims4()?;
    let c = c4 / 4;
    image.reshape(&[b, h, w, 2, 2, c])?.permute([0, 1, 3, 2, 4, 5])?.reshape((b, 2 * h, 2 * w, c))
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn published_im2col_product_equals_the_convolution_of_candle() -> Result<()> {
        let device = Device::Cpu;
        for stride in [1, 2] {
            let conv = Conv { px: 8, channels: 3, stride };
            let image = Tensor::randn(0f32, 1f32, (2, 8, 8, 3), &device)?;
            let weight = Tensor::randn(0f32, 1f32, (5, 27), &device)?;
            let got = conv2d(&image, conv, &weight, &Tensor::zeros(5, candle_core::DType::F32, &device)?)?;
            let kernel = weight.reshape((5, 3, 3, 3))?.permute((0, 3, 1, 2))?.contiguous()?;
            let want = image.permute((0, 3, 1, 2))?.contiguous()?.conv2d(&kernel, 1, stride, 1, 1)?.permute((0, 2, 3, 1))?;
            let error = (got - want)?.abs()?.max_all()?.to_scalar::<f32>()?;
            assert!(error < 1e-4, "stride {stride}: {error}");
        }
        Ok(())
    }

    #[test]
    fn property_slices_give_the_same_neighbourhoods_and_gradients() -> Result<()> {
        for (stride, px) in [(1, 6), (2, 6), (2, 8)] {
            let conv = Conv { px, channels: 3, stride };
            let image = Var::randn(0f32, 1f32, (2, px, px, 3), &Device::Cpu)?;
            let (by_op, by_slices) = (im2col(&image, conv)?, from_slices(&image, conv)?);
            assert_eq!(by_op.to_vec2::<f32>()?, by_slices.to_vec2::<f32>()?, "stride {stride}, {px} pixels");
            let upstream = Tensor::randn(0f32, 1f32, by_op.shape(), &Device::Cpu)?;
            let pulled = |rows: &Tensor| -> Result<Tensor> {
                Ok((rows * &upstream)?.sum_all()?.backward()?.get(&image).expect("the image takes part").clone())
            };
            let error = (pulled(&by_op)? - pulled(&by_slices)?)?.abs()?.max_all()?.to_scalar::<f32>()?;
            assert!(error < 1e-5, "stride {stride}, {px} pixels: gradients {error} apart");
        }
        Ok(())
    }

    #[test]
    fn analytic_backward_is_the_adjoint() -> Result<()> {
        // <im2col(x), y> = <x, col2im(y)>.
        let conv = Conv { px: 6, channels: 2, stride: 2 };
        let x = Var::randn(0f32, 1f32, (1, 6, 6, 2), &Device::Cpu)?;
        let rows = im2col(&x, conv)?;
        let y = Tensor::randn(0f32, 1f32, rows.shape(), &Device::Cpu)?;
        let product = (&rows * &y)?.sum_all()?;
        let gradient = product.backward()?.get(&x).expect("x takes part").clone();
        let other = (gradient * x.as_tensor())?.sum_all()?.to_scalar::<f32>()?;
        assert!((product.to_scalar::<f32>()? - other).abs() < 1e-4);
        Ok(())
    }
}
