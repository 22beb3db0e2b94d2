//! Whether positions follow one another as those of a vehicle do.

use std::ops::Range;

use nesam_physics::Vehicle;
use nesam_trajectories::Trajectory;

use super::{Doubt, doubt, measures_velocity, rim_speed_m_s};

/// Time, s, and way that is told meanwhile, m, from which on unchanged positions are doubted (chosen: the lidar poses of the Husky stay for 0.9 s and 0.9 m).
const FROZEN: (f64, f64) = (1.5, 1.0);
/// A vehicle moves no further than this many times its fastest speed tells (chosen: slip, lag, and a wrong unit, which is told elsewhere).
const FASTER: f64 = 2.0;
/// What it may move beyond that, m (chosen: poses of the Husky correct themselves by 0.8 m at most).
const CORRECTION_M: f64 = 1.0;
/// More jumps than one in so many steps are often: a unit, which the velocities tell, or positions of two places (chosen).
const JUMPS_ONE_IN: usize = 20;
/// Positions within this share of the way of a jump are back where it began (chosen).
const BACK: f64 = 0.5;
/// Share of the jumps after which positions come back, from which on they go to and fro (chosen): of single positions that mean none it is half.
const TO_AND_FRO: f64 = 0.25;

/// Coordinates beyond this are doubted, m: single precision has steps of 8 mm there (chosen).
const FAR_M: f64 = 1e5;

/// Positions so far from the origin that what the service answers, in single precision, is coarse.
pub(super) fn far_from_origin(positions_m: impl Iterator<Item = [f64; 3]>) -> Option<Doubt> {
    let farthest_m = positions_m.fold(0.0, |farthest: f64, [x, y, _]| farthest.max(x.abs()).max(y.abs()));
    if farthest_m <= FAR_M {
        return None;
    }
    let rounded = farthest_m as f32;
    let step_m = f64::from(rounded.next_up()) - f64::from(rounded);
    let what = format!("coordinates reach {:.0} km", farthest_m / 1e3);
    let advice = format!(
        "`nesam evaluate` scores them unrounded, but states that the service answers are f32, in steps of {step_m:.2} m there: give it poses and \
         maps from an origin nearby"
    );
    Some(doubt(what, advice))
}

/// Samples without a break at one position in the first two or three axes, to the bit: sensors have noise, and one that repeats itself exactly has nothing new.
fn stays(drive: &Trajectory, axes: usize) -> Vec<Range<usize>> {
    let mut begin = 0;
    let stays = drive.states.chunk_by(|a, b| a.position_m[..axes] == b.position_m[..axes]).map(|stay| {
        begin += stay.len();
        begin - stay.len()..begin
    });
    stays.collect()
}

/// Speed at a sample as it is measured other than by positions, m/s: of the body, else of the rims.
fn told_m_s(drive: &Trajectory, vehicle: &Vehicle, k: usize) -> Option<f64> {
    let [x, y, _] = drive.states[k].velocity_m_s;
    let rims = rim_speed_m_s(drive, vehicle, k).map(f64::abs);
    if measures_velocity(drive) { Some(x.hypot(y)) } else { rims }
}

/// Positions that stay while the vehicle is said to move.
pub(super) fn frozen(drives: &[Trajectory], vehicle: &Vehicle) -> Option<Doubt> {
    let longest_m = |drive: &Trajectory| {
        let told = stays(drive, 2).into_iter().map(|stay| {
            let way_m = stay.clone().filter_map(|k| told_m_s(drive, vehicle, k)).sum::<f64>() * drive.dt_s;
            (way_m, stay.len() as f64 * drive.dt_s, drive.time_s[stay.start])
        });
        told.filter(|(way_m, time_s, _)| *time_s >= FROZEN.0 && *way_m >= FROZEN.1).max_by(|a, b| a.0.total_cmp(&b.0))
    };
    let found: Vec<_> = drives.iter().filter_map(|drive| Some((drive, longest_m(drive)?))).collect();
    let (drive, (way_m, time_s, at_s)) = found.iter().max_by(|a, b| a.1.0.total_cmp(&b.1.0))?;
    let what = format!(
        "positions are frozen in {} of {} drives: in `{}` for {time_s:.1} s from {at_s:.1} s on, while velocities or wheels say {way_m:.1} m",
        found.len(),
        drives.len(),
        drive.id
    );
    Some(doubt(what, "the localisation seems to have stopped: leave those drives out, or part them there"))
}

/// Positions that no speed of the drive reaches.
pub(super) struct Jumps {
    pub(super) doubt: Doubt,
    /// More than one in [`JUMPS_ONE_IN`] steps.
    pub(super) often: bool,
    /// Positions come back after them.
    pub(super) back_and_forth: bool,
}

/// Positions that no speed of the drive reaches.
pub(super) fn jumps(drives: &[Trajectory], vehicle: &Vehicle) -> Option<Jumps> {
    let found: Vec<Jump> = drives.iter().flat_map(|drive| jumps_of(drive, vehicle, Way::Horizontal)).collect();
    let steps: usize = drives.iter().map(|drive| drive.states.len()).sum();
    let (count, back_and_forth) = (found.len(), back_and_forth(&found));
    let what = in_words("positions", &found, back_and_forth)?;
    let advice = if back_and_forth {
        "two recordings seem to be in one, or zeros or the like to stand for positions that are missing: leave such cells empty"
    } else {
        "the localisation seems to have been set anew: part the drives there, or leave them out"
    };
    Some(Jumps { doubt: doubt(what, advice), often: count * JUMPS_ONE_IN > steps, back_and_forth })
}

/// What of positions jumps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Way {
    Horizontal,
    Height,
}

pub(super) struct Jump<'a> {
    drive: &'a str,
    way_m: f64,
    time_s: f64,
    at_s: f64,
    fastest_m_s: f64,
    /// One of the next two positions lies near the one before.
    comes_back: bool,
}

/// How often something jumps, and its largest jump; `None` without any.
pub(super) fn in_words(what: &str, jumps: &[Jump], back_and_forth: bool) -> Option<String> {
    let Jump { drive, way_m, time_s, at_s, fastest_m_s, .. } = jumps.iter().max_by(|a, b| a.way_m.total_cmp(&b.way_m))?;
    let to_and_fro = if back_and_forth { "back and forth, " } else { "" };
    Some(format!(
        "{what} jump {to_and_fro}{} times: in `{drive}` by {way_m:.1} m within {time_s:.1} s at {at_s:.1} s, where no speed is above {fastest_m_s:.1} m/s",
        jumps.len()
    ))
}

/// Whether positions go to and fro between jumps.
pub(super) fn back_and_forth(jumps: &[Jump]) -> bool {
    jumps.iter().filter(|jump| jump.comes_back).count() as f64 >= TO_AND_FRO * jumps.len() as f64
}

pub(super) fn jumps_of<'a>(drive: &'a Trajectory, vehicle: &Vehicle, way: Way) -> Vec<Jump<'a>> {
    let speeds = (0..drive.states.len()).map(|k| told_m_s(drive, vehicle, k).unwrap_or(0.0).max(drive.controls[k].speed_m_s.abs()));
    let fastest_m_s = speeds.fold(0.0, f64::max);
    let stays = stays(drive, if way == Way::Height { 3 } else { 2 });
    let way_m = |a: usize, b: usize| {
        let [a, b] = [a, b].map(|i| drive.states[stays[i].start].position_m);
        if way == Way::Height { (b[2] - a[2]).abs() } else { (b[0] - a[0]).hypot(b[1] - a[1]) }
    };
    let step = |i: usize| {
        let (way_m_of, time_s) = (way_m(i, i + 1), stays[i].len() as f64 * drive.dt_s);
        let comes_back = || (i + 2..stays.len().min(i + 4)).any(|later| way_m(i, later) < BACK * way_m_of);
        let jump = || Jump {
            drive: &drive.id,
            way_m: way_m_of,
            time_s,
            at_s: drive.time_s[stays[i + 1].start],
            fastest_m_s,
            comes_back: comes_back(),
        };
        (way_m_of > FASTER * fastest_m_s * time_s + CORRECTION_M).then(jump)
    };
    (0..stays.len().saturating_sub(1)).filter_map(step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: coordinates that the wire rounds are told of, with by how much. Method: the steps of f32 below 2^17 (1/128 m) and from 2^22 on (1/2 m).
    #[test]
    fn analytic_coordinates_beyond_single_precision_are_doubted() {
        let doubt = |x_m: f64, y_m: f64| far_from_origin([[0.0; 3], [x_m, y_m, 1e6]].into_iter());
        assert_eq!(doubt(-9.9e4, 9.9e4), None);
        let local = doubt(-1.01e5, 0.0).expect("beyond");
        assert!(local.what.contains("101 km") && local.advice.contains("steps of 0.01 m"), "{local:?}");
        let utm = doubt(431_000.0, 4_583_000.0).expect("beyond");
        assert!(utm.what.contains("4583 km") && utm.advice.contains("steps of 0.50 m"), "{utm:?}");
    }
}
