//! The predictor: a bundle ready to answer rollouts (paper Eq. 1 and 2, applied K times).

use std::sync::{Arc, Mutex};

use nesam_physics::driveline::{DrivelineState, command_wheels, measured_wheels};
use nesam_physics::effects::Effect;
use nesam_physics::scalar::f32x8;
use nesam_physics::step::StepModel;
use nesam_physics::{Control, SOIL_DIM, STATE_DIM, VehicleState, WHEELS, wrap_angle};
use nesam_terrain::{Pose2, WorldMap};
use rayon::prelude::*;

use crate::ModelError;
use crate::bundle::ModelBundle;
use crate::dims::{CONTEXT, HIDDEN, HISTORY, MAX_HORIZON, STATE_CONTROL};
use crate::encoder::TerrainEncoders;
use crate::fused::{BlockCache, FusedTransformer, LANES, Lane, Prefix};
use crate::ground::{GroundSource, history_actuators};
use crate::rollout::{HistoryStep, Rollout, RolloutQuery, Variant, flag};
use crate::soil_coordinates::from_raw;
use crate::soil_prior::SoilPrior;
use crate::step_row::{CONSTANT, DIFFERENTIABLE, SINKAGE_AT, SOIL_AT, STATE_COLUMNS, pack_constants, step_input};
use crate::symbolic::symbolic_step;
use crate::terrain_tokens::{CacheCounts, TerrainProjection, TerrainToken, TerrainTokens, VALUES};
use crate::token::{TokenScale, token_entries};

mod transitions;

pub use self::transitions::Transition;

/// Maps whose terrain tokens are kept.
const MAPS_MAX: usize = 16;
/// Sinkage log-ratio that suppresses the sinkage (ablation "Sinkage = 0").
const NO_SINKAGE: f32 = -12.0;
/// |roll| or |pitch| beyond which a vehicle counts as overturned, rad.
const OVERTURNED_RAD: f64 = 60.0 * core::f64::consts::PI / 180.0;

/// How terrain tokens are obtained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum TerrainMode {
    /// Interpolated on a pose grid that is cached per map.
    #[default]
    Grid,
    /// Encoded at every pose: slow, for checking the grid.
    Exact,
}

/// Hash of a map and its encoded terrain.
type TokensOfMap = (String, Arc<TerrainTokens>);

/// A loaded bundle that answers rollout queries. `Send + Sync`; shared behind an `Arc`.
#[derive(Debug)]
pub struct Predictor {
    bundle: Arc<ModelBundle>,
    model: StepModel,
    network: Arc<FusedTransformer>,
    projection: Arc<TerrainProjection>,
    token_scale: TokenScale,
    mode: TerrainMode,
    maps: Arc<Mutex<Vec<TokensOfMap>>>,
}

/// One candidate while it is rolled out.
#[derive(Clone, Copy, Debug)]
struct Sample {
    state: VehicleState<f64>,
    previous: Option<VehicleState<f64>>,
    actuators: DrivelineState,
    flags: u32,
}

/// What a block of samples writes in one step.
struct BlockOutput<'a> {
    samples: &'a mut [Sample],
    cache: &'a mut BlockCache,
    sinkage: Vec<[f32; WHEELS]>,
}

/// Everything of a query that is the same for all samples.
struct Scene<'a> {
    query: &'a RolloutQuery<'a>,
    ground: GroundSource<'a>,
    prefix: Prefix,
    datum_m: f64,
    variant: Variant,
}

impl Predictor {
    /// Prepares the bundle for inference.
    ///
    /// # Errors
    /// `ModelError::Weights` naming an array that is missing or has another shape.
    pub fn new(bundle: Arc<ModelBundle>) -> Result<Self, ModelError> {
        Self::with_terrain(bundle, TerrainMode::Grid)
    }

    /// Same, choosing how terrain tokens are obtained.
    ///
    /// # Errors
    /// As [`Predictor::new`].
    pub fn with_terrain(bundle: Arc<ModelBundle>, mode: TerrainMode) -> Result<Self, ModelError> {
        let (weights, scales) = (&bundle.weights, &bundle.normalization);
        let projection = TerrainProjection::new(
            TerrainEncoders::new(weights)?,
            weights.get("token.context.weight", &[HIDDEN, CONTEXT])?,
            SoilPrior::new(weights)?,
            scales.patch_scale(),
        );
        Ok(Self {
            model: StepModel::new(&bundle.vehicle, scales.dt_s, scales.substeps),
            network: Arc::new(FusedTransformer::new(weights)?),
            projection: Arc::new(projection),
            token_scale: scales.token_scale(),
            mode,
            maps: Arc::default(),
            bundle,
        })
    }

    /// The same predictor for the vehicle with further effects. Network and terrain tokens do not depend on them and are shared, so this costs
    /// little; the bundle's hash stays that of the files it was read from.
    pub fn with_effects(&self, effects: &[Effect]) -> Self {
        let bundle = Arc::new(self.bundle.with_effects(effects));
        let scales = &bundle.normalization;
        Self {
            model: StepModel::new(&bundle.vehicle, scales.dt_s, scales.substeps),
            network: self.network.clone(),
            projection: self.projection.clone(),
            token_scale: scales.token_scale(),
            mode: self.mode,
            maps: self.maps.clone(),
            bundle,
        }
    }

    /// The bundle behind the predictions.
    pub fn bundle(&self) -> &ModelBundle {
        &self.bundle
    }

    /// Rolls every candidate out from the start. Row n of a batch equals the query of n alone, bit for bit.
    ///
    /// # Errors
    /// `ModelError::Query` naming the field when shapes disagree, the horizon is 0 or above [`MAX_HORIZON`], or a number is not finite.
    pub fn rollout(&self, query: &RolloutQuery<'_>) -> Result<Rollout, ModelError> {
        validate(query)?;
        let scales = &self.bundle.normalization;
        let tokens = query.map.map(|map| self.tokens_of(map));
        let ground = GroundSource::new(query.map.map(Arc::as_ref), &self.model, &query.start);
        let history = &query.history[query.history.len().saturating_sub(HISTORY - 1)..];
        let variant = if query.variant == Variant::Full { self.bundle.form } else { query.variant };
        let prefix = if variant.remembers() { self.prefix(history, &ground, tokens.as_deref()) } else { Prefix::default() };
        let scene = Scene { query, ground, prefix, datum_m: query.start.position_m[2], variant };

        let first = control(query, 0, 0);
        let start = Sample {
            state: query.start,
            previous: history.last().map(|step| step.state),
            actuators: history_actuators(&self.model, history, &query.start, &first, scales.dt_s),
            flags: if query.map.is_none() { flag::NO_MAP } else { 0 },
        };
        let mut samples = vec![start; query.samples];
        let mut caches = vec![BlockCache::new(query.horizon); query.samples.div_ceil(LANES)];
        let mut rollout = Rollout {
            states: vec![0.0; query.samples * query.horizon * STATE_DIM],
            sinkage_m: vec![0.0; query.samples * query.horizon * WHEELS],
            flags: Vec::new(),
            soil: [0.0; SOIL_DIM],
            samples: query.samples,
            horizon: query.horizon,
        };
        for k in 0..query.horizon {
            // Samples still stand together at the first step: one lookup serves all.
            let distinct = if k == 0 { 1 } else { samples.len() };
            let poses: Vec<Pose2> = samples[..distinct].iter().map(|s| pose(&s.state)).collect();
            let terrain = self.terrain(tokens.as_deref(), &poses);
            if k == 0 {
                rollout.soil = self.soil(&terrain[0], query);
            }
            let blocks: Vec<BlockOutput<'_>> = samples
                .par_chunks_mut(LANES)
                .zip(caches.par_iter_mut())
                .enumerate()
                .map(|(block, (samples, cache))| {
                    let tokens: Vec<&TerrainToken> = (0..samples.len()).map(|l| &terrain[(block * LANES + l).min(distinct - 1)]).collect();
                    let sinkage = self.step_block(&scene, block * LANES, k, samples, cache, &tokens);
                    BlockOutput { samples, cache, sinkage }
                })
                .collect();
            for (block, output) in blocks.iter().enumerate() {
                let _ = &output.cache;
                for (lane, sample) in output.samples.iter().enumerate() {
                    let row = (block * LANES + lane) * query.horizon + k;
                    for (out, value) in rollout.states[row * STATE_DIM..].iter_mut().zip(sample.state.to_array()) {
                        *out = value as f32;
                    }
                    rollout.sinkage_m[row * WHEELS..(row + 1) * WHEELS].copy_from_slice(&output.sinkage[lane]);
                }
            }
        }
        rollout.flags = samples.iter().map(|s| s.flags).collect();
        Ok(rollout)
    }

    /// The physics with the bundle's vehicle.
    pub fn step_model(&self) -> &StepModel {
        &self.model
    }

    /// Nominal soil θ̄ under a pose (paper §III-B: h_θ of the semantic patch); the stated default without map or semantics.
    pub fn soil_prior(&self, map: Option<&Arc<WorldMap>>, pose: Pose2) -> [f64; SOIL_DIM] {
        from_raw(&raw_soil(&self.terrain_tokens(map, &[pose])[0]))
    }

    /// Context token W_c c (128) and raw soil (6) at each pose: what the network sees of the terrain there.
    pub fn terrain_tokens(&self, map: Option<&Arc<WorldMap>>, poses: &[Pose2]) -> Vec<TerrainToken> {
        let tokens = map.map(|map| self.tokens_of(map));
        self.terrain(tokens.as_deref(), poses)
    }

    /// What was asked of the terrain cache of a map so far.
    pub fn terrain_cache(&self, map: &Arc<WorldMap>) -> CacheCounts {
        self.tokens_of(map).counts()
    }

    /// The cache of a map, made on first use; the least recently made one goes when there are too many.
    fn tokens_of(&self, map: &Arc<WorldMap>) -> Arc<TerrainTokens> {
        let mut maps = self.maps.lock().expect("no holder panics; this is a bug");
        if let Some((_, tokens)) = maps.iter().find(|(hash, _)| hash == map.hash()) {
            return tokens.clone();
        }
        if maps.len() == MAPS_MAX {
            maps.remove(0);
        }
        let tokens = Arc::new(TerrainTokens::new(map.clone()));
        maps.push((map.hash().to_string(), tokens.clone()));
        tokens
    }

    /// Terrain tokens at poses; where there is no map or no semantics, the default soil.
    fn terrain(&self, tokens: Option<&TerrainTokens>, poses: &[Pose2]) -> Vec<TerrainToken> {
        let mut terrain = match (tokens, self.mode) {
            (None, _) => vec![[0.0; VALUES]; poses.len()],
            (Some(tokens), TerrainMode::Grid) => tokens.at(&self.projection, poses),
            (Some(tokens), TerrainMode::Exact) => poses.par_iter().map(|p| self.projection.exact(tokens.map(), *p)).collect(),
        };
        if !tokens.is_some_and(|t| t.map().has_semantics()) {
            for token in &mut terrain {
                token[HIDDEN..].copy_from_slice(&self.bundle.normalization.default_soil_raw);
            }
        }
        terrain
    }

    /// Encodes the measured history.
    fn prefix(&self, history: &[HistoryStep], ground: &GroundSource<'_>, tokens: Option<&TerrainTokens>) -> Prefix {
        let poses: Vec<Pose2> = history.iter().map(|step| pose(&step.state)).collect();
        let terrain = self.terrain(tokens, &poses);
        let entries: Vec<[f32; STATE_CONTROL]> = history
            .iter()
            .enumerate()
            .map(|(j, step)| {
                let previous = j.checked_sub(1).map(|j| history[j].state);
                self.entries(&step.state, previous.as_ref(), &step.control, ground)
            })
            .collect();
        let contexts: Vec<[f32; HIDDEN]> = terrain.iter().map(|t| core::array::from_fn(|i| t[i])).collect();
        self.network.prefix(&entries, &contexts)
    }

    fn entries(
        &self,
        state: &VehicleState<f64>,
        previous: Option<&VehicleState<f64>>,
        control: &Control<f64>,
        ground: &GroundSource<'_>,
    ) -> [f32; STATE_CONTROL] {
        let (height, _, _) = ground.at(state.position_m[0], state.position_m[1]);
        let raw = token_entries(state, previous, [control.speed_m_s, control.second], height, self.bundle.normalization.dt_s);
        self.token_scale.apply(raw)
    }

    fn soil(&self, token: &TerrainToken, query: &RolloutQuery<'_>) -> [f64; SOIL_DIM] {
        query.soil_correction.apply(&from_raw(&raw_soil(token)))
    }

    /// Advances up to sixteen samples by one step; returns their wheel sinkages, m.
    fn step_block(
        &self,
        scene: &Scene<'_>,
        first: usize,
        k: usize,
        samples: &mut [Sample],
        cache: &mut BlockCache,
        terrain: &[&TerrainToken],
    ) -> Vec<[f32; WHEELS]> {
        let scales = &self.bundle.normalization;
        let query = scene.query;
        let last = samples.len() - 1;
        let controls: Vec<Control<f64>> = (0..samples.len()).map(|l| control(query, first + l, k)).collect();
        let entries: Vec<[f32; STATE_CONTROL]> =
            samples.iter().zip(&controls).map(|(s, control)| self.entries(&s.state, s.previous.as_ref(), control, &scene.ground)).collect();
        let entry_lanes: [Lane; STATE_CONTROL] = core::array::from_fn(|i| core::array::from_fn(|l| entries[l.min(last)][i]));
        let context: [Lane; HIDDEN] = core::array::from_fn(|i| core::array::from_fn(|l| terrain[l.min(last)][i]));
        if !scene.variant.remembers() {
            *cache = BlockCache::new(1);
        }
        let (raw_sinkage, raw_residual) = self.network.step(&scene.prefix, cache, &entry_lanes, &context);

        let rows: Vec<(DrivelineState, [f32; DIFFERENTIABLE], [f32; CONSTANT], bool)> = samples
            .iter()
            .zip(&controls)
            .enumerate()
            .map(|(l, (sample, control))| {
                let after = sample.actuators.advance(self.model.vehicle(), control, sample.state.velocity_m_s[0], scales.dt_s);
                let wheels = match query.wheels {
                    Some(measured) => measured_wheels(self.model.vehicle(), &measured[k].speed_rad_s, &measured[k].angle_rad),
                    None => command_wheels(self.model.vehicle(), &sample.actuators, &after, control),
                };
                let (ground, known) = scene.ground.under_wheels(&self.model, &sample.state, scene.datum_m);
                let soil = self.soil(terrain[l], query);
                let ratio: [f32; WHEELS] = core::array::from_fn(|i| match scene.variant {
                    Variant::ZeroSinkage => NO_SINKAGE,
                    _ => scales.sinkage_log_ratio_max * raw_sinkage[i][l].tanh(),
                });
                (after, varying_row(&sample.state, scene.datum_m, &ratio, &soil), pack_constants(&wheels, &ground), known)
            })
            .collect();

        let mut sinkage = vec![[0.0; WHEELS]; samples.len()];
        for half in (0..samples.len()).step_by(8) {
            let at = |l: usize| (half + l).min(last);
            let varying = core::array::from_fn(|c| f32x8::from(core::array::from_fn::<f32, 8, _>(|l| rows[at(l)].1[c])));
            let constant = core::array::from_fn(|c| f32x8::from(core::array::from_fn::<f32, 8, _>(|l| rows[at(l)].2[c])));
            let (increment, sinkages) = symbolic_step(scene.variant, &self.model, &step_input(varying, constant));
            let increment = increment.to_array().map(f32x8::to_array);
            let sinkages = sinkages.map(f32x8::to_array);
            for l in 0..8.min(samples.len() - half) {
                let lane = half + l;
                let total: [f64; STATE_DIM] = core::array::from_fn(|i| {
                    let residual = match scene.variant {
                        Variant::NoResidual => 0.0,
                        _ => raw_residual[i][lane] * scales.residual_scale[i],
                    };
                    f64::from(increment[i][l] + residual)
                });
                sinkage[lane] = core::array::from_fn(|w| sinkages[w][l]);
                let (after, _, _, known) = rows[lane];
                self.advance(&mut samples[lane], &total, after, known, &controls[lane]);
            }
        }
        sinkage
    }

    /// x' = x + Δx, actuators and flags.
    fn advance(&self, sample: &mut Sample, increment: &[f64; STATE_DIM], actuators: DrivelineState, known: bool, control: &Control<f64>) {
        let scales = &self.bundle.normalization;
        let before = sample.state;
        let (sin, cos) = before.attitude_rad[2].sin_cos();
        let x = before.to_array();
        let mut next: [f64; STATE_DIM] = core::array::from_fn(|i| x[i] + increment[i]);
        next[0] = x[0] + cos * increment[0] - sin * increment[1];
        next[1] = x[1] + sin * increment[0] + cos * increment[1];
        next[5] = wrap_angle(next[5]);
        let tilt = next[3].abs().max(next[4].abs());
        let outside = |v: f64, range: [f64; 2]| v < range[0] || v > range[1];
        let mut raise = |condition: bool, bit: u32| sample.flags |= if condition { bit } else { 0 };
        raise(!known, flag::OFF_MAP);
        raise(tilt > OVERTURNED_RAD, flag::OVERTURNED);
        raise(tilt > scales.trained_tilt_rad, flag::SLOPE_UNTRAINED);
        raise(outside(control.speed_m_s, scales.trained_speed_m_s), flag::SPEED_UNTRAINED);
        raise(outside(control.second, scales.trained_second), flag::STEERING_UNTRAINED);
        if next.iter().all(|v| v.is_finite()) {
            sample.state = VehicleState::from_array(next);
        } else {
            sample.flags |= flag::NOT_FINITE; // the sample stops where it was last finite; its neighbours are other lanes
        }
        sample.previous = Some(before);
        sample.actuators = actuators;
    }
}

fn pose(state: &VehicleState<f64>) -> Pose2 {
    Pose2 { x_m: state.position_m[0], y_m: state.position_m[1], yaw_rad: state.attitude_rad[2] }
}

fn raw_soil(token: &TerrainToken) -> [f32; SOIL_DIM] {
    core::array::from_fn(|i| token[HIDDEN + i])
}

fn control(query: &RolloutQuery<'_>, sample: usize, k: usize) -> Control<f64> {
    let at = (sample * query.horizon + k) * 2;
    Control { speed_m_s: f64::from(query.controls[at]), second: f64::from(query.controls[at + 1]) }
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

fn validate(query: &RolloutQuery<'_>) -> Result<(), ModelError> {
    let fail = |field, reason: String| Err(ModelError::Query { field, reason });
    if query.samples == 0 {
        return fail("samples", "is 0, at least one candidate is needed".into());
    }
    if query.horizon == 0 || query.horizon > MAX_HORIZON {
        return fail("horizon", format!("is {}, the model has positions for 1..={MAX_HORIZON} steps", query.horizon));
    }
    let expected = query.samples * query.horizon * 2;
    if query.controls.len() != expected {
        let reason = format!("has {} numbers, expected samples × horizon × 2 = {expected}", query.controls.len());
        return fail("controls", reason);
    }
    if let Some(at) = query.controls.iter().position(|v| !v.is_finite()) {
        return fail("controls", format!("number {at} is not finite"));
    }
    if let Some(wheels) = query.wheels {
        if wheels.len() != query.horizon {
            return fail("wheels", format!("has {} steps, expected horizon = {}", wheels.len(), query.horizon));
        }
        if let Some(at) = wheels.iter().position(|w| !w.speed_rad_s.iter().chain(&w.angle_rad).all(|v| v.is_finite())) {
            return fail("wheels", format!("step {at} holds a number that is not finite"));
        }
    }
    if !query.start.to_array().iter().all(|v| v.is_finite()) {
        return fail("start", "holds a number that is not finite".into());
    }
    if !query.soil_correction.delta.iter().all(|v| v.is_finite()) {
        return fail("soil_correction", "holds a number that is not finite".into());
    }
    let finite = |step: &HistoryStep| {
        step.state.to_array().iter().all(|v| v.is_finite()) && step.control.speed_m_s.is_finite() && step.control.second.is_finite()
    };
    match query.history.iter().position(|step| !finite(step)) {
        Some(at) => fail("history", format!("step {at} holds a number that is not finite")),
        None => Ok(()),
    }
}
