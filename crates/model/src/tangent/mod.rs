//! The rollout once more in f64 and in duals over f64: what Jacobians and covariances are made of.
//!
//! Same weights and same physics as the fast path; one step is written over [`Number`], so the value (`f64`) and its tangents (`Dual<f64, N>`) share one
//! text. The network is forward mode: N tangents ride along with the value through tokens, attention over the cache, heads and physics.

mod number;
mod rollout;
mod scenery;
mod transformer;

pub(crate) use number::Number;
pub(crate) use rollout::TangentRollout;
pub use rollout::{Linearisation, StateJacobian};
pub(crate) use scenery::{Plane, Scenery};
pub(crate) use transformer::ExactTransformer;
