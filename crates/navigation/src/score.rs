//! From laps to figures with intervals.

use nesam_evaluation::{DEFAULT_RESAMPLES, Resamples};
use serde::{Deserialize, Serialize};

use crate::lap::Lap;
use crate::report::SoilKind;

/// Seed of the bootstrap.
const BOOTSTRAP_SEED: u64 = 1;
/// Standard normal quantile of a 95 % interval.
const Z_95: f64 = 1.959_963_985;

/// A lap with what was driven.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Configuration of the planner's model.
    pub configuration: String,
    /// World.
    pub world: String,
    /// How its soil differs from what it looks like.
    pub soil: SoilKind,
    /// Half turns from phi = 0 at the start.
    pub start: usize,
    /// Seed.
    pub seed: u64,
    /// What came of it.
    pub lap: Lap,
}

impl Run {
    /// The file that it is kept in.
    pub fn file_name(&self) -> String {
        lap_file_name(&self.configuration, &self.world, self.start, self.seed)
    }

    /// Runs of one world and start share path and soil: they are one piece of evidence.
    fn place(&self) -> (String, usize) {
        (self.world.clone(), self.start)
    }
}

/// The file of a lap.
pub fn lap_file_name(configuration: &str, world: &str, start: usize, seed: u64) -> String {
    format!("{configuration}-{world}-start{start}-seed{seed}.json")
}

/// Mean, standard deviation over runs and 95 % interval of the mean (percentile bootstrap over places = world and start).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Figures {
    /// Mean; NaN without runs.
    pub mean: f64,
    /// Standard deviation over runs; NaN with fewer than two.
    pub sd: f64,
    /// Interval of the mean; `None` with fewer than two places.
    pub ci95: Option<[f64; 2]>,
}

/// Figures of one configuration on one kind of soil. A lap that ended before its first step counts as not completed and is in no mean.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Runs.
    pub runs: usize,
    /// Those that ended before their first step.
    pub never_began: usize,
    /// Places (world and start) that they come from.
    pub places: usize,
    /// Share of completed laps.
    pub completion: f64,
    /// Its 95 % interval (Wilson, as if runs were independent).
    pub completion_ci95: [f64; 2],
    /// Over completed laps only, s.
    pub time_s: Figures,
    /// Over the part of the path that each lap drove, m.
    pub hausdorff_m: Figures,
    /// Over the whole path, m; without numbers where a lap does not tell it.
    pub hausdorff_whole_path_m: Figures,
    /// Mean distance from the path, m.
    pub off_path_m: Figures,
    /// Mean |roll|, degrees.
    pub roll_deg: Figures,
    /// Mean |pitch|, degrees.
    pub pitch_deg: Figures,
}

/// Ratio of means of two configurations over the runs that both have, with a 95 % interval (bootstrap over places).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Ratio {
    /// Ratio of means.
    pub ratio: f64,
    /// Interval.
    pub ci95: Option<[f64; 2]>,
    /// Pairs.
    pub pairs: usize,
}

/// Names of the configurations that occur, in the order given by the first run of each.
pub fn configuration_names(runs: &[Run]) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for run in runs {
        if !names.contains(&run.configuration) {
            names.push(run.configuration.clone());
        }
    }
    names
}

/// Figures of the runs of a configuration; `None` where there are none.
pub fn summarise(runs: &[Run], configuration: &str, soil: Option<SoilKind>) -> Option<Summary> {
    let chosen: Vec<&Run> = runs.iter().filter(|r| r.configuration == configuration && soil.is_none_or(|soil| r.soil == soil)).collect();
    if chosen.is_empty() {
        return None;
    }
    let completed: Vec<&Run> = chosen.iter().filter(|r| r.lap.completed).copied().collect();
    let completion = completed.len() as f64 / chosen.len() as f64;
    let begun: Vec<&Run> = chosen.iter().filter(|r| r.lap.is_begun()).copied().collect();
    let whole: &[&Run] = if begun.iter().all(|r| r.lap.hausdorff_whole_path_m.is_some()) { &begun } else { &[] };
    Some(Summary {
        runs: chosen.len(),
        never_began: chosen.len() - begun.len(),
        places: places(&chosen).1,
        completion,
        completion_ci95: wilson(completion, chosen.len()),
        time_s: figures(&completed, |lap| Some(lap.time_s)),
        hausdorff_m: figures(&chosen, |lap| lap.hausdorff_m),
        hausdorff_whole_path_m: figures(whole, |lap| lap.hausdorff_whole_path_m),
        off_path_m: figures(&chosen, |lap| lap.off_path_mean_m),
        roll_deg: figures(&chosen, |lap| lap.roll_deg),
        pitch_deg: figures(&chosen, |lap| lap.pitch_deg),
    })
}

/// Ratio of a quantity between two configurations, over runs of the same world, start and seed. `of` gives the quantity of a lap over its first part, up to the
/// share of the lap that both came to; a pair of which one lap has none is left out.
pub fn ratio(runs: &[Run], over: &str, under: &str, soil: Option<SoilKind>, of: fn(&Lap, f64) -> Option<f64>) -> Option<Ratio> {
    let same = |a: &Run, b: &Run| a.place() == b.place() && a.seed == b.seed;
    let is = |r: &Run, name: &str| r.configuration == name && soil.is_none_or(|soil| r.soil == soil);
    let pair = |a: &Run, b: &Run| {
        let progress = a.lap.progress.min(b.lap.progress);
        Some((of(&a.lap, progress)?, of(&b.lap, progress)?))
    };
    let pairs = runs.iter().filter(|r| is(r, over)).filter_map(|a| {
        let b = runs.iter().find(|b| is(b, under) && same(a, b))?;
        pair(a, b).map(|values| (a, values))
    });
    let (firsts, values): (Vec<&Run>, Vec<(f64, f64)>) = pairs.unzip();
    let (above, below): (Vec<f64>, Vec<f64>) = values.into_iter().unzip();
    let total: f64 = below.iter().sum();
    if total <= 0.0 {
        return None;
    }
    let (cluster, count) = places(&firsts);
    let ci95 = Resamples::draw(count, DEFAULT_RESAMPLES, BOOTSTRAP_SEED).ratio_interval(&above, &below, &cluster);
    Some(Ratio { ratio: above.iter().sum::<f64>() / total, ci95, pairs: firsts.len() })
}

/// The place of each run as an index, and how many there are.
fn places(runs: &[&Run]) -> (Vec<usize>, usize) {
    let mut known: Vec<(String, usize)> = Vec::new();
    let index = runs.iter().map(|run| {
        let place = run.place();
        known.iter().position(|k| *k == place).unwrap_or_else(|| {
            known.push(place);
            known.len() - 1
        })
    });
    let index = index.collect();
    (index, known.len())
}

/// Figures of a quantity over the runs that have it.
fn figures(runs: &[&Run], of: fn(&Lap) -> Option<f64>) -> Figures {
    let (runs, values): (Vec<&Run>, Vec<f64>) = runs.iter().filter_map(|r| Some((*r, of(&r.lap)?))).unzip();
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    let sd = if values.len() < 2 { f64::NAN } else { (squares / (count - 1.0)).sqrt() };
    let (cluster, places) = places(&runs);
    Figures { mean, sd, ci95: Resamples::draw(places, DEFAULT_RESAMPLES, BOOTSTRAP_SEED).mean_interval(&values, &cluster) }
}

/// Wilson's score interval of a share.
fn wilson(share: f64, count: usize) -> [f64; 2] {
    let n = count as f64;
    let squared = Z_95 * Z_95;
    let middle = (share + squared / (2.0 * n)) / (1.0 + squared / n);
    let half = Z_95 / (1.0 + squared / n) * (share * (1.0 - share) / n + squared / (4.0 * n * n)).sqrt();
    [(middle - half).max(0.0), (middle + half).min(1.0)]
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::lap::{Lean, Scored};

    pub(crate) fn run(configuration: &str, world: &str, start: usize, seed: u64, hausdorff_m: f64, completed: bool) -> Run {
        let lap = Lap {
            completed,
            end: if completed { "complete" } else { "off_path" }.into(),
            time_s: 50.0,
            progress: 1.0,
            hausdorff_m: Some(hausdorff_m),
            hausdorff_whole_path_m: Some(10.0 * hausdorff_m),
            off_path_mean_m: Some(0.3 * hausdorff_m),
            roll_deg: Some(2.0),
            pitch_deg: Some(3.0),
            measurements: Default::default(),
            soil_delta: None,
            scored: Scored::Truth,
            velocity_mismatch_m_s: None,
            moved_over_told: None,
            turn_correlation: None,
            measured_off_m: None,
            path: vec![[23.5, 0.0], [23.0, 2.0]],
            lean: vec![Lean { progress: 1.0, roll_deg: 2.0, pitch_deg: 3.0 }],
        };
        Run { configuration: configuration.into(), world: world.into(), soil: SoilKind::Soft, start, seed, lap }
    }

    #[test]
    fn analytic_means_ratios_and_completion() {
        let mut runs = Vec::new();
        for (world, base) in [("a", 1.0), ("b", 2.0)] {
            for seed in 0..3 {
                runs.push(run("fixed", world, 0, seed, 2.0 * base, seed > 0));
                runs.push(run("adapted", world, 0, seed, base, true));
            }
        }
        let fixed = summarise(&runs, "fixed", None).unwrap();
        assert!((fixed.hausdorff_m.mean - 3.0).abs() < 1e-12 && (fixed.completion - 4.0 / 6.0).abs() < 1e-12 && fixed.places == 2);
        let against = ratio(&runs, "adapted", "fixed", Some(SoilKind::Soft), |lap, _| lap.hausdorff_m).unwrap();
        // Every pair has the ratio one half, so every resample has it.
        assert!(against.pairs == 6 && (against.ratio - 0.5).abs() < 1e-12);
        assert!(against.ci95.unwrap().iter().all(|v| (v - 0.5).abs() < 1e-12));
        assert!(summarise(&runs, "fixed", Some(SoilKind::Firm)).is_none() && configuration_names(&runs) == ["fixed", "adapted"]);
    }

    /// Goal: a lap that ends before the steep part is not told to lean less. Method: 2° up to the middle and 8° after it; the other lap ends in the middle.
    #[test]
    fn analytic_laps_are_compared_where_both_drove() {
        let lean = |progress: f64| Lean { progress, roll_deg: if progress > 0.5 { 8.0 } else { 2.0 }, pitch_deg: 1.0 };
        let lap = |configuration: &str, steps: usize| {
            let mut run = run(configuration, "a", 0, 1, 1.0, steps == 10);
            run.lap = Lap { progress: 0.1 * steps as f64, lean: (1..=steps).map(|k| lean(0.1 * k as f64)).collect(), ..run.lap };
            run
        };
        let runs = vec![lap("fixed", 5), lap("adapted", 10)];
        let roll = |lap: &Lap, progress: f64| lap.mean_lean_until(progress, |lean| lean.roll_deg);
        assert!((roll(&runs[1].lap, 1.0).unwrap() - 5.0).abs() < 1e-12);
        assert!((ratio(&runs, "adapted", "fixed", None, roll).unwrap().ratio - 1.0).abs() < 1e-12);
    }

    /// A lap that a plant ended at its `reset`.
    pub(crate) fn never_begun(run: Run) -> Run {
        let lap = Lap { completed: false, end: "spawn blocked".into(), time_s: 0.0, progress: 0.0, lean: Vec::new(), ..run.lap };
        Run { lap: lap.without_inventions(), ..run }
    }

    /// Goal: a lap that never began says nothing of how a model drives. Method: two pairs, in one of which a lap was blocked: means and ratios are those of the
    /// laps that were driven, intervals have one place alone, and the lap counts as not completed.
    #[test]
    fn regress_a_lap_that_never_began_is_in_no_mean_and_no_ratio() {
        let roll: fn(&Lap, f64) -> Option<f64> = |lap, progress| lap.mean_lean_until(progress, |lean| lean.roll_deg);
        let runs = vec![
            run("fixed", "a", 0, 1, 2.0, true),
            run("fixed", "b", 0, 1, 4.0, true),
            run("adapted", "a", 0, 1, 1.0, true),
            never_begun(run("adapted", "b", 0, 1, 1.0, true)),
        ];
        let adapted = summarise(&runs, "adapted", None).unwrap();
        assert_eq!((adapted.runs, adapted.never_began, adapted.completion), (2, 1, 0.5));
        for (figures, mean) in [
            (adapted.hausdorff_m, 1.0),
            (adapted.hausdorff_whole_path_m, 10.0),
            (adapted.off_path_m, 0.3),
            (adapted.roll_deg, 2.0),
            (adapted.pitch_deg, 3.0),
        ] {
            assert!(figures.mean == mean && figures.sd.is_nan() && figures.ci95.is_none(), "{figures:?}");
        }
        for of in [roll, |lap, _| lap.hausdorff_m] {
            let over = ratio(&runs, "adapted", "fixed", None, of).unwrap();
            assert!(over.pairs == 1 && over.ci95.is_none(), "{over:?}");
        }
        assert_eq!(ratio(&runs, "adapted", "fixed", None, roll).unwrap().ratio, 1.0);
        assert!(
            ratio(&runs[1..2], "fixed", "adapted", None, roll).is_none() && ratio(&runs[1..], "adapted", "adapted", None, roll).is_some()
        );
        assert!(ratio(&runs[3..], "adapted", "adapted", None, roll).is_none());
    }

    /// Wilson (1927), as tabulated for 0 of 10: 0 to 0.2775; for 5 of 10: 0.2366 to 0.7634.
    #[test]
    fn published_wilson_interval() {
        let close = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).abs() < 1e-4 && (a[1] - b[1]).abs() < 1e-4;
        assert!(close(wilson(0.0, 10), [0.0, 0.2775]) && close(wilson(0.5, 10), [0.2366, 0.7634]));
    }
}
