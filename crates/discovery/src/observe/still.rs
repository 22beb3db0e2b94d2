//! Drives in which nothing moved. What was commanded had no answer of which an effect could be told the size: a drag that is large enough stops anything.

use nesam_physics::{SecondCommand, Vehicle, wrap_angle};
use nesam_trajectories::Trajectory;

use crate::error::DiscoveryError;

/// Way below which a vehicle stood, m (chosen: noise of positions and headings stays below), and share of the commanded way below which it did not follow.
const STOOD: (f64, f64) = (0.2, 0.1);
/// Speed that is no command, m/s.
const NO_COMMAND_M_S: f64 = 0.01;

/// Ways of a drive, m, turns at the wheels of a side included.
#[derive(Clone, Copy, Debug)]
struct Ways {
    /// Commanded.
    told_m: f64,
    /// The furthest from the start that poses or measured velocities say.
    moved_m: f64,
    /// Of the rims, where they were measured.
    rims_m: Option<f64>,
    /// Largest commands, m/s and rad/s.
    most: [f64; 2],
}

impl Ways {
    fn of(vehicle: &Vehicle, drive: &Trajectory) -> Self {
        let half_track_m = 0.5 * vehicle.track_m;
        // A car turns no further than it drives.
        let turns = f64::from(vehicle.second == SecondCommand::YawRateRadS);
        let commands = || drive.controls.iter().map(|c| [c.speed_m_s.abs(), turns * c.second.abs()]);
        let rims = drive.wheel_speed_rad_s.as_ref().map(|rims| {
            let mean = |wheels: &[f64; 4]| wheels.iter().map(|speed| speed.abs()).sum::<f64>() / wheels.len() as f64;
            rims.iter().map(mean).sum::<f64>() * vehicle.wheel_radius_m * drive.dt_s
        });
        Self {
            told_m: commands().map(|[speed, turning]| speed + half_track_m * turning).sum::<f64>() * drive.dt_s,
            moved_m: by_poses_m(drive, half_track_m).max(by_velocities_m(drive)),
            rims_m: rims,
            most: commands().fold([0.0; 2], |most, now| core::array::from_fn(|i| f64::max(most[i], now[i]))),
        }
    }

    /// Whether anything was commanded.
    fn told(&self, half_track_m: f64) -> bool {
        self.most[0].max(half_track_m * self.most[1]) >= NO_COMMAND_M_S
    }
}

/// The furthest from the first pose.
fn by_poses_m(drive: &Trajectory, half_track_m: f64) -> f64 {
    let Some(first) = drive.states.first() else { return 0.0 };
    let from_first = |of: &dyn Fn(usize) -> f64| (0..drive.states.len()).map(of).fold(0.0, most);
    let [x, y, _] = first.position_m;
    let away_m = from_first(&|k| (drive.states[k].position_m[0] - x).hypot(drive.states[k].position_m[1] - y));
    let turned_rad = from_first(&|k| wrap_angle(drive.states[k].attitude_rad[2] - first.attitude_rad[2]).abs());
    away_m + half_track_m * turned_rad
}

/// The furthest that measured velocities lead in the frame of the vehicle: of a localisation that has stopped they say otherwise.
fn by_velocities_m(drive: &Trajectory) -> f64 {
    if !drive.measured.linear_velocity {
        return 0.0;
    }
    let mut way_m = [0.0; 2];
    let reach_m = drive.states.iter().map(|state| {
        way_m = core::array::from_fn(|i| way_m[i] + state.velocity_m_s[i] * drive.dt_s);
        way_m[0].hypot(way_m[1])
    });
    reach_m.fold(0.0, most)
}

/// The larger of two, of which what is no number is the largest: of that nobody says that it is small.
fn most(a: f64, b: f64) -> f64 {
    if b.is_nan() { f64::INFINITY } else { a.max(b) }
}

/// Refuses drives in none of which the vehicle moved.
///
/// # Errors
/// `DiscoveryError::Drives` that says whether it was told to.
pub(crate) fn refuse_still(vehicle: &Vehicle, drives: &[Trajectory]) -> Result<(), DiscoveryError> {
    let ways: Vec<Ways> = drives.iter().map(|drive| Ways::of(vehicle, drive)).collect();
    let told = |w: &Ways| w.told(0.5 * vehicle.track_m);
    let stood = |w: &Ways| w.moved_m < if told(w) { STOOD.0.min(STOOD.1 * w.told_m) } else { STOOD.0 };
    if ways.is_empty() || !ways.iter().all(stood) {
        return Ok(());
    }
    let (count, moved_m) = (ways.len(), ways.iter().map(|w| w.moved_m).fold(0.0, f64::max));
    if !ways.iter().any(told) {
        let reason = format!(
            "nothing was commanded and nothing moved ({moved_m:.2} m at most) in the {count} drives to fit on, which therefore tell of no effect: record drives in which the \
             vehicle is driven"
        );
        return Err(DiscoveryError::Drives { reason });
    }
    let [speed, turning] = ways.iter().fold([0.0; 2], |most, w| core::array::from_fn(|i| f64::max(most[i], w.most[i])));
    let turning = if turning > 0.0 { format!(" and {turning:.2} rad/s") } else { String::new() };
    let told_m = ways.iter().map(|w| w.told_m).sum::<f64>();
    let rims_m = ways.iter().map(|w| w.rims_m).sum::<Option<f64>>().filter(|way| way.is_finite());
    let wheels = match rims_m {
        None => "",
        Some(rims_m) if rims_m < STOOD.1 * told_m => ", nor did its wheels turn",
        Some(_) => ", though its wheels turned",
    };
    let reason = format!(
        "the vehicle never moved ({moved_m:.2} m at most) in the {count} drives to fit on, in which up to {speed:.2} m/s{turning} was commanded{wheels}: it was held, stuck or \
         switched off, or its localisation stood still. No effect of the catalogue is told by that; give drives in which it moves"
    );
    Err(DiscoveryError::Drives { reason })
}

#[cfg(test)]
mod tests {
    use nesam_physics::{Control, VehicleState};
    use nesam_test_vehicles::{robot, truck};
    use nesam_trajectories::MeasuredChannels;

    use super::*;

    /// A drive of 20 s that goes ahead at a speed and is told another, and a turning, rad/s.
    fn drive(speed_m_s: f64, told: [f64; 2]) -> Trajectory {
        let at = |k: usize| VehicleState {
            position_m: [0.1 * speed_m_s * k as f64, if k.is_multiple_of(2) { 0.02 } else { 0.0 }, 0.0],
            velocity_m_s: [speed_m_s, 0.0, 0.0],
            ..VehicleState::zero()
        };
        Trajectory {
            id: "d".into(),
            set: "set".into(),
            world: None,
            split: None,
            dt_s: 0.1,
            time_s: (0..200).map(|k| 0.1 * k as f64).collect(),
            states: (0..200).map(at).collect(),
            controls: vec![Control { speed_m_s: told[0], second: told[1] }; 200],
            wheel_speed_rad_s: None,
            road_wheel_angle_rad: None,
            measured: MeasuredChannels::POSE_AND_TWIST,
            truth: None,
        }
    }

    fn reason(vehicle: &Vehicle, drives: &[Trajectory]) -> String {
        refuse_still(vehicle, drives).err().map(|error| error.to_string()).unwrap_or_default()
    }

    /// Goal: only drives in none of which anything moved are refused, in words that fit. Method: drives by hand that stand within the noise of their positions.
    #[test]
    fn analytic_drives_in_which_nothing_moved_are_refused_with_what_was_commanded() {
        let (car, base) = (truck(), robot());
        let stands = || drive(0.0, [2.0, 0.3]);
        let stuck = reason(&car, &[stands(), stands()]);
        assert!(
            stuck.starts_with("the vehicle never moved (0.02 m at most) in the 2 drives")
                && stuck.contains("up to 2.00 m/s was commanded: it was"),
            "{stuck}"
        );
        assert!(reason(&base, &[drive(0.0, [0.0, 0.3])]).contains("up to 0.00 m/s and 0.30 rad/s was commanded"));
        assert!(
            reason(&car, &[drive(0.0, [0.0, 0.3])]).starts_with("nothing was commanded and nothing moved"),
            "a car does not turn where it stands"
        );
        for (rims_rad_s, words) in [(0.0, ", nor did its wheels turn:"), (8.0, ", though its wheels turned:")] {
            let spins = Trajectory { wheel_speed_rad_s: Some(vec![[rims_rad_s; 4]; 200]), ..stands() };
            assert!(reason(&car, &[spins]).contains(words), "{words}");
        }
        assert_eq!(reason(&car, &[stands(), drive(2.0, [2.0, 0.0])]), "", "one that moves tells something");
        assert_eq!(reason(&car, &[drive(0.5, [0.0, 0.0])]), "", "it rolls or is towed");
        assert_eq!(reason(&car, &[drive(0.012, [0.012, 0.0])]), "", "it creeps as it is told");
        let frozen = Trajectory {
            states: drive(2.0, [2.0, 0.0]).states.into_iter().map(|s| VehicleState { position_m: [0.0; 3], ..s }).collect(),
            ..stands()
        };
        assert_eq!(reason(&car, &[frozen]), "", "velocities say that it moved");
        let mut unknown = stands();
        unknown.states[7].position_m[0] = f64::NAN;
        assert_eq!(reason(&car, &[unknown]), "", "of what is no number nothing is said");
    }
}
