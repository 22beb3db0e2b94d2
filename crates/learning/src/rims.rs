//! Calibration of a skid-steer base's rim servo: what it makes of a commanded twist, on measured wheel speeds apart from what the ground makes of the rims, or,
//! where nobody measured them, together with that on the motion.

use nesam_model::Normalization;
use nesam_physics::driveline::{DrivelineState, rim_twist};
use nesam_physics::{RimServo, Vehicle};

use crate::drives::Drive;
use crate::symbolic::{descend, symbolic_error};

/// A number of the servo that is fitted, with its range.
type Knob = (fn(&mut RimServo) -> &mut f64, [f64; 2]);

/// Those that the motion alone tells; the others are told by measured rims.
pub(crate) const KNOBS_OF_MOTION: [Knob; 6] = [KNOBS[0], KNOBS[1], KNOBS[2], KNOBS[3], KNOBS[4], KNOBS[5]];

const KNOBS: [Knob; 8] = [
    (|s| &mut s.speed_gain, [0.1, 5.0]),
    (|s| &mut s.yaw_gain, [0.1, 5.0]),
    (|s| &mut s.yaw_limit_rad_s, [0.1, 20.0]),
    (|s| &mut s.rim_limit_m_s, [0.1, 20.0]),
    (|s| &mut s.speed_lag_s, [0.01, 2.0]),
    (|s| &mut s.yaw_lag_s, [0.01, 2.0]),
    (|s| &mut s.acceleration_limit[0], [0.05, RimServo::NO_LIMIT]),
    (|s| &mut s.acceleration_limit[1], [0.05, RimServo::NO_LIMIT]),
];

/// Mean rim speed (m/s) and turning of the rims (rad/s) over a drive.
fn rim_twists(vehicle: &Vehicle, drive: &Drive) -> Option<Vec<[f64; 2]>> {
    Some(drive.wheel_speed_rad_s.as_ref()?.iter().map(|w| rim_twist(vehicle, w)).collect())
}

/// Mean square error of the rims, (m/s)², when the servo runs freely from each drive's first sample.
fn servo_error(vehicle: &Vehicle, measured: &[(&Drive, Vec<[f64; 2]>)], dt_s: f64) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for (drive, twists) in measured {
        let mut state = DrivelineState::turning(vehicle, twists[0]);
        for (control, twist) in drive.controls.iter().zip(&twists[1..]) {
            state = state.advance(vehicle, control, 0.0, dt_s);
            let speed = state.rim_speed_m_s - twist[0];
            let turning = 0.5 * vehicle.track_m * (state.steering - twist[1]);
            sum += speed * speed + turning * turning;
            count += 1;
        }
    }
    sum / count.max(1) as f64
}

/// Where a search begins: limits at the largest of these twists (m/s, rad/s) and lags of 0.2 s, the rest as it is.
fn begun(servo: RimServo, track_m: f64, twists: impl Iterator<Item = [f64; 2]>) -> RimServo {
    let limits = twists.fold([0.1f64; 2], |[turning, rim], [speed_m_s, turning_rad_s]| {
        [turning.max(turning_rad_s.abs()), rim.max(speed_m_s.abs() + 0.5 * track_m * turning_rad_s.abs())]
    });
    RimServo { yaw_limit_rad_s: limits[0], rim_limit_m_s: limits[1], speed_lag_s: 0.2, yaw_lag_s: 0.2, ..servo }
}

/// The servo that follows the measured wheel speeds best, by coordinate search; `None` where no drive has wheel speeds.
pub fn fit_rims(vehicle: &Vehicle, drives: &[&Drive], dt_s: f64) -> Option<RimServo> {
    let measured: Vec<(&Drive, Vec<[f64; 2]>)> =
        drives.iter().filter_map(|d| Some((*d, rim_twists(vehicle, d)?))).filter(|(_, twists)| twists.len() > 1).collect();
    if measured.is_empty() {
        return None;
    }
    // Limits show as the largest values that were measured: a search that begins there does not take a limit for a small gain, nor a ramp for a lag.
    let begin = begun(RimServo::default(), vehicle.track_m, measured.iter().flat_map(|(_, twists)| twists).copied());
    let led = RimServo { acceleration_limit: fastest(&measured, dt_s), ..begin };
    let found = [begin, led].map(|servo| searched(vehicle, servo, &measured, dt_s));
    let [(mut servo, lagged), (ramp, led)] = found;
    if led < lagged {
        servo = ramp;
    }
    if let Some(share) = turn_efficiency(&measured) {
        servo.turn_efficiency = share;
    }
    Some(servo)
}

/// Largest mean accelerations over half a second: of the mean rim speed, m/s², and of the turning of the rims, rad/s².
fn fastest(measured: &[(&Drive, Vec<[f64; 2]>)], dt_s: f64) -> [f64; 2] {
    let span = (0.5 / dt_s).round().max(1.0) as usize;
    let rate = |a: &[f64; 2], b: &[f64; 2], i: usize| (b[i] - a[i]).abs() / (span as f64 * dt_s);
    let pairs = || measured.iter().flat_map(|(_, twists)| twists.iter().zip(twists.iter().skip(span)));
    core::array::from_fn(|i| pairs().map(|(a, b)| rate(a, b, i)).fold(0.1, f64::max))
}

/// The servo that a coordinate search from one leads to, and its error.
fn searched(vehicle: &Vehicle, from: RimServo, measured: &[(&Drive, Vec<[f64; 2]>)], dt_s: f64) -> (RimServo, f64) {
    let mut best = vehicle.clone();
    best.driveline.rims = from;
    let mut error = servo_error(&best, measured, dt_s);
    for round in 0..16 {
        for (knob, [low, high]) in KNOBS {
            let mut reach = 0.5 / f64::from(1 << round.min(5));
            while reach > 0.000_5 {
                let current = *knob(&mut best.driveline.rims);
                let mut improved = false;
                for trial in [current / (1.0 + reach), current * (1.0 + reach)] {
                    let mut candidate = best.clone();
                    *knob(&mut candidate.driveline.rims) = trial.clamp(low, high);
                    let found = servo_error(&candidate, measured, dt_s);
                    if found < error {
                        (best, error, improved) = (candidate, found, true);
                    }
                }
                if !improved {
                    reach *= 0.5;
                }
            }
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
        for (knob, [low, high]) in KNOBS_OF_MOTION {
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
fn turn_efficiency(measured: &[(&Drive, Vec<[f64; 2]>)]) -> Option<f64> {
    let (mut product, mut square) = (0.0, 0.0);
    for (drive, twists) in measured {
        for (state, twist) in drive.states.iter().zip(twists) {
            product += twist[1] * state.angular_velocity_rad_s[2];
            square += twist[1] * twist[1];
        }
    }
    let share = product / square;
    (share > 0.05 && share < 2.0).then_some(share)
}
