//! Whether wheel speeds fit positions and headings, wheel by wheel.

use nesam_physics::{Vehicle, WHEELS};
use nesam_trajectories::Trajectory;

use super::relation::{Relation, wheel_speeds};
use super::{Doubt, SPEED_M_S, YAW_RATE_RAD_S, angle_rate_rad_s, doubt, forward_m_s, rim_speed_m_s};

/// Rim speeds per speed over ground that are let pass: wheels slip.
const SLIPS: [f64; 2] = [0.5, 2.0];
/// Share of the speed that the turning may make at a wheel: what a skid-steer vehicle slips in turning is no wrong unit (chosen).
const STRAIGHT: f64 = 0.1;
/// Share of the seconds of turning in which an axle that disagrees alone must do so (chosen: light or slipping axles of sound drives stay below).
const ALONE: f64 = 0.75;
const NAMES: [&str; WHEELS] = ["FL", "FR", "RL", "RR"];
const BACKWARDS: &str = "wheels counted backwards";
/// What swaps the sides of a log that agrees with itself in all else.
const MIRRORED: &str = "; or the log has y to the right and yaw clockwise, as PX4 and ArduPilot have: import it with `--frame ned-frd`";

/// Rims go as fast as the ground below the vehicle: the wheels that do not, where they are fewer than all, and else the mean of all.
pub(super) fn speeds(drives: &[Trajectory], vehicle: &Vehicle) -> Vec<Doubt> {
    let units = wheel_speeds(vehicle.wheel_radius_m);
    let judge = |relation: &Relation, of: &str| {
        relation.judge(&format!("rim speed{of} (wheel speed times radius)"), "positions", SLIPS, BACKWARDS, &units)
    };
    let wheel = |i: usize| {
        Relation::of(drives, SPEED_M_S, |drive, k, v| {
            let (forward, rim) = (forward_m_s(drive, k, v), drive.wheel_speed_rad_s.as_ref()?[k][i] * vehicle.wheel_radius_m);
            // A pose that freezes in turning does not turn, the gyro does.
            let yaw_rate = angle_rate_rad_s(drive, k, 2).abs().max(drive.states[k].angular_velocity_rad_s[2].abs());
            (yaw_rate * vehicle.wheel_centre_m[i][1].abs() <= STRAIGHT * forward.abs().max(rim.abs())).then_some([forward, rim])
        })
    };
    let wrong: Vec<(usize, Relation)> = (0..WHEELS).map(|i| (i, wheel(i))).filter(|(_, relation)| judge(relation, "").is_some()).collect();
    if wrong.is_empty() || wrong.len() == WHEELS {
        let mean = Relation::of(drives, SPEED_M_S, |drive, k, v| Some([forward_m_s(drive, k, v), rim_speed_m_s(drive, vehicle, k)?]));
        return judge(&mean, "").into_iter().collect();
    }
    let mut told: Vec<(Vec<&str>, &Relation)> = Vec::new();
    for (i, relation) in &wrong {
        // The coupled wheels of a side have one channel.
        match told.iter_mut().find(|(_, other)| *other == relation) {
            Some((names, _)) => names.push(NAMES[*i]),
            None => told.push((vec![NAMES[*i]], relation)),
        }
    }
    told.iter().filter_map(|(names, relation)| judge(relation, &format!(" of {}", names.join(" and ")))).collect()
}

/// The right wheels of an axle are the faster ones where the vehicle turns to the left.
///
/// Where one axle alone disagrees, a wheel that drags or spins is in question too: it is slower or faster whichever way the vehicle turns.
pub(super) fn sides(drives: &[Trajectory], vehicle: &Vehicle) -> Vec<Doubt> {
    let axle = |[left, right]: [usize; 2]| {
        let track_m = vehicle.wheel_centre_m[left][1] - vehicle.wheel_centre_m[right][1];
        Relation::of(drives, YAW_RATE_RAD_S, |drive, k, _| {
            let wheels = drive.wheel_speed_rad_s.as_ref()?[k];
            Some([angle_rate_rad_s(drive, k, 2), (wheels[right] - wheels[left]) * vehicle.wheel_radius_m / track_m])
        })
    };
    let told = |name: &str, (count, of): (usize, usize), or_else: &str| {
        let what = format!("{name} left and right wheels turn against the yaw in {count} of {of} seconds of turning");
        doubt(what, format!("the left and right wheel speeds seem to be swapped: swap their columns{or_else}"))
    };
    let axles = [axle([0, 1]), axle([2, 3])];
    let [front, rear] = axles.each_ref().map(|axle| axle.reversed(YAW_RATE_RAD_S));
    if let (Some(both), Some(_)) = (front, rear) {
        return vec![told("the", both, MIRRORED)];
    }
    let alone = |(name, (axle, reversed)): (&str, (Relation, Option<(usize, usize)>))| {
        let clearly = reversed.filter(|(count, of)| *count as f64 >= ALONE * *of as f64)?;
        axle.about_means().reversed(YAW_RATE_RAD_S).map(|_| told(name, clearly, ""))
    };
    ["the front", "the rear"].into_iter().zip(axles.into_iter().zip([front, rear])).filter_map(alone).collect()
}
