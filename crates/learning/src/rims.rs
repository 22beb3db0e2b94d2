//! Calibration of a skid-steer base's rim servo: what it makes of a commanded twist, on measured wheel speeds apart from what the ground makes of the rims, or,
//! where nobody measured them, together with that on the motion.

use nesam_model::Normalization;
use nesam_physics::driveline::{free_run, rim_speeds_m_s, rim_twist};
use nesam_physics::{RimServo, Vehicle, WHEELS};
use nesam_trajectories::limited_starts;
use rayon::prelude::*;

use crate::at_end::AtEnd;
use crate::drives::Drive;
use crate::symbolic::{descend, symbolic_error};

/// A number of the servo that is fitted: its key in the servo of a card, its unit, and its range.
type Knob = (&'static str, &'static str, fn(&mut RimServo) -> &mut f64, [f64; 2]);

/// Those that the motion alone tells; the others are told by measured rims.
pub(crate) const KNOBS_OF_MOTION: [Knob; 6] = [KNOBS[0], KNOBS[1], KNOBS[2], KNOBS[3], KNOBS[4], KNOBS[5]];

const KNOBS: [Knob; 10] = [
    ("speed_gain", "", |s| &mut s.speed_gain, [0.1, 5.0]),
    ("yaw_gain", "", |s| &mut s.yaw_gain, [0.1, 5.0]),
    ("yaw_limit_rad_s", "rad/s", |s| &mut s.yaw_limit_rad_s, [0.1, 20.0]),
    ("rim_limit_m_s", "m/s", |s| &mut s.rim_limit_m_s, [0.1, 20.0]),
    ("speed_lag_s", "s", |s| &mut s.speed_lag_s, [0.01, 2.0]),
    ("yaw_lag_s", "s", |s| &mut s.yaw_lag_s, [0.01, 2.0]),
    ("dead_time_s[0]", "s", |s| &mut s.dead_time_s[0], [0.0, 0.6]),
    ("dead_time_s[1]", "s", |s| &mut s.dead_time_s[1], [0.0, 0.6]),
    ("acceleration_limit[0]", "m/s²", |s| &mut s.acceleration_limit[0], [0.05, RimServo::NO_LIMIT]),
    ("acceleration_limit[1]", "rad/s²", |s| &mut s.acceleration_limit[1], [0.05, RimServo::NO_LIMIT]),
];

/// Numbers of a fitted servo that lie at an end of their range, none where the card's stood. A dead time or a ramp that nothing asks for is no end.
pub(crate) fn at_ends(card: &RimServo, fitted: &RimServo) -> Vec<AtEnd> {
    if card == fitted {
        return Vec::new();
    }
    let mut servo = *fitted;
    let asked = |value: f64| value != 0.0 && value != RimServo::NO_LIMIT;
    let numbers = KNOBS.iter().map(|&(name, unit, knob, range)| (name, unit, *knob(&mut servo), range));
    let ends = numbers.filter(|(_, _, value, _)| asked(*value));
    ends.filter_map(|(name, unit, value, range)| AtEnd::of(format!("driveline.rims.{name}"), unit, value, range)).collect()
}

/// Dead time, s, from which a search begins where it may be that there is one.
const DEAD_TIME_S: f64 = 0.2;
/// Share of the error of the rims that a dead time has to take away, as a rollout costs more with one.
const DEAD_TIME_GAIN_MIN: f64 = 0.01;
/// Rounds of a search, and the share of the error below which one gains nothing.
const ROUNDS: i32 = 16;
const GAIN_MIN: f64 = 1e-4;

/// A drive whose wheel speeds (FL, FR, RL, RR, rad/s) were measured.
#[derive(Clone, Copy, Debug)]
struct Log<'a> {
    drive: &'a Drive,
    wheel_speed_rad_s: &'a [[f64; WHEELS]],
}

impl<'a> Log<'a> {
    fn of(drive: &'a Drive) -> Option<Self> {
        let wheel_speed_rad_s = drive.wheel_speed_rad_s.as_deref().filter(|wheels| wheels.len() > 1)?;
        Some(Self { drive, wheel_speed_rad_s })
    }

    /// Mean rim speed (m/s) and turning of the rims (rad/s) at every sample.
    fn twists(&self, vehicle: &Vehicle) -> impl Iterator<Item = [f64; 2]> {
        self.wheel_speed_rad_s.iter().map(|wheels| rim_twist(vehicle, wheels))
    }

    /// Sum of squares of what both rims deviate by when the servo runs freely from the first sample, (m/s)², and the number of samples.
    fn deviation(&self, vehicle: &Vehicle, dt_s: f64) -> (f64, usize) {
        let run = free_run(vehicle, &self.wheel_speed_rad_s[0], &self.drive.controls, dt_s);
        run.zip(&self.wheel_speed_rad_s[1..]).fold((0.0, 0), |(sum, count), (state, wheels)| {
            let ([left, right], [run_left, run_right]) = (rim_speeds_m_s(vehicle, wheels), state.rim_speeds_m_s(vehicle));
            (sum + 0.5 * ((left - run_left).powi(2) + (right - run_right).powi(2)), count + 1)
        })
    }
}

/// Mean square error of the rims, (m/s)², when the servo runs freely from each drive's first sample.
fn servo_error(vehicle: &Vehicle, logs: &[Log<'_>], dt_s: f64) -> f64 {
    let by_drive: Vec<(f64, usize)> = logs.par_iter().map(|log| log.deviation(vehicle, dt_s)).collect();
    let (sum, count) = by_drive.iter().fold((0.0, 0), |(sum, count), own| (sum + own.0, count + own.1));
    sum / count.max(1) as f64
}

/// Where a search begins: limits at the largest of these twists (m/s, rad/s) and lags of 0.2 s, the rest as it is.
fn begun(servo: RimServo, track_m: f64, twists: impl Iterator<Item = [f64; 2]>) -> RimServo {
    let limits = twists.fold([0.1f64; 2], |[turning, rim], [speed_m_s, turning_rad_s]| {
        [turning.max(turning_rad_s.abs()), rim.max(speed_m_s.abs() + 0.5 * track_m * turning_rad_s.abs())]
    });
    RimServo { yaw_limit_rad_s: limits[0], rim_limit_m_s: limits[1], speed_lag_s: 0.2, yaw_lag_s: 0.2, ..servo }
}

/// The servo that follows the measured wheel speeds best, by coordinate search, and where wheel speeds ask for a dead time the one that follows them best with one; none where
/// no drive has wheel speeds. Which of the two the motion follows better is for others to say: a start that is known badly is held on to for a dead time.
pub fn fit_rims(vehicle: &Vehicle, drives: &[&Drive], dt_s: f64) -> Vec<RimServo> {
    let measured: Vec<Log<'_>> = drives.iter().filter_map(|drive| Log::of(drive)).collect();
    let sides = |log: &Log<'_>| log.wheel_speed_rad_s.iter().map(|wheels| rim_speeds_m_s(vehicle, wheels)).collect::<Vec<_>>();
    let limited = limited_starts(&measured.iter().map(sides).collect::<Vec<_>>());
    let logs: Vec<Log<'_>> = measured.iter().zip(limited).filter(|(_, limited)| !limited).map(|(log, _)| *log).collect();
    if logs.is_empty() {
        return Vec::new();
    }
    // Limits show as the largest values that were measured: a search that begins there does not take a limit for a small gain, nor a ramp for a lag.
    let begin = begun(RimServo::default(), vehicle.track_m, measured.iter().flat_map(|log| log.twists(vehicle)));
    let led = RimServo { acceleration_limit: fastest(vehicle, &logs, dt_s), ..begin };
    let best_of = |dead_time_s: f64| {
        let found = [begin, led].map(|servo| searched(vehicle, RimServo { dead_time_s: [dead_time_s; 2], ..servo }, &logs, dt_s));
        let [lagged, led] = found;
        if led.1 < lagged.1 { led } else { lagged }
    };
    let [at_once, late] = [0.0, DEAD_TIME_S].map(best_of);
    let asked_for = late.1 < (1.0 - DEAD_TIME_GAIN_MIN) * at_once.1;
    let turns = |servo: RimServo| match turn_efficiency(vehicle, &measured) {
        Some(turn_efficiency) => RimServo { turn_efficiency, ..servo },
        None => servo,
    };
    std::iter::once(at_once).chain(asked_for.then_some(late)).map(|(servo, _)| turns(servo)).collect()
}

/// Largest mean accelerations over half a second: of the mean rim speed, m/s², and of the turning of the rims, rad/s².
fn fastest(vehicle: &Vehicle, logs: &[Log<'_>], dt_s: f64) -> [f64; 2] {
    let span = (0.5 / dt_s).round().max(1.0) as usize;
    let rate = |a: &[f64; 2], b: &[f64; 2], i: usize| (b[i] - a[i]).abs() / (span as f64 * dt_s);
    logs.iter().fold([0.1f64; 2], |largest, log| {
        let twists: Vec<[f64; 2]> = log.twists(vehicle).collect();
        let pairs = || twists.iter().zip(twists.iter().skip(span));
        core::array::from_fn(|i| pairs().map(|(a, b)| rate(a, b, i)).fold(largest[i], f64::max))
    })
}

/// The servo that a coordinate search from one leads to, and its error. What is zero stays so.
fn searched(vehicle: &Vehicle, from: RimServo, logs: &[Log<'_>], dt_s: f64) -> (RimServo, f64) {
    let mut best = vehicle.clone();
    best.driveline.rims = from;
    let mut error = servo_error(&best, logs, dt_s);
    for round in 0..ROUNDS {
        let before = error;
        for (_, _, knob, [low, high]) in KNOBS {
            let mut reach = 0.5 / f64::from(1 << round.min(5));
            while reach > 0.000_5 && *knob(&mut best.driveline.rims) > 0.0 {
                let current = *knob(&mut best.driveline.rims);
                let mut improved = false;
                for trial in [current / (1.0 + reach), current * (1.0 + reach)] {
                    let mut candidate = best.clone();
                    *knob(&mut candidate.driveline.rims) = trial.clamp(low, high);
                    let found = servo_error(&candidate, logs, dt_s);
                    if found < error {
                        (best, error, improved) = (candidate, found, true);
                    }
                }
                if !improved {
                    reach *= 0.5;
                }
            }
        }
        if round > 5 && before - error < GAIN_MIN * before {
            break;
        }
    }
    (best.driveline.rims, error)
}

/// The servo with which the symbolic model follows the measured motion best, for a base whose wheel speeds nobody measured. The error, m, is that of the position
/// with what the error of the heading moves a wheel by, half of the track away. The servo stays as it is where none that is found is better; `progress` is told a
/// number and the error after each of its turns.
pub fn fit_rims_to_motion(
    vehicle: &Vehicle,
    drives: &[&Drive],
    scales: &Normalization,
    mut progress: impl FnMut(f64, f64),
    interrupted: &dyn Fn() -> bool,
) -> RimServo {
    let error = |vehicle: &Vehicle| {
        let of = symbolic_error(vehicle, drives, scales);
        of.position_m + 0.5 * vehicle.track_m * of.yaw_rad
    };
    let before = error(vehicle);
    let mut found = vehicle.clone();
    // Limits begin where the commands do not reach them: from there a search sees them.
    let commands = drives.iter().flat_map(|d| &d.controls).map(|c| [c.speed_m_s, c.second]);
    found.driveline.rims = begun(vehicle.driveline.rims, vehicle.track_m, commands);
    let mut best = error(&found);
    for reach in [0.5, 0.2, 0.1] {
        for (_, _, knob, [low, high]) in KNOBS_OF_MOTION {
            let trials = |vehicle: &Vehicle, reach: f64| {
                [1.0 / (1.0 + reach), 1.0 + reach].map(|factor| {
                    let mut trial = vehicle.clone();
                    let value = knob(&mut trial.driveline.rims);
                    *value = (*value * factor).clamp(low, high);
                    trial
                })
            };
            if interrupted() {
                break;
            }
            best = descend(&mut found, best, reach, trials, error);
            progress(*knob(&mut found.driveline.rims), best);
        }
    }
    if best < before { found.driveline.rims } else { vehicle.driveline.rims }
}

/// Yaw rate of the vehicle per turning of its rims, by least squares; `None` if the rims never turn or the vehicle does not follow them.
fn turn_efficiency(vehicle: &Vehicle, logs: &[Log<'_>]) -> Option<f64> {
    let (mut product, mut square) = (0.0, 0.0);
    for log in logs {
        for (state, [_, turning]) in log.drive.states.iter().zip(log.twists(vehicle)) {
            product += turning * state.angular_velocity_rad_s[2];
            square += turning * turning;
        }
    }
    let share = product / square;
    (share > 0.05 && share < 2.0).then_some(share)
}
