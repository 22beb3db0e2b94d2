//! Measurements in order of their stamps, made into the steps of the model.

use std::collections::VecDeque;

use nesam_model::{HISTORY, HistoryStep};
use nesam_physics::VehicleState;

use crate::grid::{Place, StepAt, StepGrid};
use crate::limits::YAW_MAX_RAD;
use crate::measurement::Measurement;

/// A step and its instant, ns.
pub(super) type Stamped = (i64, HistoryStep);

/// What a measurement made of a track.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Taken {
    /// These steps follow, one or two; the caller pushes them.
    Steps(Stamped, Option<Stamped>),
    /// This step follows after a pause, ns; the history before is forgotten.
    AfterGap(Stamped, i64),
    /// None: time until the next grid point, ns.
    Waiting(i64),
}

/// The grid, the measurement before, and the steps made so far. What it holds depends on the sequence of measurements alone.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Track {
    /// `None` before the first measurement, as `before`.
    pub(super) grid: Option<StepGrid>,
    /// The last measurement.
    pub(super) before: Option<Measurement>,
    /// At most 32 steps, oldest first.
    pub(super) history: VecDeque<HistoryStep>,
}

impl Track {
    /// Takes a measurement later than all before. Its steps are not in the history yet: see [`Track::push`].
    pub(super) fn take(&mut self, measurement: &Measurement, step_ns: i64) -> Taken {
        let own = (measurement.stamp_ns, HistoryStep { state: measurement.state, control: measurement.command });
        let before = self.before.replace(*measurement);
        let (Some(grid), Some(before)) = (self.grid.as_mut(), before) else {
            self.grid = Some(StepGrid::start(measurement.stamp_ns, step_ns));
            return Taken::Steps(own, None);
        };
        let step = |at: StepAt| match at {
            StepAt::Stamp => own,
            StepAt::Between(at_ns) => (at_ns, interpolate(&before, measurement, at_ns)),
        };
        match grid.take(measurement.stamp_ns) {
            Place::Steps { first, second } => Taken::Steps(step(first), second.map(step)),
            Place::Waiting { remaining_ns } => Taken::Waiting(remaining_ns),
            Place::Gap { gap_ns } => {
                *grid = StepGrid::start(measurement.stamp_ns, step_ns);
                self.history.clear();
                Taken::AfterGap(own, gap_ns)
            }
        }
    }

    /// Appends a step to the history.
    pub(super) fn push(&mut self, step: HistoryStep) {
        if self.history.len() == HISTORY {
            self.history.pop_front();
        }
        self.history.push_back(step);
    }

    /// Takes a measurement and pushes what it makes.
    pub(super) fn advance(&mut self, measurement: &Measurement, step_ns: i64) -> Taken {
        let taken = self.take(measurement, step_ns);
        match &taken {
            Taken::Steps(first, second) => [Some(*first), *second].into_iter().flatten().for_each(|(_, step)| self.push(step)),
            Taken::AfterGap((_, step), _) => self.push(*step),
            Taken::Waiting(_) => {}
        }
        taken
    }
}

/// The state at an instant between two measurements: linear in position and velocities, angles along the shorter way, yaw as unwrapped as before, but for whole turns where it
/// would leave the range of a measurement. The command is that of the earlier measurement, which the vehicle applies until the later one.
///
/// At 20 Hz and an acceleration of 3 m/s², linear interpolation moves a position by at most 1 mm (a h² / 8).
fn interpolate(before: &Measurement, after: &Measurement, at_ns: i64) -> HistoryStep {
    let interval_ns = after.stamp_ns.saturating_sub(before.stamp_ns).max(1);
    let weight = at_ns.saturating_sub(before.stamp_ns) as f64 / interval_ns as f64;
    let (a, b) = (before.state.to_array(), after.state.to_array());
    let state = core::array::from_fn(|i| match i {
        3 | 4 => wrapped(a[i] + weight * wrapped(b[i] - a[i])),
        5 => within_turns(a[i] + weight * wrapped(b[i] - a[i])),
        // Rounding may not lead beyond either of them.
        _ => (a[i] + weight * (b[i] - a[i])).clamp(a[i].min(b[i]), a[i].max(b[i])),
    });
    HistoryStep { state: VehicleState::from_array(state), control: before.command }
}

/// The angle in [-π, π).
fn wrapped(angle_rad: f64) -> f64 {
    use core::f64::consts::{PI, TAU};
    (angle_rad + PI).rem_euclid(TAU) - PI
}

/// The same yaw within the range of a measurement; half a turn beyond it at most.
fn within_turns(yaw_rad: f64) -> f64 {
    use core::f64::consts::TAU;
    if yaw_rad.abs() > YAW_MAX_RAD { yaw_rad - TAU.copysign(yaw_rad) } else { yaw_rad }
}

#[cfg(test)]
mod tests {
    use nesam_physics::Control;

    use super::*;
    use crate::measurement::WheelMeasurement;

    const STEP_NS: i64 = 100_000_000;

    fn at(stamp_ns: i64, yaw_rad: f64, speed_m_s: f64) -> Measurement {
        let mut state = VehicleState::zero();
        let t = stamp_ns as f64 * 1e-9;
        (state.position_m[0], state.attitude_rad[2], state.velocity_m_s[0]) = (2.0 * t, yaw_rad, 2.0);
        let command = Control { speed_m_s, second: 0.0 };
        Measurement { sequence: None, boot: None, stamp_ns, state, command, wheels: WheelMeasurement::default() }
    }

    #[test]
    fn analytic_steps_between_measurements_lie_on_the_line() {
        // 15 Hz: 0, 67, 133 ms; the grid point at 100 ms lies in the middle of the last two.
        let mut track = Track::default();
        track.advance(&at(0, 3.0, 1.0), STEP_NS);
        assert_eq!(track.advance(&at(66_666_666, 3.1, 2.0), STEP_NS), Taken::Waiting(33_333_334));
        let Taken::Steps((at_ns, step), None) = track.advance(&at(133_333_334, 3.3 - core::f64::consts::TAU, 3.0), STEP_NS) else {
            panic!("one step")
        };
        assert_eq!(at_ns, STEP_NS);
        let [x, yaw, v] = [step.state.position_m[0], step.state.attitude_rad[2], step.state.velocity_m_s[0]];
        assert!((x - 0.2).abs() < 1e-12 && (yaw - 3.2).abs() < 1e-12 && v == 2.0, "{x} {yaw} {v}");
        assert_eq!(step.control.speed_m_s, 2.0, "the command that is in effect at the grid point");
        assert_eq!(track.history.len(), 2);
    }

    /// Goal: what is made of accepted measurements would be accepted itself. Method: 15 Hz, yaw at either end of its range, the other one three radians on and a turn less, so that the
    /// shorter way leads out of the range; the steps are held against the same ones ten turns further in.
    #[test]
    fn regress_an_interpolated_yaw_stays_in_the_range_of_a_measurement() {
        use core::f64::consts::TAU;
        for sign in [1.0, -1.0] {
            let (mut track, mut further_in) = (Track::default(), Track::default());
            for i in 0..12_i64 {
                let yaw_rad = sign * if i % 2 == 0 { YAW_MAX_RAD } else { YAW_MAX_RAD + 3.0 - TAU };
                track.advance(&at(i * 66_666_667, yaw_rad, 1.0), STEP_NS);
                further_in.advance(&at(i * 66_666_667, yaw_rad - sign * 10.0 * TAU, 1.0), STEP_NS);
            }
            assert!(track.history.len() > 6);
            for (step, inner) in track.history.iter().zip(&further_in.history) {
                let [yaw, inner] = [step, inner].map(|step| step.state.attitude_rad[2]);
                assert!(yaw.abs() <= YAW_MAX_RAD && wrapped(yaw - inner).abs() < 1e-9, "{yaw} for {inner}");
            }
        }
    }

    #[test]
    fn analytic_each_of_two_steps_has_its_own_stamp() {
        let mut track = Track::default();
        track.advance(&at(0, 0.0, 1.0), STEP_NS);
        track.advance(&at(STEP_NS / 10 * 8, 0.0, 1.0), STEP_NS);
        let Taken::Steps(first, Some(second)) = track.take(&at(2 * STEP_NS, 0.0, 1.0), STEP_NS) else { panic!("two steps") };
        assert_eq!((first.0, second.0), (STEP_NS, 2 * STEP_NS));
    }

    #[test]
    fn analytic_no_step_lies_inside_a_gap() {
        let mut track = Track::default();
        for i in 0..3 {
            track.advance(&at(i * STEP_NS, 0.0, 1.0), STEP_NS);
        }
        assert!(matches!(track.advance(&at(4 * STEP_NS, 0.0, 1.0), STEP_NS), Taken::AfterGap(_, gap) if gap == 2 * STEP_NS));
        assert_eq!(track.history.len(), 1);
    }
}
