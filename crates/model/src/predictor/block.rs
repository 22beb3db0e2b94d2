//! A block of samples on its way through the horizon.

use nesam_physics::driveline::{DrivelineState, command_wheels, measured_wheels};
use nesam_physics::{SOIL_DIM, STATE_DIM, VehicleState, WHEELS};
use nesam_terrain::Pose2;

use super::observed::reported;
use super::parts::{Part, Watch};
use super::physics::{PhysicsOutput, PhysicsStep};
use super::risk::RiskRow;
use super::rollout::{Caches, Scene};
use super::{NO_SINKAGE, Predictor, Sample, TerrainMode, pose, under};
use crate::dims::{HIDDEN, STATE_CONTROL};
use crate::fused::{BlockCache, LANES, Lane, Path, Row, Said};
use crate::rollout::Variant;
use crate::step_row::{CONSTANT, DIFFERENTIABLE, SINKAGE_AT, SOIL_AT, STATE_COLUMNS, pack_constants};
use crate::symbolic::residual_share;
use crate::terrain_tokens::{Node, TerrainToken, VALUES};

/// Steps that a sample which meets terrain that is not encoded is followed at the velocities it has: what lies there is encoded in the same go. Without, blocks stand
/// aside twice as often, and next to nothing of it is encoded in vain (25 nodes a query with and 26 without, of queries that follow each other; chosen).
const LOOK_AHEAD: usize = 4;

/// Up to 16 H samples, how far they are, and where their results go.
pub(super) struct Block<'a, const H: usize> {
    /// Row of the first sample.
    pub(super) first: usize,
    /// Steps done.
    pub(super) done: usize,
    pub(super) samples: &'a mut [Sample],
    /// (samples, horizon, 12) of the rollout.
    pub(super) states: &'a mut [f32],
    /// (samples, horizon, 4), m.
    pub(super) sinkage_m: &'a mut [f32],
    /// (samples, horizon) when positions are asked for unrounded, else empty.
    pub(super) position_m: Vec<[f64; 3]>,
    /// (samples, horizon) when risk is asked for, else empty.
    pub(super) risk: Vec<RiskRow>,
    /// Held from the first step to the last.
    pub(super) cache: Option<BlockCache<H>>,
    /// Nodes of the terrain without which the block cannot go on.
    pub(super) missing: Vec<Node>,
}

impl Predictor {
    /// Takes a block to the end of the horizon, or to the first step whose terrain is not encoded yet, or to where it is given up.
    pub(super) fn advance_block<const H: usize>(&self, scene: &Scene<'_>, caches: &Caches<H>, block: &mut Block<'_, H>) {
        let mut cache = block.cache.take().unwrap_or_else(|| caches.take(scene.query.horizon, scene.variant.remembers()));
        let mut terrain = [[[0.0; VALUES]; LANES]; H];
        while block.done < scene.query.horizon && !scene.is_over(block.first) {
            let mut watch = Watch::start(scene.clocks);
            if !self.block_terrain(scene, block, &mut terrain) {
                block.cache = Some(cache);
                return;
            }
            watch.add_to(Part::Lookup);
            self.step_block(scene, block, &mut cache, &terrain);
            block.done += 1;
            give_way();
        }
        caches.give(cache);
    }

    /// Terrain tokens of a block; false when nodes are missing, which the block then names.
    fn block_terrain<const H: usize>(&self, scene: &Scene<'_>, block: &mut Block<'_, H>, terrain: &mut [[TerrainToken; LANES]; H]) -> bool {
        let terrain = terrain.as_flattened_mut();
        // Samples still stand together at the first step: one lookup serves all.
        let distinct = if block.done == 0 { 1 } else { block.samples.len() };
        let poses: [[Pose2; LANES]; H] =
            core::array::from_fn(|h| core::array::from_fn(|l| pose(&block.samples[(h * LANES + l).min(distinct - 1)].state)));
        let poses = poses.as_flattened();
        match (scene.tokens, self.mode) {
            (Some(tokens), TerrainMode::Grid) => {
                tokens.try_at(&poses[..distinct], &mut terrain[..distinct], &mut block.missing);
                if !block.missing.is_empty() {
                    let dt_s = self.bundle.normalization.dt_s;
                    let steps = LOOK_AHEAD.min(scene.query.horizon - block.done - 1);
                    let paths = block.samples[..distinct].iter().map(|sample| ahead(&sample.state, dt_s).take(1 + steps));
                    tokens.add_missing(paths, &mut block.missing);
                    return false;
                }
                self.stand_in(scene.tokens, &mut terrain[..distinct]);
            }
            _ => terrain[..distinct].copy_from_slice(&self.terrain(scene.tokens, &poses[..distinct])),
        }
        let last = terrain[distinct - 1];
        terrain[distinct..].fill(last);
        true
    }

    /// Advances the samples of a block by one step and writes what it gives.
    fn step_block<const H: usize>(
        &self,
        scene: &Scene<'_>,
        block: &mut Block<'_, H>,
        cache: &mut BlockCache<H>,
        terrain: &[[TerrainToken; LANES]; H],
    ) {
        let mut watch = Watch::start(scene.clocks);
        let count = block.samples.len();
        let model = self.physics.at(scene.clock.after(block.done));
        let mut entries = [[Lane::ZERO; H]; STATE_CONTROL];
        for (i, sample) in block.samples.iter().enumerate() {
            let control = scene.control(block.first + i, block.done);
            let values = self.entries(model, &sample.state, sample.previous.as_ref(), &control, &scene.ground);
            entries.iter_mut().zip(values).for_each(|(row, value)| row[i / LANES][i % LANES] = value);
        }
        entries.iter_mut().for_each(|row| repeat_last(row, count));
        let context: [Row<H>; HIDDEN] = core::array::from_fn(|i| core::array::from_fn(|h| Lane::from_fn(|l| terrain[h][l][i])));
        watch.add_to(Part::Rest);
        let said = self.rolled.step(&scene.prefix, cache, &entries, &context);
        watch.add_to(Part::Network);
        give_way();
        for (h, terrain) in terrain.iter().enumerate().take(count.div_ceil(LANES)) {
            self.step_vector(scene, block, h, &said, terrain);
        }
    }

    /// Advances the samples of a vector of a block by one step, after what the network has said.
    fn step_vector<const H: usize>(
        &self,
        scene: &Scene<'_>,
        block: &mut Block<'_, H>,
        h: usize,
        said: &Said<H>,
        terrain: &[TerrainToken; LANES],
    ) {
        let scales = &self.bundle.normalization;
        let mut watch = Watch::start(scene.clocks);
        let (k, first) = (block.done, h * LANES);
        let time_s = scene.clock.after(k);
        let model = self.physics.at(time_s);
        let samples = &block.samples[first..block.samples.len().min(first + LANES)];
        let count = samples.len();
        let (mut varying, mut constant) = ([Lane::ZERO; DIFFERENTIABLE], [Lane::ZERO; CONSTANT]);
        let mut after = [DrivelineState::default(); LANES];
        let mut known = [true; LANES];
        for (l, sample) in samples.iter().enumerate() {
            let control = scene.control(block.first + first + l, k);
            after[l] = sample.actuators.advance(model.vehicle(), &control, sample.state.velocity_m_s[0], model.dt_s());
            let wheels = match scene.query.wheels {
                Some(measured) => measured_wheels(model.vehicle(), &measured[k].speed_rad_s, &measured[k].angle_rad),
                None => command_wheels(model.vehicle(), &sample.actuators, &after[l], &control),
            };
            let (ground, inside) = scene.ground.under_wheels(model, &sample.state, scene.datum_m);
            known[l] = inside;
            let soil = self.soil_at(under(scene.soil, block.first + first + l, sample, &terrain[l]), time_s);
            let ratio: [f32; WHEELS] = core::array::from_fn(|i| match scene.variant {
                Variant::ZeroSinkage => NO_SINKAGE,
                _ => scales.sinkage_log_ratio_max * said.sinkage[i][h][l],
            });
            let row = varying_row(&sample.state, scene.datum_m, &ratio, &soil);
            varying.iter_mut().zip(row).for_each(|(lane, value)| lane[l] = value);
            constant
                .iter_mut()
                .zip(pack_constants(&wheels, &ground, sample.state.attitude_rad[2]))
                .for_each(|(lane, value)| lane[l] = value);
        }

        varying.iter_mut().chain(&mut constant).for_each(|lane| repeat_last(core::slice::from_mut(lane), count));
        let physics =
            PhysicsStep { variant: scene.variant, model, varying: &varying, constant: &constant, risk: scene.risk, path: self.path() };
        watch.add_to(Part::Rest);
        let output = Path::run_on_target(physics);
        watch.add_to(Part::Physics);
        let sensors = &self.physics.at(scene.clock.after(k + 1)).vehicle().effects.sensor;
        for l in 0..count {
            let at = first + l;
            let control = scene.control(block.first + at, k);
            let share = residual_share(scene.variant, scales.trained_speed_m_s[0], control.speed_m_s) as f32;
            let total: [f64; STATE_DIM] =
                core::array::from_fn(|i| f64::from(output.increment[i][l] + share * (said.residual[i][h][l] * scales.residual_scale[i])));
            self.advance(&mut block.samples[at], &total, after[l], known[l], &control);
            let shown = reported(sensors, &block.samples[at].state);
            block.write(at, k, scene.query.horizon, &shown, &output);
        }
        watch.add_to(Part::Rest);
    }
}

/// Gives whoever waits for a processor its turn, so that what is quick to answer or to refuse need not wait until a slice of time ends.
fn give_way() {
    std::thread::yield_now();
}

impl<const H: usize> Block<'_, H> {
    /// Writes the state and the wheels of a sample after step `k`; `output` is that of its vector.
    fn write(&mut self, at: usize, k: usize, horizon: usize, state: &VehicleState<f64>, output: &PhysicsOutput) {
        let (row, l) = (at * horizon + k, at % LANES);
        for (out, value) in self.states[row * STATE_DIM..(row + 1) * STATE_DIM].iter_mut().zip(state.to_array()) {
            *out = value as f32;
        }
        if let Some(position_m) = self.position_m.get_mut(row) {
            *position_m = state.position_m;
        }
        for (out, lane) in self.sinkage_m[row * WHEELS..(row + 1) * WHEELS].iter_mut().zip(&output.sinkage_m) {
            *out = lane[l];
        }
        if let Some(risk) = &output.risk {
            self.risk[row] = risk[l];
        }
    }
}

/// Poses of a sample that keeps its velocities, the present one first.
fn ahead(state: &VehicleState<f64>, dt_s: f64) -> impl Iterator<Item = Pose2> {
    let ([ahead_m_s, left_m_s, _], turn_rad_s) = (state.velocity_m_s, state.angular_velocity_rad_s[2]);
    core::iter::successors(Some(pose(state)), move |at| {
        let (sin, cos) = (at.yaw_rad + 0.5 * turn_rad_s * dt_s).sin_cos();
        Some(Pose2 {
            x_m: at.x_m + (cos * ahead_m_s - sin * left_m_s) * dt_s,
            y_m: at.y_m + (sin * ahead_m_s + cos * left_m_s) * dt_s,
            yaw_rad: at.yaw_rad + turn_rad_s * dt_s,
        })
    })
}

/// Lets the lanes beyond the last of `count` samples repeat it.
fn repeat_last(row: &mut [Lane], count: usize) {
    let last = row[(count - 1) / LANES][(count - 1) % LANES];
    for (lane, first) in row.iter_mut().zip((0..).step_by(LANES)) {
        lane[count.saturating_sub(first).min(LANES)..].fill(last);
    }
}

/// The differentiable columns of a step row.
fn varying_row(state: &VehicleState<f64>, datum_m: f64, ratio: &[f32; WHEELS], soil: &[f64; SOIL_DIM]) -> [f32; DIFFERENTIABLE] {
    let x = state.to_array();
    core::array::from_fn(|c| match c {
        0 => (x[2] - datum_m) as f32,
        1 | 2 => x[c + 2] as f32,
        c if c < STATE_COLUMNS => x[c + 3] as f32,
        c if c < SOIL_AT => ratio[c - SINKAGE_AT],
        c => soil[c - SOIL_AT] as f32,
    })
}
