//! Which point of the vehicle positions are of.

use nesam_physics::{SecondCommand, Vehicle};
use nesam_trajectories::Trajectory;

use super::relation::means;
use super::{Doubt, SPEED_M_S, YAW_RATE_RAD_S, doubt, forward_m_s, left_m_s};

/// Lateral acceleration up to which tyres hardly slide, m/s² (chosen: on soft soil of the simulator the point is found to a quarter of its distance).
const SLOW_M_S2: f64 = 1.0;
/// Stretches to the left and to the right from which on their middles say something (chosen).
const STRETCHES_MIN: usize = 10;
/// Distance from where positions should be of, in parts of the wheelbase, from which on they are doubted: of a car, whose rear axle does not move sideways, and of a
/// skid-steer base, which turns about a point between its axles (chosen: 0.13 on the softest ground of the simulator, 0.18 of the Husky).
const APART: [f64; 2] = [0.25, 0.5];

/// Positions of a point that moves sideways otherwise than the reference point does. In a slow turn a point moves to the left by the yaw rate times its distance ahead of
/// the one that does not move sideways. A heading that is wrong by a constant tells left and right turns apart, and not their mean.
pub(super) fn moves_sideways(drives: &[Trajectory], vehicle: &Vehicle) -> Option<Doubt> {
    let turning = means(drives, |drive, k, world| {
        let state = &drive.states[k];
        let (forward_m_s, yaw_rate_rad_s) = (forward_m_s(drive, k, world), state.angular_velocity_rad_s[2]);
        let told = forward_m_s.abs() > SPEED_M_S && (forward_m_s * yaw_rate_rad_s).abs() < SLOW_M_S2;
        told.then(|| [yaw_rate_rad_s, left_m_s(drive, k, world)])
    });
    let ahead_m = |side: f64| {
        let turns = turning.iter().filter(|[rate, _]| side * rate >= YAW_RATE_RAD_S);
        let mut ahead_m: Vec<f64> = turns.map(|[rate, left]| left / rate).collect();
        ahead_m.sort_by(f64::total_cmp);
        (ahead_m.len() >= STRETCHES_MIN).then(|| ahead_m[ahead_m.len() / 2])
    };
    let ahead_m = 0.5 * (ahead_m(1.0)? + ahead_m(-1.0)?);
    let is_car = vehicle.second != SecondCommand::YawRateRadS;
    let [_, _, left, right] = vehicle.wheel_centre_m;
    let (expected_m, apart) = if is_car { (-0.5 * (left[0] + right[0]), APART[0]) } else { (0.0, APART[1]) };
    let off_m = ahead_m - expected_m;
    let what = if is_car && ahead_m.abs() < APART[0] * expected_m {
        format!("positions are of the rear axle, and not of the reference point of the card, {expected_m:.2} m ahead of it")
    } else {
        let side = if off_m > 0.0 { "ahead of" } else { "behind" };
        format!(
            "positions are of a point {:.2} m {side} the reference point of the card, by how it moves sideways in slow turns",
            off_m.abs()
        )
    };
    let change = if off_m > 0.0 { "smaller" } else { "larger" };
    let advice = format!(
        "import with an X of `--reference X,Y,Z` that is {:.2} m {change} than it was (0 where none was given), unless the card has the axles elsewhere than the vehicle",
        off_m.abs()
    );
    (off_m.abs() > apart * vehicle.wheelbase_m).then(|| doubt(what, advice))
}
