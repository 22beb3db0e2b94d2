//! A rollout in f64 with its terrain held, and its derivatives.

use std::sync::Arc;

use nesam_physics::driveline::{DrivelineState, differentiable_wheels, measured_wheels};
use nesam_physics::effects::Phases;
use nesam_physics::scalar::{Dual, Real};
use nesam_physics::step::{StepInput, StepModel};
use nesam_physics::{Control, SOIL_DIM, STATE_DIM, Soil, SoilCoordinates, VehicleState, WHEELS};
use rayon::prelude::*;

use crate::dims::CONTROL_DIM;
use crate::fused::Prefix;
use crate::interruption::Interruption;
use crate::normalization::Normalization;
use crate::predictor::LogClock;
use crate::rollout::{MeasuredWheels, Variant};
use crate::symbolic::{residual_share, symbolic_step};
use crate::tangent::transformer::{ExactCache, ExactTransformer};
use crate::tangent::{Number, Scenery};
use crate::token::entries_of;

/// Steps whose commands share one pass of tangents.
const STEPS_PER_PASS: usize = 8;
/// Tangents of that pass.
const COMMAND_TANGENTS: usize = STEPS_PER_PASS * CONTROL_DIM;
/// Tangents of start and soil.
const START_TANGENTS: usize = STATE_DIM + SOIL_DIM;

/// What all samples of a query share.
#[derive(Debug)]
pub struct TangentRollout<'a> {
    pub physics: &'a Phases<StepModel>,
    pub clock: LogClock,
    pub network: ExactTransformer<'a>,
    pub scales: &'a Normalization,
    pub variant: Variant,
    pub prefix: Prefix,
    pub coordinates: SoilCoordinates,
    pub wheels: Option<&'a [MeasuredWheels]>,
    pub interruption: Interruption<'a>,
    /// Last measured state before the start.
    pub previous: Option<VehicleState<f64>>,
    /// Actuators after the history; `None` without a history, where they begin as start and first command say.
    pub actuators: Option<DrivelineState>,
    /// Share of a lasting resistance that the history has told of.
    pub observed_share: f64,
}

/// What moves from step to step.
#[derive(Clone, Copy, Debug)]
pub struct Motion<T> {
    pub state: VehicleState<T>,
    previous: Option<VehicleState<T>>,
    actuators: DrivelineState<T>,
}

impl Motion<f64> {
    fn constant<T: Number>(&self) -> Motion<T> {
        Motion {
            state: self.state.map(T::lit),
            previous: self.previous.map(|state| state.map(T::lit)),
            actuators: self.actuators.map(T::lit),
        }
    }
}

impl TangentRollout<'_> {
    /// Where a rollout from a measured state begins.
    pub fn initial<T: Number>(&self, start: &VehicleState<T>, first: &Control<T>) -> Motion<T> {
        let vehicle = self.physics.at(self.clock.start_s).vehicle();
        let start = vehicle.effects.sensor.to_true(start);
        let actuators = match &self.actuators {
            Some(settled) => settled.map(T::lit),
            None => DrivelineState::starting(vehicle, &start, first),
        };
        Motion { state: start, previous: self.previous.map(|state| state.map(T::lit)), actuators }
    }

    /// The same where the speed control has also made up for what the soil is beyond the nominal one under the start.
    fn on_soil<T: Number>(&self, motion: Motion<T>, delta: &[T; SOIL_DIM], under_start: &Scenery) -> Motion<T> {
        let model = self.physics.at(self.clock.start_s);
        let drift = &model.vehicle().effects.soil;
        let nominal = Soil::from_array(drift.drifted(under_start.prior, self.clock.start_s));
        let soil = Soil::from_array(drift.drifted(self.coordinates.correct(&under_start.prior, delta), self.clock.start_s));
        let made_up_for = model.compaction_made_up_for_m(&nominal, &soil, motion.state.velocity_m_s[0], self.observed_share);
        let mut actuators = motion.actuators;
        actuators.speed_error_integral_m = actuators.speed_error_integral_m + made_up_for;
        Motion { actuators, ..motion }
    }

    /// A true state after `k` steps as the sensors measure it.
    fn reported<T: Number>(&self, k: usize, state: &VehicleState<T>) -> VehicleState<T> {
        let sensors = &self.physics.at(self.clock.after(k)).vehicle().effects.sensor;
        if !sensors.alters_states() {
            return *state;
        }
        let mut measured = sensors.to_measured(state);
        measured.attitude_rad[2] = measured.attitude_rad[2].wrapped();
        measured
    }

    /// Step `k` from a motion: network, physics, x' = x + Δx.
    pub fn step<T: Number>(
        &self,
        k: usize,
        motion: &Motion<T>,
        control: &Control<T>,
        delta: &[T; SOIL_DIM],
        scenery: &Scenery,
        cache: &mut ExactCache<T>,
    ) -> Motion<T> {
        let time_s = self.clock.after(k);
        let model = self.physics.at(time_s);
        let (state, vehicle, scales) = (&motion.state, model.vehicle(), self.scales);
        let height = scenery.reference.height_m(state.position_m[0], state.position_m[1]);
        let known = model.as_known(state);
        let raw = entries_of(&known, motion.previous.as_ref(), [control.speed_m_s, control.second], height, scales.dt_s, T::wrapped);
        let lit = |v: f32| T::lit(f64::from(v));
        let entries = core::array::from_fn(|i| (raw[i] - lit(scales.token_mean[i])) / lit(scales.token_scale[i]));
        let (sinkage, residual) = self.network.step(&self.prefix, cache, &entries, &scenery.token);
        let after = motion.actuators.advance(vehicle, control, state.velocity_m_s[0], model.dt_s());
        let wheels = match self.wheels {
            Some(measured) => measured_wheels(vehicle, &measured[k].speed_rad_s, &measured[k].angle_rad),
            None => differentiable_wheels(vehicle, &motion.actuators, &after, control),
        };
        let ratio = |i: usize| match self.variant {
            Variant::ZeroSinkage => T::lit(f64::from(crate::predictor::NO_SINKAGE)),
            _ => lit(scales.sinkage_log_ratio_max) * sinkage[i].tanh(),
        };
        let input = StepInput {
            state: *state,
            wheels,
            sinkage_log_ratio: core::array::from_fn::<T, WHEELS, _>(ratio),
            soil: Soil::from_array(vehicle.effects.soil.drifted(self.coordinates.correct(&scenery.prior, delta), time_s)),
            ground: scenery.under_wheels(model, state),
        };
        let moved = symbolic_step(self.variant, model, &input).increment.to_array();
        let share = residual_share(self.variant, scales.trained_speed_m_s[0], control.speed_m_s);
        let total: [T; STATE_DIM] = core::array::from_fn(|i| moved[i] + share * (residual[i] * lit(scales.residual_scale[i])));
        let mut next = state.advanced(&total);
        next[5] = next[5].wrapped();
        Motion { state: VehicleState::from_array(next), previous: Some(*state), actuators: after }
    }
}

/// Derivatives of one predicted state, rows in the order of the state, World positions and yaw included.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StateJacobian {
    /// ∂x_k/∂x_0.
    pub start: [[f64; STATE_DIM]; STATE_DIM],
    /// ∂x_k/∂Δθ, in the coordinates of the query's soil correction; zero where the soil is clipped to its bounds.
    pub soil: [[f64; SOIL_DIM]; STATE_DIM],
}

impl StateJacobian {
    const UNKNOWN: Self = Self { start: [[f64::NAN; STATE_DIM]; STATE_DIM], soil: [[f64::NAN; SOIL_DIM]; STATE_DIM] };
}

/// A rollout of one sample in f64 and the function of which it is a value: x_k (x_0, u, Δθ) with the terrain held as the rollout met it.
///
/// Held: context token and soil prior at each predicted pose, as in training, and the ground under reference point and wheels as the plane through
/// it with the slope of the footprint. So the derivatives know that a vehicle further up a slope stands higher, and neither that the slope
/// changes there nor that the ground is another one. The measured history and, after a history, its actuators are held too.
#[derive(Clone, Debug)]
pub struct Linearisation<'a> {
    shared: Arc<TangentRollout<'a>>,
    scenery: Vec<Scenery>,
    controls: Vec<Control<f64>>,
    delta: [f64; SOIL_DIM],
    /// Before each step, and after the last that is finite.
    motions: Vec<Motion<f64>>,
    /// After each step, as measured.
    reported: Vec<VehicleState<f64>>,
    cache: ExactCache<f64>,
    start: VehicleState<f64>,
}

impl<'a> Linearisation<'a> {
    /// Rolls out, asking for the terrain of each step at the state that was reached. Ends early at a state that is not finite, and where it is given up.
    pub(crate) fn roll_out(
        shared: Arc<TangentRollout<'a>>,
        start: &VehicleState<f64>,
        controls: Vec<Control<f64>>,
        delta: [f64; SOIL_DIM],
        mut look: impl FnMut(usize, &VehicleState<f64>) -> Scenery,
    ) -> Self {
        let mut cache = ExactCache::new();
        let mut motions = vec![shared.initial(start, &controls[0])];
        let mut scenery = Vec::with_capacity(controls.len());
        let mut reported = Vec::with_capacity(controls.len());
        for (k, control) in controls.iter().enumerate() {
            let seen = look(k, &motions[k].state);
            if k == 0 {
                motions[0] = shared.on_soil(motions[0], &delta, &seen);
            }
            let motion = motions[k];
            let next = shared.step(k, &motion, control, &delta, &seen, &mut cache);
            if shared.interruption.ends() || !next.state.to_array().iter().all(|v| v.is_finite()) {
                break;
            }
            scenery.push(seen);
            reported.push(shared.reported(k + 1, &next.state));
            motions.push(next);
        }
        Self { shared, scenery, controls, delta, motions, reported, cache, start: *start }
    }

    /// Steps asked for, K.
    pub fn horizon(&self) -> usize {
        self.controls.len()
    }

    /// Predicted states after steps 1…K, fewer when one is not finite.
    pub fn states(&self) -> impl Iterator<Item = &VehicleState<f64>> {
        self.reported.iter()
    }

    /// State that it starts from.
    pub fn start(&self) -> &VehicleState<f64> {
        &self.start
    }

    /// The function itself at another start, other commands (K of them) and another correction, with the same terrain: what finite differences
    /// of the Jacobians are to be taken of.
    pub fn replay(&self, start: &VehicleState<f64>, controls: &[Control<f64>], delta: &[f64; SOIL_DIM]) -> Vec<VehicleState<f64>> {
        let Some(first) = controls.first() else { return Vec::new() };
        self.run(0, self.shared.initial(start, first), &mut ExactCache::new(), |k| controls[k], delta)
    }

    /// States after the steps `from` …, of which the first begins with `motion`.
    fn run<T: Number>(
        &self,
        from: usize,
        mut motion: Motion<T>,
        cache: &mut ExactCache<T>,
        control: impl Fn(usize) -> Control<T>,
        delta: &[T; SOIL_DIM],
    ) -> Vec<VehicleState<T>> {
        if from == 0
            && let Some(under_start) = self.scenery.first()
        {
            motion = self.shared.on_soil(motion, delta, under_start);
        }
        (from..self.scenery.len())
            .take_while(|_| !self.shared.interruption.ends())
            .map(|k| {
                motion = self.shared.step(k, &motion, &control(k), delta, &self.scenery[k], cache);
                self.shared.reported(k + 1, &motion.state)
            })
            .collect()
    }

    /// ∂x_k/∂x_0 and ∂x_k/∂Δθ for k = 1…K, by eighteen tangents in forward mode. NaN after a state that is not finite.
    pub fn by_start_and_soil(&self) -> Vec<StateJacobian> {
        type T = Dual<f64, START_TANGENTS>;
        let x = self.start.to_array();
        let start = VehicleState::from_array(core::array::from_fn(|i| T::variable(x[i], i)));
        let delta = core::array::from_fn(|i| T::variable(self.delta[i], STATE_DIM + i));
        let constant = |k: usize| self.controls[k].map(T::lit);
        let motion = self.shared.initial(&start, &constant(0));
        let states = self.run(0, motion, &mut ExactCache::new(), constant, &delta);
        let of_state = |state: &VehicleState<T>| {
            let rows = state.to_array();
            StateJacobian {
                start: core::array::from_fn(|r| core::array::from_fn(|c| rows[r].eps[c])),
                soil: core::array::from_fn(|r| core::array::from_fn(|c| rows[r].eps[STATE_DIM + c])),
            }
        };
        let mut jacobians: Vec<StateJacobian> = states.iter().map(of_state).collect();
        jacobians.resize(self.horizon(), StateJacobian::UNKNOWN);
        jacobians
    }

    /// ∂x_k/∂u_j, row-major (K, 12, K, 2): zero for j ≥ k. Tangents of eight commands ride together and begin at the first of them.
    pub fn by_controls(&self) -> Vec<f64> {
        type T = Dual<f64, COMMAND_TANGENTS>;
        let (horizon, known) = (self.horizon(), self.scenery.len());
        let width = horizon * CONTROL_DIM;
        let mut jacobian = vec![0.0; horizon * STATE_DIM * width];
        jacobian[known * STATE_DIM * width..].fill(f64::NAN);
        let passes: Vec<(usize, Vec<VehicleState<T>>)> = (0..known)
            .step_by(STEPS_PER_PASS)
            .collect::<Vec<_>>()
            .into_par_iter()
            .map(|from| {
                let control = |k: usize| {
                    let [speed, second] = [self.controls[k].speed_m_s, self.controls[k].second];
                    match CONTROL_DIM * (k - from) {
                        at if at < COMMAND_TANGENTS => Control { speed_m_s: T::variable(speed, at), second: T::variable(second, at + 1) },
                        _ => self.controls[k].map(T::lit),
                    }
                };
                let motion = match from {
                    0 => self.shared.initial(&self.start.map(T::lit), &control(0)),
                    _ => self.motions[from].constant(),
                };
                (from, self.run(from, motion, &mut self.cache.first(from), control, &self.delta.map(T::lit)))
            })
            .collect();
        for (from, states) in passes {
            let columns = COMMAND_TANGENTS.min(width - from * CONTROL_DIM);
            for (k, state) in (from..).zip(&states) {
                for (row, value) in state.to_array().iter().enumerate() {
                    let at = (k * STATE_DIM + row) * width + from * CONTROL_DIM;
                    jacobian[at..at + columns].copy_from_slice(&value.eps[..columns]);
                }
            }
        }
        jacobian
    }
}
