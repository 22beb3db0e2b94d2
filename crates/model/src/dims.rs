//! Dimensions of the paper (§IV), named once.

use nesam_physics::STATE_DIM;

/// Tokens of measured history the Transformer sees, the current one included (paper §IV-C).
pub const HISTORY: usize = 32;
/// Longest horizon: the positions left after the history (64 positions in all).
pub const MAX_HORIZON: usize = 32;
/// Positional embeddings.
pub const POSITIONS: usize = HISTORY + MAX_HORIZON;
/// Channels of each encoder's feature map.
pub const FEATURE_CHANNELS: usize = 18;
/// Height and width of the feature map.
pub const FEATURE_PX: usize = 16;
/// Values of one encoder's feature map: 18 × 16 × 16.
pub const FEATURES: usize = FEATURE_CHANNELS * FEATURE_PX * FEATURE_PX;
/// Values of the terrain context c = z_e ‖ z_s.
pub const CONTEXT: usize = 2 * FEATURES;
/// Values of a control.
pub const CONTROL_DIM: usize = 2;
/// State and control part of a token.
pub const STATE_CONTROL: usize = STATE_DIM + CONTROL_DIM;
/// Hidden width of the Transformer.
pub const HIDDEN: usize = 128;
/// Width of the feed-forward network.
pub const FEED_FORWARD: usize = 256;
/// Attention heads.
pub const HEADS: usize = 4;
/// Width of a head.
pub const HEAD_DIM: usize = HIDDEN / HEADS;
/// Transformer blocks.
pub const BLOCKS: usize = 2;
/// Trainable parameters of the soil prior (paper §IV-B).
pub const SOIL_PRIOR_PARAMETERS: usize = 28_262;
/// Added to the variance in layer normalisation.
pub const NORM_EPS: f32 = 1e-5;
