//! Whether the channels of a segment agree with one another: displacement with velocity, change of attitude with angular velocity. No force, soil or
//! command enters, so only sensors can make these differ.

use nesam_evaluation::Resamples;
use nesam_physics::effects::{Effect, ScheduledEffect};
use nesam_physics::{CONTRADICTIONS, Vehicle, VehicleState, contradiction};
use nesam_trajectories::Trajectory;

use crate::observe::channels::{PATH_AT, Row, SEGMENT_STEPS, available};
use crate::proof::{RISE_MIN, sure_fall};

/// Adds Δp - ∫ R v dt (heading frame of the first sample, m) and Δη - ∫ E ω dt (rad) over consecutive samples, by the trapezoidal rule.
pub fn add_consistency(states: &[VehicleState<f64>], dt_s: f64, row: &mut Row) {
    let found = contradiction(states, |_| dt_s);
    row[PATH_AT..PATH_AT + found.len()].copy_from_slice(&found);
}

/// How much the measurements of some drives contradict one another, in segments as long as those that are fitted.
#[derive(Clone, Debug)]
pub(crate) struct Contradictions {
    /// Drive of each segment.
    drive: Vec<usize>,
    /// What each segment contradicts itself by, m and rad.
    rows: Vec<[f64; CONTRADICTIONS]>,
    /// What all drives measure both sides of.
    compared: [bool; CONTRADICTIONS],
}

impl Contradictions {
    /// Of drives as sensors with effects measured them; `effects` gives those of each drive, each from its onset on.
    pub(crate) fn of<'e>(vehicle: &Vehicle, drives: &[Trajectory], effects: impl Fn(usize) -> &'e [ScheduledEffect]) -> Self {
        let mut found = Self { drive: Vec::new(), rows: Vec::new(), compared: [true; CONTRADICTIONS] };
        for (d, drive) in drives.iter().enumerate() {
            // Neither rims nor a map enter here.
            let own = available(&drive.measured, false, false);
            for (i, compared) in found.compared.iter_mut().enumerate() {
                *compared &= own[PATH_AT + i];
            }
            found.add(vehicle, d, drive, effects(d));
        }
        found
    }

    fn add(&mut self, vehicle: &Vehicle, d: usize, drive: &Trajectory, effects: &[ScheduledEffect]) {
        let (mut acting, mut states) = (None, Vec::new());
        for start in (0..drive.states.len().saturating_sub(SEGMENT_STEPS)).step_by(SEGMENT_STEPS) {
            let time_s = start as f64 * drive.dt_s;
            let on: Vec<Effect> = effects.iter().filter(|e| e.onset_s <= time_s).map(|e| e.effect).collect();
            // Effects begin and none ends, so as many are the same.
            if acting != Some(on.len()) {
                acting = Some(on.len());
                states = vehicle.with_effects(&on).effects.sensor.to_true_along(&drive.states, drive.dt_s);
            }
            self.drive.push(d);
            self.rows.push(contradiction(&states[start..=start + SEGMENT_STEPS], |_| drive.dt_s));
        }
    }

    /// Whether measurements surely contradict one another less `after` than here: the mean size of a contradiction falls by at least a share of itself, and none
    /// surely rises by more than is negligible.
    pub(crate) fn fall_surely(&self, after: &Self, gain: f64, resamples: &Resamples) -> bool {
        let change = |i: usize| -> (f64, Option<[f64; 2]>) {
            let falls: Vec<f64> = self.rows.iter().zip(&after.rows).map(|(before, after)| before[i].abs() - after[i].abs()).collect();
            let size = self.rows.iter().map(|row| row[i].abs()).sum::<f64>() / self.rows.len().max(1) as f64;
            (size, resamples.mean_interval(&falls, &self.drive))
        };
        let changes: Vec<(f64, Option<[f64; 2]>)> = (0..CONTRADICTIONS).filter(|i| self.compared[*i]).map(change).collect();
        let falls = |(size, interval): &(f64, Option<[f64; 2]>)| sure_fall(*interval, *size, gain);
        let rises = |(size, interval): &(f64, Option<[f64; 2]>)| interval.is_some_and(|[_, high]| high < -RISE_MIN * size);
        changes.iter().any(falls) && !changes.iter().any(rises)
    }

    /// Channels in which the contradictions are others `after`, by more than is negligible beside their size: a bias about one axis turns those about the others by as much as
    /// the vehicle leans, which tells nothing.
    pub(crate) fn changed(&self, after: &Self) -> Vec<usize> {
        let sum = |of: &dyn Fn(&[f64; CONTRADICTIONS], &[f64; CONTRADICTIONS]) -> f64| -> f64 {
            self.rows.iter().zip(&after.rows).map(|(before, after)| of(before, after)).sum()
        };
        let differs = |i: usize| sum(&|before, after| (before[i] - after[i]).abs()) > RISE_MIN * sum(&|before, _| before[i].abs());
        (0..CONTRADICTIONS).filter(|i| self.compared[*i] && differs(*i)).map(|i| PATH_AT + i).collect()
    }
}

#[cfg(test)]
mod tests {
    use nesam_physics::Control;
    use nesam_physics::effects::GyroBias;
    use nesam_trajectories::MeasuredChannels;

    use super::*;
    use crate::observe::channels::TURN_AT;

    #[test]
    fn analytic_a_gyro_bias_shows_as_its_integral_and_a_velocity_scale_as_its_path() {
        let (dt, rate, speed) = (0.1, 0.3, 2.0);
        let at = |k: usize| {
            let t = k as f64 * dt;
            // A circle: x' = v cos ψ, y' = v sin ψ.
            let yaw: f64 = rate * t;
            VehicleState {
                position_m: [speed / rate * yaw.sin(), speed / rate * (1.0 - yaw.cos()), 0.0],
                attitude_rad: [0.0, 0.0, yaw],
                velocity_m_s: [speed * 1.02, 0.0, 0.0],
                angular_velocity_rad_s: [0.0, 0.0, rate + 0.01],
            }
        };
        let states: Vec<_> = (0..9).map(at).collect();
        let mut row = [0.0; crate::observe::channels::CHANNELS];
        add_consistency(&states, dt, &mut row);
        assert!((row[TURN_AT + 2] + 0.01 * 0.8).abs() < 1e-12, "{row:?}");
        let chord = speed / rate * (rate * 0.8f64).sin();
        assert!((row[PATH_AT] + 0.02 * chord).abs() < 2e-4, "{row:?}");
    }

    /// A level drive of 41 samples on a circle whose gyro reads this much too much, and as noise of the pose one step of yaw to and fro.
    fn circling(bias_rad_s: f64) -> Trajectory {
        let (dt_s, rate, speed) = (0.1, 0.3, 2.0);
        let state = |k: usize| {
            let yaw: f64 = rate * k as f64 * dt_s;
            VehicleState {
                position_m: [speed / rate * yaw.sin(), speed / rate * (1.0 - yaw.cos()), 0.0],
                attitude_rad: [0.0, 0.0, yaw + if k % 16 < 8 { 0.002 } else { -0.002 }],
                velocity_m_s: [speed, 0.0, 0.0],
                angular_velocity_rad_s: [0.0, 0.0, rate + bias_rad_s],
            }
        };
        Trajectory {
            id: "circle".into(),
            set: "circles".into(),
            world: None,
            split: None,
            dt_s,
            time_s: (0..41).map(|k| dt_s * k as f64).collect(),
            states: (0..41).map(state).collect(),
            controls: vec![Control { speed_m_s: speed, second: rate }; 41],
            wheel_speed_rad_s: None,
            road_wheel_angle_rad: None,
            measured: MeasuredChannels::POSE_AND_TWIST,
            truth: None,
        }
    }

    /// Goal: a sensor's effect is told by what it settles. Method: six circles whose gyro is 0.05 rad/s too fast, with that bias, with one of the other sign, with one
    /// that begins after the drive, and with one drive alone.
    #[test]
    fn analytic_what_measurements_contradict_falls_with_the_right_sensor_alone() {
        let vehicle = nesam_test_vehicles::robot();
        let drives: Vec<Trajectory> = (0..6).map(|_| circling(0.05)).collect();
        let gyro = |rad_s: f64, onset_s: f64| [ScheduledEffect { effect: Effect::GyroBias(GyroBias { rad_s }), onset_s }];
        let resamples = Resamples::draw(6, 50, 1);
        let before = Contradictions::of(&vehicle, &drives, |_| &[]);
        let (right, wrong, late) = (gyro(0.05, 0.0), gyro(-0.05, 0.0), gyro(0.05, 60.0));
        let with = |effects: &[ScheduledEffect]| Contradictions::of(&vehicle, &drives, |_| effects);
        assert!(before.fall_surely(&with(&right), 0.5, &resamples));
        assert_eq!(before.changed(&with(&right)), [TURN_AT + 2]);
        assert!(!before.fall_surely(&with(&wrong), 0.0, &resamples));
        assert!(before.changed(&with(&late)).is_empty());
        let mut blind = drives.clone();
        blind[3].measured.angular_velocity[2] = false;
        let unmeasured = |effects: &[ScheduledEffect]| Contradictions::of(&vehicle, &blind, |_| effects);
        assert!(!unmeasured(&[]).fall_surely(&unmeasured(&right), 0.0, &resamples), "what a drive does not measure is not compared");
        let alone = |effects: &[ScheduledEffect]| Contradictions::of(&vehicle, &drives[..1], |_| effects);
        assert!(!alone(&[]).fall_surely(&alone(&right), 0.0, &resamples), "one drive proves nothing");
    }

    /// Goal: a bias about the vertical is asked for the turn about it, not for what little it makes of the others on a slope. Method: the circles with their nose down and
    /// roll and pitch that are measured with noise.
    #[test]
    fn regress_a_lean_makes_no_other_channel_the_sensors_own() {
        let mut leaning = circling(0.01);
        for (k, state) in leaning.states.iter_mut().enumerate() {
            state.attitude_rad[0] = if k % 16 < 8 { 0.01 } else { -0.01 };
            state.attitude_rad[1] = if k % 24 < 12 { 0.02 } else { -0.01 };
        }
        let effects = [ScheduledEffect { effect: Effect::GyroBias(GyroBias { rad_s: 0.01 }), onset_s: 0.0 }];
        let [before, after] =
            [&[][..], &effects].map(|own| Contradictions::of(&nesam_test_vehicles::robot(), core::slice::from_ref(&leaning), |_| own));
        assert!(
            before.rows.iter().zip(&after.rows).any(|(b, a)| (b[TURN_AT - PATH_AT] - a[TURN_AT - PATH_AT]).abs() > 1e-9),
            "the others do change"
        );
        assert_eq!(before.changed(&after), [TURN_AT + 2]);
    }
}
