//! What the network needs of the terrain at a pose: the context token W_c c and the raw soil prior, cached on a pose grid.
//!
//! The encoders are frozen and the projection is linear, so both are fixed functions of (x, y, yaw, map version). They are computed exactly at the nodes of
//! a grid in position and heading and interpolated trilinearly between them. Nodes depend on nothing but the map, so a
//! prediction does not depend on what was asked before it. The cache belongs to one map version and one bundle.

mod of_maps;
mod store;

use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use nesam_physics::SOIL_DIM;
use nesam_terrain::{Patch, PatchScale, Pose2, WorldMap, sample_patch};
use rayon::prelude::*;

use crate::dims::{CONTEXT, FEATURES, HIDDEN};
use crate::encoder::{EncoderScratch, TerrainEncoders};
use crate::fused::{After, Kernel, LANES, Lane, PANEL, Packed, Path, Row, Vector, linear};
use crate::soil_prior::SoilPrior;
pub use of_maps::TokensOfMaps;
use store::NodeStore;

/// Spacing of the pose grid: 0.25 m and 5 degrees (interpolation error 4 % of the token's spread on trained encoders).
pub const GRID_M: f64 = 0.25;
/// Headings on the grid: one every 5 degrees.
pub const HEADINGS: i32 = 72;
/// Token and soil at one pose: W_c c (128) and raw soil (6).
pub const VALUES: usize = HIDDEN + SOIL_DIM;
/// W_c c followed by the raw soil prior.
pub type TerrainToken = [f32; VALUES];

/// Node of the pose grid: x, y, heading.
pub type Node = (i32, i32, i32);

/// Maps patches to their tokens: encoders, projection W_c and soil prior of a bundle.
#[derive(Clone, Debug)]
pub struct TerrainProjection {
    encoders: TerrainEncoders,
    /// W_c, (128, 9216), eight outputs each.
    context: Vec<Packed>,
    soil: SoilPrior,
    scale: PatchScale,
    path: Path,
}

/// Patches that are projected together: two vectors.
const BATCH: usize = 2 * LANES;

thread_local! {
    /// Buffers of a worker that crops and encodes.
    static SCRATCH: RefCell<(Patch, EncoderScratch)> = RefCell::default();
}

impl TerrainProjection {
    /// Bundles the parts; `context` is W_c, (128, 9216) row-major.
    pub fn new(encoders: TerrainEncoders, context: &[f32], soil: SoilPrior, scale: PatchScale) -> Self {
        let context = context.chunks(PANEL * CONTEXT).map(|rows| Packed::from_rows(rows, &[0.0; PANEL])).collect();
        Self { encoders, context, soil, scale, path: Path::fastest() }
    }

    /// The same on another path.
    pub fn on(&self, path: Path) -> Self {
        Self { path, encoders: self.encoders.on(path), ..self.clone() }
    }

    /// The exact tokens at poses, in parallel. A pose's token does not depend on the others.
    pub fn exact(&self, map: &WorldMap, poses: &[Pose2]) -> Vec<TerrainToken> {
        let tokens = |poses: &[Pose2]| match poses.len() {
            ..=LANES => self.tokens::<1>(map, poses),
            _ => self.tokens::<2>(map, poses),
        };
        poses.chunks(batch()).flat_map(tokens).collect()
    }

    /// The exact tokens at a few poses: each worker encodes some of the patches and then works out some of the outputs of all of them, so that W_c, far larger
    /// than what is near a processor, is read once and not by every worker.
    fn tokens<const H: usize>(&self, map: &WorldMap, poses: &[Pose2]) -> Vec<TerrainToken> {
        let mut contexts = vec![0.0; poses.len() * CONTEXT];
        contexts.par_chunks_exact_mut(CONTEXT).zip(poses).with_max_len(1).for_each(|(context, pose)| {
            SCRATCH.with_borrow_mut(|(patch, scratch)| {
                sample_patch(map, *pose, &self.scale, patch);
                self.encoders.encode(patch, scratch, context);
            });
        });
        let size = H * LANES;
        let batches: Vec<Vec<Row<H>>> = contexts.par_chunks(size * CONTEXT).map(in_lanes).collect();
        let of_part = |part: usize| batches.iter().map(|rows| self.path.run(Project { projection: self, part, rows })).collect();
        let parts: Vec<Vec<[Row<H>; PANEL]>> = (0..VALUES.div_ceil(PANEL)).into_par_iter().with_max_len(1).map(of_part).collect();
        let value = |patch: usize, i: usize| parts[i / PANEL][patch / size][i % PANEL][patch % size / LANES][patch % LANES];
        (0..poses.len()).map(|patch| core::array::from_fn(|i| value(patch, i))).collect()
    }
}

/// Contexts of up to 16 H patches as rows, a patch in each lane.
fn in_lanes<const H: usize>(contexts: &[f32]) -> Vec<Row<H>> {
    let mut rows = vec![[Lane::ZERO; H]; CONTEXT];
    for (group, rows) in rows.chunks_exact_mut(LANES).enumerate() {
        for (patch, context) in contexts.chunks_exact(CONTEXT).enumerate() {
            for (row, value) in rows.iter_mut().zip(&context[group * LANES..(group + 1) * LANES]) {
                row[patch / LANES][patch % LANES] = *value;
            }
        }
    }
    rows
}

/// Eight values of a token for a batch of contexts: of W_c c, or the soil in the part after the last of these.
struct Project<'a, const H: usize> {
    projection: &'a TerrainProjection,
    part: usize,
    rows: &'a [Row<H>],
}

impl<const H: usize> Kernel for Project<'_, H> {
    type Output = [Row<H>; PANEL];
    #[inline(always)]
    fn run<V: Vector>(self) -> Self::Output {
        let mut values = [[Lane::ZERO; H]; PANEL];
        match self.projection.context.get(self.part) {
            Some(panel) => linear::<V, H>(panel, After::Store, self.rows, &mut values),
            None => values[..SOIL_DIM].copy_from_slice(&self.projection.soil.raw::<V, H>(&self.rows[FEATURES..])),
        }
        values
    }
}

/// Tokens of one map.
#[derive(Debug)]
pub struct TerrainTokens {
    map: Arc<WorldMap>,
    nodes: NodeStore,
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
        Self { map, nodes: NodeStore::default(), looked_up: AtomicU64::new(0), encoded: AtomicU64::new(0) }
    }

    /// The map.
    pub fn map(&self) -> &Arc<WorldMap> {
        &self.map
    }

    /// Nodes that it holds.
    pub fn nodes(&self) -> usize {
        self.nodes.read().count()
    }

    /// What was asked of the cache so far.
    pub fn counts(&self) -> CacheCounts {
        CacheCounts { looked_up: self.looked_up.load(Ordering::Relaxed), encoded: self.encoded.load(Ordering::Relaxed) }
    }

    /// Tokens at poses, interpolated; missing nodes are encoded first, in parallel.
    pub fn at(&self, projection: &TerrainProjection, poses: &[Pose2]) -> Vec<TerrainToken> {
        let mut tokens = vec![[0.0; VALUES]; poses.len()];
        loop {
            let mut missing = Vec::new();
            self.try_at(poses, &mut tokens, &mut missing);
            if missing.is_empty() {
                return tokens;
            }
            // Another query may empty the cache in between, rarely; then this one begins again.
            self.encode(projection, missing);
        }
    }

    /// Tokens at poses, interpolated, from the nodes that are there; those that are not are added to `missing`, and then `tokens` are of no use.
    pub fn try_at(&self, poses: &[Pose2], tokens: &mut [TerrainToken], missing: &mut Vec<Node>) {
        let nodes = self.nodes.read();
        for (pose, token) in poses.iter().zip(tokens) {
            *token = [0.0; VALUES];
            for (node, weight) in corners(pose) {
                if weight <= 0.0 {
                    continue;
                }
                match nodes.get(node) {
                    Some(values) => add_weighted(token, weight, values),
                    None => missing.push(node),
                }
            }
        }
        if missing.is_empty() {
            self.looked_up.fetch_add(8 * poses.len() as u64, Ordering::Relaxed);
        }
    }

    /// Adds the nodes that are not there of paths that begin where one is not.
    pub fn add_missing(&self, paths: impl Iterator<Item = impl Iterator<Item = Pose2>>, missing: &mut Vec<Node>) {
        let nodes = self.nodes.read();
        for path in paths {
            let before = missing.len();
            for pose in path {
                missing.extend(
                    corners(&pose).into_iter().filter(|(node, weight)| *weight > 0.0 && nodes.get(*node).is_none()).map(|(node, _)| node),
                );
                if missing.len() == before {
                    break;
                }
            }
        }
    }

    /// The token at a pose if all of its nodes are there. It is not counted as a lookup.
    pub fn known(&self, pose: &Pose2) -> Option<TerrainToken> {
        let nodes = self.nodes.read();
        let mut token = [0.0; VALUES];
        for (node, weight) in corners(pose) {
            if weight > 0.0 {
                add_weighted(&mut token, weight, nodes.get(node)?);
            }
        }
        Some(token)
    }

    /// Encodes nodes, in parallel; those that several poses miss once.
    pub fn encode(&self, projection: &TerrainProjection, missing: Vec<Node>) {
        self.encode_unless(projection, missing, || false);
    }

    /// The same until `ends`, which may wait, says so before some of them.
    pub fn encode_unless(&self, projection: &TerrainProjection, mut missing: Vec<Node>, ends: impl Fn() -> bool) {
        // Nodes of one heading stand together.
        missing.sort_unstable_by_key(|(x, y, heading)| (*heading, *x, *y));
        missing.dedup();
        let batches = missing.chunks(batch()).take_while(|_| !ends());
        let poses = batches.map(|nodes| nodes.iter().map(|node| pose_of(*node)).collect::<Vec<_>>());
        let encoded: Vec<TerrainToken> = poses.flat_map(|poses| projection.exact(&self.map, &poses)).collect();
        self.encoded.fetch_add(encoded.len() as u64, Ordering::Relaxed);
        self.nodes.insert(missing.into_iter().zip(encoded));
    }
}

/// Patches that are encoded together.
fn batch() -> usize {
    BATCH * rayon::current_num_threads()
}

#[inline]
fn add_weighted(sum: &mut TerrainToken, weight: f32, values: &TerrainToken) {
    for (sum, value) in sum.iter_mut().zip(values) {
        *sum = weight.mul_add(*value, *sum);
    }
}

/// Pose of a node.
fn pose_of((x, y, heading): Node) -> Pose2 {
    let yaw_rad = f64::from(heading) / f64::from(HEADINGS) * core::f64::consts::TAU;
    Pose2 { x_m: f64::from(x) * GRID_M, y_m: f64::from(y) * GRID_M, yaw_rad }
}

#[cfg(test)]
mod tests {
    use nesam_terrain::GridGeometry;

    use super::*;

    #[test]
    fn property_a_path_is_followed_where_it_begins_in_the_unknown() {
        let geometry = GridGeometry { origin_m: [0.0; 2], resolution_m: 1.0, width: 8, height: 8 };
        let map = WorldMap::from_layers("flat", 1, geometry, vec![0.0; 64], None).expect("a valid map");
        let tokens = TerrainTokens::new(Arc::new(map));
        let pose = |x_m: f64| Pose2 { x_m, y_m: 1.1, yaw_rad: 0.3 };
        let nodes = |x_m: f64| corners(&pose(x_m)).map(|(node, _)| node).to_vec();
        tokens.nodes.insert(nodes(1.1).into_iter().map(|node| (node, [0.0; VALUES])));
        let missing = |path: &[f64]| {
            let mut missing = Vec::new();
            tokens.add_missing(std::iter::once(path.iter().map(|x_m| pose(*x_m))), &mut missing);
            missing
        };
        assert_eq!(missing(&[1.1, 2.1, 3.1]), [], "its terrain is there, so nobody waits");
        assert_eq!(missing(&[2.1, 1.1, 3.1]), [nodes(2.1), nodes(3.1)].concat());
    }
}
