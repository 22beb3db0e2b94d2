//! The JSON of `nesam adapt` (`nesam.adapt/1`).

use nesam_adaptation::{FilterConfig, FilterSettings};
use nesam_physics::SOIL_DIM;
use nesam_trajectories::Trajectory;
use serde::Serialize;

use crate::adapt::{Consistency, DriveAdaptation};
use crate::evaluate::ModelScore;
use crate::output::Provenance;
use crate::score::{ErrorSummary, ErrorTree, PerDimension, PositionError, paired_difference, paired_ratio};
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
    /// Drives in the order of `filtered`.
    pub drives: &'a [Trajectory],
    /// The bundle's own prediction, soil prior as it is.
    pub fixed: &'a ModelScore,
    /// The same windows with the posterior known at their start.
    pub adapted: &'a ModelScore,
    /// What the filter did on each drive.
    pub filtered: &'a [DriveAdaptation],
    /// Settings of the filter.
    pub filter: &'a FilterConfig,
    /// Seed of the bootstrap.
    pub seed: u64,
    /// Bootstrap draws.
    pub resamples: &'a Resamples,
    /// What the numbers were made from.
    pub provenance: &'a Provenance,
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
    truth: &'static str,
    failed: usize,
    difference: Difference,
    filter: FilterSettings,
    ratio_ci95: ErrorTree<[f64; 2]>,
    bootstrap: Bootstrap,
    provenance: &'a Provenance,
}

#[derive(Serialize)]
struct ConsistencyJson {
    nis_mean_over_dof: Option<f64>,
    inside_95: Option<f64>,
    nis_median_over_dof: Option<f64>,
}

/// Soil under the vehicle after one buffer.
#[derive(Serialize)]
struct SoilRow<'a> {
    trajectory: &'a str,
    t_s: f64,
    /// Reserved for a posterior per region; one posterior per drive has none.
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

    /// NIS over all buffers.
    pub fn consistency(&self) -> Consistency {
        Consistency::of(self.filtered)
    }

    /// Time of a sample in its drive, s.
    pub(crate) fn time_s(&self, drive: usize, sample: usize) -> f64 {
        self.drives[drive].time_s[sample]
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
            oracle_soil: None,
            ratio: self.ratio(),
            consistency: ConsistencyJson {
                nis_mean_over_dof: consistency.nis_mean_over_dof,
                inside_95: consistency.inside_95,
                nis_median_over_dof: consistency.nis_median_over_dof,
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
            truth: self.truth.as_str(),
            failed: consistency.failed,
            difference: Difference { value, ci95 },
            filter: FilterSettings::of(self.filter),
            ratio_ci95: self.ratio_ci95(),
            bootstrap: Bootstrap { by: "trajectory", resamples: self.resamples.count(), seed: self.seed },
            provenance: self.provenance,
        };
        serde_json::to_string_pretty(&document).expect("finite numbers and text always serialise; this is a bug") + "\n"
    }

    fn soil_rows(&self) -> Vec<SoilRow<'_>> {
        let row = |drive: usize, timed: &crate::adapt::TimedUpdate| SoilRow {
            trajectory: &self.drives[drive].id,
            t_s: self.time_s(drive, timed.sample),
            region: None,
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
    let divide = |a: Option<f64>, b: Option<f64>| a.zip(b).map(|(a, b)| a / b).filter(|r| r.is_finite());
    let six = |a: &PerDimension<f64>, b: &PerDimension<f64>| {
        let (a, b) = (a.to_array(), b.to_array());
        PerDimension::from_array(std::array::from_fn(|d| divide(a[d], b[d])))
    };
    let (a, b) = (&over.position_m, &under.position_m);
    ErrorTree {
        mae_mean: six(&over.mae_mean, &under.mae_mean),
        mae_final: six(&over.mae_final, &under.mae_final),
        position_m: PositionError {
            mean: divide(a.mean, b.mean),
            final_: divide(a.final_, b.final_),
            final_over_path_median: divide(a.final_over_path_median, b.final_over_path_median),
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
