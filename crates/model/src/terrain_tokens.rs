//! What the network needs of the terrain at a pose: the context token W_c c and the raw soil prior, cached on a pose grid.
//!
//! The encoders are frozen and the projection is linear, so both are fixed functions of (x, y, yaw, map version). They are computed exactly at the nodes of
//! a grid in position and heading and interpolated trilinearly between them. Nodes depend on nothing but the map, so a
//! prediction does not depend on what was asked before it. The cache belongs to one map version and one bundle.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, RwLock};

use nesam_physics::SOIL_DIM;
use nesam_terrain::{Patch, PatchScale, Pose2, WorldMap, sample_patch};
use rayon::prelude::*;

use crate::dims::{CONTEXT, FEATURES, HIDDEN};
use crate::encoder::{EncoderScratch, TerrainEncoders};
use crate::soil_prior::SoilPrior;

/// Spacing of the pose grid: 0.25 m and 5 degrees (interpolation error 4 % of the token's spread on trained encoders).
pub const GRID_M: f64 = 0.25;
/// Headings on the grid: one every 5 degrees.
pub const HEADINGS: i32 = 72;
/// Nodes after which a cache forgets all it has (0.5 kB each).
const NODES_MAX: usize = 400_000;

/// Token and soil at one pose: W_c c (128) and raw soil (6).
pub const VALUES: usize = HIDDEN + SOIL_DIM;
/// W_c c followed by the raw soil prior.
pub type TerrainToken = [f32; VALUES];

/// Node of the pose grid.
type Node = (i32, i32, i32);

/// Maps a patch to its token: encoders, projection W_c and soil prior of a bundle.
#[derive(Clone, Debug)]
pub struct TerrainProjection {
    encoders: TerrainEncoders,
    /// W_c transposed: (9216) rows of 128.
    context: Vec<[f32; HIDDEN]>,
    soil: SoilPrior,
    scale: PatchScale,
}

/// Buffers of one worker.
#[derive(Default)]
struct Scratch {
    patch: Patch,
    encoder: EncoderScratch,
    context: Vec<f32>,
}

impl TerrainProjection {
    /// Bundles the parts; `context` is W_c, (128, 9216) row-major.
    pub fn new(encoders: TerrainEncoders, context: &[f32], soil: SoilPrior, scale: PatchScale) -> Self {
        let context = (0..CONTEXT).map(|k| core::array::from_fn(|o| context[o * CONTEXT + k])).collect();
        Self { encoders, context, soil, scale }
    }

    /// The exact token at a pose.
    fn token(&self, map: &WorldMap, pose: Pose2, scratch: &mut Scratch) -> TerrainToken {
        sample_patch(map, pose, &self.scale, &mut scratch.patch);
        scratch.context.resize(CONTEXT, 0.0);
        self.encoders.encode(&scratch.patch, &mut scratch.encoder, &mut scratch.context);
        let mut token = [0.0; VALUES];
        // Eight partial sums keep the adds independent.
        let mut sums = [[0f32; HIDDEN]; 2];
        for (pair, rows) in scratch.context.chunks_exact(2).zip(self.context.chunks_exact(2)) {
            for half in 0..2 {
                for o in 0..HIDDEN {
                    sums[half][o] = pair[half].mul_add(rows[half][o], sums[half][o]);
                }
            }
        }
        for o in 0..HIDDEN {
            token[o] = sums[0][o] + sums[1][o];
        }
        token[HIDDEN..].copy_from_slice(&self.soil.raw(&scratch.context[FEATURES..]));
        token
    }

    /// The exact token at a pose, without the cache.
    pub fn exact(&self, map: &WorldMap, pose: Pose2) -> TerrainToken {
        self.token(map, pose, &mut Scratch::default())
    }
}

/// Tokens of one map.
#[derive(Debug)]
pub struct TerrainTokens {
    map: Arc<WorldMap>,
    nodes: RwLock<HashMap<Node, Arc<TerrainToken>>>,
    looked_up: AtomicU64,
    encoded: AtomicU64,
}

/// How often a cache was asked and how often it had to encode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CacheCounts {
    /// Nodes that poses asked for, eight each.
    pub looked_up: u64,
    /// Nodes that were not there yet.
    pub encoded: u64,
}

impl CacheCounts {
    /// What was asked since `before`.
    pub fn since(&self, before: Self) -> Self {
        Self { looked_up: self.looked_up - before.looked_up, encoded: self.encoded - before.encoded }
    }

    /// Share of the lookups that needed no encoding; 1 when nothing was asked.
    pub fn hit_rate(&self) -> f64 {
        1.0 - self.encoded as f64 / self.looked_up.max(1) as f64
    }
}

/// The eight nodes around a pose and their weights.
fn corners(pose: &Pose2) -> [(Node, f32); 8] {
    let heading = pose.yaw_rad.rem_euclid(core::f64::consts::TAU) / core::f64::consts::TAU * f64::from(HEADINGS);
    let cell = [pose.x_m / GRID_M, pose.y_m / GRID_M, heading];
    let base = cell.map(f64::floor);
    let share: [f64; 3] = core::array::from_fn(|i| cell[i] - base[i]);
    core::array::from_fn(|corner| {
        let bit = |i: usize| (corner >> i) & 1;
        let weight: f64 = (0..3).map(|i| if bit(i) == 1 { share[i] } else { 1.0 - share[i] }).product();
        let at = |i: usize| base[i] as i32 + bit(i) as i32;
        ((at(0), at(1), at(2).rem_euclid(HEADINGS)), weight as f32)
    })
}

impl TerrainTokens {
    /// An empty cache of a map.
    pub fn new(map: Arc<WorldMap>) -> Self {
        Self { map, nodes: RwLock::default(), looked_up: AtomicU64::new(0), encoded: AtomicU64::new(0) }
    }

    /// The map.
    pub fn map(&self) -> &Arc<WorldMap> {
        &self.map
    }

    /// What was asked of the cache so far.
    pub fn counts(&self) -> CacheCounts {
        CacheCounts { looked_up: self.looked_up.load(Ordering::Relaxed), encoded: self.encoded.load(Ordering::Relaxed) }
    }

    /// Tokens at poses, interpolated; missing nodes are encoded first, in parallel.
    pub fn at(&self, projection: &TerrainProjection, poses: &[Pose2]) -> Vec<TerrainToken> {
        let wanted: Vec<[(Node, f32); 8]> = poses.iter().map(corners).collect();
        self.encode_missing(projection, &wanted);
        let nodes = self.nodes.read().expect("no writer panics; this is a bug");
        wanted
            .iter()
            .map(|corners| {
                let mut token = [0.0; VALUES];
                for (node, weight) in corners.iter().filter(|(_, w)| *w > 0.0) {
                    // Another query may have emptied the cache in between; the node is a pure function of its pose.
                    let values =
                        nodes.get(node).cloned().unwrap_or_else(|| Arc::new(self.encode(projection, node, &mut Scratch::default())));
                    for (sum, value) in token.iter_mut().zip(values.iter()) {
                        *sum = weight.mul_add(*value, *sum);
                    }
                }
                token
            })
            .collect()
    }

    /// The exact token at a node.
    fn encode(&self, projection: &TerrainProjection, node: &Node, scratch: &mut Scratch) -> TerrainToken {
        let yaw_rad = f64::from(node.2) / f64::from(HEADINGS) * core::f64::consts::TAU;
        let pose = Pose2 { x_m: f64::from(node.0) * GRID_M, y_m: f64::from(node.1) * GRID_M, yaw_rad };
        projection.token(&self.map, pose, scratch)
    }

    fn encode_missing(&self, projection: &TerrainProjection, wanted: &[[(Node, f32); 8]]) {
        let mut missing: Vec<Node> = {
            let nodes = self.nodes.read().expect("no writer panics; this is a bug");
            let used = wanted.iter().flatten().filter(|(_, w)| *w > 0.0).map(|(node, _)| *node);
            used.filter(|node| !nodes.contains_key(node)).collect()
        };
        missing.sort_unstable();
        missing.dedup();
        self.looked_up.fetch_add(8 * wanted.len() as u64, Ordering::Relaxed);
        self.encoded.fetch_add(missing.len() as u64, Ordering::Relaxed);
        if missing.is_empty() {
            return;
        }
        let encoded: Vec<TerrainToken> =
            missing.par_iter().map_init(Scratch::default, |scratch, node| self.encode(projection, node, scratch)).collect();
        let mut nodes = self.nodes.write().expect("no writer panics; this is a bug");
        if nodes.len() > NODES_MAX {
            nodes.retain(|node, _| wanted.iter().flatten().any(|(w, _)| w == node));
        }
        nodes.extend(missing.into_iter().zip(encoded.into_iter().map(Arc::new)));
    }
}
