//! The model as candle tensors: the reference that trains, and against which the fused path is tested.

mod attention;
mod device;
mod host;
mod image;
mod network;
mod nodes;
mod physics_op;
mod predictor;
mod rollout;

pub use device::ComputeDevice;
pub use image::{Conv, conv2d, im2col, pixel_shuffle};
pub use network::{KvCache, Network, SoilPriorHead, causal_mask, linear, soil_from_raw, trainable_shapes};
pub use physics_op::physics_increment;
pub use predictor::ReferencePredictor;
pub use rollout::{PredictedStep, ReferenceRollout, Row, TerrainProvider};
