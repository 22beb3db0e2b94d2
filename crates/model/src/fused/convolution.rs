//! Convolutions of stride 2 with sixteen pixels of an output row in a vector.

use super::vector::{LANES, Vector};

/// An image as the input of a convolution of stride 2: of each row the odd columns, then the even ones, so that sixteen outputs read neighbouring numbers;
/// a row and a vector of zeros lie before the first.
#[derive(Clone, Debug)]
pub struct Image {
    pixels: Vec<f32>,
    px: usize,
}

impl Image {
    /// A black image (channels, px, px); px is a multiple of 32.
    pub fn new(channels: usize, px: usize) -> Self {
        Self { pixels: vec![0.0; channels * (px + 1) * row_stride(px)], px }
    }

    /// Sets sixteen pixels of a row, from column 16 · group.
    #[inline(always)]
    pub fn put(&mut self, channel: usize, row: usize, group: usize, pixels: &[f32; LANES]) {
        let stride = row_stride(self.px);
        let at = (channel * (self.px + 1) + row + 1) * stride + LANES + group * LANES / 2;
        let (odd, even) = self.pixels[at..].split_at_mut(self.px / 2);
        let (odd, even) = (&mut odd[..LANES / 2], &mut even[..LANES / 2]);
        for i in 0..LANES / 2 {
            even[i] = pixels[2 * i];
            odd[i] = pixels[2 * i + 1];
        }
    }
}

/// Numbers of a row: a vector of zeros, odd columns, even columns.
const fn row_stride(px: usize) -> usize {
    LANES + px
}

/// A 3×3 convolution of stride 2 with zero padding; R filters are computed together.
#[derive(Clone, Debug)]
pub struct Convolution<const R: usize> {
    /// Per group of R filters and tap: the weights.
    weights: Vec<[f32; R]>,
    bias: Vec<[f32; R]>,
    /// Where the tap of an output lies, from the start of its uppermost input row.
    taps: Vec<usize>,
    px: usize,
}

impl<const R: usize> Convolution<R> {
    /// `weight` (filters, 3 · 3 · channels) ordered (row, column, channel), `bias` (filters), for images of `px` pixels a side. Filters are a multiple of R.
    pub fn new(weight: &[f32], bias: &[f32], px: usize) -> Self {
        let inputs = weight.len() / bias.len();
        let channels = inputs / 9;
        // Channel by channel, so that the rows of one plane are read together.
        let order: Vec<[usize; 3]> = (0..channels).flat_map(|c| (0..3).flat_map(move |ky| (0..3).map(move |kx| [c, ky, kx]))).collect();
        let column = |kx: usize| match kx {
            0 => LANES - 1,
            1 => LANES + px / 2,
            _ => LANES,
        };
        let groups = bias.len() / R;
        let source = |group: usize, [c, ky, kx]: [usize; 3]| {
            core::array::from_fn(|r| weight[(group * R + r) * inputs + (ky * 3 + kx) * channels + c])
        };
        Self {
            weights: (0..groups).flat_map(|group| order.iter().map(move |tap| source(group, *tap)).collect::<Vec<_>>()).collect(),
            bias: (0..groups).map(|group| core::array::from_fn(|r| bias[group * R + r])).collect(),
            taps: order.iter().map(|[c, ky, kx]| (c * (px + 1) + ky) * row_stride(px) + column(*kx)).collect(),
            px,
        }
    }

    /// Runs over an image of at least its channels; `store(filter, row, group, pixels)` takes sixteen pixels of an output row each. Sums run over channel, row
    /// and column in order.
    #[inline(always)]
    pub fn run<V: Vector>(&self, image: &Image, relu: bool, mut store: impl FnMut(usize, usize, usize, &[f32; LANES])) {
        for (filters, (weights, bias)) in self.weights.chunks_exact(self.taps.len()).zip(&self.bias).enumerate() {
            if V::WIDE {
                self.filters::<V, 2>(filters * R, weights, bias, image, relu, &mut store);
            } else {
                self.filters::<V, 1>(filters * R, weights, bias, image, relu, &mut store);
            }
        }
    }

    /// R filters over the whole image, W neighbouring vectors at a time, of one row or of two.
    #[inline(always)]
    fn filters<V: Vector, const W: usize>(
        &self,
        first: usize,
        weights: &[[f32; R]],
        bias: &[f32; R],
        image: &Image,
        relu: bool,
        store: &mut impl FnMut(usize, usize, usize, &[f32; LANES]),
    ) {
        let groups = self.px / 2 / LANES;
        for position in (0..self.px / 2 * groups).step_by(W) {
            let mut at = [0; W];
            for w in 0..W {
                let p = position + w;
                at[w] = 2 * (p / groups) * row_stride(self.px) + p % groups * LANES;
            }
            let sums = self.tile::<V, W>(weights, bias, &image.pixels, at);
            for w in 0..W {
                for r in 0..R {
                    let value = if relu { V::splat(0.0).max(sums[r][w]) } else { sums[r][w] };
                    let mut pixels = [0.0; LANES];
                    value.store(&mut pixels);
                    store(first + r, (position + w) / groups, (position + w) % groups, &pixels);
                }
            }
        }
    }

    /// R filters at W places of the image.
    #[inline(always)]
    fn tile<V: Vector, const W: usize>(&self, weights: &[[f32; R]], bias: &[f32; R], pixels: &[f32], at: [usize; W]) -> [[V; W]; R] {
        let mut sums = [[V::splat(0.0); W]; R];
        for r in 0..R {
            sums[r] = [V::splat(bias[r]); W];
        }
        for (weights, tap) in weights.iter().zip(&self.taps) {
            let mut input = [V::splat(0.0); W];
            for w in 0..W {
                let from = at[w] + tap;
                let chunk: &[f32; LANES] = pixels[from..from + LANES].try_into().expect("sixteen pixels; this is a bug");
                input[w] = V::load(chunk);
            }
            for r in 0..R {
                let weight = V::splat(weights[r]);
                for w in 0..W {
                    sums[r][w] = weight.mul_add(input[w], sums[r][w]);
                }
            }
        }
        sums
    }
}

#[cfg(test)]
mod tests {
    use super::super::vector::{Kernel, Path};
    use super::*;

    const PX: usize = 32;
    const CHANNELS: usize = 3;
    const FILTERS: usize = 4;

    fn value(i: usize) -> f32 {
        ((i * 7919 + 13) % 1000) as f32 / 500.0 - 1.0
    }

    struct Run<'a>(&'a Convolution<2>, &'a Image);

    impl Kernel for Run<'_> {
        type Output = Vec<f32>;
        #[inline(always)]
        fn run<V: Vector>(self) -> Vec<f32> {
            let out = PX / 2;
            let mut result = vec![0.0; FILTERS * out * out];
            self.0.run::<V>(self.1, true, |filter, row, group, pixels| {
                let at = (filter * out + row) * out + group * LANES;
                result[at..at + LANES].copy_from_slice(pixels);
            });
            result
        }
    }

    #[test]
    fn analytic_convolution_equals_its_sum_on_every_path() {
        let weight: Vec<f32> = (0..FILTERS * 9 * CHANNELS).map(value).collect();
        let bias: Vec<f32> = (0..FILTERS).map(|i| value(i + 77)).collect();
        let pixel = |c: usize, y: usize, x: usize| value(c * PX * PX + y * PX + x + 5);
        let mut image = Image::new(CHANNELS, PX);
        for (c, y, group) in (0..CHANNELS).flat_map(|c| (0..PX).flat_map(move |y| (0..PX / LANES).map(move |g| (c, y, g)))) {
            image.put(c, y, group, &core::array::from_fn(|i| pixel(c, y, group * LANES + i)));
        }
        let convolution = Convolution::<2>::new(&weight, &bias, PX);
        for path in Path::available() {
            let found = path.run(Run(&convolution, &image));
            for (i, found) in found.iter().enumerate() {
                let (filter, oy, ox) = (i / 256, i / 16 % 16, i % 16);
                let mut sum = f64::from(bias[filter]);
                for (ky, kx, c) in (0..3).flat_map(|y| (0..3).flat_map(move |x| (0..CHANNELS).map(move |c| (y, x, c)))) {
                    if let (Some(y), Some(x)) = ((2 * oy + ky).checked_sub(1), (2 * ox + kx).checked_sub(1)) {
                        let weight = weight[filter * 9 * CHANNELS + (ky * 3 + kx) * CHANNELS + c];
                        sum += f64::from(weight) * f64::from(pixel(c, y, x));
                    }
                }
                assert!((f64::from(*found) - sum.max(0.0)).abs() < 1e-5, "{} {filter} {oy} {ox}: {found} {sum}", path.as_str());
            }
        }
    }
}
