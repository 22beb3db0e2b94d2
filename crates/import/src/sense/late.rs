//! Whether channels have one clock: which of two that tell the same, or of which one causes the other, is late.

use nesam_physics::Vehicle;
use nesam_trajectories::Trajectory;

use super::{Doubt, angle_rate_rad_s, doubt, forward_m_s, ground_velocity_m_s, measures_velocity, rim_speed_m_s};

/// How late is tried, steps.
const STEPS_MAX: usize = 20;
/// Samples that must be compared, of a drive and of all: one start of a vehicle looks like another (chosen).
const SAMPLES_MIN: [usize; 2] = [10, 300];
/// Correlation of the two where they fit best, from which on that says something (chosen: commands and speeds of sound logs have 0.8 and more).
const CORRELATION_MIN: f64 = 0.7;
/// What it must be above that without a shift (chosen: speeds that hardly vary fit nearly as well with any).
const BETTER_BY: f64 = 0.1;

/// Two channels of which the second is expected to come after the first by a time in a range, s.
struct Pair<'a> {
    first: &'a str,
    /// With its verb.
    second: &'a str,
    sound_s: [f64; 2],
    of: &'a dyn Fn(&Trajectory, usize) -> Option<[f64; 2]>,
}

/// What comes too late or too early.
pub(super) fn late(drives: &[Trajectory], vehicle: &Vehicle) -> Vec<Doubt> {
    let ground = |drive: &Trajectory, k: usize| forward_m_s(drive, k, ground_velocity_m_s(drive, k));
    let told = |drive: &Trajectory, k: usize| {
        if measures_velocity(drive) { Some(drive.states[k].velocity_m_s[0]) } else { rim_speed_m_s(drive, vehicle, k) }
    };
    let gyro = |drive: &Trajectory, k: usize| drive.measured.angular_velocity[2].then(|| drive.states[k].angular_velocity_rad_s[2]);
    // A vehicle may take its time, and does nothing before it is told to.
    let (same_s, answer_s) = ([-0.25, 0.25], [-0.25, 1.45]);
    let pairs = [
        Pair {
            first: "the gyro",
            second: "the heading comes",
            sound_s: same_s,
            of: &|drive, k| Some([gyro(drive, k)?, angle_rate_rad_s(drive, k, 2)]),
        },
        Pair {
            first: "velocities or wheel speeds",
            second: "positions come",
            sound_s: [-0.45, 0.45],
            of: &|drive, k| Some([told(drive, k)?, ground(drive, k)]),
        },
        Pair {
            first: "the speed command",
            second: "the speed comes",
            sound_s: answer_s,
            of: &|drive, k| Some([drive.controls[k].speed_m_s, told(drive, k).unwrap_or_else(|| ground(drive, k))]),
        },
        Pair {
            first: "the steering command",
            second: "the turning comes",
            sound_s: answer_s,
            of: &|drive, k| Some([drive.controls[k].second, drive.states[k].angular_velocity_rad_s[2]]),
        },
    ];
    pairs.iter().filter_map(|pair| pair.judge(drives)).collect()
}

impl Pair<'_> {
    fn judge(&self, drives: &[Trajectory]) -> Option<Doubt> {
        let runs: Vec<Vec<[f64; 2]>> = drives.iter().filter_map(|drive| self.run(drive)).collect();
        if runs.iter().map(|run| run.len() - 2 * STEPS_MAX).sum::<usize>() < SAMPLES_MIN[1] {
            return None;
        }
        let shifts = || -(STEPS_MAX as isize)..=STEPS_MAX as isize;
        let (best, by) = shifts().map(|by| (correlation(&runs, by), by)).max_by(|a, b| a.0.total_cmp(&b.0))?;
        let late_s = by as f64 * drives.first()?.dt_s;
        // At an end of what is tried it may be any.
        let is_told = by.unsigned_abs() < STEPS_MAX;
        let is_sound = (self.sound_s[0]..=self.sound_s[1]).contains(&late_s);
        if !is_told || is_sound || best < CORRELATION_MIN || best - correlation(&runs, 0) < BETTER_BY {
            return None;
        }
        let side = if late_s > 0.0 { "after" } else { "before" };
        let what = format!("{} {:.1} s {side} {} (correlation {best:.2})", self.second, late_s.abs(), self.first);
        Some(doubt(
            what,
            "their time stamps seem to be of two clocks, or one is stamped when it arrives: bring both to one clock before the import",
        ))
    }

    /// The two in all samples of a drive that has them everywhere, each the mean of three.
    fn run(&self, drive: &Trajectory) -> Option<Vec<[f64; 2]>> {
        let end = drive.states.len().checked_sub(1).filter(|end| *end > 2 * STEPS_MAX + SAMPLES_MIN[0] + 2)?;
        let all: Vec<[f64; 2]> = (1..end).map(|k| (self.of)(drive, k)).collect::<Option<_>>()?;
        let mean = |three: &[[f64; 2]]| [0, 1].map(|i| three.iter().map(|pair| pair[i]).sum::<f64>() / three.len() as f64);
        Some(all.windows(3).map(mean).collect())
    }
}

/// Correlation of the first with the second so many steps later, about their means in each drive; the first are the same ones whatever the shift.
fn correlation(runs: &[Vec<[f64; 2]>], by: isize) -> f64 {
    let [mut xy, mut xx, mut yy] = [0.0; 3];
    for run in runs {
        let firsts = STEPS_MAX..run.len() - STEPS_MAX;
        let pairs: Vec<[f64; 2]> = firsts.map(|k| [run[k][0], run[k.wrapping_add_signed(by)][1]]).collect();
        let mean = [0, 1].map(|i| pairs.iter().map(|pair| pair[i]).sum::<f64>() / pairs.len() as f64);
        for pair in &pairs {
            let (x, y) = (pair[0] - mean[0], pair[1] - mean[1]);
            (xy, xx, yy) = (xy + x * y, xx + x * x, yy + y * y);
        }
    }
    if xx * yy > 0.0 { xy / (xx * yy).sqrt() } else { 0.0 }
}
