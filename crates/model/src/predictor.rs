//! The predictor: a bundle ready to answer rollouts (paper Eq. 1 and 2, applied K times).

use std::sync::{Arc, Mutex};

use nesam_physics::driveline::{DrivelineState, command_wheels, measured_wheels};
use nesam_physics::effects::{Phases, ScheduledEffect};
use nesam_physics::scalar::f32x8;
use nesam_physics::step::StepModel;
use nesam_physics::{Control, SOIL_DIM, STATE_DIM, SoilCorrection, VehicleState, WHEELS, wrap_angle};
use nesam_terrain::{Pose2, WorldMap};
use rayon::prelude::*;

use crate::ModelError;
use crate::bundle::ModelBundle;
use crate::dims::{CONTEXT, HIDDEN, HISTORY, STATE_CONTROL};
use crate::encoder::TerrainEncoders;
use crate::fused::{BlockCache, FusedTransformer, LANES, Lane, Prefix};
use crate::ground::{GroundSource, actuators_along};
use crate::rollout::{HistoryStep, RiskOutputs, Rollout, RolloutExtras, RolloutQuery, Variant, flag};
use crate::soil_coordinates::from_raw;
use crate::soil_field::SoilField;
use crate::soil_prior::SoilPrior;
use crate::step_row::{CONSTANT, DIFFERENTIABLE, SINKAGE_AT, SOIL_AT, STATE_COLUMNS, pack_constants, step_input};
use crate::symbolic::symbolic_step;
use crate::terrain_tokens::{CacheCounts, TerrainProjection, TerrainToken, TerrainTokens, VALUES};
use crate::token::{TokenScale, token_entries};

mod linearise;
mod observed;
mod risk;
mod transitions;
mod validate;

pub(crate) use self::observed::LogClock;
use self::observed::reported;
use self::risk::RiskRow;
pub use self::transitions::Transition;
use self::validate::{validate, validate_extras};

/// Maps whose terrain tokens are kept.
const MAPS_MAX: usize = 16;
/// Sinkage log-ratio that suppresses the sinkage (ablation "Sinkage = 0").
pub(crate) const NO_SINKAGE: f32 = -12.0;
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
    physics: Phases<StepModel>,
    /// Some effect makes measured states differ from true ones.
    sensors_err: bool,
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
    wheels: Vec<StepRow>,
}

/// What a step tells of one sample beyond its state.
#[derive(Clone, Copy, Debug, Default)]
struct StepRow {
    sinkage_m: [f32; WHEELS],
    /// Zero unless asked for.
    risk: RiskRow,
}

/// Everything of a query that is the same for all samples.
struct Scene<'a> {
    query: &'a RolloutQuery<'a>,
    soil: &'a dyn SoilField,
    ground: GroundSource<'a>,
    prefix: Prefix,
    datum_m: f64,
    variant: Variant,
    risk: bool,
    clock: LogClock,
}

/// A correction for each group of `samples` rows.
#[derive(Debug)]
struct SoilPerGroup<'a> {
    soils: &'a [SoilCorrection],
    samples: usize,
}

impl SoilField for SoilPerGroup<'_> {
    fn soil(&self, row: usize, _position_m: [f64; 2], prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        self.soils[row / self.samples].apply(prior)
    }
}

impl Scene<'_> {
    /// Command of a row in step `k`: every group of samples has the same.
    fn control(&self, row: usize, k: usize) -> Control<f64> {
        control(self.query, row % self.query.samples, k)
    }
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
        let physics = phases(&bundle);
        Ok(Self {
            sensors_err: physics.any(sensors_err),
            physics,
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
    pub fn with_effects<E: Copy + Into<ScheduledEffect>>(&self, effects: &[E]) -> Self {
        let bundle = Arc::new(self.bundle.with_effects(effects));
        let scales = &bundle.normalization;
        let physics = phases(&bundle);
        Self {
            sensors_err: physics.any(sensors_err),
            physics,
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
    /// `ModelError::Query` naming the field when shapes disagree, the horizon is 0 or above [`crate::MAX_HORIZON`], or a number is not finite.
    pub fn rollout(&self, query: &RolloutQuery<'_>) -> Result<Rollout, ModelError> {
        self.rollout_with(query, &RolloutExtras::default()).map(|(rollout, _)| rollout)
    }

    /// The same on a soil that may differ from place to place and from sample to sample; the correction of the query stands aside.
    ///
    /// # Errors
    /// As [`Predictor::rollout`].
    pub fn rollout_on(&self, query: &RolloutQuery<'_>, soil: &dyn SoilField) -> Result<Rollout, ModelError> {
        self.rollout_with(query, &RolloutExtras { field: Some(soil), ..Default::default() }).map(|(rollout, _)| rollout)
    }

    /// The same with what-if soils and, where they are asked for, risk outputs. States do not depend on whether risk is asked for, and a what-if soil
    /// that equals the query's correction gives the rollout of the query, both bit for bit.
    ///
    /// # Errors
    /// As [`Predictor::rollout`]; also naming `soils` when a correction is not finite, and `risk` when the form has no soil.
    pub fn rollout_with(&self, query: &RolloutQuery<'_>, extras: &RolloutExtras<'_>) -> Result<(Rollout, Option<RiskOutputs>), ModelError> {
        validate(query)?;
        validate_extras(extras)?;
        let scales = &self.bundle.normalization;
        let tokens = query.map.map(|map| self.tokens_of(map));
        let clock = LogClock { start_s: query.start_time_s, dt_s: scales.dt_s };
        let (history, start_state) = self.true_motion(query.history, &query.start, clock);
        let history = history.as_ref();
        let ground = GroundSource::new(query.map.map(Arc::as_ref), self.physics.at(clock.start_s), &start_state);
        let variant = self.form_of(query);
        if extras.risk && !variant.has_soil() {
            return Err(ModelError::Query { field: "risk", reason: format!("a model of the form `{}` has no soil", variant.as_str()) });
        }
        let prefix = self.prefix(variant, history, &ground, tokens.as_deref(), clock);
        let what_if = SoilPerGroup { soils: extras.soils, samples: query.samples };
        let soil: &dyn SoilField = if extras.soils.is_empty() { extras.field.unwrap_or(&query.soil_correction) } else { &what_if };
        let scene = Scene { query, soil, ground, prefix, datum_m: start_state.position_m[2], variant, risk: extras.risk, clock };
        let rows = extras.soils.len().max(1) * query.samples;

        // Without a history the actuators begin as a row's own first command says, so rows stay independent.
        let start = |row: usize| Sample {
            state: start_state,
            previous: history.last().map(|step| step.state),
            actuators: self.actuators(history, &start_state, &scene.control(row, 0), clock),
            flags: if query.map.is_none() { flag::NO_MAP } else { 0 },
        };
        let shared = start(0);
        let mut samples: Vec<Sample> = (0..rows).map(|row| if history.is_empty() { start(row) } else { shared }).collect();
        let mut caches = vec![BlockCache::new(query.horizon, variant.remembers()); rows.div_ceil(LANES)];
        let mut rollout = Rollout {
            states: vec![0.0; rows * query.horizon * STATE_DIM],
            sinkage_m: vec![0.0; rows * query.horizon * WHEELS],
            flags: Vec::new(),
            soil: [0.0; SOIL_DIM],
            samples: rows,
            horizon: query.horizon,
        };
        let mut risk = extras.risk.then(|| RiskOutputs::zero(rows * query.horizon));
        for k in 0..query.horizon {
            // Samples still stand together at the first step: one lookup serves all.
            let distinct = if k == 0 { 1 } else { samples.len() };
            let poses: Vec<Pose2> = samples[..distinct].iter().map(|s| pose(&s.state)).collect();
            let terrain = self.terrain(tokens.as_deref(), &poses);
            if k == 0 {
                rollout.soil = self.soil_at(under(soil, 0, &samples[0], &terrain[0]), clock.before(0));
            }
            let blocks: Vec<BlockOutput<'_>> = samples
                .par_chunks_mut(LANES)
                .zip(caches.par_iter_mut())
                .enumerate()
                .map(|(block, (samples, cache))| {
                    let tokens: Vec<&TerrainToken> = (0..samples.len()).map(|l| &terrain[(block * LANES + l).min(distinct - 1)]).collect();
                    let wheels = self.step_block(&scene, block * LANES, k, samples, cache, &tokens);
                    BlockOutput { samples, cache, wheels }
                })
                .collect();
            let sensors = &self.physics.at(clock.after(k + 1)).vehicle().effects.sensor;
            for (block, output) in blocks.iter().enumerate() {
                let _ = &output.cache;
                for (lane, sample) in output.samples.iter().enumerate() {
                    let row = (block * LANES + lane) * query.horizon + k;
                    for (out, value) in rollout.states[row * STATE_DIM..].iter_mut().zip(reported(sensors, &sample.state).to_array()) {
                        *out = value as f32;
                    }
                    rollout.sinkage_m[row * WHEELS..(row + 1) * WHEELS].copy_from_slice(&output.wheels[lane].sinkage_m);
                    if let Some(risk) = &mut risk {
                        risk.put(row, &output.wheels[lane].risk);
                    }
                }
            }
        }
        rollout.flags = samples.iter().map(|s| s.flags).collect();
        Ok((rollout, risk))
    }

    /// Form that a query asks for.
    fn form_of(&self, query: &RolloutQuery<'_>) -> Variant {
        if query.variant == Variant::Full { self.bundle.form } else { query.variant }
    }

    /// The physics with the bundle's vehicle, all of its effects begun.
    pub fn step_model(&self) -> &StepModel {
        self.physics.last()
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

    /// Encodes the measured history for a form that remembers it.
    fn prefix(
        &self,
        variant: Variant,
        history: &[HistoryStep],
        ground: &GroundSource<'_>,
        tokens: Option<&TerrainTokens>,
        clock: LogClock,
    ) -> Prefix {
        if !variant.remembers() {
            return Prefix::default();
        }
        let poses: Vec<Pose2> = history.iter().map(|step| pose(&step.state)).collect();
        let terrain = self.terrain(tokens, &poses);
        let entries: Vec<[f32; STATE_CONTROL]> = history
            .iter()
            .enumerate()
            .map(|(j, step)| {
                let previous = j.checked_sub(1).map(|j| history[j].state);
                let model = self.physics.at(clock.before(history.len() - j));
                self.entries(model, &step.state, previous.as_ref(), &step.control, ground)
            })
            .collect();
        let contexts: Vec<[f32; HIDDEN]> = terrain.iter().map(|t| core::array::from_fn(|i| t[i])).collect();
        self.network.prefix(&entries, &contexts)
    }

    fn entries(
        &self,
        model: &StepModel,
        state: &VehicleState<f64>,
        previous: Option<&VehicleState<f64>>,
        control: &Control<f64>,
        ground: &GroundSource<'_>,
    ) -> [f32; STATE_CONTROL] {
        let (height, _, _) = ground.at(&model.vehicle().effects.map, state.position_m[0], state.position_m[1]);
        let raw = token_entries(state, previous, [control.speed_m_s, control.second], height, self.bundle.normalization.dt_s);
        self.token_scale.apply(raw)
    }

    /// Advances up to sixteen samples by one step; returns what their wheels did.
    fn step_block(
        &self,
        scene: &Scene<'_>,
        first: usize,
        k: usize,
        samples: &mut [Sample],
        cache: &mut BlockCache,
        terrain: &[&TerrainToken],
    ) -> Vec<StepRow> {
        let scales = &self.bundle.normalization;
        let query = scene.query;
        let time_s = scene.clock.after(k);
        let model = self.physics.at(time_s);
        let last = samples.len() - 1;
        let controls: Vec<Control<f64>> = (0..samples.len()).map(|l| scene.control(first + l, k)).collect();
        let entries: Vec<[f32; STATE_CONTROL]> = samples
            .iter()
            .zip(&controls)
            .map(|(s, control)| self.entries(model, &s.state, s.previous.as_ref(), control, &scene.ground))
            .collect();
        let entry_lanes: [Lane; STATE_CONTROL] = core::array::from_fn(|i| core::array::from_fn(|l| entries[l.min(last)][i]));
        let context: [Lane; HIDDEN] = core::array::from_fn(|i| core::array::from_fn(|l| terrain[l.min(last)][i]));
        let (raw_sinkage, raw_residual) = self.network.step(&scene.prefix, cache, &entry_lanes, &context);

        let rows: Vec<(DrivelineState, [f32; DIFFERENTIABLE], [f32; CONSTANT], bool)> = samples
            .iter()
            .zip(&controls)
            .enumerate()
            .map(|(l, (sample, control))| {
                let after = sample.actuators.advance(model.vehicle(), control, sample.state.velocity_m_s[0], model.dt_s());
                let wheels = match query.wheels {
                    Some(measured) => measured_wheels(model.vehicle(), &measured[k].speed_rad_s, &measured[k].angle_rad),
                    None => command_wheels(model.vehicle(), &sample.actuators, &after, control),
                };
                let (ground, known) = scene.ground.under_wheels(model, &sample.state, scene.datum_m);
                let soil = self.soil_at(under(scene.soil, first + l, sample, terrain[l]), time_s);
                let ratio: [f32; WHEELS] = core::array::from_fn(|i| match scene.variant {
                    Variant::ZeroSinkage => NO_SINKAGE,
                    _ => scales.sinkage_log_ratio_max * raw_sinkage[i][l].tanh(),
                });
                (
                    after,
                    varying_row(&sample.state, scene.datum_m, &ratio, &soil),
                    pack_constants(&wheels, &ground, sample.state.attitude_rad[2]),
                    known,
                )
            })
            .collect();

        let mut wheels = vec![StepRow::default(); samples.len()];
        for half in (0..samples.len()).step_by(8) {
            let at = |l: usize| (half + l).min(last);
            let varying = core::array::from_fn(|c| f32x8::from(core::array::from_fn::<f32, 8, _>(|l| rows[at(l)].1[c])));
            let constant = core::array::from_fn(|c| f32x8::from(core::array::from_fn::<f32, 8, _>(|l| rows[at(l)].2[c])));
            let input = step_input(varying, constant);
            let output = symbolic_step(scene.variant, model, &input);
            let increment = output.increment.to_array().map(f32x8::to_array);
            let sinkages = output.contacts.map(|contact| contact.sinkage_m.to_array());
            let risks = scene.risk.then(|| risk::of_lanes(model, &input, &output.contacts));
            for l in 0..8.min(samples.len() - half) {
                let lane = half + l;
                let total: [f64; STATE_DIM] = core::array::from_fn(|i| {
                    let residual = match scene.variant {
                        Variant::NoResidual => 0.0,
                        _ => raw_residual[i][lane] * scales.residual_scale[i],
                    };
                    f64::from(increment[i][l] + residual)
                });
                wheels[lane].sinkage_m = core::array::from_fn(|w| sinkages[w][l]);
                wheels[lane].risk = risks.map_or_else(RiskRow::default, |risks| risks[l]);
                let (after, _, _, known) = rows[lane];
                self.advance(&mut samples[lane], &total, after, known, &controls[lane]);
            }
        }
        wheels
    }

    /// x' = x + Δx, actuators and flags.
    fn advance(&self, sample: &mut Sample, increment: &[f64; STATE_DIM], actuators: DrivelineState, known: bool, control: &Control<f64>) {
        let scales = &self.bundle.normalization;
        let before = sample.state;
        let mut next = before.advanced(increment);
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

/// The physics of a bundle in each phase between the onsets of its effects.
fn phases(bundle: &ModelBundle) -> Phases<StepModel> {
    let scales = &bundle.normalization;
    Phases::new(&bundle.vehicle, &bundle.effects, |vehicle| StepModel::new(vehicle, scales.dt_s, scales.substeps))
}

fn sensors_err(model: &StepModel) -> bool {
    model.vehicle().effects.sensor.alters_states()
}

fn pose(state: &VehicleState<f64>) -> Pose2 {
    Pose2 { x_m: state.position_m[0], y_m: state.position_m[1], yaw_rad: state.attitude_rad[2] }
}

/// Soil under a sample.
fn under(field: &dyn SoilField, sample: usize, at: &Sample, token: &TerrainToken) -> [f64; SOIL_DIM] {
    field.soil(sample, [at.state.position_m[0], at.state.position_m[1]], &from_raw(&raw_soil(token)))
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
