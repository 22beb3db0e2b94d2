//! Whether the vehicle goes where it points.

use std::f64::consts::{FRAC_PI_2, PI};
use std::ops::Range;

use nesam_physics::wrap_angle;
use nesam_trajectories::Trajectory;

use super::relation::surely_most;
use super::{Doubt, doubt, ground_velocity_m_s, stretches};

/// Speed over ground from which on a direction of motion is known, m/s.
const MOVING_M_S: f64 = 0.7;
/// Angle between heading and motion that is let pass on the whole, rad: vehicles slide.
const SLIDES_RAD: f64 = 0.45;
/// Agreement of directions, 0 to 1, that is none by chance.
const AGREE: f64 = 0.8;

/// A heading turns no faster than this many times the fastest yaw rate (chosen, as positions).
const FASTER: f64 = 2.0;
/// What it may turn beyond that, rad (chosen: poses correct themselves).
const CORRECTION_RAD: f64 = 0.5;
/// Fastest yaw rate where no gyro tells one, rad/s (chosen: beyond that of ground vehicles).
const UNMEASURED_RAD_S: f64 = 3.0;

/// Headings that no yaw rate of the drive reaches.
pub(super) fn turns(drives: &[Trajectory]) -> Option<Doubt> {
    let mut found: Vec<(&Trajectory, usize, f64, f64, f64)> = Vec::new();
    for drive in drives {
        let rates = drive.states.iter().map(|s| s.angular_velocity_rad_s[2].abs());
        let fastest_rad_s = if drive.measured.angular_velocity[2] { rates.fold(0.0, f64::max) } else { UNMEASURED_RAD_S };
        let (mut begin, yaw) = (0, |k: usize| drive.states[k].attitude_rad[2]);
        for k in 1..drive.states.len() {
            let turned = wrap_angle(yaw(k) - yaw(k - 1)).abs();
            if turned == 0.0 {
                continue;
            }
            // A heading that was held catches up.
            let time_s = (k - begin) as f64 * drive.dt_s;
            if turned > FASTER * fastest_rad_s * time_s + CORRECTION_RAD {
                found.push((drive, k, turned, time_s, fastest_rad_s));
            }
            begin = k;
        }
    }
    let (drive, k, turned, time_s, fastest_rad_s) = found.iter().max_by(|a, b| a.2.total_cmp(&b.2))?;
    let what = format!(
        "the heading jumps {} times: in `{}` by {:.0} degrees within {time_s:.1} s at {:.1} s, where no yaw rate is above {fastest_rad_s:.1} rad/s",
        found.len(),
        drive.id,
        turned.to_degrees(),
        drive.time_s[*k]
    );
    Some(doubt(
        what,
        "it seems to be taken from the course over ground, or to be lost in between: part the drives there, or leave them out",
    ))
}

/// The vehicle goes where it points.
pub(super) fn heading(drives: &[Trajectory]) -> Option<Doubt> {
    let apart: Vec<[f64; 2]> = drives.iter().flat_map(|drive| stretches(drive).filter_map(|stretch| apart(drive, stretch))).collect();
    let [straight, negated] = [0, 1].map(|i| apart.iter().map(|angles| angles[i]).collect::<Vec<f64>>());
    let (direction, agreement) = mean_direction(&straight);
    let (_, clockwise) = mean_direction(&negated);
    let off = straight.iter().filter(|angle| angle.abs() > SLIDES_RAD).count();
    if !surely_most(off, straight.len()) {
        return None;
    }
    // A vehicle that goes straight all the time has a fixed angle to both.
    if clockwise > AGREE && clockwise > agreement + 0.1 {
        let what =
            format!("the heading turns against the direction of motion (agreement {agreement:.2} of 1, {clockwise:.2} when negated)");
        return Some(doubt(what, "the yaw seems to count clockwise, like a compass; import with `--frame ned-frd` or negate it"));
    }
    if agreement > AGREE {
        let advice = if direction.abs() > PI - SLIDES_RAD {
            "x of the body seems to point to the rear, the yaw to be off by 180 degrees, or the speed command to be negated"
        } else if (direction.abs() - FRAC_PI_2).abs() < SLIDES_RAD {
            "the yaw seems to count from north; it must count from the x axis of World (east)"
        } else {
            "the position and the attitude seem to be in different frames"
        };
        return Some(doubt(format!("the vehicle moves {:.0} degrees off its heading", direction.to_degrees()), advice));
    }
    let advice = "the yaw seems to be in degrees, or of another frame";
    Some(doubt(format!("heading and direction of motion are unrelated (agreement {agreement:.2} of 1)"), advice))
}

/// Angle from the heading to the motion of a stretch, and from the negated heading, rad; `None` where the vehicle hardly moves.
fn apart(drive: &Trajectory, stretch: Range<usize>) -> Option<[f64; 2]> {
    let samples = stretch.len() as f64;
    let mut sums = [[0.0; 2]; 3];
    for k in stretch {
        let ([x, y, _], yaw) = (ground_velocity_m_s(drive, k), drive.states[k].attitude_rad[2]);
        let forward = if drive.controls[k].speed_m_s < 0.0 { -1.0 } else { 1.0 };
        for (sum, angle) in sums.iter_mut().zip([0.0, yaw, -yaw]) {
            let (sin, cos) = angle.sin_cos();
            *sum = [sum[0] + forward * (cos * x + sin * y), sum[1] + forward * (cos * y - sin * x)];
        }
    }
    let [way, straight, negated] = sums;
    (way[0].hypot(way[1]) > MOVING_M_S * samples).then(|| [straight, negated].map(|[x, y]| y.atan2(x)))
}

/// Direction of the mean of unit vectors, and how much they agree, 0 to 1.
fn mean_direction(angles: &[f64]) -> (f64, f64) {
    let n = angles.len().max(1) as f64;
    let (c, s) = angles.iter().fold((0.0, 0.0), |(c, s), a| (c + a.cos(), s + a.sin()));
    (s.atan2(c), c.hypot(s) / n)
}
