//! Whether recorded drives make sense: units, signs and frames are told from each other by what they must agree on.
//!
//! A log that reads without an error can still say metres where it means feet, or count yaw like a compass. Every check here compares two channels that
//! measure the same motion, or a command with what came of it, over all drives of a set; a doubt says which convention explains the numbers. The
//! limits are wide (chosen): slip, lag and noise of a sound log stay inside, a wrong unit or sign does not.

use nesam_physics::{SecondCommand, Vehicle, wrap_angle};
use nesam_trajectories::{Trajectory, VelocitySource, to_body};

/// Speed over ground from which on a direction of motion is known, m/s.
const MOVING_M_S: f64 = 0.7;
/// Pairs of values from which on a slope says something.
const PAIRS_MIN: usize = 40;
/// Slopes between two measurements of the same that are let pass.
const SAME: [f64; 2] = [0.7, 1.4];
/// Slopes between a command and what came of it that are let pass: a vehicle lags and slips.
const FOLLOWS: [f64; 2] = [0.5, 1.6];
/// Factors that a wrong unit makes.
const UNITS: [(f64, &str); 7] = [
    (9.549, "revolutions per minute instead of rad/s"),
    (3.6, "km/h or the like instead of m/s"),
    (1.0 / 3.6, "m/s that were divided by 3.6 once too often"),
    (2.237, "miles per hour instead of m/s"),
    (3.281, "feet instead of metres"),
    (57.296, "degrees instead of radians"),
    (0.017_453, "radians that were taken for degrees"),
];
/// Deviation from such a factor that is still taken for it.
const UNIT_TOLERANCE: f64 = 0.2;
/// Roll or pitch beyond this in a twentieth of all samples is no driving, rad.
const TILT_MAX_RAD: f64 = 1.2;

/// Something that does not fit together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Doubt {
    /// What disagrees, with the figure.
    pub what: String,
    /// What to do.
    pub advice: String,
}

fn doubt(what: String, advice: impl Into<String>) -> Doubt {
    Doubt { what, advice: advice.into() }
}

/// Pairs of values of which the second should be the first.
#[derive(Clone, Debug, Default)]
struct Pairs(Vec<[f64; 2]>);

impl Pairs {
    fn push(&mut self, expected: f64, found: f64) {
        if expected.is_finite() && found.is_finite() {
            self.0.push([expected, found]);
        }
    }

    /// Slope of the line through the origin, and the correlation about it; `None` where the first value hardly varies.
    fn slope(&self) -> Option<(f64, f64)> {
        let sum = |f: fn(&[f64; 2]) -> f64| self.0.iter().map(f).sum::<f64>();
        let (aa, ab, bb) = (sum(|p| p[0] * p[0]), sum(|p| p[0] * p[1]), sum(|p| p[1] * p[1]));
        (self.0.len() >= PAIRS_MIN && aa > 1e-9 * self.0.len() as f64 && bb > 0.0).then(|| (ab / aa, ab / (aa * bb).sqrt()))
    }

    /// A doubt when the slope is outside of what is let pass and the two are related at all.
    fn judge(&self, what: &str, pass: [f64; 2], reversed: &str) -> Option<Doubt> {
        let (slope, correlation) = self.slope()?;
        if correlation.abs() < 0.5 || (pass[0]..=pass[1]).contains(&slope) {
            return None;
        }
        let (size, sign) = (slope.abs(), if slope < 0.0 { reversed } else { "" });
        let unit = UNITS.iter().find(|(factor, _)| (size / factor - 1.0).abs() < UNIT_TOLERANCE).map_or("", |(_, name)| name);
        let reasons: Vec<&str> = [sign, unit].into_iter().filter(|r| !r.is_empty()).collect();
        let advice =
            if reasons.is_empty() { "see the units of both".into() } else { format!("the file seems to have {}", reasons.join(", and ")) };
        Some(doubt(format!("{what}: {slope:.3} times as much as expected"), advice))
    }
}

/// What does not fit together in these drives of one vehicle. Nothing is said of what they hardly exercise.
pub fn doubts(drives: &[Trajectory], vehicle: &Vehicle) -> Vec<Doubt> {
    let mut found = Vec::new();
    found.extend(tilt(drives));
    found.extend(heading(drives));
    found.extend(velocity(drives));
    found.extend(rates(drives));
    found.extend(climb(drives));
    found.extend(commands(drives, vehicle));
    found.extend(wheels(drives, vehicle));
    found
}

/// What does not fit together in a card.
pub fn card_doubts(vehicle: &Vehicle) -> Vec<Doubt> {
    let mut found = Vec::new();
    let [fl, fr, rl, rr] = vehicle.wheel_centre_m;
    if fl[1] <= fr[1] || rl[1] <= rr[1] {
        found
            .push(doubt("the left wheels lie right of the right ones".into(), "y points to the left, and wheels are named FL, FR, RL, RR"));
    }
    if fl[0] <= rl[0] || fr[0] <= rr[0] {
        found.push(doubt("the front wheels lie behind the rear ones".into(), "x points forward, and wheels are named FL, FR, RL, RR"));
    } else if fl[0] <= 0.0 || rl[0] >= 0.0 {
        let what = format!("the centre of gravity lies outside of the wheels (x of the axles {:.2} and {:.2} m)", fl[0], rl[0]);
        found.push(doubt(what, "wheel centres are given relative to the centre of gravity"));
    }
    let about = |what: &str, value: f64, range: [f64; 2], unit: &str| {
        let text = format!("{what} is {value:.3} {unit}, off-road vehicles have {} to {} {unit}", range[0], range[1]);
        (!(range[0]..=range[1]).contains(&value)).then(|| doubt(text, "see the unit in the card"))
    };
    found.extend(about("the mass", vehicle.mass_kg, [5.0, 60_000.0], "kg"));
    found.extend(about("the radius of the wheels", vehicle.wheel_radius_m, [0.05, 1.2], "m"));
    found.extend(about("the width of the wheels", vehicle.wheel_width_m, [0.02, 1.2], "m"));
    found.extend(about("the wheelbase", vehicle.wheelbase_m, [0.15, 8.0], "m"));
    found
}

/// Every step in the middle of two others: drive, index, ground velocity from positions in World.
fn steps(drives: &[Trajectory]) -> impl Iterator<Item = (&Trajectory, usize, [f64; 3])> {
    drives.iter().flat_map(|drive| {
        (1..drive.states.len().saturating_sub(1)).map(move |k| {
            let (a, b) = (drive.states[k - 1].position_m, drive.states[k + 1].position_m);
            (drive, k, core::array::from_fn(|i| (b[i] - a[i]) / (2.0 * drive.dt_s)))
        })
    })
}

fn moving(velocity: &[f64; 3]) -> bool {
    velocity[0].hypot(velocity[1]) > MOVING_M_S
}

fn tilt(drives: &[Trajectory]) -> Option<Doubt> {
    let all: usize = drives.iter().map(|d| d.states.len()).sum();
    let steep = |s: &nesam_physics::VehicleState<f64>| s.attitude_rad[0].abs().max(s.attitude_rad[1].abs()) > TILT_MAX_RAD;
    let count = drives.iter().flat_map(|d| &d.states).filter(|s| steep(s)).count();
    (all > 0 && count * 20 > all).then(|| {
        let what = format!("roll or pitch is beyond {TILT_MAX_RAD} rad in {count} of {all} samples");
        doubt(what, "the file seems to have degrees instead of radians")
    })
}

/// Direction of the mean of unit vectors, and how much they agree, 0 to 1.
fn mean_direction(angles: &[f64]) -> (f64, f64) {
    let n = angles.len().max(1) as f64;
    let (c, s) = angles.iter().fold((0.0, 0.0), |(c, s), a| (c + a.cos(), s + a.sin()));
    (s.atan2(c), c.hypot(s) / n)
}

/// The vehicle goes where it points.
fn heading(drives: &[Trajectory]) -> Option<Doubt> {
    let along: Vec<[f64; 2]> = steps(drives)
        .filter(|(_, _, v)| moving(v))
        .map(|(drive, k, v)| {
            let forward = if drive.controls[k].speed_m_s < 0.0 { std::f64::consts::PI } else { 0.0 };
            [v[1].atan2(v[0]) - forward, drive.states[k].attitude_rad[2]]
        })
        .collect();
    if along.len() < PAIRS_MIN {
        return None;
    }
    let apart = |sign: f64| along.iter().map(|[course, yaw]| wrap_angle(course - sign * yaw)).collect::<Vec<_>>();
    let (direction, agreement) = mean_direction(&apart(1.0));
    let (_, clockwise) = mean_direction(&apart(-1.0));
    // A vehicle that goes straight all the time has a fixed angle to both.
    if clockwise > 0.8 && clockwise > agreement + 0.1 {
        let what =
            format!("the heading turns against the direction of motion (agreement {agreement:.2} of 1, {clockwise:.2} when negated)");
        return Some(doubt(what, "the yaw seems to count clockwise, like a compass; import with `--frame ned-frd` or negate it"));
    }
    let degrees = direction.to_degrees();
    if agreement > 0.8 {
        let advice = if direction.abs() < 0.45 {
            return None;
        } else if direction.abs() > 2.6 {
            "x of the body seems to point to the rear, or the yaw to be off by 180 degrees"
        } else if (direction.abs() - std::f64::consts::FRAC_PI_2).abs() < 0.45 {
            "the yaw seems to count from north; it must count from the x axis of World (east)"
        } else {
            "the position and the attitude seem to be in different frames"
        };
        return Some(doubt(format!("the vehicle moves {degrees:.0} degrees off its heading"), advice));
    }
    let advice = "the yaw seems to be in degrees, or of another frame";
    Some(doubt(format!("heading and direction of motion are unrelated (agreement {agreement:.2} of 1)"), advice))
}

fn velocity(drives: &[Trajectory]) -> Vec<Doubt> {
    let (mut forward, mut left) = (Pairs::default(), Pairs::default());
    for (drive, k, world) in steps(drives).filter(|(drive, _, v)| drive.measured.velocity_source != VelocitySource::Positions && moving(v))
    {
        let (moved, told) = (to_body(drive.states[k].attitude_rad, world), drive.states[k].velocity_m_s);
        forward.push(moved[0], told[0]);
        left.push(moved[1], told[1]);
    }
    // Sideways motion is small: only its sign can be told.
    let reversed = left.slope().is_some_and(|(slope, correlation)| slope < -0.5 && correlation < -0.5);
    let sideways = reversed.then(|| {
        let what = "sideways velocity has the opposite sign of what positions say".to_string();
        doubt(what, "y of the body must point to the left; import with `--frame ned-frd` or negate it")
    });
    let forward = forward.judge("forward velocity against positions", SAME, "x of the body pointing to the rear");
    [forward, sideways].into_iter().flatten().collect()
}

fn rates(drives: &[Trajectory]) -> Vec<Doubt> {
    let mut axes: [Pairs; 3] = Default::default();
    for (drive, k, _) in steps(drives) {
        let (a, b) = (drive.states[k - 1].attitude_rad, drive.states[k + 1].attitude_rad);
        for (axis, pairs) in axes.iter_mut().enumerate().filter(|(axis, _)| drive.measured.angular_velocity[*axis]) {
            pairs.push(wrap_angle(b[axis] - a[axis]) / (2.0 * drive.dt_s), drive.states[k].angular_velocity_rad_s[axis]);
        }
    }
    // Roll and pitch rates are shaken by the suspension: only gross disagreement counts there.
    let checks = [("roll", [0.3, 3.0]), ("pitch", [0.3, 3.0]), ("yaw", SAME)];
    let judge = |(pairs, (name, pass)): (&Pairs, (&str, [f64; 2]))| {
        pairs.judge(&format!("{name} rate against the change of {name}"), pass, "the opposite sign")
    };
    axes.iter().zip(checks).filter_map(judge).collect()
}

/// Nose up means climbing.
fn climb(drives: &[Trajectory]) -> Option<Doubt> {
    let mut pairs = Pairs::default();
    for (drive, k, v) in steps(drives).filter(|(drive, k, v)| moving(v) && drive.controls[*k].speed_m_s > 0.0) {
        pairs.push(-drive.states[k].attitude_rad[1].tan(), v[2] / v[0].hypot(v[1]));
    }
    let (slope, correlation) = pairs.slope()?;
    (slope < -0.3 && correlation < -0.3).then(|| {
        doubt(
            "the vehicle climbs while its nose points down".into(),
            "pitch > 0 must be nose down (x forward, y left, z up); negate it, or import with `--frame ned-frd`",
        )
    })
}

fn commands(drives: &[Trajectory], vehicle: &Vehicle) -> Vec<Doubt> {
    let (mut speed, mut second) = (Pairs::default(), Pairs::default());
    for (drive, k, _) in steps(drives) {
        let (state, command) = (&drive.states[k], drive.controls[k]);
        speed.push(command.speed_m_s, state.velocity_m_s[0]);
        let curvature = state.angular_velocity_rad_s[2] / state.velocity_m_s[0];
        match vehicle.second {
            SecondCommand::YawRateRadS => second.push(command.second, state.angular_velocity_rad_s[2]),
            _ if state.velocity_m_s[0].abs() < MOVING_M_S => {}
            SecondCommand::RoadWheelAngleRad => second.push(command.second, (curvature * vehicle.wheelbase_m).atan()),
            SecondCommand::SteeringNormalised => {
                let reach = vehicle.steering.as_ref().and_then(|table| table.front_left_rad.last()).copied().unwrap_or(0.4);
                second.push(command.second * reach, (curvature * vehicle.wheelbase_m).atan());
            }
        }
    }
    let backwards = "the opposite sign: steering to the left is positive";
    // A skid-steer vehicle may turn at a tenth of the rate that is asked for; only a wrong unit makes less.
    let least = if vehicle.second == SecondCommand::YawRateRadS { 0.05 } else { 0.3 };
    let second = second.judge("turning against the steering command", [least, 2.5], backwards);
    [speed.judge("speed against the speed command", FOLLOWS, "the opposite sign"), second].into_iter().flatten().collect()
}

fn wheels(drives: &[Trajectory], vehicle: &Vehicle) -> Option<Doubt> {
    let mut pairs = Pairs::default();
    for (drive, k, v) in steps(drives).filter(|(_, _, v)| moving(v)) {
        if let Some(wheels) = &drive.wheel_speed_rad_s {
            let forward = if drive.controls[k].speed_m_s < 0.0 { -1.0 } else { 1.0 };
            pairs.push(forward * v[0].hypot(v[1]), vehicle.wheel_radius_m * wheels[k].iter().sum::<f64>() / 4.0);
        }
    }
    pairs.judge("rim speed (wheel speed times radius) against positions", [0.5, 2.0], "wheels counted backwards")
}

#[cfg(test)]
mod tests {
    use nesam_physics::{Control, VehicleState};

    use super::*;
    use nesam_trajectories::MeasuredChannels;

    /// A car on a wavy plane that drives curves, in the conventions of the data root.
    fn sound() -> Trajectory {
        let (dt_s, wheelbase_m) = (0.1, 3.3);
        let (mut x, mut y, mut yaw) = (0.0_f64, 0.0_f64, 0.3_f64);
        let (mut states, mut controls, mut wheels) = (Vec::new(), Vec::new(), Vec::new());
        for k in 0..400 {
            let t = f64::from(k) * dt_s;
            let (speed, angle) = (2.0 + 0.8 * (0.7 * t).sin(), 0.3 * (0.15 * t).sin());
            let slope = 0.15 * (0.3 * x).cos() * yaw.cos();
            let yaw_rate = speed / wheelbase_m * angle.tan();
            states.push(VehicleState {
                position_m: [x, y, 0.5 * (0.3 * x).sin()],
                attitude_rad: [0.02 * (1.3 * t).sin(), -slope.atan(), wrap_angle(yaw)],
                velocity_m_s: [speed / slope.atan().cos(), 0.0, 0.0],
                angular_velocity_rad_s: [0.026 * (1.3 * t).cos(), 0.0, yaw_rate],
            });
            controls.push(Control { speed_m_s: speed, second: angle });
            wheels.push([speed / 0.4; 4]);
            (x, y, yaw) = (x + dt_s * speed * yaw.cos(), y + dt_s * speed * yaw.sin(), yaw + dt_s * yaw_rate);
        }
        let measured = MeasuredChannels { angular_velocity: [true, false, true], wheel_speed: true, ..MeasuredChannels::POSE_AND_TWIST };
        Trajectory {
            id: "a".into(),
            set: "s".into(),
            world: None,
            split: None,
            dt_s,
            time_s: (0..400).map(|k| f64::from(k) * dt_s).collect(),
            states,
            controls,
            wheel_speed_rad_s: Some(wheels),
            road_wheel_angle_rad: None,
            measured,
            truth: None,
        }
    }

    fn car() -> Vehicle {
        let mut car = nesam_test_vehicles::truck();
        (car.second, car.wheelbase_m, car.wheel_radius_m) = (SecondCommand::RoadWheelAngleRad, 3.3, 0.4);
        car
    }

    fn told(change: impl Fn(&mut Trajectory)) -> String {
        let mut drive = sound();
        change(&mut drive);
        doubts(&[drive], &car()).iter().map(|d| format!("{}; {}\n", d.what, d.advice)).collect()
    }

    fn states(change: impl Fn(&mut VehicleState<f64>)) -> impl Fn(&mut Trajectory) {
        move |drive| drive.states.iter_mut().for_each(&change)
    }

    #[test]
    fn analytic_a_sound_drive_raises_no_doubt() {
        assert_eq!(told(|_| {}), "");
    }

    #[test]
    fn analytic_every_mistake_is_named() {
        let mistakes: [(&str, String); 10] = [
            ("km/h", told(states(|s| s.velocity_m_s[0] *= 3.6))),
            ("pointing to the rear", told(states(|s| s.velocity_m_s[0] *= -1.0))),
            ("degrees instead of radians", told(states(|s| s.angular_velocity_rad_s[2] *= 57.3))),
            ("clockwise", told(states(|s| s.attitude_rad[2] = wrap_angle(std::f64::consts::FRAC_PI_2 - s.attitude_rad[2])))),
            ("from north", told(states(|s| s.attitude_rad[2] = wrap_angle(s.attitude_rad[2] - std::f64::consts::FRAC_PI_2)))),
            ("nose points down", told(states(|s| s.attitude_rad[1] *= -1.0))),
            ("degrees instead of radians", told(states(|s| s.attitude_rad[1] = 30.0 * (2.0 + s.attitude_rad[1])))),
            ("opposite sign: steering to the left", told(|drive| drive.controls.iter_mut().for_each(|c| c.second *= -1.0))),
            ("km/h", told(|drive| drive.controls.iter_mut().for_each(|c| c.speed_m_s /= 3.6))),
            ("rim speed", told(|drive| drive.wheel_speed_rad_s.iter_mut().flatten().for_each(|w| *w = w.map(|w| 9.55 * w)))),
        ];
        for (i, (expected, told)) in mistakes.iter().enumerate() {
            assert!(told.contains(expected), "{i}: `{expected}` is not in\n{told}");
        }
    }

    #[test]
    fn analytic_a_mirrored_card_is_doubted() {
        assert!(card_doubts(&nesam_test_vehicles::truck()).is_empty());
        let mut mirrored = nesam_test_vehicles::truck();
        mirrored.wheel_centre_m.iter_mut().for_each(|w| w[1] *= -1.0);
        assert!(card_doubts(&mirrored)[0].what.contains("left wheels"));
    }
}
