//! A block of samples on its way through the horizon.

use nesam_physics::driveline::{DrivelineState, command_wheels, measured_wheels};
use nesam_physics::{Control, SOIL_DIM, STATE_DIM, VehicleState, WHEELS};
use nesam_terrain::Pose2;

use super::observed::reported;
use super::parts::{Part, Watch};
use super::physics::{PhysicsOutput, PhysicsStep};
use super::risk::RiskRow;
use super::rollout::Scene;
use super::{NO_SINKAGE, Predictor, Sample, TerrainMode, pose, under};
use crate::dims::HIDDEN;
use crate::fused::{BlockCache, LANES, Lane, Path, Row};
use crate::rollout::Variant;
use crate::step_row::{CONSTANT, DIFFERENTIABLE, SINKAGE_AT, SOIL_AT, STATE_COLUMNS, pack_constants};
use crate::terrain_tokens::{Node, TerrainToken, VALUES};

/// Keys and values of a block: one vector of samples, so that keys and values of a whole rollout stay in the second-level cache.
pub(super) type Cache = BlockCache<1>;

/// Up to sixteen samples, how far they are, and where their results go.
pub(super) struct Block<'a> {
    /// Row of the first sample.
    pub(super) first: usize,
    /// Steps done.
    pub(super) done: usize,
    pub(super) samples: &'a mut [Sample],
    /// (samples, horizon, 12) of the rollout.
    pub(super) states: &'a mut [f32],
    /// (samples, horizon, 4), m.
    pub(super) sinkage_m: &'a mut [f32],
    /// (samples, horizon) when risk is asked for, else empty.
    pub(super) risk: Vec<RiskRow>,
    /// Held from the first step to the last.
    pub(super) cache: Option<Cache>,
    /// Nodes of the terrain without which the block cannot go on.
    pub(super) missing: Vec<Node>,
}

impl Predictor {
    /// Takes a block to the end of the horizon, or to the first step whose terrain is not encoded yet.
    pub(super) fn advance_block(&self, scene: &Scene<'_>, block: &mut Block<'_>) {
        let mut cache = block.cache.take().unwrap_or_else(|| scene.caches.take());
        let mut terrain = [[0.0; VALUES]; LANES];
        while block.done < scene.query.horizon {
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
        scene.caches.give(cache);
    }

    /// Terrain tokens of a block; false when nodes are missing, which the block then names.
    fn block_terrain(&self, scene: &Scene<'_>, block: &mut Block<'_>, terrain: &mut [TerrainToken; LANES]) -> bool {
        // Samples still stand together at the first step: one lookup serves all.
        let distinct = if block.done == 0 { 1 } else { block.samples.len() };
        let poses: [Pose2; LANES] = core::array::from_fn(|l| pose(&block.samples[l.min(distinct - 1)].state));
        match (scene.tokens, self.mode) {
            (Some(tokens), TerrainMode::Grid) => {
                tokens.try_at(&poses[..distinct], &mut terrain[..distinct], &mut block.missing);
                if !block.missing.is_empty() {
                    return false;
                }
                self.default_soil(scene.tokens, &mut terrain[..distinct]);
            }
            _ => terrain[..distinct].copy_from_slice(&self.terrain(scene.tokens, &poses[..distinct])),
        }
        for l in distinct..LANES {
            terrain[l] = terrain[distinct - 1];
        }
        true
    }

    /// Advances the samples of a block by one step and writes what it gives.
    fn step_block(&self, scene: &Scene<'_>, block: &mut Block<'_>, cache: &mut Cache, terrain: &[TerrainToken; LANES]) {
        let scales = &self.bundle.normalization;
        let mut watch = Watch::start(scene.clocks);
        let (k, count) = (block.done, block.samples.len());
        let time_s = scene.clock.after(k);
        let model = self.physics.at(time_s);
        let last = count - 1;
        let controls: [Control<f64>; LANES] = core::array::from_fn(|l| scene.control(block.first + l.min(last), k));
        let mut entries = [[Lane::ZERO]; crate::dims::STATE_CONTROL];
        for (l, sample) in block.samples.iter().enumerate() {
            let values = self.entries(model, &sample.state, sample.previous.as_ref(), &controls[l], &scene.ground);
            entries.iter_mut().zip(values).for_each(|(row, value)| row[0][l] = value);
        }
        entries.iter_mut().for_each(|row| repeat_last(&mut row[0], count));
        let context: [Row<1>; HIDDEN] = core::array::from_fn(|i| [Lane::from_fn(|l| terrain[l][i])]);
        watch.add_to(Part::Rest);
        let said = self.rolled.step(&scene.prefix, cache, &entries, &context);
        watch.add_to(Part::Network);
        give_way();

        let (mut varying, mut constant) = ([Lane::ZERO; DIFFERENTIABLE], [Lane::ZERO; CONSTANT]);
        let mut after = [DrivelineState::default(); LANES];
        let mut known = [true; LANES];
        for (l, sample) in block.samples.iter().enumerate() {
            after[l] = sample.actuators.advance(model.vehicle(), &controls[l], sample.state.velocity_m_s[0], model.dt_s());
            let wheels = match scene.query.wheels {
                Some(measured) => measured_wheels(model.vehicle(), &measured[k].speed_rad_s, &measured[k].angle_rad),
                None => command_wheels(model.vehicle(), &sample.actuators, &after[l], &controls[l]),
            };
            let (ground, inside) = scene.ground.under_wheels(model, &sample.state, scene.datum_m);
            known[l] = inside;
            let soil = self.soil_at(under(scene.soil, block.first + l, sample, &terrain[l]), time_s);
            let ratio: [f32; WHEELS] = core::array::from_fn(|i| match scene.variant {
                Variant::ZeroSinkage => NO_SINKAGE,
                _ => scales.sinkage_log_ratio_max * said.sinkage[i][0][l],
            });
            let row = varying_row(&sample.state, scene.datum_m, &ratio, &soil);
            varying.iter_mut().zip(row).for_each(|(lane, value)| lane[l] = value);
            constant
                .iter_mut()
                .zip(pack_constants(&wheels, &ground, sample.state.attitude_rad[2]))
                .for_each(|(lane, value)| lane[l] = value);
        }

        varying.iter_mut().chain(&mut constant).for_each(|lane| repeat_last(lane, count));
        let physics =
            PhysicsStep { variant: scene.variant, model, varying: &varying, constant: &constant, risk: scene.risk, path: self.path() };
        watch.add_to(Part::Rest);
        let output = Path::run_on_target(physics);
        watch.add_to(Part::Physics);
        let sensors = &self.physics.at(scene.clock.after(k + 1)).vehicle().effects.sensor;
        for l in 0..count {
            let total: [f64; STATE_DIM] = core::array::from_fn(|i| {
                let residual = match scene.variant {
                    Variant::NoResidual => 0.0,
                    _ => said.residual[i][0][l] * scales.residual_scale[i],
                };
                f64::from(output.increment[i][l] + residual)
            });
            self.advance(&mut block.samples[l], &total, after[l], known[l], &controls[l]);
            let shown = reported(sensors, &block.samples[l].state);
            block.write(l, k, scene.query.horizon, &shown, &output);
        }
        watch.add_to(Part::Rest);
    }
}

/// Gives whoever waits for a processor its turn, so that what is quick to answer or to refuse need not wait until a slice of time ends.
fn give_way() {
    std::thread::yield_now();
}

impl Block<'_> {
    /// Writes the state and the wheels of a sample after step `k`.
    fn write(&mut self, l: usize, k: usize, horizon: usize, state: &VehicleState<f64>, output: &PhysicsOutput) {
        let row = l * horizon + k;
        for (out, value) in self.states[row * STATE_DIM..(row + 1) * STATE_DIM].iter_mut().zip(state.to_array()) {
            *out = value as f32;
        }
        for (out, lane) in self.sinkage_m[row * WHEELS..(row + 1) * WHEELS].iter_mut().zip(&output.sinkage_m) {
            *out = lane[l];
        }
        if let Some(risk) = &output.risk {
            self.risk[row] = risk[l];
        }
    }
}

/// Lets the lanes beyond the last of `count` samples repeat it.
fn repeat_last(lane: &mut Lane, count: usize) {
    let last = lane[count - 1];
    lane[count..].fill(last);
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
