//! The predictor: a bundle ready to answer rollouts (paper Eq. 1 and 2, applied K times).

use std::sync::{Arc, Mutex, MutexGuard};

use nesam_physics::driveline::DrivelineState;
use nesam_physics::effects::{Phases, ScheduledEffect};
use nesam_physics::step::StepModel;
use nesam_physics::{Control, Ride, SOIL_DIM, STATE_DIM, VehicleState, wrap_angle};
use nesam_terrain::{Pose2, WorldMap};

use crate::ModelError;
use crate::bundle::ModelBundle;
use crate::dims::{CONTEXT, HIDDEN, STATE_CONTROL};
use crate::encoder::TerrainEncoders;
use crate::fused::{FusedTransformer, Path, Prefix};
use crate::ground::GroundSource;
use crate::precision::Precision;
use crate::rollout::{HistoryStep, Rollout, RolloutExtras, RolloutQuery, Variant, flag};
use crate::soil_coordinates::from_raw;
use crate::soil_field::SoilField;
use crate::soil_prior::SoilPrior;
use crate::terrain_tokens::{CacheCounts, TerrainProjection, TerrainToken, TerrainTokens, TokensOfMaps, VALUES};
use crate::token::{TokenScale, token_entries};

mod block;
mod linearise;
mod observed;
mod parts;
mod physics;
mod risk;
mod rollout;
mod transitions;
mod validate;

pub(crate) use self::observed::LogClock;
pub use self::parts::PartTimes;
use self::rollout::BlockCaches;
pub use self::transitions::Transition;
pub(crate) use self::validate::validate;

/// Sinkage log-ratio that suppresses the sinkage (ablation "Sinkage = 0").
pub(crate) const NO_SINKAGE: f32 = -12.0;
/// |roll| or |pitch| beyond which a vehicle counts as overturned, rad.
const OVERTURNED_RAD: f64 = 60.0 * core::f64::consts::PI / 180.0;
/// Speed beyond the trained commands that counts as trained, as a share of the fastest of them: vehicles overshoot and roll downhill (chosen).
const OVERSHOOT: f64 = 0.25;
/// Height above or below the ground of a map at which a start cannot be meant, m: more than springs and sinkage take up (chosen).
const OFF_GROUND_M: f64 = 0.5;

/// How terrain tokens are obtained.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TerrainMode {
    /// Interpolated on a pose grid that is cached per map.
    Grid,
    /// Encoded at every pose: slow, for checking the grid.
    Exact,
}

/// A loaded bundle that answers rollout queries. `Send + Sync`; a clone shares all that is large.
#[derive(Clone, Debug)]
pub struct Predictor {
    bundle: Arc<ModelBundle>,
    physics: Phases<StepModel>,
    /// Some effect makes measured states differ from true ones.
    sensors_err: bool,
    network: Arc<FusedTransformer>,
    /// The same as rollouts use it: its steps may be in bf16. The history and what the soil filter asks are not.
    rolled: Arc<FusedTransformer>,
    projection: Arc<TerrainProjection>,
    token_scale: TokenScale,
    mode: TerrainMode,
    maps: Arc<Mutex<TokensOfMaps>>,
    caches: Arc<BlockCaches>,
}

/// One candidate while it is rolled out.
#[derive(Clone, Copy, Debug)]
struct Sample {
    state: VehicleState<f64>,
    previous: Option<VehicleState<f64>>,
    actuators: DrivelineState,
    flags: u32,
}

impl Predictor {
    /// Prepares the bundle for inference.
    ///
    /// # Errors
    /// `ModelError::Weights` naming an array that is missing or has another shape, `ModelError::Bundle` naming effects that the vehicle cannot have.
    pub fn new(bundle: Arc<ModelBundle>) -> Result<Self, ModelError> {
        bundle.check_effects(std::path::Path::new(""))?;
        let (weights, scales) = (&bundle.weights, &bundle.normalization);
        let projection = TerrainProjection::new(
            TerrainEncoders::new(weights)?,
            weights.get("token.context.weight", &[HIDDEN, CONTEXT])?,
            SoilPrior::new(weights)?,
            scales.patch_scale(),
        );
        let physics = phases(&bundle);
        let network = Arc::new(FusedTransformer::new(weights)?);
        Ok(Self {
            sensors_err: physics.any(sensors_err),
            physics,
            rolled: network.clone(),
            network,
            projection: Arc::new(projection),
            token_scale: scales.token_scale(),
            mode: TerrainMode::Grid,
            maps: Arc::default(),
            caches: Arc::default(),
            bundle,
        })
    }

    /// The same predictor on other instructions, with caches of its own: for measuring, and for holding one path against another.
    pub fn on_path(&self, path: Path) -> Self {
        Self {
            network: Arc::new(self.network.on(path)),
            rolled: Arc::new(self.rolled.on(path)),
            projection: Arc::new(self.projection.on(path)),
            maps: Arc::default(),
            ..self.clone()
        }
    }

    /// The same predictor with the terrain encoded at every pose: what interpolation on the pose grid is held against.
    pub fn exactly(&self) -> Self {
        Self { mode: TerrainMode::Exact, ..self.clone() }
    }

    /// The same predictor with the network in this precision in rollouts, on the fastest instructions of this processor for it.
    pub fn in_precision(&self, precision: Precision) -> Self {
        Self { rolled: Arc::new(self.network.in_precision(precision)), ..self.clone() }
    }

    /// What the network's products are rounded to in rollouts.
    pub fn precision(&self) -> Precision {
        self.rolled.precision()
    }

    /// Instructions that rollouts run on.
    pub fn path(&self) -> Path {
        self.rolled.path()
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
            rolled: self.rolled.clone(),
            projection: self.projection.clone(),
            token_scale: scales.token_scale(),
            mode: self.mode,
            maps: self.maps.clone(),
            caches: self.caches.clone(),
            bundle,
        }
    }

    /// The same predictor whose network sees the vehicle without this much of its ride: what effects that are not the bundle's would make of it.
    pub fn asked_without(&self, ride_shift: &Ride) -> Self {
        let mut asked = self.clone();
        asked.token_scale.mean.iter_mut().zip(ride_shift).for_each(|(mean, shift)| *mean += *shift as f32);
        asked
    }

    /// The same predictor with changed weights of the residual head: what a refit of the learned residual on few drives can change. `weight` is added to
    /// the weights (12, 128), `bias` to the biases (12). The bundle's hash stays that of the files it was read from.
    ///
    /// # Errors
    /// `ModelError::Weights` when the bundle has no such head or the changes have another length.
    pub fn with_residual_head(&self, weight: &[f32], bias: &[f32]) -> Result<Self, ModelError> {
        let mut bundle = (*self.bundle).clone();
        for (name, change) in [("residual.weight", weight), ("residual.bias", bias)] {
            let fail = |reason: &str| ModelError::Weights { name: name.into(), reason: reason.into() };
            let own = bundle.weights.values_mut(name).ok_or_else(|| fail("is missing"))?;
            if own.len() != change.len() {
                return Err(fail("is changed by another number of values than it has"));
            }
            own.iter_mut().zip(change).for_each(|(own, change)| *own += change);
        }
        let network = Arc::new(FusedTransformer::new(&bundle.weights)?.on(self.network.path()));
        let rolled = Arc::new(network.in_precision(self.precision()).on(self.path()));
        Ok(Self { network, rolled, bundle: Arc::new(bundle), ..self.clone() })
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

    /// The same on a soil that may differ from place to place and from sample to sample, with positions that are not rounded ([`Rollout::position_m`]); the
    /// correction of the query stands aside.
    ///
    /// # Errors
    /// As [`Predictor::rollout`].
    pub fn rollout_on(&self, query: &RolloutQuery<'_>, soil: &dyn SoilField) -> Result<Rollout, ModelError> {
        self.rollout_with(query, &RolloutExtras { field: Some(soil), unrounded: true, ..Default::default() }).map(|(rollout, _)| rollout)
    }

    /// How far the first candidate of an answer lies from the same candidate with the terrain encoded at every pose: horizontal distance, mean over the
    /// horizon, m. `answered` is what this predictor made of the query, whose first candidate is its first row, with positions that are not rounded
    /// ([`RolloutExtras::unrounded`]): at UTM coordinates the rounded ones lie further apart than any interpolation moves them.
    ///
    /// # Errors
    /// As [`Predictor::rollout`].
    pub fn interpolation_deviation_m(
        &self,
        query: &RolloutQuery<'_>,
        extras: &RolloutExtras<'_>,
        answered: &Rollout,
    ) -> Result<f64, ModelError> {
        let first = RolloutQuery { samples: 1, controls: &query.controls[..2 * query.horizon], ..query.clone() };
        let extras = RolloutExtras { soils: &extras.soils[..extras.soils.len().min(1)], risk: false, unrounded: true, ..*extras };
        let (exact, _) = self.exactly().rollout_with(&first, &extras)?;
        let apart_m = |k: usize| {
            let [a, b] = [answered, &exact].map(|rollout| rollout.state_f64(0, k).position_m);
            (a[0] - b[0]).hypot(a[1] - b[1])
        };
        Ok((0..query.horizon).map(apart_m).sum::<f64>() / query.horizon as f64)
    }

    /// Form that a query asks for.
    pub(crate) fn form_of(&self, query: &RolloutQuery<'_>) -> Variant {
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

    /// The same where it costs a lookup: `None` where the terrain has not been encoded yet. It encodes nothing, makes no cache and counts as no lookup, so
    /// an onlooker can ask while others predict.
    pub fn known_soil_prior(&self, map: Option<&Arc<WorldMap>>, pose: Pose2) -> Option<[f64; SOIL_DIM]> {
        let Some(map) = map.filter(|map| map.has_semantics()) else {
            return Some(self.bundle.default_soil());
        };
        self.held_tokens(map)?.known(&pose).map(|token| from_raw(&raw_soil(&token)))
    }

    /// Context token W_c c (128) and raw soil (6) at each pose: what the network sees of the terrain there.
    pub fn terrain_tokens(&self, map: Option<&Arc<WorldMap>>, poses: &[Pose2]) -> Vec<TerrainToken> {
        let tokens = map.map(|map| self.tokens_of(map));
        self.terrain(tokens.as_deref(), poses)
    }

    /// Keeps the encoded terrain of so many maps, and of no fewer than before.
    pub fn keep_maps(&self, maps: usize) {
        self.maps().keep(maps);
    }

    /// What was asked of the terrain cache of a map so far; nothing when there is none.
    pub fn terrain_cache(&self, map: &Arc<WorldMap>) -> CacheCounts {
        self.held_tokens(map).map_or_else(CacheCounts::default, |tokens| tokens.counts())
    }

    /// The cache of a map, if somebody has asked for it.
    fn held_tokens(&self, map: &WorldMap) -> Option<Arc<TerrainTokens>> {
        self.maps().get(map).cloned()
    }

    /// The cache of a map, made on first use.
    fn tokens_of(&self, map: &Arc<WorldMap>) -> Arc<TerrainTokens> {
        self.maps().used(map)
    }

    fn maps(&self) -> MutexGuard<'_, TokensOfMaps> {
        self.maps.lock().expect("no holder panics; this is a bug")
    }

    /// Terrain tokens at poses; where there is no map or no semantics, what stands in for them.
    fn terrain(&self, tokens: Option<&TerrainTokens>, poses: &[Pose2]) -> Vec<TerrainToken> {
        let mut terrain = match (tokens, self.mode) {
            (None, _) => vec![[0.0; VALUES]; poses.len()],
            (Some(tokens), TerrainMode::Grid) => tokens.at(&self.projection, poses),
            (Some(tokens), TerrainMode::Exact) => self.projection.exact(tokens.map(), poses),
        };
        self.stand_in(tokens, &mut terrain);
        terrain
    }

    /// Puts what stands in for unseen ground into tokens of a map without semantics, or of none.
    fn stand_in(&self, tokens: Option<&TerrainTokens>, terrain: &mut [TerrainToken]) {
        if tokens.is_some_and(|t| t.map().has_semantics()) {
            return;
        }
        let scales = &self.bundle.normalization;
        let unseen = scales.stand_in.as_ref().map(|s| if tokens.is_some() { &s.colours } else { &s.ground });
        for token in terrain {
            if let Some(unseen) = unseen {
                token[..HIDDEN].iter_mut().zip(unseen).for_each(|(value, unseen)| *value += unseen);
            }
            token[HIDDEN..].copy_from_slice(scales.unseen_soil_raw());
        }
    }

    /// By how much soils differ for which one stands in on a map, as [`crate::StandIn::soil_sd`]; `None` where colours show what soil is where, and for bundles
    /// that do not say.
    pub fn unseen_soil_sd(&self, map: &WorldMap) -> Option<&[f64; SOIL_DIM]> {
        let stand_in = self.bundle.normalization.stand_in.as_ref();
        stand_in.filter(|_| !map.has_semantics()).map(|stand_in| &stand_in.soil_sd)
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
        let (known, dt_s) = (model.as_known(state), self.bundle.normalization.dt_s);
        let raw = token_entries(&known, previous, [control.speed_m_s, control.second], height, dt_s);
        self.token_scale.apply(raw)
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
        let driven = driven_m_s(scales.trained_speed_m_s);
        raise(outside(before.velocity_m_s[0], driven) || outside(next[6], driven), flag::SPEED_UNTRAINED);
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

/// Speeds of a vehicle that was told these speeds, beginning and ending at rest, m/s.
fn driven_m_s([slowest, fastest]: [f64; 2]) -> [f64; 2] {
    let overshoot = OVERSHOOT * slowest.abs().max(fastest.abs());
    [slowest.min(0.0) - overshoot, fastest.max(0.0) + overshoot]
}

/// The physics of a bundle in each phase between the onsets of its effects.
fn phases(bundle: &ModelBundle) -> Phases<StepModel> {
    let scales = &bundle.normalization;
    let usual = || bundle.usual_ride();
    Phases::new(&bundle.vehicle, &bundle.effects, |vehicle| StepModel::new(vehicle, scales.dt_s, scales.substeps).riding_as(usual))
}

fn sensors_err(model: &StepModel) -> bool {
    model.vehicle().effects.sensor.alters_states()
}

pub(crate) fn pose(state: &VehicleState<f64>) -> Pose2 {
    Pose2 { x_m: state.position_m[0], y_m: state.position_m[1], yaw_rad: state.attitude_rad[2] }
}

/// Soil under a sample.
fn under(field: &dyn SoilField, sample: usize, at: &Sample, token: &TerrainToken) -> [f64; SOIL_DIM] {
    field.soil(sample, [at.state.position_m[0], at.state.position_m[1]], &from_raw(&raw_soil(token)))
}

fn raw_soil(token: &TerrainToken) -> [f32; SOIL_DIM] {
    core::array::from_fn(|i| token[HIDDEN + i])
}

pub(crate) fn control(query: &RolloutQuery<'_>, sample: usize, k: usize) -> Control<f64> {
    let at = (sample * query.horizon + k) * 2;
    Control { speed_m_s: f64::from(query.controls[at]), second: f64::from(query.controls[at + 1]) }
}
