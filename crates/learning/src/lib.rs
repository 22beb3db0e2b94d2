//! Offline training: encoder pre-training and autoregressive rollouts (paper §III-D, §IV).
//!
//! A run has four stages: the encoders are pre-trained as autoencoders on patches around the driven places ([`autoencoder`]); the drive line
//! and the suspension of the vehicle card are calibrated with the symbolic model alone ([`calibrate`], [`suspension`]); the contexts of all
//! measured poses are computed once ([`drives`]); and the network is trained through K-step rollouts ([`trainer`]).
#![forbid(unsafe_code)]

mod adam;
pub mod at_end;
mod autoencoder;
pub mod batch;
pub mod calibrate;
pub mod checkpoint;
mod class_soil;
mod drives;
mod features;
pub mod initial;
pub mod origin;
mod pooling;
pub mod recipe;
pub mod rims;
pub mod scales;
mod schedule;
pub mod stand_in;
pub mod suspension;
pub mod symbolic;
mod trainer;

pub use drives::{Drive, encode_drives};
pub use pooling::Pooling;
pub use trainer::{EpochReport, Objective, Trained, TrainingError, TrainingPlan, TrainingSet, train};
