//! Calibration of a vehicle's card on measured drives, with the symbolic model alone: how soil and engine act, the drive line, the suspension.

use nesam_model::Normalization;
use nesam_physics::terramechanics::ContactLaw;
use nesam_physics::{HARD_GROUND, RimServo, SecondCommand, TORQUE_KNOTS, TorqueDrive, Vehicle};

use crate::at_end::{self, AtEnd};
use crate::drives::Drive;
use crate::recipe::Reporter;
use crate::rims::{self, fit_rims, fit_rims_to_motion};
use crate::scales::{MIDDLE_SOIL, measure};
use crate::suspension::{TURNS, calibrate_suspension};
use crate::symbolic::{HORIZON, descend, symbolic_error};

/// A number of the drive line that is calibrated: its key in the card, its unit, and its range.
pub type Knob = (&'static str, &'static str, fn(&mut Vehicle) -> &mut f64, [f64; 2]);

const STEERING: Knob = ("driveline.steering_lag_s", "s", |v| &mut v.driveline.steering_lag_s, [0.0, 0.5]);

/// Numbers of a drive that holds its rims at an over-speed.
const OVERSPEED: [Knob; 4] = [
    ("driveline.speed_gain", "", |v| &mut v.driveline.speed_gain, [0.01, 1.0]),
    ("driveline.speed_integral_gain_per_s", "1/s", |v| &mut v.driveline.speed_integral_gain_per_s, [0.0, 0.5]),
    ("driveline.overspeed_limit_m_s", "m/s", |v| &mut v.driveline.overspeed_limit_m_s, [0.05, 3.0]),
    STEERING,
];

/// Numbers of a drive by torque; the gain stands for the torque per demand, which is fixed by the vehicle, and the curve is relative to its middle.
const TORQUE: [Knob; 13] = [
    ("driveline.speed_gain", "", |v| &mut v.driveline.speed_gain, [0.05, 5.0]),
    ("driveline.speed_integral_gain_per_s", "1/s", |v| &mut v.driveline.speed_integral_gain_per_s, [0.0, 2.0]),
    ("driveline.torque.holding_demand_m_s", "m/s", |v| &mut torque(v).holding_demand_m_s, [0.0, 2.0]),
    ("driveline.speed_integral_leak_s", "s", |v| &mut v.driveline.speed_integral_leak_s, [0.5, 100.0]),
    ("driveline.torque.integral_observer_per_s", "1/s", |v| &mut torque(v).integral_observer_per_s, [0.0, 2.0]),
    ("driveline.torque.curve[0]", "", |v| &mut torque(v).curve[0], [0.2, 3.0]),
    ("driveline.torque.curve[1]", "", |v| &mut torque(v).curve[1], [0.2, 3.0]),
    ("driveline.torque.curve[3]", "", |v| &mut torque(v).curve[3], [0.2, 3.0]),
    ("driveline.torque.curve[4]", "", |v| &mut torque(v).curve[4], [0.2, 3.0]),
    ("driveline.torque.closed_n_m", "N m", |v| &mut torque(v).closed_n_m, [0.0, 2000.0]),
    ("driveline.torque.brake_ratio", "", |v| &mut torque(v).brake_ratio, [0.0, 3.0]),
    ("driveline.side_coupling_n_m_s", "N m s/rad", |v| &mut v.driveline.side_coupling_n_m_s, [0.0, 2000.0]),
    STEERING,
];

/// Engine and brakes of a vehicle that has been put under this law.
fn torque(vehicle: &mut Vehicle) -> &mut TorqueDrive {
    vehicle.driveline.torque.as_mut().expect("the drive is by torque; this is a bug")
}

/// How the commands of a car reach its rims before calibration: at an over-speed as its card says, or by a torque that gives 0.4 g per m/s.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DriveLaw {
    /// Rims at an over-speed.
    Overspeed,
    /// Hubs under a torque.
    Torque,
}

/// Torque per demand of a drive by torque over weight and radius, s/m.
const TORQUE_PER_WEIGHT_S_M: f64 = 0.4;
/// Shares of the samples below the speeds of a torque curve.
const CURVE_SHARES: [f64; TORQUE_KNOTS] = [0.03, 0.2, 0.5, 0.8, 0.97];

impl DriveLaw {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Overspeed, Self::Torque];

    /// As whoever watches a calibration reads it.
    fn as_str(self) -> &'static str {
        match self {
            Self::Overspeed => "rims at an over-speed",
            Self::Torque => "hubs under a torque",
        }
    }

    /// The vehicle under this law, uncalibrated; a torque curve has its knots where the drives have their speeds. `None` where they do not move.
    pub fn of(self, vehicle: &Vehicle, drives: &[&Drive]) -> Option<Vehicle> {
        let mut vehicle = vehicle.clone();
        let line = &mut vehicle.driveline;
        if self == Self::Overspeed {
            line.torque = None;
            return Some(vehicle);
        }
        let mut speeds: Vec<f64> = drives.iter().flat_map(|d| d.states.iter().map(|s| s.velocity_m_s[0])).filter(|v| *v > 0.0).collect();
        speeds.sort_by(f64::total_cmp);
        let last = speeds.len().checked_sub(1)?;
        let curve_speed_m_s = CURVE_SHARES.map(|share| speeds[(share * last as f64) as usize]);
        if curve_speed_m_s.windows(2).any(|w| w[1] - w[0] < 1e-3) {
            return None;
        }
        (line.speed_gain, line.speed_integral_gain_per_s, line.speed_integral_leak_s, line.overspeed_limit_m_s) = (1.0, 0.4, 5.0, 3.0);
        line.torque = Some(TorqueDrive {
            per_demand_n_m_s_m: TORQUE_PER_WEIGHT_S_M * vehicle.mass_kg * vehicle.gravity_m_s2 * vehicle.wheel_radius_m,
            holding_demand_m_s: 0.4,
            integral_observer_per_s: 0.5,
            closed_n_m: 0.0,
            brake_ratio: 1.0,
            curve_speed_m_s,
            curve: [1.0; TORQUE_KNOTS],
        });
        Some(vehicle)
    }
}

/// What vehicles are taken to drive on where no map tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ground {
    /// Loam ([`MIDDLE_SOIL`]).
    Middle,
    /// A floor or a paved road ([`HARD_GROUND`]).
    Hard,
}

/// A card that was fitted to drives.
#[derive(Clone, Debug)]
pub struct Calibrated {
    /// The fitted card.
    pub vehicle: Vehicle,
    /// Scales of the drives, with the soil on which the card was fitted where no map tells.
    pub scales: Normalization,
    /// The ground of that soil; `None` where a drive has a map.
    pub ground: Option<Ground>,
}

impl Ground {
    const ALL: [Self; 2] = [Self::Middle, Self::Hard];

    /// As whoever watches a calibration reads it.
    fn as_str(self) -> &'static str {
        match self {
            Self::Middle => "",
            Self::Hard => ", on hard ground",
        }
    }

    /// Scales with its soil where no map tells.
    pub fn under(self, scales: &Normalization) -> Normalization {
        let soil = match self {
            Self::Middle => MIDDLE_SOIL,
            Self::Hard => HARD_GROUND,
        };
        let mut scales = scales.clone();
        scales.set_default_soil(&soil);
        scales
    }
}

fn name_of(law: ContactLaw) -> &'static str {
    match law {
        ContactLaw::WongReece => "Wong and Reece",
        ContactLaw::SoilContactModel => "soil contact model",
    }
}

/// The vehicle with its drive line fitted on drives under each contact law and drive, and each ground where none has a map, the best kept; its suspension fitted with
/// that where drives have one. `None` where it was interrupted, which is asked before each number. A number that ends at an end of its range is a line of warning.
pub fn calibrate_vehicle(
    vehicle: Vehicle,
    training: &[&Drive],
    dt_s: f64,
    reporter: &dyn Reporter,
    interrupted: &dyn Fn() -> bool,
) -> Option<Calibrated> {
    let scales = measure(training, &vehicle, dt_s);
    let seconds = HORIZON as f64 * dt_s;
    let samples: usize = training.iter().map(|d| d.states.len()).sum();
    let few: Vec<&Drive> = training.iter().copied().step_by((samples / 15_000).max(1)).collect();
    let mut best: Option<(f64, Vehicle, Ground)> = None;
    let skid = vehicle.second == SecondCommand::YawRateRadS;
    let drives_by: &[DriveLaw] = if skid { &DriveLaw::ALL[..1] } else { &DriveLaw::ALL };
    // Wheel speeds tell them whatever the wheels stand on.
    let servos = if skid { fit_rims(&vehicle, &few, dt_s) } else { Vec::new() };
    // Under the other law soil has no damping to ask for.
    let laws = ContactLaw::ALL.into_iter().filter(|law| vehicle.soil_damping_pa_s_m == 0.0 || *law == ContactLaw::SoilContactModel);
    let mapless = training.iter().all(|drive| drive.map.is_none());
    let grounds: &[Ground] = if mapless { &Ground::ALL } else { &Ground::ALL[..1] };
    let ways = laws.flat_map(|law| drives_by.iter().flat_map(move |drive| grounds.iter().map(move |ground| (law, *drive, *ground))));
    for (law, drive, ground) in ways {
        let Some(start) = drive.of(&vehicle, &few) else { continue };
        let mut candidate = Vehicle { contact_law: law, ..start };
        let name = format!("{}, {}{}", name_of(law), drive.as_str(), ground.as_str());
        reporter.stage(&format!("drive line, {name}"), 3 * if skid { rims::KNOBS_OF_MOTION.len() } else { knobs(&candidate).len() });
        let mut done = 0;
        let progress = |name: &str, value: f64, error: f64| {
            done += 1;
            reporter.progress(done, &format!("{name} = {value:.4}, {error:.3} m"));
        };
        let [before, after] = calibrate_driveline(&mut candidate, &few, &ground.under(&scales), &servos, progress, interrupted);
        if interrupted() {
            return None;
        }
        reporter.line(&format!("{name}, pose of the symbolic model alone {before:.3} m -> {after:.3} m over {seconds:.1} s"));
        if best.as_ref().is_none_or(|(error, ..)| after < *error) {
            best = Some((after, candidate, ground));
        }
    }
    let (mut chosen, ground) = best.map_or_else(|| (vehicle.clone(), Ground::Middle), |(_, chosen, ground)| (chosen, ground));
    let warn = |fitted: &Vehicle| at_end::at_ends(&vehicle, fitted).iter().for_each(|end| reporter.line(&format!("warning: {end}")));
    if mapless {
        warn(&chosen);
        return Some(Calibrated { vehicle: chosen, scales: ground.under(&scales), ground: Some(ground) });
    }
    reporter.stage("suspension", TURNS);
    let mut done = 0;
    let progress = |name: &str, value: f64, error: f64| {
        done += 1;
        reporter.progress(done, &format!("{name} = {value:.0}, {:.3}°", error.to_degrees()));
    };
    let [before, after] = calibrate_suspension(&mut chosen, training, &scales, progress, interrupted);
    if interrupted() {
        return None;
    }
    let (rates, dampings) = (chosen.suspension_n_m, chosen.suspension_n_s_m);
    reporter.line(&format!(
        "suspension, symbolic model alone {:.3}° -> {:.3}° of roll and pitch over {seconds:.1} s; {rates:.0?} N/m, {dampings:.0?} N s/m",
        before.to_degrees(),
        after.to_degrees()
    ));
    warn(&chosen);
    Some(Calibrated { vehicle: chosen, scales, ground: None })
}

/// Numbers of the drive line of a car that lie at an end of their range.
pub(crate) fn at_ends(vehicle: &Vehicle) -> Vec<AtEnd> {
    let mut vehicle = vehicle.clone();
    knobs(&vehicle).iter().filter_map(|&(name, unit, knob, range)| AtEnd::of(name, unit, *knob(&mut vehicle), range)).collect()
}

/// Numbers that are calibrated on a car.
pub fn knobs(vehicle: &Vehicle) -> &'static [Knob] {
    if vehicle.driveline.torque.is_some() { &TORQUE } else { &OVERSPEED }
}

/// Fits the drive line by coordinate search (each number in turn, shrinking steps), of a skid-steer base by the best of the servos that wheel speeds tell or from the
/// motion where there is none, and returns the error of the pose before and after, m. Where it is interrupted, which is asked before each number, the vehicle is as fitted
/// by then.
fn calibrate_driveline(
    vehicle: &mut Vehicle,
    drives: &[&Drive],
    scales: &Normalization,
    servos: &[RimServo],
    mut progress: impl FnMut(&str, f64, f64),
    interrupted: &dyn Fn() -> bool,
) -> [f64; 2] {
    let error = |vehicle: &Vehicle| symbolic_error(vehicle, drives, scales).pose_m();
    let before = error(vehicle);
    if vehicle.second == SecondCommand::YawRateRadS {
        let with = |servo| {
            let mut vehicle = vehicle.clone();
            vehicle.driveline.rims = servo;
            (error(&vehicle), servo)
        };
        let fitted = servos.iter().copied().map(with).min_by(|a, b| a.0.total_cmp(&b.0));
        let (after, servo) = fitted.unwrap_or_else(|| {
            let told = |value: f64, error: f64| progress("rims, from the motion", value, error);
            with(fit_rims_to_motion(vehicle, drives, scales, told, interrupted))
        });
        vehicle.driveline.rims = servo;
        progress("rims", servo.speed_gain, after);
        return [before, after];
    }
    let mut best = before;
    for round in 0..3 {
        for &(name, _, knob, [low, high]) in knobs(vehicle) {
            if interrupted() {
                return [before, best];
            }
            let reach = if round == 0 { 0.5 } else { 0.5 / f64::from(2 << round) };
            let trials = |vehicle: &Vehicle, reach: f64| {
                [(-1.0, 1e-3), (1.0, 0.05)].map(|(sign, of_range)| {
                    let mut trial = vehicle.clone();
                    let value = knob(&mut trial);
                    *value = (*value * (1.0 + sign * reach) + sign * of_range * (high - low) * reach).clamp(low, high);
                    trial
                })
            };
            best = descend(vehicle, best, reach, trials, error);
            progress(name.rsplit('.').next().unwrap_or(name), *knob(vehicle), best);
        }
    }
    [before, best]
}
