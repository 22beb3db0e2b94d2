//! The model as candle tensors: the reference that trains, and against which the fused path is tested.

mod image;
mod network;
mod physics_op;
mod rollout;

pub use image::{Conv, conv2d, im2col, pixel_shuffle};
pub use network::{KvCache, Network, SoilPriorHead, causal_mask, layer_norm, linear, soil_from_raw, trainable_shapes, zeros};
pub use physics_op::physics_increment;
pub use rollout::{PredictedStep, ReferenceRollout, Row, TerrainProvider};
