//! The instructions of x86-64 beyond those of the build.

use core::arch::asm;
use core::arch::x86_64::*;
use core::fmt::Debug;
use core::marker::PhantomData;
use std::sync::OnceLock;

use super::{Kernel, LANES, Lane, Order, TILE_PANELS, Tile, Vector, products_in_f32};

/// Whether the processor has what `on_avx512` needs.
pub(super) fn has_avx512() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq") && is_x86_feature_detected!("avx512vl")
}

/// Whether the processor has tiles of bf16, the system gives them to this process, and they compute what the manual says.
pub(super) fn has_amx() -> bool {
    static FOUND: OnceLock<bool> = OnceLock::new();
    *FOUND.get_or_init(|| {
        let (tile, bf16) = (1 << 24, 1 << 22);
        let features = if __cpuid(0).eax >= 7 { __cpuid_count(7, 0).edx } else { 0 };
        // SAFETY: the processor has the instructions and the system has been asked for the registers.
        has_avx512() && features & (tile | bf16) == tile | bf16 && tiles_are_given() && unsafe { tiles_are_right() }
    })
}

/// Asks the system for the registers of the tiles, which every process has to (Linux 5.16 and later). It refuses where it does not know them.
fn tiles_are_given() -> bool {
    #[cfg(target_os = "linux")]
    {
        /// `arch_prctl`, its request for a part of the processor's state, and the number of the tiles' data among these parts.
        const ARCH_PRCTL: i64 = 158;
        const REQUEST_PERMISSION: i64 = 0x1023;
        const TILE_DATA: i64 = 18;
        let mut result = ARCH_PRCTL;
        // SAFETY: the call changes nothing but what this process may use; it clobbers rcx and r11 as every call of the system.
        unsafe {
            asm!("syscall", inlateout("rax") result, in("rdi") REQUEST_PERMISSION, in("rsi") TILE_DATA, lateout("rcx") _, lateout("r11") _, options(nostack));
        }
        result == 0
    }
    #[cfg(not(target_os = "linux"))]
    false
}

/// Products by the path's own instructions, and the same in f32.
struct BothWays<'a> {
    order: Order,
    weights: &'a [[Tile; TILE_PANELS]],
    inputs: &'a [Tile],
}

impl Kernel for BothWays<'_> {
    type Output = [[[Lane; LANES]; TILE_PANELS]; 2];
    #[inline(always)]
    fn run<V: Vector>(self) -> Self::Output {
        // What is not written stays no number, which equals nothing.
        let mut sums = [[[Lane([f32::NAN; LANES]); LANES]; TILE_PANELS]; 2];
        V::products(self.order, self.weights, self.inputs, &mut sums[0]);
        products_in_f32::<V>(self.order, self.weights, self.inputs, &mut sums[1]);
        sums
    }
}

/// Whether tiles multiply as [`super::products_in_f32`] does, bit for bit, on numbers that show a wrong order, a wrong half of a pair and a wrong layout.
///
/// # Safety
/// As [`on_amx`].
unsafe fn tiles_are_right() -> bool {
    let mut state = 1u32;
    let mut tile = || {
        Tile(core::array::from_fn(|_| {
            core::array::from_fn(|_| {
                let mut half = || {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    ((state >> 8) as f32 / 8_388_608.0 - 1.0).to_bits() >> 16
                };
                half() | half() << 16
            })
        }))
    };
    let weights: [[Tile; TILE_PANELS]; 2] = core::array::from_fn(|_| core::array::from_fn(|_| tile()));
    let inputs: [Tile; 2] = core::array::from_fn(|_| tile());
    // SAFETY: by the caller.
    let [found, expected] = unsafe { on_amx(BothWays { order: Order::Tiles, weights: &weights, inputs: &inputs }) };
    found == expected
}

/// What a processor with AVX-512 has for products of bf16.
pub(super) trait Products: Copy + Debug {
    /// As [`Vector::products`], where it has instructions for this order; else false.
    fn products(order: Order, weights: &[[Tile; TILE_PANELS]], inputs: &[Tile], sums: &mut [[Lane; LANES]; TILE_PANELS]) -> bool;
}

/// Nothing.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plain;

impl Products for Plain {
    #[inline(always)]
    fn products(_: Order, _: &[[Tile; TILE_PANELS]], _: &[Tile], _: &mut [[Lane; LANES]; TILE_PANELS]) -> bool {
        false
    }
}

/// `vdpbf16ps`.
#[derive(Clone, Copy, Debug)]
pub(super) struct OfPairs;

impl Products for OfPairs {
    #[inline(always)]
    fn products(order: Order, weights: &[[Tile; TILE_PANELS]], inputs: &[Tile], sums: &mut [[Lane; LANES]; TILE_PANELS]) -> bool {
        if order != Order::Pairs {
            return false;
        }
        for panel in 0..TILE_PANELS {
            let mut totals = [unsafe { _mm512_setzero_ps() }; LANES];
            for (weights, inputs) in weights.iter().zip(inputs) {
                for (weights, inputs) in weights[panel].0.iter().zip(&inputs.0) {
                    let inputs = unsafe { _mm512_loadu_si512(inputs.as_ptr().cast()) };
                    for m in 0..LANES {
                        let weight = unsafe { _mm512_set1_epi32(weights[m].cast_signed()) };
                        // The type of sixteen pairs is that of sixteen integers to the register.
                        let pairs = |integers| unsafe { core::mem::transmute::<__m512i, __m512bh>(integers) };
                        totals[m] = unsafe { _mm512_dpbf16_ps(totals[m], pairs(inputs), pairs(weight)) };
                    }
                }
            }
            for (total, sum) in totals.iter().zip(&mut sums[panel]) {
                unsafe { _mm512_storeu_ps(sum.0.as_mut_ptr(), *total) };
            }
        }
        true
    }
}

/// `tdpbf16ps`.
#[derive(Clone, Copy, Debug)]
pub(super) struct OfTiles;

/// Shapes of the tiles: palette 1, all eight of sixteen rows of 64 bytes.
#[repr(C, align(64))]
struct Shapes([u8; 64]);

const SHAPES: Shapes = {
    let mut bytes = [0; 64];
    bytes[0] = 1;
    let mut tile = 0;
    while tile < 8 {
        bytes[16 + 2 * tile] = 64;
        bytes[48 + tile] = LANES as u8;
        tile += 1;
    }
    Shapes(bytes)
};

impl Products for OfTiles {
    #[inline(always)]
    fn products(order: Order, weights: &[[Tile; TILE_PANELS]], inputs: &[Tile], sums: &mut [[Lane; LANES]; TILE_PANELS]) -> bool {
        let count = weights.len().min(inputs.len());
        if order != Order::Tiles || count == 0 {
            return false;
        }
        // SAFETY: `count` groups of weights and tiles of inputs are read, both of 64 bytes a row, and the four results are written, sixteen lanes of 64 bytes each.
        unsafe {
            asm!(
                "tilezero tmm0",
                "tilezero tmm1",
                "tilezero tmm2",
                "tilezero tmm3",
                "2:",
                "tileloadd tmm7, [{inputs} + {row}]",
                "tileloadd tmm4, [{weights} + {row}]",
                "tileloadd tmm5, [{weights} + {row} + 1024]",
                "tdpbf16ps tmm0, tmm4, tmm7",
                "tileloadd tmm6, [{weights} + {row} + 2048]",
                "tdpbf16ps tmm1, tmm5, tmm7",
                "tileloadd tmm4, [{weights} + {row} + 3072]",
                "tdpbf16ps tmm2, tmm6, tmm7",
                "tdpbf16ps tmm3, tmm4, tmm7",
                "add {inputs}, 1024",
                "add {weights}, 4096",
                "dec {count}",
                "jnz 2b",
                "tilestored [{sums} + {row}], tmm0",
                "tilestored [{sums} + {row} + 1024], tmm1",
                "tilestored [{sums} + {row} + 2048], tmm2",
                "tilestored [{sums} + {row} + 3072], tmm3",
                inputs = inout(reg) inputs.as_ptr() => _,
                weights = inout(reg) weights.as_ptr() => _,
                count = inout(reg) count => _,
                sums = in(reg) sums.as_mut_ptr(),
                row = in(reg) 64usize,
                out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                options(nostack),
            );
        }
        true
    }
}

/// Sixteen floats in one register.
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx512<P>(__m512, PhantomData<P>);

/// # Safety
/// The processor has AVX-512 F, DQ and VL.
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
pub(super) unsafe fn on_avx512<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Avx512<Plain>>()
}

/// # Safety
/// The processor has AVX-512 F, DQ, VL and BF16.
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx512bf16")]
pub(super) unsafe fn on_avx512_bf16<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Avx512<OfPairs>>()
}

/// # Safety
/// The processor has AVX-512 F, DQ and VL and tiles of bf16, and the system has given them to this process.
#[target_feature(enable = "avx512f,avx512dq,avx512vl")]
pub(super) unsafe fn on_amx<K: Kernel>(kernel: K) -> K::Output {
    // SAFETY: shapes that palette 1 has. A kernel that panics leaves the tiles in use, which costs room where the system saves registers and nothing else.
    unsafe { asm!("ldtilecfg [{}]", in(reg) &SHAPES, options(nostack, readonly)) };
    let output = kernel.run::<Avx512<OfTiles>>();
    // SAFETY: nothing else uses the tiles.
    unsafe { asm!("tilerelease", options(nostack, nomem)) };
    output
}

// SAFETY of every block in this module: values of these types exist only inside the three functions above, whose callers have found the instructions.
impl<P> Avx512<P> {
    #[inline(always)]
    fn of(lanes: __m512) -> Self {
        Self(lanes, PhantomData)
    }
}

impl<P: Products> Vector for Avx512<P> {
    const WIDE: bool = true;
    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self::of(unsafe { _mm512_set1_ps(x) })
    }
    #[inline(always)]
    fn load(from: &[f32; LANES]) -> Self {
        Self::of(unsafe { _mm512_loadu_ps(from.as_ptr()) })
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self::of(unsafe { _mm512_add_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self::of(unsafe { _mm512_sub_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self::of(unsafe { _mm512_mul_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Self::of(unsafe { _mm512_div_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn mul_add(self, by: Self, plus: Self) -> Self {
        Self::of(unsafe { _mm512_fmadd_ps(self.0, by.0, plus.0) })
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::of(unsafe { _mm512_max_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self::of(unsafe { _mm512_min_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self::of(unsafe { _mm512_sqrt_ps(self.0) })
    }
    #[inline(always)]
    fn round(self) -> Self {
        Self::of(unsafe { _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(self.0) })
    }
    #[inline(always)]
    fn neg(self) -> Self {
        Self::of(unsafe { _mm512_xor_ps(self.0, _mm512_set1_ps(-0.0)) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self::of(unsafe { _mm512_andnot_ps(_mm512_set1_ps(-0.0), self.0) })
    }
    #[inline(always)]
    fn shift_to_exponent(self) -> Self {
        Self::of(unsafe { _mm512_castsi512_ps(_mm512_slli_epi32::<23>(_mm512_castps_si512(self.0))) })
    }
    #[inline(always)]
    fn exponent_over_2_23(self) -> Self {
        let shifted = unsafe { _mm512_castsi512_ps(_mm512_srli_epi32::<23>(_mm512_castps_si512(self.0))) };
        Self::of(unsafe { _mm512_or_ps(shifted, _mm512_set1_ps(8_388_608.0)) })
    }
    #[inline(always)]
    fn mantissa(self) -> Self {
        let bits = unsafe { _mm512_and_ps(self.0, _mm512_set1_ps(f32::from_bits(0x007f_ffff))) };
        Self::of(unsafe { _mm512_or_ps(bits, _mm512_set1_ps(0.5)) })
    }
    #[inline(always)]
    fn select_ge0(self, a: Self, b: Self) -> Self {
        Self::of(unsafe { _mm512_mask_blend_ps(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(self.0, _mm512_setzero_ps()), b.0, a.0) })
    }
    #[inline(always)]
    fn store_pairs(self, odd: Self, to: &mut [u32; LANES]) {
        unsafe {
            let rounded = |x: __m512| {
                let bits = _mm512_castps_si512(x);
                let tie = _mm512_and_si512(_mm512_srli_epi32::<16>(bits), _mm512_set1_epi32(1));
                _mm512_add_epi32(_mm512_add_epi32(bits, _mm512_set1_epi32(0x7fff)), tie)
            };
            let high = _mm512_and_si512(rounded(odd.0), _mm512_set1_epi32(0xffff_0000_u32.cast_signed()));
            let pairs = _mm512_or_si512(_mm512_srli_epi32::<16>(rounded(self.0)), high);
            _mm512_storeu_si512(to.as_mut_ptr().cast(), pairs);
        }
    }
    #[inline(always)]
    fn load_pairs(from: &[u32; LANES]) -> [Self; 2] {
        unsafe {
            let pairs = _mm512_loadu_si512(from.as_ptr().cast());
            let high = _mm512_and_si512(pairs, _mm512_set1_epi32(0xffff_0000_u32.cast_signed()));
            [_mm512_slli_epi32::<16>(pairs), high].map(|bits| Self::of(_mm512_castsi512_ps(bits)))
        }
    }
    #[inline(always)]
    fn products(order: Order, weights: &[[Tile; TILE_PANELS]], inputs: &[Tile], sums: &mut [[Lane; LANES]; TILE_PANELS]) {
        if !P::products(order, weights, inputs, sums) {
            products_in_f32::<Self>(order, weights, inputs, sums);
        }
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tiles_by_hand;
