//! Whether commands belong to the motion: those of another drive, or of a clock that is far off, tell nothing of it.

use nesam_physics::{SecondCommand, Vehicle};
use nesam_trajectories::Trajectory;

use super::{Doubt, STRETCH, YAW_RATE_RAD_S, doubt, forward_m_s, ground_velocity_m_s, measures_velocity};

/// How much later or earlier is tried, steps; up to [`NEAR`] a vehicle may take its time, and clocks are compared elsewhere.
const STEPS_MAX: isize = 100;
const NEAR: isize = 20;
/// Samples that must be compared (chosen: 20 s).
const SAMPLES_MIN: usize = 200;
/// A drive counts where it is this many times as long as what is tried (chosen).
const LONGER: usize = 3;
/// Correlation within [`NEAR`] below which commands are of something else (chosen: of sound logs it is 0.8 and more).
const RELATED: f64 = 0.5;
/// Correlation of commands of another clock, and what it is above that within [`NEAR`] (chosen).
const OTHER_CLOCK: (f64, f64) = (0.8, 0.3);
/// Deviation of speeds about the mean, m/s and as a share of it, from which on they vary (chosen: the speed controller of the simulated truck makes a tenth by itself).
const SPEED_VARIES: (f64, f64) = (0.15, 0.15);
/// The same of yaw rates, rad/s, whose mean says nothing.
const YAW_RATE_VARIES: (f64, f64) = (YAW_RATE_RAD_S, 0.0);
/// Share of the samples in which more comes than is commanded, by what varies, below which commands are not followed for other reasons: a vehicle that slips, is stuck or
/// at its limits does less (chosen).
const MORE: f64 = 0.1;
/// Correlation of a motion with itself a second later from which on it is more than noise (chosen).
const SMOOTH: f64 = 0.3;

/// A command and what should come of it, all along a drive.
type Run = Vec<[f64; 2]>;

/// Commands that have nothing to do with the motion, or only so with a clock that is far off. Where either command is followed, both belong to it.
pub(super) fn belong(drives: &[Trajectory], vehicle: &Vehicle) -> Option<Doubt> {
    let speed = |drive: &Trajectory, k: usize| Some([drive.controls[k].speed_m_s, driven_m_s(drive, k)]);
    let turning = |drive: &Trajectory, k: usize| Some([commanded_rad_s(drive, vehicle, k)?, drive.states[k].angular_velocity_rad_s[2]]);
    let channels = [
        (["the speed", "the speed command"], Followed::of(drives, SPEED_VARIES, speed)),
        (["the turning", "the steering command"], Followed::of(drives, YAW_RATE_VARIES, turning)),
    ];
    let told: Vec<([&str; 2], Followed)> = channels.into_iter().filter_map(|(names, found)| Some((names, found?))).collect();
    if told.iter().any(|(_, found)| found.near >= RELATED) {
        return None;
    }
    let ([motion, command], found) = told.into_iter().max_by(|a, b| a.1.best.total_cmp(&b.1.best))?;
    let Followed { near, best, late_s, more } = found;
    if best > OTHER_CLOCK.0 && best - near > OTHER_CLOCK.1 {
        let side = if late_s > 0.0 { "after" } else { "before" };
        return Some(doubt(
            format!("{motion} comes {:.1} s {side} {command} (correlation {best:.2}, within 2 s at most {near:.2})", late_s.abs()),
            "their time stamps seem to be of the clocks of two machines: bring both to one clock before the import",
        ));
    }
    (more >= MORE).then(|| {
        doubt(
            format!("commands do not belong to this motion: {motion} does not follow {command} (correlation at most {near:.2} within 2 s, {best:.2} within 10 s)"),
            "they seem to be of another drive or vehicle, or not to be those that were driven by: see from which column or topic they were read",
        )
    })
}

/// Forward speed at a sample, m/s: as measured, else by positions.
fn driven_m_s(drive: &Trajectory, k: usize) -> f64 {
    if measures_velocity(drive) { drive.states[k].velocity_m_s[0] } else { forward_m_s(drive, k, ground_velocity_m_s(drive, k)) }
}

/// Yaw rate that the second command asks for at a sample, rad/s.
fn commanded_rad_s(drive: &Trajectory, vehicle: &Vehicle, k: usize) -> Option<f64> {
    let second = drive.controls[k].second;
    let by_angle = |angle_rad: f64| driven_m_s(drive, k) * angle_rad.tan() / vehicle.wheelbase_m;
    Some(match vehicle.second {
        SecondCommand::YawRateRadS => second,
        SecondCommand::RoadWheelAngleRad => by_angle(second),
        SecondCommand::SteeringNormalised => by_angle(second * vehicle.steering.as_ref()?.front_left_rad.last()?),
    })
}

/// How well a motion follows a command.
struct Followed {
    /// Best correlation within [`NEAR`].
    near: f64,
    /// Best correlation.
    best: f64,
    /// How late the motion is there, s.
    late_s: f64,
    /// Share of the samples in which it is more than commanded.
    more: f64,
}

impl Followed {
    /// `None` where one of the two does not vary enough, or too little is known.
    fn of(drives: &[Trajectory], varies: (f64, f64), pair: impl Fn(&Trajectory, usize) -> Option<[f64; 2]>) -> Option<Self> {
        let runs: Vec<Run> = drives.iter().filter_map(|drive| run(drive, &pair)).collect();
        let itself: Vec<Run> = runs.iter().map(|run| run.iter().map(|pair| [pair[1]; 2]).collect()).collect();
        let at_once = Sums::of(&runs, 0);
        let all = || runs.iter().flatten();
        let mean = all().map(|pair| pair[0].abs()).sum::<f64>() / at_once.count.max(1) as f64;
        let varies = varies.0.max(varies.1 * mean);
        let is_still = at_once.deviations().iter().any(|deviation| *deviation < varies);
        if at_once.count < SAMPLES_MIN || is_still || Sums::of(&itself, STRETCH as isize).correlation() < SMOOTH {
            return None;
        }
        let enough = SAMPLES_MIN.max(at_once.count / 2);
        let tried = (-STEPS_MAX..=STEPS_MAX).map(|by| (by, Sums::of(&runs, by))).filter(|(_, sums)| sums.count >= enough);
        let tried: Vec<(isize, f64)> = tried.map(|(by, sums)| (by, sums.correlation())).collect();
        let near = tried.iter().filter(|(by, _)| by.abs() <= NEAR).map(|(_, correlation)| *correlation).fold(-1.0, f64::max);
        let (by, best) = tried.into_iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
        let more = all().filter(|[command, motion]| motion.abs() > command.abs() + varies).count() as f64 / at_once.count as f64;
        Some(Self { near, best, late_s: by as f64 * drives.first()?.dt_s, more })
    }
}

/// The two along a drive, each the mean over a second; `None` where a sample lacks one.
fn run(drive: &Trajectory, pair: impl Fn(&Trajectory, usize) -> Option<[f64; 2]>) -> Option<Run> {
    let end = drive.states.len().saturating_sub(1);
    let all: Run = (1..end).map(|k| pair(drive, k).filter(|pair| pair.iter().all(|value| value.is_finite()))).collect::<Option<_>>()?;
    let mean = |stretch: &[[f64; 2]]| [0, 1].map(|i| stretch.iter().map(|pair| pair[i]).sum::<f64>() / stretch.len() as f64);
    Some(all.windows(STRETCH).map(mean).collect())
}

/// Sums over pairs of a command and the motion some steps later, about their means in each drive.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    count: usize,
    xy: f64,
    xx: f64,
    yy: f64,
}

impl Sums {
    fn of(runs: &[Run], by: isize) -> Self {
        let (skip, later) = (by.unsigned_abs(), by.max(0).unsigned_abs());
        let mut sums = Self::default();
        for run in runs.iter().filter(|run| run.len() >= (LONGER * skip).max(1)) {
            let pairs: Vec<[f64; 2]> = (0..run.len() - skip).map(|k| [run[k + skip - later][0], run[k + later][1]]).collect();
            let mean = [0, 1].map(|i| pairs.iter().map(|pair| pair[i]).sum::<f64>() / pairs.len() as f64);
            sums.count += pairs.len();
            for pair in &pairs {
                let (x, y) = (pair[0] - mean[0], pair[1] - mean[1]);
                (sums.xy, sums.xx, sums.yy) = (sums.xy + x * y, sums.xx + x * x, sums.yy + y * y);
            }
        }
        sums
    }

    fn deviations(&self) -> [f64; 2] {
        [self.xx, self.yy].map(|squares| (squares / self.count.max(1) as f64).sqrt())
    }

    fn correlation(&self) -> f64 {
        if self.xx * self.yy > 0.0 { self.xy / (self.xx * self.yy).sqrt() } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use nesam_physics::{Control, VehicleState};

    use super::*;
    use crate::sense::doubts;
    use crate::sense::tests::{car, numbers, sound};

    /// A minute of a base that turns at 0.85 of the rate that is asked for, at most so fast, and follows commands that change every two seconds within 0.3 s.
    fn base(seed: u64, most_m_s: f64) -> Trajectory {
        let (mut next, mut drive) = (numbers(seed), sound());
        let (mut control, mut state) = (Control { speed_m_s: 0.0, second: 0.0 }, VehicleState { ..drive.states[0] });
        (state.velocity_m_s, state.angular_velocity_rad_s, state.attitude_rad) = ([0.0; 3], [0.0; 3], [0.0; 3]);
        (drive.states, drive.controls, drive.wheel_speed_rad_s, drive.road_wheel_angle_rad) = (Vec::new(), Vec::new(), None, None);
        for k in 0..600 {
            if k % 20 == 0 {
                control = Control { speed_m_s: 0.3 + 0.7 * next(), second: 1.2 * (next() - 0.5) };
            }
            drive.states.push(state);
            drive.controls.push(control);
            let (speed, yaw_rate, yaw) = (&mut state.velocity_m_s[0], &mut state.angular_velocity_rad_s[2], &mut state.attitude_rad[2]);
            *speed += (control.speed_m_s.min(most_m_s) - *speed) / 3.0;
            *yaw_rate += (0.85 * control.second - *yaw_rate) / 3.0;
            *yaw = nesam_physics::wrap_angle(*yaw + 0.1 * *yaw_rate);
            let (sin, cos) = yaw.sin_cos();
            (state.position_m[0], state.position_m[1]) =
                (state.position_m[0] + 0.1 * *speed * cos, state.position_m[1] + 0.1 * *speed * sin);
        }
        drive.time_s = (0..600).map(|k| 0.1 * f64::from(k)).collect();
        drive
    }

    fn told(drive: Trajectory) -> String {
        let vehicle = Vehicle { second: SecondCommand::YawRateRadS, ..car() };
        doubts(&[drive], &vehicle).iter().map(|d| format!("{}; {}\n", d.what, d.advice)).collect()
    }

    /// Goal: commands of another drive are told, those of another clock with by how much, and a vehicle's own are sound. Method: bases with their own commands, with those of
    /// another seed, with their own 6 s earlier and later; a base that is slower than most commands (seeds 1 to 60). Where most seconds of turning disagree, that is told instead; by
    /// chance a few pairs of seeds fit.
    #[test]
    fn property_commands_of_another_drive_are_told() {
        let (mut named, mut silent) = ([0; 3], [0; 3]);
        for seed in 1..=60 {
            let with = |controls: Vec<Control<f64>>| told(Trajectory { controls, ..base(seed, 2.0) });
            let own = base(seed, 2.0).controls;
            assert_eq!((with(own.clone()), told(base(seed, 0.6))), (String::new(), String::new()), "seed {seed}");
            let others = [base(seed + 100, 2.0).controls, [&own[60..], &own[..60]].concat(), [&own[540..], &own[..540]].concat()];
            let expected = ["commands do not belong to this motion", "s after the s", "s before the s"];
            for (i, (controls, expected)) in others.into_iter().zip(expected).enumerate() {
                let told = with(controls);
                named[i] += usize::from(told.contains(expected));
                silent[i] += usize::from(told.is_empty());
            }
        }
        assert!(named.iter().all(|count| *count >= 45) && silent.iter().all(|count| *count <= 2), "{named:?} {silent:?}");
    }
}
