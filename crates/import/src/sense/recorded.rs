//! Whether drives were measured as often as they seem to be, and by one recording each: what is lost at the step of the model.

use std::ops::Range;

use nesam_trajectories::Recorded;

use super::{Doubt, SPEED_M_S, doubt};

/// Drives that are measured less often than this are doubted, Hz: the model steps at 10 Hz, and stamps tremble.
const RATE_MIN_HZ: f64 = 9.0;
/// Those that are measured less often than this may count their time in milliseconds, Hz: at a kilohertz they would lie a second apart.
const SECONDS_MIN_HZ: f64 = 1.5;
/// Share of the rows of a moving vehicle that repeat a position, from which on it comes less often than the rows (chosen: poses that freeze now and then stay below).
const REPEATED: f64 = 1.0 / 3.0;
/// Rows that are judged together on whether positions alternate.
const WINDOW: usize = 20;
/// How many rows before one may be the last one of the same recording (chosen).
const BACK: usize = 3;
/// Way to the nearest of these rows over that to the last one, below which positions alternate (chosen: noise without motion makes 0.6, motion 1).
const ALTERNATES: f64 = 0.2;
/// Mean way from row to row from which on that is told, m (chosen: beyond rounding and noise).
const APART_M: f64 = 0.1;

/// What does not fit together in the rows of these drives as they were recorded.
pub fn recorded_doubts(drives: &[Recorded]) -> Vec<Doubt> {
    [seldom(drives), held(drives), alternating(drives)].into_iter().flatten().collect()
}

/// Rows per second of those in a range to the one after it.
fn rate_hz(drive: &Recorded, rows: &Range<usize>) -> f64 {
    rows.len() as f64 / (drive.time_s[rows.end] - drive.time_s[rows.start])
}

/// Drives that are measured less often than the model steps.
fn seldom(drives: &[Recorded]) -> Option<Doubt> {
    let rates = drives.iter().filter(|drive| drive.time_s.len() > 1).map(|drive| (drive, rate_hz(drive, &(0..drive.time_s.len() - 1))));
    let seldom: Vec<(&Recorded, f64)> = rates.filter(|(_, rate_hz)| *rate_hz < RATE_MIN_HZ).collect();
    let (drive, rate_hz) = seldom.iter().min_by(|a, b| a.1.total_cmp(&b.1))?;
    let what = format!(
        "{} of {} drives are measured more seldom than the model steps, `{}` at {rate_hz:.1} Hz: what lies between is interpolated to steps of 0.1 s",
        seldom.len(),
        drives.len(),
        drive.id
    );
    let advice = if *rate_hz < SECONDS_MIN_HZ {
        "record at 10 Hz or faster, or, where its time stamps are milliseconds, import with `--column t=COLUMN:ms`"
    } else {
        "record at 10 Hz or faster"
    };
    Some(doubt(what, advice))
}

/// Positions of a moving vehicle that repeat themselves to the bit from row to row.
fn held(drives: &[Recorded]) -> Option<Doubt> {
    let mut found: Vec<(&str, f64, f64)> = Vec::new();
    for drive in drives {
        let (mut begin, mut stays, mut rows, mut time_s) = (0, 0, 0, 0.0);
        for stay in drive.position_m.chunk_by(|a, b| a == b) {
            let end = begin + stay.len();
            if let Some([x, y]) = drive.position_m.get(end) {
                let lasts_s = drive.time_s[end] - drive.time_s[begin];
                // Where it stands, nothing is new.
                if (x - stay[0][0]).hypot(y - stay[0][1]) >= SPEED_M_S * lasts_s {
                    (stays, rows, time_s) = (stays + 1, rows + stay.len(), time_s + lasts_s);
                }
            }
            begin = end;
        }
        let [of_positions, of_rows] = [stays, rows].map(|count| f64::from(u32::try_from(count).unwrap_or(u32::MAX)) / time_s);
        if (rows - stays) as f64 > REPEATED * rows as f64 && of_positions < RATE_MIN_HZ && of_rows >= RATE_MIN_HZ {
            found.push((&drive.id, of_positions, of_rows));
        }
    }
    let (drive, of_positions, of_rows) = found.iter().min_by(|a, b| a.1.total_cmp(&b.1))?;
    let what = format!(
        "positions come at {of_positions:.1} Hz in rows at {of_rows:.1} Hz in `{drive}`, and are repeated to the bit in between, so in {} of {} drives",
        found.len(),
        drives.len()
    );
    Some(doubt(what, "they are late wherever they are repeated: leave the cells of `x` and `y` empty in rows without a new position"))
}

/// Positions that go to and fro between two places.
fn alternating(drives: &[Recorded]) -> Option<Doubt> {
    let far_m = |drive: &Recorded, i: usize, j: usize| {
        let ([ax, ay], [bx, by]) = (drive.position_m[i], drive.position_m[j]);
        (ax - bx).hypot(ay - by)
    };
    // A position that is the same to the bit tells nothing of where a recording goes on: it is held, or rounded.
    let nearest_m = |drive: &Recorded, i: usize| {
        let before = (1..=BACK).filter_map(|back| Some(far_m(drive, i, i.checked_sub(back)?))).filter(|way_m| *way_m > 0.0);
        before.min_by(f64::total_cmp).unwrap_or(0.0)
    };
    let alternates = |drive: &Recorded, window: &Range<usize>| {
        let way_m: f64 = window.clone().map(|i| far_m(drive, i, i - 1)).sum();
        let nearest_m: f64 = window.clone().map(|i| nearest_m(drive, i)).sum();
        way_m >= APART_M * WINDOW as f64 && nearest_m < ALTERNATES * way_m
    };
    let windows = |drive: &Recorded| {
        let rows = drive.position_m.len();
        (BACK..rows.saturating_sub(WINDOW)).step_by(WINDOW).map(|begin| begin..begin + WINDOW)
    };
    let found: Vec<(&Recorded, Range<usize>)> =
        drives.iter().filter_map(|drive| Some((drive, windows(drive).find(|window| alternates(drive, window))?))).collect();
    let (drive, window) = found.first()?;
    let way_m = window.clone().map(|i| far_m(drive, i, i - 1)).fold(0.0, f64::max);
    let what = format!(
        "positions alternate from row to row in {} of {} drives: in `{}` by up to {way_m:.1} m from {:.1} s on",
        found.len(),
        drives.len(),
        drive.id,
        drive.time_s[window.start]
    );
    Some(doubt(
        what,
        "two recordings seem to be in one, as where a log whose clock was set back was sorted by time: import it in the order in which it was recorded",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A drive of 20 s at 2 m/s on an arc of radius 10 m.
    fn arc(id: &str, rate_hz: f64) -> Recorded {
        let time_s: Vec<f64> = (0..(20.0 * rate_hz) as usize).map(|k| k as f64 / rate_hz).collect();
        let position_m = time_s.iter().map(|t| (0.2 * t).sin_cos()).map(|(sin, cos)| [10.0 * sin, 10.0 * (1.0 - cos)]).collect();
        Recorded { id: id.into(), time_s, position_m }
    }

    fn told(drives: &[Recorded]) -> String {
        recorded_doubts(drives).iter().map(|d| format!("{}; {}\n", d.what, d.advice)).collect()
    }

    /// Positions of every so many rows.
    fn held_for(mut drive: Recorded, rows: usize) -> Recorded {
        (0..drive.position_m.len()).for_each(|i| drive.position_m[i] = drive.position_m[i / rows * rows]);
        drive
    }

    /// Goal: what is measured more seldom than the model steps is told, however it is written. Method: rows at 1, 5, 10 and 50 Hz; rows at 20 Hz whose positions come at
    /// 1 to 10 Hz; a vehicle that stands for half of the time; a pose that freezes for 0.9 s twice.
    #[test]
    fn regress_rows_and_positions_that_come_seldom_are_told() {
        assert_eq!(told(&[arc("a", 10.0), arc("b", 50.0), held_for(arc("c", 20.0), 2), held_for(arc("d", 50.0), 5)]), "");
        let one = told(&[arc("a", 10.0), arc("b", 5.0), arc("c", 1.0)]);
        assert!(one.contains("2 of 3 drives") && one.contains("`c` at 1.0 Hz") && one.contains("t=COLUMN:ms"), "{one}");
        assert!(told(&[arc("b", 5.0)]).contains("`b` at 5.0 Hz"));
        for (rows, rate) in [(4, "5.0"), (10, "2.0"), (20, "1.0")] {
            let told = told(&[arc("a", 20.0), held_for(arc("b", 20.0), rows)]);
            assert!(
                told.contains(&format!("positions come at {rate} Hz in rows at 20.0 Hz in `b`")) && told.lines().count() == 1,
                "{told}"
            );
        }
        let mut stands = arc("a", 20.0);
        let there = stands.position_m[100];
        stands.position_m[100..300].fill(there);
        let mut freezes = arc("b", 20.0);
        for begin in [100, 300] {
            let there = freezes.position_m[begin];
            freezes.position_m[begin..begin + 18].fill(there);
        }
        assert_eq!(told(&[stands, freezes]), "");
    }

    /// Goal: two recordings in one are told, noise is not. Method: a drive whose last 12 s were stamped 8 s too early, sorted, at 50 Hz with an offset of 7 ms, so that at
    /// steps of 0.1 s one of the two alone is seen; one that was set back by 0.8 s; noise of 0.5 m about a place and about the arc; rounding to half a metre
    /// (generator: multiplier of Knuth, seed 3).
    #[test]
    fn regress_two_recordings_that_were_sorted_into_one_are_told() {
        let set_back = |at: usize, back_s: f64| {
            let drive = arc("a", 50.0);
            let stamp = |i: usize| drive.time_s[i] - if i >= at { back_s } else { 0.0 };
            let mut rows: Vec<(f64, [f64; 2])> = (0..drive.time_s.len()).map(|i| (stamp(i), drive.position_m[i])).collect();
            rows.sort_by(|a, b| a.0.total_cmp(&b.0));
            Recorded { id: "a".into(), time_s: rows.iter().map(|row| row.0).collect(), position_m: rows.iter().map(|row| row.1).collect() }
        };
        for drive in [set_back(400, 7.993), set_back(500, 0.807)] {
            let told = told(&[arc("b", 50.0), drive]);
            assert!(told.contains("positions alternate from row to row in 1 of 2 drives: in `a`") && told.lines().count() == 1, "{told}");
        }
        let mut seed = 3_u64;
        let mut noise = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (seed >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
        };
        let mut noisy = [arc("a", 50.0), arc("b", 50.0), arc("c", 50.0)];
        noisy[0].position_m.iter_mut().for_each(|p| *p = [noise(), noise()]);
        noisy[1].position_m.iter_mut().for_each(|p| *p = [p[0] + noise(), p[1] + noise()]);
        noisy[2].position_m.iter_mut().for_each(|p| *p = p.map(|v| (2.0 * (v + 0.2 * noise())).round() / 2.0));
        assert!(!told(&noisy).contains("alternate"), "{}", told(&noisy));
    }
}
