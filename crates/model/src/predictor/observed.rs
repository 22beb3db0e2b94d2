//! From measured states to true ones and back, and the clock of a log: what effects with sensors and onsets ask of a prediction.

use std::borrow::Cow;

use nesam_physics::driveline::DrivelineState;
use nesam_physics::effects::SensorTerms;
use nesam_physics::{Control, SOIL_DIM, Soil, VehicleState, wrap_angle};

use super::Predictor;
use crate::ground::actuators_along;
use crate::rollout::{HistoryStep, remembered};

/// When the steps around the start of a prediction begin.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LogClock {
    /// Time of the start, s since the start of the log; `None` = after every onset.
    pub(crate) start_s: Option<f64>,
    /// Step of the log, s.
    pub(crate) dt_s: f64,
}

impl LogClock {
    /// After every onset.
    pub(crate) fn late(dt_s: f64) -> Self {
        Self { start_s: None, dt_s }
    }

    /// The instant so many steps after the start.
    pub(crate) fn after(self, steps: usize) -> Option<f64> {
        self.start_s.map(|start| start + steps as f64 * self.dt_s)
    }

    /// The instant so many steps before the start.
    pub(crate) fn before(self, steps: usize) -> Option<f64> {
        self.start_s.map(|start| start - steps as f64 * self.dt_s)
    }
}

/// A true state as the sensors measure it, yaw in (-pi, pi]; bit for bit as it is where no effect is on the sensors.
pub(super) fn reported(sensors: &SensorTerms, state: &VehicleState<f64>) -> VehicleState<f64> {
    if !sensors.alters_states() {
        return *state;
    }
    let mut measured = sensors.to_measured(state);
    measured.attitude_rad[2] = wrap_angle(measured.attitude_rad[2]);
    measured
}

impl Predictor {
    /// The true state behind a measured one, every effect on the sensors begun; as it is without such effects.
    pub fn true_state(&self, measured: &VehicleState<f64>) -> VehicleState<f64> {
        self.step_model().vehicle().effects.sensor.to_true(measured)
    }

    /// The last steps of a measured history and the start as true motion.
    pub(super) fn true_motion<'h>(
        &self,
        history: &'h [HistoryStep],
        start: &VehicleState<f64>,
        clock: LogClock,
    ) -> (Cow<'h, [HistoryStep]>, VehicleState<f64>) {
        let history = remembered(history);
        if !self.sensors_err {
            return (Cow::Borrowed(history), *start);
        }
        let truth = |steps: usize, state: &VehicleState<f64>| self.physics.at(clock.before(steps)).vehicle().effects.sensor.to_true(state);
        let step = |(j, step): (usize, &HistoryStep)| HistoryStep { state: truth(history.len() - j, &step.state), ..*step };
        (Cow::Owned(history.iter().enumerate().map(step).collect()), truth(0, start))
    }

    /// Actuators at the start of a prediction, from the true motion before it.
    pub(super) fn actuators(
        &self,
        history: &[HistoryStep],
        start: &VehicleState<f64>,
        first: &Control<f64>,
        clock: LogClock,
    ) -> DrivelineState {
        let model_before = |steps: usize| self.physics.at(clock.before(steps));
        actuators_along(model_before, history, start, first, model_before(0).dt_s())
    }

    /// What the integral of the speed error has been drawn to beyond [`Predictor::actuators`] at a start on a soil that is not the nominal one, m.
    /// `observed_share` is that of the history ([`Predictor::observed_share`]).
    pub(super) fn made_up_for_m(
        &self,
        nominal: &Soil<f64>,
        soil: &Soil<f64>,
        start: &VehicleState<f64>,
        observed_share: f64,
        clock: LogClock,
    ) -> f64 {
        self.physics.at(clock.start_s).compaction_made_up_for_m(nominal, soil, start.velocity_m_s[0], observed_share)
    }

    /// Share of a lasting resistance that a history has told of: its last step, before the start, observes nothing (`actuators_along`).
    pub(super) fn observed_share(&self, history: &[HistoryStep], clock: LogClock) -> f64 {
        self.physics.at(clock.start_s).observed_share(history.len().saturating_sub(1))
    }

    /// A soil at an instant of its drift.
    pub(super) fn soil_at(&self, soil: [f64; SOIL_DIM], time_s: Option<f64>) -> [f64; SOIL_DIM] {
        self.physics.at(time_s).vehicle().effects.soil.drifted(soil, time_s)
    }
}
