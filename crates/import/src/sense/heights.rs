//! Whether heights are those of a vehicle on the ground.

use nesam_physics::Vehicle;
use nesam_trajectories::Trajectory;

use super::positions::{Jump, Way, back_and_forth, in_words, jumps_of};
use super::relation::{means, surely_most};
use super::{Doubt, SPEED_M_S, doubt};

/// Height over way beyond which no vehicle drives, - (chosen: 45 degrees).
const STEEP: f64 = 1.0;
/// Slope by the pitch whose sign says something, - (chosen: beyond the squat of a suspension).
const PITCHED: f64 = 0.05;

/// Heights that change as those of no vehicle do: in another unit, or in jumps.
pub(super) fn heights(drives: &[Trajectory], vehicle: &Vehicle) -> Option<Doubt> {
    let jumps: Vec<Jump> = drives.iter().flat_map(|drive| jumps_of(drive, vehicle, Way::Height)).collect();
    let back_and_forth = !jumps.is_empty() && back_and_forth(&jumps);
    // Noise is steep too, and goes neither one way nor with the pitch.
    steep(drives).filter(|steep| steep.with_pitch || !back_and_forth).map(|steep| steep.doubt).or_else(|| {
        let what = in_words("heights", &jumps, back_and_forth)?;
        let advice = if back_and_forth {
            "zeros or the like seem to stand for heights that are missing, or they are noise: leave such cells empty, or import without `z` (`--flat`)"
        } else {
            "the height seems to have been lost or set anew: part the drives there, leave them out, or import without `z` (`--flat`)"
        };
        Some(doubt(what, advice))
    })
}

struct Steep {
    doubt: Doubt,
    /// They go up where the nose does.
    with_pitch: bool,
}

/// Heights that change by more than the way, for most of the time.
fn steep(drives: &[Trajectory]) -> Option<Steep> {
    let told = means(drives, |drive, k, [x, y, z]| {
        let state = &drive.states[k];
        let forward = drive.controls[k].speed_m_s.signum();
        (x.hypot(y) > SPEED_M_S).then(|| [-forward * state.attitude_rad[1].tan(), z / x.hypot(y)])
    });
    let pitched: Vec<bool> =
        told.iter().filter(|[pitched, _]| pitched.abs() > PITCHED).map(|[pitched, slope]| pitched * slope > 0.0).collect();
    let with_pitch = surely_most(pitched.iter().filter(|same| **same).count(), pitched.len());
    let mut slopes: Vec<f64> = told.iter().map(|[_, slope]| slope.abs()).collect();
    slopes.sort_by(f64::total_cmp);
    let count = slopes.iter().filter(|slope| **slope > STEEP).count();
    let what = format!(
        "heights change by {:.1} m per metre of way in the middle, by more than one in {count} of {} seconds",
        slopes.get(slopes.len() / 2)?,
        slopes.len()
    );
    let advice = "heights seem to be in another unit than positions, millimetres or the like: import with `--column z=COLUMN:mm`";
    surely_most(count, slopes.len()).then(|| Steep { doubt: doubt(what, advice), with_pitch })
}

#[cfg(test)]
mod tests {
    use crate::sense::tests::{numbers, told};

    /// Goal: heights that no vehicle drives are told, as what they seem to be, and nothing else of them. Method: in the sound drive on waves of half a metre two samples of
    /// -9999 m, every seventh at zero of 300 m, a step of 15 m, a second at zero of 300 m, noise of 3 m, millimetres; a step of 0.8 m is sound (seed 5).
    #[test]
    fn regress_heights_of_no_vehicle_are_told() {
        let heights = |change: &dyn Fn(usize, f64) -> f64| {
            told(|drive| drive.states.iter_mut().enumerate().for_each(|(k, s)| s.position_m[2] = change(k, s.position_m[2])))
        };
        let mut next = numbers(5);
        let noise: Vec<f64> = (0..400).map(|_| 6.0 * (next() - 0.5)).collect();
        for (expected, told) in [
            ("heights jump back and forth, 2 times: in `a` by 9999", heights(&|k, z| if k / 2 == 100 { -9999.0 } else { z })),
            ("heights jump back and forth, 114 times: in `a` by 300", heights(&|k, z| if k % 7 == 0 { 0.0 } else { z + 300.0 })),
            ("heights jump back and forth", heights(&|k, z| z + noise[k])),
            ("heights jump 1 times: in `a` by 15", heights(&|k, z| if k < 200 { z } else { z + 15.0 })),
            ("heights jump 2 times: in `a` by 300", heights(&|k, z| if k / 10 == 20 { 0.0 } else { z + 300.0 })),
            ("--column z=COLUMN:mm", heights(&|_, z| 1e3 * z)),
        ] {
            assert!(told.contains(expected) && told.lines().count() == 1, "`{expected}` is not all of\n{told}");
        }
        assert_eq!(heights(&|k, z| if k < 200 { z } else { z + 0.8 }), "");
    }
}
