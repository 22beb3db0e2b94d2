//! Sixteen f32 as one value, in the instructions that the processor has: the only module of this workspace with `unsafe` code (`x86` is a part of it).
//!
//! A [`Kernel`] is written once over [`Vector`]; [`Path::run`] compiles it for AVX-512 and for the target of the build (AVX2 with FMA on x86-64, see
//! `.cargo/config.toml`; whatever `wide` makes of it elsewhere), and calls the one that was found to run here. Both do the same IEEE operations in the same order, lane
//! by lane, so they give the same bits (where the target has a fused multiply-add; elsewhere its path rounds twice).
//!
//! # Why this is sound
//! Two things need `unsafe`: calling a function that is compiled for instructions which the processor may lack, and the intrinsics themselves. A [`Path`]
//! of AVX-512 exists only after the processor was asked ([`Path::available`]); the vector types are private and reach a kernel only through
//! [`Path::run`], so an intrinsic is never executed without its instructions. Loads and stores take references to whole arrays, so no pointer can leave
//! its memory. Tiles are registers of their own, which the compiler does not use; they are set up before a kernel of that path and given back after it.
//!
//! # Products of bf16
//! [`Vector::products`] multiplies tiles of bf16 in one of two orders of summation, those of the two instructions that do it: AMX's `tdpbf16ps` and AVX-512's
//! `vdpbf16ps`. Every path can do both, with the same bits: a product of two bf16 is exact in f32, so only the order of the sums counts.
#![allow(unsafe_code)]

use core::fmt::Debug;
use core::ops::{Deref, DerefMut};

use wide::{f32x8, u32x8};

#[cfg(target_arch = "x86_64")]
mod x86;

/// Samples of one lane.
pub const LANES: usize = 16;

/// One feature of sixteen samples, in a cache line of its own.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lane(pub [f32; LANES]);

impl Lane {
    /// All zero.
    pub const ZERO: Self = Self([0.0; LANES]);

    /// `value(l)` for each sample l.
    #[inline(always)]
    pub fn from_fn(value: impl FnMut(usize) -> f32) -> Self {
        Self(core::array::from_fn(value))
    }
}

impl Deref for Lane {
    type Target = [f32; LANES];
    #[inline(always)]
    fn deref(&self) -> &Self::Target {
        &self.0
    }
}

impl DerefMut for Lane {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut Self::Target {
        &mut self.0
    }
}

/// Sixteen rows of sixteen pairs of bf16, the even one of a pair in the low half.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile(pub [[u32; LANES]; LANES]);

impl Tile {
    /// All zero.
    pub const ZERO: Self = Self([[0; LANES]; LANES]);
}

/// Panels of sixteen outputs whose products are taken together.
pub const TILE_PANELS: usize = 4;

/// Order in which products of bf16 are summed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// That of AMX (`tdpbf16ps`): over each 32 inputs the even ones and the odd ones apart, then both, then to what came before.
    /// Rows of a tile of weights are outputs.
    Tiles,
    /// That of AVX-512 (`vdpbf16ps`): one after the other, of each pair the odd one first. Rows of a tile of weights are pairs of inputs.
    Pairs,
}

/// Sixteen f32 in registers. Every operation acts on each lane alone.
pub trait Vector: Copy + Debug {
    /// Whether the processor has registers for tiles of eight rows by two vectors.
    const WIDE: bool;
    /// x in all lanes.
    fn splat(x: f32) -> Self;
    /// From memory.
    fn load(from: &[f32; LANES]) -> Self;
    /// To memory.
    fn store(self, to: &mut [f32; LANES]);
    /// self + other.
    fn add(self, other: Self) -> Self;
    /// self - other.
    fn sub(self, other: Self) -> Self;
    /// self · other.
    fn mul(self, other: Self) -> Self;
    /// self / other.
    fn div(self, other: Self) -> Self;
    /// self · by + plus, rounded once.
    fn mul_add(self, by: Self, plus: Self) -> Self;
    /// The larger one; `other` where one is not a number.
    fn max(self, other: Self) -> Self;
    /// The smaller one; `other` where one is not a number.
    fn min(self, other: Self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Nearest integer, ties to even.
    fn round(self) -> Self;
    /// -self.
    fn neg(self) -> Self;
    /// |self|.
    fn abs(self) -> Self;
    /// The bits, shifted left by 23: turns the low bits of a mantissa into an exponent.
    fn shift_to_exponent(self) -> Self;
    /// The bits, shifted right by 23, under the bits of 2^23: the biased exponent of a positive number as 2^23 + exponent.
    fn exponent_over_2_23(self) -> Self;
    /// The mantissa of a positive normal number, in [1/2, 1).
    fn mantissa(self) -> Self;
    /// `a` where self >= 0, else `b`; `b` where self is not a number.
    fn select_ge0(self, a: Self, b: Self) -> Self;
    /// Pairs of bf16, rounded to nearest, ties to even: self and `odd`.
    fn store_pairs(self, odd: Self, to: &mut [u32; LANES]);
    /// Pairs of bf16 as numbers: the even ones and the odd ones.
    fn load_pairs(from: &[u32; LANES]) -> [Self; 2];

    /// Sums over the inputs of weight · input: `weights` four tiles for each of `inputs`, whose rows are pairs of inputs and whose columns are samples.
    /// (The instructions take numbers below 1.2e-38 for zero, [`products_in_f32`] does not.)
    #[inline(always)]
    fn products(order: Order, weights: &[[Tile; TILE_PANELS]], inputs: &[Tile], sums: &mut [[Lane; LANES]; TILE_PANELS]) {
        products_in_f32::<Self>(order, weights, inputs, sums);
    }
}

/// [`Vector::products`] where there are no instructions for it.
#[inline(always)]
fn products_in_f32<V: Vector>(order: Order, weights: &[[Tile; TILE_PANELS]], inputs: &[Tile], sums: &mut [[Lane; LANES]; TILE_PANELS]) {
    /// Outputs at a time.
    const M: usize = 4;
    for panel in 0..TILE_PANELS {
        for first in (0..LANES).step_by(M) {
            let mut totals = [V::splat(0.0); M];
            for (weights, inputs) in weights.iter().zip(inputs) {
                let mut apart = [[V::splat(0.0); 2]; M];
                for (k, inputs) in inputs.0.iter().enumerate() {
                    let [even, odd] = V::load_pairs(inputs);
                    for m in 0..M {
                        let pair = match order {
                            Order::Tiles => weights[panel].0[first + m][k],
                            Order::Pairs => weights[panel].0[k][first + m],
                        };
                        let [low, high] = [pair << 16, pair & 0xffff_0000].map(|bits| V::splat(f32::from_bits(bits)));
                        match order {
                            Order::Tiles => apart[m] = [low.mul_add(even, apart[m][0]), high.mul_add(odd, apart[m][1])],
                            Order::Pairs => totals[m] = low.mul_add(even, high.mul_add(odd, totals[m])),
                        }
                    }
                }
                if order == Order::Tiles {
                    for m in 0..M {
                        totals[m] = totals[m].add(apart[m][0].add(apart[m][1]));
                    }
                }
            }
            for m in 0..M {
                totals[m].store(&mut sums[panel][first + m].0);
            }
        }
    }
}

/// A computation in vectors. `run` must be `#[inline(always)]`, as everything that it calls with vectors, or the instructions do not reach the code.
pub trait Kernel {
    /// What it gives back.
    type Output;
    /// The computation.
    fn run<V: Vector>(self) -> Self::Output;
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Instructions {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// AVX-512 with products of bf16.
    #[cfg(target_arch = "x86_64")]
    Avx512Bf16,
    /// AVX-512 with tiles of bf16.
    #[cfg(target_arch = "x86_64")]
    Amx,
    Target,
}

/// Instructions that the kernels run on, found on this processor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Path(Instructions);

impl Path {
    /// Every path that runs on this processor, the fastest first.
    pub fn available() -> Vec<Self> {
        let mut paths = Vec::new();
        #[cfg(target_arch = "x86_64")]
        if x86::has_avx512() {
            paths.push(Self(Instructions::Avx512));
        }
        paths.push(Self(Instructions::Target));
        paths
    }

    /// The instructions of this processor for products of bf16 and the order in which they sum, the faster first. None on processors without.
    pub fn for_bf16() -> Vec<(Order, Self)> {
        let mut paths = Vec::new();
        #[cfg(target_arch = "x86_64")]
        if x86::has_avx512() {
            if x86::has_amx() {
                paths.push((Order::Tiles, Self(Instructions::Amx)));
            }
            if is_x86_feature_detected!("avx512bf16") {
                paths.push((Order::Pairs, Self(Instructions::Avx512Bf16)));
            }
        }
        paths
    }

    /// The fastest path of this processor.
    pub fn fastest() -> Self {
        Self::available()[0]
    }

    /// Runs a kernel on the path of the build's target and compiles it for no other: for long kernels (thousands of inlined instructions take minutes to compile) and
    /// for those that call functions which are not inlined, where wider vectors would be a call each. The bits are the same.
    #[inline]
    pub fn run_on_target<K: Kernel>(kernel: K) -> K::Output {
        kernel.run::<Target>()
    }

    /// Name in reports: `avx512`; for the path of the target `avx2` where it has AVX2, else `portable`.
    pub fn as_str(self) -> &'static str {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            Instructions::Avx512 => "avx512",
            #[cfg(target_arch = "x86_64")]
            Instructions::Avx512Bf16 => "avx512-bf16",
            #[cfg(target_arch = "x86_64")]
            Instructions::Amx => "amx",
            Instructions::Target if cfg!(target_feature = "avx2") => "avx2",
            Instructions::Target => "portable",
        }
    }

    /// Runs a kernel on this path. What products of bf16 it takes are done in f32.
    #[inline]
    pub fn run<K: Kernel>(self, kernel: K) -> K::Output {
        match self.0 {
            // SAFETY: `available` or `for_bf16` has found these instructions on this processor.
            #[cfg(target_arch = "x86_64")]
            Instructions::Avx512 | Instructions::Avx512Bf16 | Instructions::Amx => unsafe { x86::on_avx512(kernel) },
            Instructions::Target => kernel.run::<Target>(),
        }
    }

    /// The same with the path's own products of bf16. Of its own, because every path on which a kernel may run costs time to compile.
    #[inline]
    pub fn run_with_bf16<K: Kernel>(self, kernel: K) -> K::Output {
        match self.0 {
            // SAFETY: `for_bf16` has found these instructions on this processor.
            #[cfg(target_arch = "x86_64")]
            Instructions::Avx512Bf16 => unsafe { x86::on_avx512_bf16(kernel) },
            // SAFETY: the same, and the system has given the tiles to this process.
            #[cfg(target_arch = "x86_64")]
            Instructions::Amx => unsafe { x86::on_amx(kernel) },
            _ => self.run(kernel),
        }
    }
}

/// Sixteen floats in what the target of the build has.
#[derive(Clone, Copy, Debug)]
struct Target([f32x8; 2]);

impl Target {
    #[inline(always)]
    fn map(self, f: impl Fn(f32x8) -> f32x8) -> Self {
        Self([f(self.0[0]), f(self.0[1])])
    }

    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f32x8, f32x8) -> f32x8) -> Self {
        Self([f(self.0[0], other.0[0]), f(self.0[1], other.0[1])])
    }

    #[inline(always)]
    fn map_bits(self, f: impl Fn(u32x8) -> u32x8) -> Self {
        self.map(|x| bytemuck::cast(f(bytemuck::cast(x))))
    }
}

impl Vector for Target {
    const WIDE: bool = false;
    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self([f32x8::splat(x); 2])
    }
    #[inline(always)]
    fn load(from: &[f32; LANES]) -> Self {
        let [low, high] = from.as_chunks::<8>().0 else { unreachable!("sixteen is twice eight") };
        Self([f32x8::from(*low), f32x8::from(*high)])
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        let (low, high) = to.split_at_mut(8);
        low.copy_from_slice(&self.0[0].to_array());
        high.copy_from_slice(&self.0[1].to_array());
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
    #[inline(always)]
    fn mul_add(self, by: Self, plus: Self) -> Self {
        Self([self.0[0].mul_add(by.0[0], plus.0[0]), self.0[1].mul_add(by.0[1], plus.0[1])])
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| a.simd_gt(b).select(a, b))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| a.simd_lt(b).select(a, b))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.map(f32x8::sqrt)
    }
    #[inline(always)]
    fn round(self) -> Self {
        self.map(f32x8::round_ties_even)
    }
    #[inline(always)]
    fn neg(self) -> Self {
        self.map(|x| x ^ f32x8::splat(-0.0))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        self.map(f32x8::abs)
    }
    #[inline(always)]
    fn shift_to_exponent(self) -> Self {
        self.map_bits(|bits| bits << 23u32)
    }
    #[inline(always)]
    fn exponent_over_2_23(self) -> Self {
        self.map_bits(|bits| (bits >> 23u32) | u32x8::splat(0x4b00_0000))
    }
    #[inline(always)]
    fn mantissa(self) -> Self {
        self.map_bits(|bits| (bits & u32x8::splat(0x007f_ffff)) | u32x8::splat(0x3f00_0000))
    }
    #[inline(always)]
    fn select_ge0(self, a: Self, b: Self) -> Self {
        let half = |i: usize| self.0[i].simd_ge(f32x8::ZERO).select(a.0[i], b.0[i]);
        Self([half(0), half(1)])
    }
    #[inline(always)]
    fn store_pairs(self, odd: Self, to: &mut [u32; LANES]) {
        let rounded = |x: f32x8| -> u32x8 {
            let bits: u32x8 = bytemuck::cast(x);
            bits + u32x8::splat(0x7fff) + ((bits >> 16u32) & u32x8::splat(1))
        };
        for (i, to) in to.as_chunks_mut::<8>().0.iter_mut().enumerate() {
            *to = ((rounded(self.0[i]) >> 16u32) | (rounded(odd.0[i]) & u32x8::splat(0xffff_0000))).to_array();
        }
    }
    #[inline(always)]
    fn load_pairs(from: &[u32; LANES]) -> [Self; 2] {
        let [low, high] = from.as_chunks::<8>().0 else { unreachable!("sixteen is twice eight") };
        let pairs = [u32x8::from(*low), u32x8::from(*high)];
        [Self(pairs.map(|bits| bytemuck::cast(bits << 16u32))), Self(pairs.map(|bits| bytemuck::cast(bits & u32x8::splat(0xffff_0000))))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every operation on the same numbers.
    struct Everything<'a>(&'a [Lane; 3]);

    impl Kernel for Everything<'_> {
        type Output = Vec<[u32; LANES]>;
        #[inline(always)]
        fn run<V: Vector>(self) -> Self::Output {
            let [a, b, c] = [0, 1, 2].map(|i| V::load(&self.0[i].0));
            let results = [
                a.add(b),
                a.sub(b),
                a.mul(b),
                a.div(b),
                a.mul_add(b, c),
                a.max(b),
                a.min(b),
                a.abs().sqrt(),
                a.round(),
                a.neg(),
                a.abs().mantissa(),
                a.abs().exponent_over_2_23(),
                a.add(V::splat(8_388_735.0)).shift_to_exponent(),
                a.select_ge0(b, c),
            ];
            results
                .iter()
                .map(|r| {
                    let mut lane = Lane::ZERO;
                    r.store(&mut lane.0);
                    // All numbers that are none count as one.
                    lane.0.map(|x| if x.is_nan() { u32::MAX } else { x.to_bits() })
                })
                .collect()
        }
    }

    #[test]
    fn property_every_path_gives_the_same_bits() {
        let edges = [0.0, -0.0, 1.0, -1.0, 0.5, 2.5, -2.5, 1e-30, -1e30, f32::INFINITY, f32::NEG_INFINITY, f32::NAN, 3.3, -7.7, 88.0, 1e-6];
        let mut seed = 12345u32;
        let mut random = || {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (seed >> 8) as f32 / 65536.0 - 128.0
        };
        for round in 0..200 {
            let lanes: [Lane; 3] =
                core::array::from_fn(|i| Lane::from_fn(|l| if round < 16 && i < 2 { edges[(l * (i + 1) + round) % 16] } else { random() }));
            let expected = Path::run_on_target(Everything(&lanes));
            for path in Path::available() {
                assert_eq!(path.run(Everything(&lanes)), expected, "{} differs from the target's path at {lanes:?}", path.as_str());
            }
        }
    }

    /// What reads and writes memory, and next to nothing else: miri knows these of the AVX-512 instructions (`tests/hostile/miri.sh`).
    struct Memory<'a>(&'a [Lane; 2], &'a mut [Lane; 3], &'a mut Tile);

    impl Kernel for Memory<'_> {
        type Output = [[Lane; LANES]; TILE_PANELS];
        #[inline(always)]
        fn run<V: Vector>(self) -> Self::Output {
            let [a, b] = self.0.each_ref().map(|lane| V::load(lane));
            a.add(b).store(&mut self.1[0]);
            for row in &mut self.2.0 {
                a.store_pairs(b, row);
            }
            let [even, odd] = V::load_pairs(&self.2.0[LANES - 1]);
            even.store(&mut self.1[1]);
            odd.store(&mut self.1[2]);
            let mut sums = [[Lane::ZERO; LANES]; TILE_PANELS];
            V::products(Order::Tiles, &[[*self.2; TILE_PANELS]], core::slice::from_ref(self.2), &mut sums);
            sums
        }
    }

    #[test]
    fn property_memory_is_read_and_written_where_it_is_lent() {
        // Halves of small integers are numbers of bf16, so nothing is rounded.
        let lanes = [Lane::from_fn(|l| l as f32 * 0.5), Lane::from_fn(|l| 3.0 - l as f32)];
        for path in Path::available() {
            let (mut out, mut tile) = (Box::new([Lane::ZERO; 3]), Box::new(Tile::ZERO));
            let sums = path.run(Memory(&lanes, &mut out, &mut tile));
            assert_eq!(*out, [Lane::from_fn(|l| lanes[0][l] + lanes[1][l]), lanes[0], lanes[1]], "{}", path.as_str());
            // All rows of weights and inputs are alike: output m of sample l is the sum over the pairs of a row of weights times that sample's pair.
            let [even, odd]: [f32; 2] = core::array::from_fn(|i| lanes[i].iter().sum());
            for (m, sums) in sums.iter().enumerate() {
                let expected = [Lane::from_fn(|l| even * lanes[0][l] + odd * lanes[1][l]); LANES];
                assert_eq!(*sums, expected, "{}, panel {m}", path.as_str());
            }
        }
    }
}
