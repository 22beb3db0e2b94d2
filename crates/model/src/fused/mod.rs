//! The fast inference path: blocks of samples in lanes, f32, no tensors. Same interface and same numbers, to rounding, as `reference`.
//!
//! `vector` holds the instructions, `elementary`, `kernels`, `bf16` and `convolution` the arithmetic, `transformer` and `prefix` the network, `real` the physics in
//! lanes.

mod bf16;
mod convolution;
mod elementary;
mod kernels;
mod prefix;
mod real;
mod transformer;
mod vector;

pub(crate) use convolution::{Convolution, Image};
pub(crate) use elementary::{exp, gelu, gelu_slope, silu, silu_slope};
pub use kernels::Row;
pub(crate) use kernels::{After, PANEL, Packed, add_rows, linear, linear_of};
pub use prefix::Prefix;
pub(crate) use real::Numbers;
pub(crate) use transformer::{Block, Dense, SCORE_SCALE};
pub use transformer::{BlockCache, FusedTransformer, Said};
pub(crate) use vector::{Kernel, Vector};
pub use vector::{LANES, Lane, Order, Path};
