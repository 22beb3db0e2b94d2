//! The fast inference path: blocks of samples in lanes, f32, no tensors. Same interface and same numbers, to rounding, as `reference`.

mod lanes;
mod transformer;

pub use lanes::{LANES, Lane};
pub(crate) use transformer::{Block, Dense};
pub use transformer::{BlockCache, FusedTransformer, Prefix};
