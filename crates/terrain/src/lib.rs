//! World maps: elevation, semantics, vehicle-aligned patches.
//!
//! A [`WorldMap`] is an immutable grid of heights and colours in World (x east, y north, z up). The physics asks it for the
//! [`Ground`] under each wheel; the encoders see it through [`sample_patch`], a 128 x 128 window aligned with the vehicle. Maps come
//! from a world folder ([`WorldMap::load`]) or from memory ([`WorldMap::from_layers`]), e.g. a rolling local map of a robot; holes
//! and missing semantics are valid in both.
#![forbid(unsafe_code)]

mod colours;
mod disguise;
mod error;
mod geometry;
mod holes;
mod image;
mod patch;
mod read;
mod surface;
mod world_map;

pub use disguise::Disguise;
pub use error::TerrainError;
pub use geometry::{GridGeometry, MAX_CELLS, ORIGIN_MAX_M, Pose2};
pub use image::read_gray8;
pub use patch::{PATCH_PX, PATCH_RESOLUTION_M, Patch, PatchScale, sample_patch};
pub use read::SOIL_KEYS;
pub use world_map::{Ground, MapSource, SoilClassRange, WorldMap};
