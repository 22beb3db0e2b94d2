//! Two channels of which one should tell the other.

use nesam_trajectories::Trajectory;

use super::{Doubt, doubt, ground_velocity_m_s, stretches};

/// Stretches from which on a majority says something.
const STRETCHES_MIN: usize = 5;
/// Seconds in which only the found one moves count where they are this share of all (chosen): fewer may be a pose that slips.
const FOUND_ONLY: f64 = 0.2;
/// A factor that a wrong unit makes, and which.
type Unit = (f64, &'static str);
/// Units of speeds that are mistaken for one another.
pub(super) const SPEEDS: &[Unit] = &[
    (3.6, "km/h or the like instead of m/s"),
    (1.0 / 3.6, "m/s that were divided by 3.6 once too often"),
    (2.237, "miles per hour instead of m/s"),
    (3.281, "feet instead of metres"),
    (1e3, "time stamps in milliseconds that were taken for seconds (`--column t=COLUMN:ms`), or else millimetres instead of metres"),
];
/// The same where the command is expected and the speed is found: the wrong unit is rather that of the command, which the speed is held against alone.
pub(super) const COMMANDED_SPEEDS: &[Unit] = &[
    (1.0 / 3.6, "a speed command in km/h or the like instead of m/s"),
    (3.6, "a speed command that was divided by 3.6 once too often, or else speeds in km/h instead of m/s"),
    (1.0 / 2.237, "a speed command in miles per hour instead of m/s"),
    (1.0 / 3.281, "a speed command in feet instead of metres"),
    (3.281, "positions and speeds in feet instead of metres"),
    (
        1e-3,
        "a speed command in millimetres instead of metres, or else time stamps in milliseconds that were taken for seconds (`--column t=COLUMN:ms`)",
    ),
    (1e3, "positions and speeds in millimetres instead of metres"),
];
/// The same of wheel speeds, rad/s, for wheels of a radius.
pub(super) fn wheel_speeds(radius_m: f64) -> [Unit; 4] {
    const TURNS_PER_RAD: f64 = 0.159_155;
    let (turns, rims) =
        ("revolutions per second instead of rad/s", "metres per second instead of rad/s (divide by the radius of the wheels)");
    let alike = (radius_m / TURNS_PER_RAD - 1.0).abs() < UNIT_TOLERANCE;
    let either = "revolutions per second instead of rad/s, or else metres per second (divide by the radius of the wheels)";
    let [turns, rims] = if alike { [either; 2] } else { [turns, rims] };
    [(9.549, "revolutions per minute instead of rad/s"), (TURNS_PER_RAD, turns), (radius_m, rims), (1e3, CLOCK)]
}
/// The same of angles and their rates.
pub(super) const ANGLES: &[Unit] =
    &[(57.296, "degrees instead of radians"), (0.017_453, "radians that were taken for degrees"), (1e3, CLOCK)];
/// What makes rates a thousand times as large as the changes that they are held against.
const CLOCK: &str = "time stamps in milliseconds that were taken for seconds (`--column t=COLUMN:ms`)";
/// Times as much as expected below which nothing is found but noise (chosen).
const NOTHING: f64 = 0.02;
/// What to do where two channels are unrelated.
pub(super) const UNRELATED_ADVICE: &str = "see from which column either was read, and that both have one clock";
/// Deviation from such a factor that is still taken for it (chosen: wheels slip).
const UNIT_TOLERANCE: f64 = 0.3;
/// Metres in a degree: of latitude 111 km, of longitude 38 km at a latitude of 70 degrees; with some slip.
const DEGREE_M: [f64; 2] = [3e4, 1.3e5];
/// Spread of the middle half of speeds, m/s, from which on another measurement must follow them (chosen: noise of positions over a stretch stays below).
const VARIES_M_S: f64 = 0.25;
/// Correlation below which the speeds of that many stretches are unrelated: by chance alone it is above that once in ten times (chosen).
const UNRELATED: (f64, usize) = (0.3, 20);

/// Whether more than half are meant, by two standard deviations of a fair toss: a few drives with a frozen pose are no evidence.
pub(super) fn surely_most(count: usize, of: usize) -> bool {
    of >= STRETCHES_MIN && count as f64 > 0.5 * of as f64 + (of as f64).sqrt()
}

/// The means of two channels in every stretch. `pair` tells the two of a sample, given the ground velocity in World, m/s, or `None`.
pub(super) fn means(drives: &[Trajectory], pair: impl Fn(&Trajectory, usize, [f64; 3]) -> Option<[f64; 2]>) -> Vec<[f64; 2]> {
    let mean = |drive: &Trajectory, stretch: std::ops::Range<usize>| {
        let half = stretch.len().div_ceil(2);
        let pairs = stretch.filter_map(|k| pair(drive, k, ground_velocity_m_s(drive, k)));
        let pairs: Vec<[f64; 2]> = pairs.filter(|pair| pair.iter().all(|value| value.is_finite())).collect();
        (pairs.len() >= half).then(|| [0, 1].map(|i| pairs.iter().map(|pair| pair[i]).sum::<f64>() / pairs.len() as f64))
    };
    drives.iter().flat_map(|drive| stretches(drive).filter_map(|stretch| mean(drive, stretch)).collect::<Vec<_>>()).collect()
}

/// The means of two channels, expected and found, in every stretch in which one of them says something.
///
/// Means: a pose that freezes and catches up, noise of differences and the shaking of a suspension are not in them. Stretches: no single drive decides.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Relation(Vec<[f64; 2]>);

impl Relation {
    /// Of [`means`], one of which must reach `floor`.
    pub(super) fn of(drives: &[Trajectory], floor: f64, pair: impl Fn(&Trajectory, usize, [f64; 3]) -> Option<[f64; 2]>) -> Self {
        let all = means(drives, pair);
        let (both, found_only): (Vec<_>, Vec<_>) =
            all.iter().filter(|[a, b]| a.abs().max(b.abs()) >= floor).partition(|[expected, _]| expected.abs() >= floor);
        let counts = found_only.len() as f64 >= FOUND_ONLY * all.len() as f64;
        Self(if counts { [both, found_only].concat() } else { both })
    }

    /// How many times as much as expected is found, least first.
    fn ratios(&self) -> Vec<f64> {
        let mut ratios: Vec<f64> = self.0.iter().map(|[expected, found]| found / expected).collect();
        ratios.sort_by(f64::total_cmp);
        ratios
    }

    /// A doubt when most stretches are outside of what is let pass.
    pub(super) fn judge(&self, found: &str, against: &str, pass: [f64; 2], reversed: &str, units: &[Unit]) -> Option<Doubt> {
        let ratios = self.ratios();
        let n = ratios.len();
        let wrong = ratios.iter().filter(|ratio| !(pass[0]..=pass[1]).contains(*ratio)).count();
        if !surely_most(wrong, n) {
            return None;
        }
        let [low, median, high] = [n / 4, n / 2, n - 1 - n / 4].map(|at| ratios[at]);
        let (about, count) = (format!("{found} against {against}"), format!("{wrong} of {n} seconds disagree"));
        if median.is_infinite() {
            return Some(doubt(
                format!("{about}: the latter is zero, {count}"),
                "a channel of zeros measures nothing; see what it was read from",
            ));
        }
        let most = high.max(-low);
        if low <= 0.0 && high >= 0.0 && most < NOTHING {
            let what = format!("{about}: at most {most:.3} times as much as expected, {count}");
            return Some(doubt(
                what,
                "nothing moved, or a channel of zeros was recorded: see what it was read from, or leave it out (`--leave-out`)",
            ));
        }
        if low < 0.0 && high > 0.0 {
            let what = format!("{about}: unrelated, {low:.2} to {high:.2} times as much as expected in the middle half, {count}");
            return Some(doubt(what, UNRELATED_ADVICE));
        }
        let (size, sign) = (median.abs(), if median < 0.0 { reversed } else { "" });
        let reasons: Vec<&str> = [sign, unit(size, units)].into_iter().filter(|reason| !reason.is_empty()).collect();
        let advice =
            if reasons.is_empty() { "see the units of both".into() } else { format!("the file seems to have {}", reasons.join(", and ")) };
        let times = if (1e-3..1e4).contains(&size) { format!("{median:.3}") } else { format!("{median:.1e}") };
        Some(doubt(format!("{about}: {times} times as much as expected, {count}"), advice))
    }

    /// The same of what varies about the means of all: an offset of either is no relation.
    pub(super) fn about_means(self) -> Self {
        let mean = self.means();
        Self(self.0.into_iter().map(|pair| [pair[0] - mean[0], pair[1] - mean[1]]).collect())
    }

    fn means(&self) -> [f64; 2] {
        [0, 1].map(|i| self.0.iter().map(|pair| pair[i]).sum::<f64>() / self.0.len().max(1) as f64)
    }

    /// How many of the stretches in which both reach `floor` have opposite signs, when most do.
    pub(super) fn reversed(&self, floor: f64) -> Option<(usize, usize)> {
        let told = self.0.iter().filter(|pair| pair.iter().all(|value| value.abs() >= floor));
        let (n, reversed) = told.fold((0, 0), |(n, reversed), [a, b]| (n + 1, reversed + usize::from(a * b < 0.0)));
        surely_most(reversed, n).then_some((reversed, n))
    }

    /// Correlation of two speeds, m/s, of the right size that vary and do not vary together.
    pub(super) fn unrelated(&self) -> Option<f64> {
        let n = self.0.len();
        let mut expected: Vec<f64> = self.0.iter().map(|pair| pair[0]).collect();
        expected.sort_by(f64::total_cmp);
        if n < UNRELATED.1 || expected[n - 1 - n / 4] - expected[n / 4] < VARIES_M_S {
            return None;
        }
        let mean = self.means();
        let about = |i: usize, j: usize| self.0.iter().map(|pair| (pair[i] - mean[i]) * (pair[j] - mean[j])).sum::<f64>();
        let scale = (about(0, 0) * about(1, 1)).sqrt();
        let correlation = if scale > 0.0 { about(0, 1) / scale } else { 0.0 };
        (correlation < UNRELATED.0).then_some(correlation)
    }
}

/// What a factor looks like; empty where no unit makes it.
fn unit(size: f64, units: &[Unit]) -> &'static str {
    let degrees = |size: f64| (DEGREE_M[0]..=DEGREE_M[1]).contains(&size);
    if degrees(size) || degrees(1.0 / size) {
        return "positions in degrees of latitude and longitude instead of metres";
    }
    let off = |(factor, _): &&Unit| (size / factor - 1.0).abs();
    units.iter().min_by(|a, b| off(a).total_cmp(&off(b))).filter(|unit| off(unit) < UNIT_TOLERANCE).map_or("", |(_, name)| name)
}
