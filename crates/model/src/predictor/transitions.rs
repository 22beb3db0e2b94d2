//! Measured transitions as filter and discovery need them: what the network says, and the input of the physics.

use std::ops::Range;
use std::sync::Arc;

use nesam_physics::driveline::{DrivelineState, command_wheels};
use nesam_physics::step::StepInput;
use nesam_physics::{Control, STATE_DIM, Soil, SoilCorrection, VehicleState};
use nesam_terrain::WorldMap;

use super::{LogClock, Predictor, Sample, pose, raw_soil, under};
use crate::dims::{HIDDEN, STATE_CONTROL};
use crate::fused::{BlockCache, LANES, Lane, Row, Said};
use crate::ground::GroundSource;
use crate::rollout::HistoryStep;
use crate::soil_coordinates::from_raw;
use crate::soil_field::SoilField;
use crate::symbolic::residual_share;
use crate::terrain_tokens::TerrainToken;

/// Distance, m, and commanded speed, m/s, below which a vehicle stands over a buffer or a forecast. Chosen.
const STANDING: [f64; 2] = [0.5, 0.5];
/// Speeds of vehicle and command below which a vehicle is parked, m/s.
const PARKED_M_S: f64 = 0.3;
/// Steps within which a vehicle that was parked counts as setting off: one second.
const SETTING_OFF_STEPS: usize = 10;

/// A measured transition, ready for the physics.
#[derive(Clone, Copy, Debug)]
pub struct Transition {
    /// Input of the step, in f64, with the nominal soil; heights are those of World.
    pub input: StepInput<f64>,
    /// Actuators before and after the step: what an effect in the actuator layer starts from.
    pub actuators: [DrivelineState; 2],
    /// Share of a lasting resistance that the actuators were observed to make up for ([`nesam_physics::step::StepModel::observed_share`]), on the nominal soil; 0 in a
    /// transition on its own, as Algorithm 1 to the letter takes it.
    pub observed_share: f64,
    /// Command of the step.
    pub control: Control<f64>,
    /// Learned state residual Δx_res: displacement in the heading frame (m), attitude (rad), velocities in Body.
    pub residual: [f64; STATE_DIM],
    /// Last hidden layer of the network, of which the residual is a linear function.
    pub hidden: [f32; HIDDEN],
    /// False when a wheel stands off the map.
    pub ground_known: bool,
}

impl Predictor {
    /// One measured transition (x_k, u_k) as filter and discovery need it: what the network says there, and the input of the physics with the
    /// nominal soil θ̄. Nothing of it depends on the soil correction, so ∂ŷ/∂Δθ flows through the physics alone (paper Alg. 1).
    ///
    /// `history` are the measured steps before x_k, as in [`crate::RolloutQuery`].
    pub fn transition(
        &self,
        history: &[HistoryStep],
        state: &VehicleState<f64>,
        control: &Control<f64>,
        map: Option<&Arc<WorldMap>>,
    ) -> Transition {
        let one = self.transitions_along(history, state, std::slice::from_ref(control), map, &SoilCorrection::NONE);
        one.into_iter().next().expect("one command makes one transition; this is a bug")
    }

    /// The transitions of one rollout from a measured state under the commands that followed on a given soil: network and ground at the *predicted* states, as a
    /// prediction meets them. A filter that learns from them sees the errors that predictions have, not those of single steps. History and start are
    /// measured, the states of the transitions true ([`Predictor::true_state`]); every effect has begun.
    pub fn transitions_along(
        &self,
        history: &[HistoryStep],
        start: &VehicleState<f64>,
        controls: &[Control<f64>],
        map: Option<&Arc<WorldMap>>,
        soil: &dyn SoilField,
    ) -> Vec<Transition> {
        let clock = LogClock::late(self.bundle.normalization.dt_s);
        let (history, start) = self.true_motion(history, start, clock);
        let history = history.as_ref();
        let tokens = map.map(|map| self.tokens_of(map));
        let ground = GroundSource::new(map.map(Arc::as_ref), self.step_model(), &start);
        let prefix = self.prefix(self.bundle.form, history, &ground, tokens.as_deref(), clock);
        let mut cache = BlockCache::new(controls.len(), self.bundle.form.remembers());
        let Some(first) = controls.first() else { return Vec::new() };
        let mut sample = Sample {
            state: start,
            previous: history.last().map(|step| step.state),
            actuators: self.actuators(history, &start, first, clock),
            flags: 0,
        };
        let observed_share = self.observed_share(history, clock);
        let mut made_up_for_m_s = None;
        let mut transitions = Vec::with_capacity(controls.len());
        for control in controls {
            let token = self.terrain(tokens.as_deref(), &[pose(&sample.state)])[0];
            let entries = self.entries(self.step_model(), &sample.state, sample.previous.as_ref(), control, &ground);
            let lanes: [Row<1>; STATE_CONTROL] = entries.map(|entry| [Lane([entry; LANES])]);
            let context: [Row<1>; HIDDEN] = core::array::from_fn(|i| [Lane([token[i]; LANES])]);
            let said = self.network.step(&prefix, &mut cache, &lanes, &context);
            let seen = self.transition_from(&sample, control, &ground, &token, &said);
            let transition = Transition { hidden: cache.hidden(0), observed_share, ..seen };
            transitions.push(transition);
            if transitions.len() == controls.len() {
                break; // nothing starts from the end of the last one
            }
            let soil = self.soil_at(under(soil, 0, &sample, &token), None);
            let mut input = StepInput { soil: Soil::from_array(soil), ..transition.input };
            let made_up_for_m_s = *made_up_for_m_s.get_or_insert_with(|| {
                let integral_m = self.made_up_for_m(&transition.input.soil, &input.soil, &sample.state, observed_share, clock);
                integral_m * self.step_model().vehicle().driveline.speed_integral_gain_per_s
            });
            input.wheels = input.wheels.demanding_more(made_up_for_m_s);
            let moved = self.step_model().step(&input).increment.to_array();
            let total = core::array::from_fn(|i| moved[i] + transition.residual[i]);
            self.advance(&mut sample, &total, transition.actuators[1], transition.ground_known, control);
        }
        transitions
    }

    /// Whether a vehicle stands over these steps and is told to: nothing moves, so nothing is told of soil or of the model's errors. One that is told to drive and does not is
    /// no such case.
    pub fn stands(steps: &[HistoryStep]) -> bool {
        let [first, .., last] = steps else { return false };
        let ([x0, y0, _], [x1, y1, _]) = (first.state.position_m, last.state.position_m);
        let told = steps[..steps.len() - 1].iter().fold(0.0, |most: f64, step| most.max(step.control.speed_m_s.abs()));
        (x1 - x0).hypot(y1 - y0) < STANDING[0] && told < STANDING[1]
    }

    /// Whether a car under torque sets off in `newest`: it was parked within the second before, or these steps begin with it at rest, and it is slower than any speed
    /// at which its card knows the engine. How hard it pulls there is a guess, whose error would be taken for soil. One that is stuck for longer is no such case.
    pub fn sets_off(&self, before: &[HistoryStep], newest: &HistoryStep) -> bool {
        let Some(torque) = &self.step_model().vehicle().driveline.torque else { return false };
        let speed = |step: &HistoryStep| step.state.velocity_m_s[0].abs();
        let parked = |step: &HistoryStep| speed(step) < PARKED_M_S && step.control.speed_m_s.abs() < PARKED_M_S;
        if speed(newest) >= torque.curve_speed_m_s[0] || parked(newest) {
            return false;
        }
        let recent = &before[before.len().saturating_sub(SETTING_OFF_STEPS)..];
        let begins_at_rest = before.len() < SETTING_OFF_STEPS && speed(before.first().unwrap_or(newest)) < PARKED_M_S;
        begins_at_rest || recent.iter().any(parked)
    }

    /// The transitions that start at `steps[range]`, as the soil filter takes them into one buffer: along one rollout on the soil `along`, or each
    /// from its own measured state. `None` when a wheel stands off the map, where the slope of the ground is a guess.
    pub fn measured_transitions(
        &self,
        steps: &[HistoryStep],
        range: Range<usize>,
        along: Option<&dyn SoilField>,
        map: &Arc<WorldMap>,
    ) -> Option<Vec<Transition>> {
        let transitions: Vec<Transition> = match along {
            None => range.map(|k| self.transition(&steps[..k], &steps[k].state, &steps[k].control, Some(map))).collect(),
            Some(soil) => {
                let controls: Vec<Control<f64>> = steps[range.clone()].iter().map(|step| step.control).collect();
                self.transitions_along(&steps[..range.start], &steps[range.start].state, &controls, Some(map), soil)
            }
        };
        transitions.iter().all(|t| t.ground_known).then_some(transitions)
    }

    /// How far a prediction from `steps[start]` on a given soil, under the commands measured since, lies from what was measured then: measured minus predicted (x, y, z),
    /// x and y in the heading frame of the predicted state, m, after each of `ahead` steps (ascending). History and start are those before and at `start`. `None` where the
    /// steps do not reach so far, or a wheel of the prediction stands off the map.
    pub fn forecast_errors<const N: usize>(
        &self,
        steps: &[HistoryStep],
        start: usize,
        ahead: [usize; N],
        soil: &dyn SoilField,
        map: &Arc<WorldMap>,
    ) -> Option<[[f64; 3]; N]> {
        let last = start + ahead.last()?;
        if last >= steps.len() {
            return None;
        }
        let predicted = self.measured_transitions(steps, start..last + 1, Some(soil), map)?;
        Some(ahead.map(|k| {
            let at = &predicted[k].input.state;
            let measured = self.true_state(&steps[start + k].state);
            let [dx, dy, dz] = core::array::from_fn(|i| measured.position_m[i] - at.position_m[i]);
            let (sin, cos) = at.attitude_rad[2].sin_cos();
            [cos * dx + sin * dy, cos * dy - sin * dx, dz]
        }))
    }

    /// A transition from what the network said of it.
    fn transition_from(
        &self,
        sample: &Sample,
        control: &Control<f64>,
        ground: &GroundSource<'_>,
        token: &TerrainToken,
        said: &Said<1>,
    ) -> Transition {
        let (scales, model) = (&self.bundle.normalization, self.step_model());
        let after = sample.actuators.advance(model.vehicle(), control, sample.state.velocity_m_s[0], model.dt_s());
        let (under_wheels, known) = ground.under_wheels(model, &sample.state, 0.0);
        let ratio = |i: usize| f64::from(scales.sinkage_log_ratio_max * said.sinkage[i][0][0]);
        let share = residual_share(self.bundle.form, scales.trained_speed_m_s[0], control.speed_m_s);
        Transition {
            input: StepInput {
                state: sample.state,
                wheels: command_wheels(model.vehicle(), &sample.actuators, &after, control),
                sinkage_log_ratio: core::array::from_fn(ratio),
                soil: Soil::from_array(self.soil_at(from_raw(&raw_soil(token)), None)),
                ground: under_wheels,
            },
            actuators: [sample.actuators, after],
            observed_share: 0.0,
            control: *control,
            residual: core::array::from_fn(|i| share * f64::from(said.residual[i][0][0] * scales.residual_scale[i])),
            hidden: [0.0; HIDDEN],
            ground_known: known,
        }
    }
}

#[cfg(test)]
mod tests {
    use nesam_physics::{Control, VehicleState};

    use super::*;

    /// Eleven steps at this speed, m/s, told this speed.
    fn steps(speed_m_s: f64, told_m_s: f64) -> Vec<HistoryStep> {
        let at = |k: usize| VehicleState { position_m: [0.1 * speed_m_s * k as f64, 0.0, 0.0], ..VehicleState::zero() };
        (0..11).map(|k| HistoryStep { state: at(k), control: Control { speed_m_s: told_m_s, second: 0.0 } }).collect()
    }

    #[test]
    fn analytic_who_is_told_to_drive_does_not_stand() {
        assert!(Predictor::stands(&steps(0.0, 0.0)) && Predictor::stands(&steps(0.1, 0.0)));
        assert!(!Predictor::stands(&steps(0.0, 2.0)), "stuck");
        assert!(!Predictor::stands(&steps(1.0, 0.0)), "rolling");
        assert!(!Predictor::stands(&steps(0.0, 0.0)[..1]), "no way");
    }
}
