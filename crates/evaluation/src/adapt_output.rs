//! The JSON of `nesam adapt` (`nesam.adapt/1`).

use std::collections::BTreeMap;

use nesam_adaptation::{FilterConfig, FilterSettings};
use nesam_physics::SOIL_DIM;
use nesam_trajectories::Trajectory;
use serde::Serialize;

use crate::adapt::{Consistency, DriveAdaptation};
use crate::errors::PATH_FLOOR_M;
use crate::evaluate::{DriveMaps, ModelScore};
use crate::known_soil::KnownSoil;
use crate::output::Provenance;
use crate::score::{ErrorSummary, ErrorTree, PerDimension, PositionError, paired_difference, paired_ratio, summarise};
use crate::{Resamples, Truth};

/// Inputs of the JSON and HTML reports of `nesam adapt`.
#[derive(Debug)]
pub struct Adaptation<'a> {
    /// Name of the set.
    pub set: &'a str,
    /// `train`, `test` or `all`.
    pub split: &'a str,
    /// Steps K.
    pub horizon_steps: usize,
    /// Step, s.
    pub dt_s: f64,
    /// Median true path of the windows, m.
    pub path_m_median: f64,
    /// What errors are measured against.
    pub truth: Truth,
    /// Time since the start of its log at which each window starts, s.
    pub starts_s: &'a [f64],
    /// Map of each drive.
    pub maps: &'a DriveMaps,
    /// Drives in the order of `filtered`.
    pub drives: &'a [Trajectory],
    /// The bundle's own prediction, soil prior as it is.
    pub fixed: &'a ModelScore,
    /// The same windows with the posterior known at their start.
    pub adapted: &'a ModelScore,
    /// Further predictors on the same windows: oracles, other filters.
    pub others: &'a [Row],
    /// Drives that are reported apart, by index.
    pub apart: &'a [usize],
    /// The same model with its soil prior on a set whose ground is what it looks like, and the name of the set.
    pub reference: Option<(&'a str, &'a ErrorSummary)>,
    /// What the filter did on each drive.
    pub filtered: &'a [DriveAdaptation],
    /// How that agrees with the simulator's soil, where it was read.
    pub known_soil: Option<&'a KnownSoil>,
    /// Settings of the filter.
    pub filter: &'a FilterConfig,
    /// Seed of the bootstrap.
    pub seed: u64,
    /// Bootstrap draws.
    pub resamples: &'a Resamples,
    /// What the numbers were made from.
    pub provenance: &'a Provenance,
}

/// A predictor by its key in the JSON: `oracle_soil`, `literal`, `best_constant`, `best_by_class`, `constant_elsewhere`.
#[derive(Debug)]
pub struct Row {
    /// Key.
    pub key: &'static str,
    /// Its score.
    pub score: ModelScore,
}

/// Some of the drives, scored for themselves.
#[derive(Debug, Serialize)]
pub struct Part {
    /// Its drives.
    pub trajectories: Vec<String>,
    /// `fixed`, `adapted` and the others.
    pub models: BTreeMap<&'static str, ErrorSummary>,
    /// Adapted over fixed.
    pub ratio: ErrorTree<f64>,
    /// 95 % intervals of the ratio.
    pub ratio_ci95: ErrorTree<[f64; 2]>,
}

#[derive(Serialize)]
struct Document<'a> {
    schema: &'static str,
    set: &'a str,
    fixed: &'a ErrorSummary,
    adapted: &'a ErrorSummary,
    oracle_soil: Option<&'a ErrorSummary>,
    ratio: ErrorTree<f64>,
    consistency: ConsistencyJson,
    updates: usize,
    rejected: usize,
    soil: Vec<SoilRow<'a>>,
    split: &'a str,
    horizon_steps: usize,
    dt_s: f64,
    windows: usize,
    trajectories: usize,
    path_m_median: f64,
    /// As in `nesam.evaluate/1`.
    path_floor_m: f64,
    windows_below_path_floor: usize,
    truth: &'static str,
    failed: usize,
    difference: Difference,
    filter: FilterSettings,
    ratio_ci95: ErrorTree<[f64; 2]>,
    others: BTreeMap<&'static str, &'a ErrorSummary>,
    parts: Vec<Part>,
    reference: Option<Reference<'a>>,
    bootstrap: Bootstrap,
    provenance: &'a Provenance,
}

#[derive(Serialize)]
struct ConsistencyJson {
    nis_mean_over_dof: Option<f64>,
    inside_95: Option<f64>,
    nis_median_over_dof: Option<f64>,
    /// With `oracle_soil`: what was learned against the simulator's soil.
    known_soil: Option<KnownSoil>,
}

/// What there is to gain: the same model on ground that is what it looks like.
#[derive(Serialize)]
struct Reference<'a> {
    set: &'a str,
    fixed: &'a ErrorSummary,
    /// Share of the gap between `fixed` here and `fixed` there that each predictor closes.
    closed: BTreeMap<&'static str, ErrorTree<f64>>,
}

/// Soil under the vehicle after one buffer.
#[derive(Serialize)]
struct SoilRow<'a> {
    trajectory: &'a str,
    t_s: f64,
    /// Class of the ground there, where the map tells it: what the posterior belongs to when the filter keeps classes apart.
    region: Option<&'a str>,
    theta: [f64; SOIL_DIM],
    sd: [f64; SOIL_DIM],
    learned: [bool; SOIL_DIM],
    prior: [f64; SOIL_DIM],
    nis_over_dof: f64,
    rejected: bool,
    trust: f64,
    noise_scale: f64,
}

/// Adapted minus fixed on the same windows: negative = adapted is closer.
#[derive(Serialize)]
struct Difference {
    value: ErrorTree<f64>,
    ci95: ErrorTree<[f64; 2]>,
}

#[derive(Serialize)]
struct Bootstrap {
    by: &'static str,
    resamples: usize,
    seed: u64,
}

impl Adaptation<'_> {
    /// Adapted over fixed, number by number; `None` where either is missing or fixed is 0.
    pub fn ratio(&self) -> ErrorTree<f64> {
        ratio(&self.adapted.summary.tree, &self.fixed.summary.tree)
    }

    /// 95 % intervals of the ratio, by drive.
    pub fn ratio_ci95(&self) -> ErrorTree<[f64; 2]> {
        paired_ratio(&self.adapted.errors, &self.fixed.errors, self.resamples)
    }

    /// All predictors with their keys, `fixed` and `adapted` first.
    pub fn models(&self) -> impl Iterator<Item = (&'static str, &ModelScore)> {
        [("fixed", self.fixed), ("adapted", self.adapted)].into_iter().chain(self.others.iter().map(|row| (row.key, &row.score)))
    }

    /// Share of the gap to the reference set that a predictor closes, number by number; `None` without a reference.
    pub fn closed(&self, score: &ModelScore) -> Option<ErrorTree<f64>> {
        let (_, reference) = self.reference?;
        let (from, to) = (&self.fixed.summary.tree, &reference.tree);
        let gap = combine(from, to, |from, to| from - to);
        let gained = combine(from, &score.summary.tree, |from, now| from - now);
        Some(combine(&gained, &gap, |gained, gap| if gap > 0.0 { gained / gap } else { f64::NAN }))
    }

    /// The drives that are reported apart and the rest; empty without a split.
    pub fn parts(&self) -> Vec<Part> {
        if self.apart.is_empty() {
            return Vec::new();
        }
        [false, true].map(|apart| self.part(|drive| self.apart.contains(&drive) == apart)).into_iter().collect()
    }

    fn part(&self, belongs: impl Fn(usize) -> bool) -> Part {
        let of = |score: &ModelScore| score.errors.filter(|w| belongs(score.errors.trajectory[w]));
        let (fixed, adapted) = (of(self.fixed), of(self.adapted));
        let models: BTreeMap<_, _> = self.models().map(|(key, score)| (key, summarise(&of(score), self.resamples))).collect();
        Part {
            trajectories: (0..self.drives.len()).filter(|d| belongs(*d)).map(|d| self.drives[d].id.clone()).collect(),
            ratio: ratio(&models["adapted"].tree, &models["fixed"].tree),
            models,
            ratio_ci95: paired_ratio(&adapted, &fixed, self.resamples),
        }
    }

    /// NIS over all buffers.
    pub fn consistency(&self) -> Consistency {
        Consistency::of(self.filtered)
    }

    /// Time of a sample since the start of its log, s: clocks of vehicles do not begin at zero.
    pub(crate) fn since_log_start_s(&self, drive: usize, sample: usize) -> f64 {
        let time_s = &self.drives[drive].time_s;
        time_s[sample] - time_s[0]
    }

    /// The JSON document, pretty-printed, with a trailing newline.
    pub fn to_json(&self) -> String {
        let consistency = self.consistency();
        let (value, ci95) = paired_difference(&self.adapted.errors, &self.fixed.errors, self.resamples);
        let document = Document {
            schema: "nesam.adapt/1",
            set: self.set,
            fixed: &self.fixed.summary,
            adapted: &self.adapted.summary,
            oracle_soil: self.others.iter().find(|row| row.key == "oracle_soil").map(|row| &row.score.summary),
            ratio: self.ratio(),
            consistency: ConsistencyJson {
                nis_mean_over_dof: consistency.nis_mean_over_dof,
                inside_95: consistency.inside_95,
                nis_median_over_dof: consistency.nis_median_over_dof,
                known_soil: self.known_soil.cloned(),
            },
            updates: consistency.updates,
            rejected: consistency.rejected,
            soil: self.soil_rows(),
            split: self.split,
            horizon_steps: self.horizon_steps,
            dt_s: self.dt_s,
            windows: self.fixed.summary.windows,
            trajectories: self.drives.len(),
            path_m_median: self.path_m_median,
            path_floor_m: PATH_FLOOR_M,
            windows_below_path_floor: self.fixed.errors.below_path_floor(),
            truth: self.truth.as_str(),
            failed: consistency.failed,
            difference: Difference { value, ci95 },
            filter: FilterSettings::of(self.filter),
            ratio_ci95: self.ratio_ci95(),
            others: self.others.iter().map(|row| (row.key, &row.score.summary)).collect(),
            parts: self.parts(),
            reference: self.reference.map(|(set, fixed)| Reference {
                set,
                fixed,
                closed: self.models().filter_map(|(key, score)| Some((key, self.closed(score)?))).collect(),
            }),
            bootstrap: Bootstrap { by: "trajectory", resamples: self.resamples.count(), seed: self.seed },
            provenance: self.provenance,
        };
        serde_json::to_string_pretty(&document).expect("finite numbers and text always serialise; this is a bug") + "\n"
    }

    fn class_name(&self, drive: usize, class: usize) -> Option<&str> {
        let classes = self.maps.get(drive)?.as_ref()?.soil_classes();
        Some(classes.get(class.checked_sub(1)?)?.name.as_str())
    }

    fn soil_rows(&self) -> Vec<SoilRow<'_>> {
        let row = |drive: usize, timed: &crate::adapt::TimedUpdate| SoilRow {
            trajectory: &self.drives[drive].id,
            t_s: self.drives[drive].time_s[timed.sample],
            region: self.class_name(drive, timed.class),
            theta: timed.soil(),
            sd: timed.update.posterior.sd(&timed.prior),
            learned: timed.update.posterior.learned,
            prior: timed.prior,
            nis_over_dof: timed.update.nis / timed.update.dof as f64,
            rejected: timed.update.rejected,
            trust: timed.update.trust,
            noise_scale: timed.update.noise_scale,
        };
        let rows = self.filtered.iter().enumerate();
        rows.flat_map(|(drive, f)| f.updates.iter().map(move |u| (drive, u))).map(|(drive, u)| row(drive, u)).collect()
    }
}

fn ratio(over: &ErrorTree<f64>, under: &ErrorTree<f64>) -> ErrorTree<f64> {
    combine(over, under, |a, b| a / b)
}

/// Two trees number by number; `None` where either is missing or the outcome is not finite.
fn combine(over: &ErrorTree<f64>, under: &ErrorTree<f64>, by: impl Fn(f64, f64) -> f64) -> ErrorTree<f64> {
    let both = |a: Option<f64>, b: Option<f64>| a.zip(b).map(|(a, b)| by(a, b)).filter(|r| r.is_finite());
    let six = |a: &PerDimension<f64>, b: &PerDimension<f64>| {
        let (a, b) = (a.to_array(), b.to_array());
        PerDimension::from_array(std::array::from_fn(|d| both(a[d], b[d])))
    };
    let (a, b) = (&over.position_m, &under.position_m);
    ErrorTree {
        mae_mean: six(&over.mae_mean, &under.mae_mean),
        mae_final: six(&over.mae_final, &under.mae_final),
        position_m: PositionError {
            mean: both(a.mean, b.mean),
            final_: both(a.final_, b.final_),
            final_over_path_median: both(a.final_over_path_median, b.final_over_path_median),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_ratio_by_hand_and_null_where_nothing_is_measured() {
        let tree = |x: f64, position: f64| ErrorTree {
            mae_mean: PerDimension { x_m: Some(x), z_m: Some(0.0), ..PerDimension::default() },
            position_m: PositionError { mean: Some(position), ..PositionError::default() },
            ..ErrorTree::default()
        };
        let r = ratio(&tree(1.0, 3.0), &tree(2.0, 4.0));
        assert_eq!((r.mae_mean.x_m, r.mae_mean.y_m, r.mae_mean.z_m, r.position_m.mean), (Some(0.5), None, None, Some(0.75)));
    }
}
