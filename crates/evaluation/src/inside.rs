//! Is the physics inside real? What the symbolic half says of wheels and soil against the simulator's own values; for evaluation only.

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_model::{HISTORY, Predictor};
use nesam_physics::{SOIL_DIM, STATE_DIM, WHEELS};
use nesam_terrain::WorldMap;
use nesam_trajectories::{SoilTruth, Trajectory};
use rayon::prelude::*;
use serde::Serialize;

use crate::windows::history_steps;

/// Samples between two comparisons: suspension and ground decorrelate in less than a second.
const EVERY: usize = 8;

/// One quantity, predicted against true.
#[derive(Clone, Debug, Default)]
pub struct Pairs {
    predicted: Vec<f64>,
    truth: Vec<f64>,
}

/// How well one quantity is met.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Agreement {
    /// Values compared.
    pub count: usize,
    /// Mean of the true values.
    pub mean: f64,
    /// Mean error, predicted minus true.
    pub bias: f64,
    /// Mean absolute error.
    pub mae: f64,
    /// Pearson correlation; `None` when one side does not vary.
    pub correlation: Option<f64>,
    /// Spearman rank correlation.
    pub rank_correlation: Option<f64>,
}

impl Pairs {
    fn push(&mut self, predicted: f64, truth: f64) {
        self.predicted.push(predicted);
        self.truth.push(truth);
    }

    fn append(&mut self, other: Self) {
        self.predicted.extend(other.predicted);
        self.truth.extend(other.truth);
    }

    /// Statistics; `None` without a pair.
    pub fn agreement(&self) -> Option<Agreement> {
        let n = self.truth.len();
        if n == 0 {
            return None;
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / n as f64;
        let errors: Vec<f64> = self.predicted.iter().zip(&self.truth).map(|(p, t)| p - t).collect();
        let mae = errors.iter().map(|e| e.abs()).sum::<f64>() / n as f64;
        Some(Agreement {
            count: n,
            mean: mean(&self.truth),
            bias: mean(&errors),
            mae,
            correlation: correlation(&self.predicted, &self.truth),
            rank_correlation: correlation(&ranks(&self.predicted), &ranks(&self.truth)),
        })
    }
}

fn correlation(a: &[f64], b: &[f64]) -> Option<f64> {
    let n = a.len() as f64;
    let (mean_a, mean_b) = (a.iter().sum::<f64>() / n, b.iter().sum::<f64>() / n);
    let product = |x: &[f64], mx: f64, y: &[f64], my: f64| x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum::<f64>();
    let spread = (product(a, mean_a, a, mean_a) * product(b, mean_b, b, mean_b)).sqrt();
    (spread > 0.0).then(|| product(a, mean_a, b, mean_b) / spread)
}

/// Ranks with ties at their mean.
fn ranks(values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&i, &j| values[i].total_cmp(&values[j]));
    let mut ranks = vec![0.0; values.len()];
    let mut from = 0;
    while from < order.len() {
        let to = (from..order.len()).take_while(|&i| values[order[i]] == values[order[from]]).count() + from;
        for &i in &order[from..to] {
            ranks[i] = 0.5 * (from + to - 1) as f64;
        }
        from = to;
    }
    ranks
}

/// Pairs by name: `sinkage_m/dry_sand`, `load_n/all`, `soil_log_k_phi/all`, ….
pub type Comparison = BTreeMap<String, Pairs>;

/// What the learned residual adds to a step, by state entry.
#[derive(Clone, Copy, Debug)]
pub struct ResidualPart {
    /// Share of all that moves the state: Σ|Δx_res| / (Σ|Δx_res| + Σ|Δx_NE|).
    pub share: f64,
    /// Mean over the steps, in units of the state per second: what lasts, and should be the wheels' work.
    pub mean_per_s: f64,
}

/// Sums over steps of one state entry.
#[derive(Clone, Copy, Default)]
struct Sums {
    residual: f64,
    residual_size: f64,
    symbolic_size: f64,
    steps: f64,
}

impl Sums {
    fn add(&mut self, other: &Self) {
        self.residual += other.residual;
        self.residual_size += other.residual_size;
        self.symbolic_size += other.symbolic_size;
        self.steps += other.steps;
    }
}

/// Compares wheels, soils and shares along the drives; `soils` are the true soils of each drive's world, where they are known.
///
/// One step is taken from each measured state, so that nothing but that step is judged. Loads and forces are horizontal and vertical ones;
/// the tilt of the contact, 0.1 rad on a slope, is left out of the comparison.
pub fn look_inside(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &[Option<Arc<WorldMap>>],
    soils: &[Option<SoilTruth>],
) -> (Comparison, [ResidualPart; STATE_DIM]) {
    let parts: Vec<(Comparison, [Sums; STATE_DIM])> =
        (0..drives.len()).into_par_iter().map(|d| drive_inside(predictor, &drives[d], maps[d].as_ref(), soils[d].as_ref())).collect();
    let mut all = Comparison::new();
    let mut sums = [Sums::default(); STATE_DIM];
    for (part, own) in parts {
        for (name, pairs) in part {
            all.entry(name).or_default().append(pairs);
        }
        sums.iter_mut().zip(&own).for_each(|(sum, own)| sum.add(own));
    }
    let dt_s = predictor.bundle().normalization.dt_s;
    let part = |sum: Sums| ResidualPart {
        share: sum.residual_size / (sum.residual_size + sum.symbolic_size).max(f64::MIN_POSITIVE),
        mean_per_s: sum.residual / (sum.steps * dt_s).max(f64::MIN_POSITIVE),
    };
    (all, sums.map(part))
}

fn drive_inside(
    predictor: &Predictor,
    drive: &Trajectory,
    map: Option<&Arc<WorldMap>>,
    soils: Option<&SoilTruth>,
) -> (Comparison, [Sums; STATE_DIM]) {
    let mut out = Comparison::new();
    let mut sums = [Sums::default(); STATE_DIM];
    let Some(truth) = &drive.truth else { return (out, sums) };
    let steps = history_steps(drive);
    for i in (HISTORY..steps.len().saturating_sub(1)).step_by(EVERY) {
        let transition = predictor.transition(&steps[i + 1 - HISTORY..i], &steps[i].state, &steps[i].control, map);
        let output = predictor.step_model().step(&transition.input);
        for ((sum, residual), symbolic) in sums.iter_mut().zip(transition.residual).zip(output.increment.to_array()) {
            sum.add(&Sums { residual, residual_size: residual.abs(), symbolic_size: symbolic.abs(), steps: 1.0 });
        }
        let yaw = truth.states[i + 1].attitude_rad[2];
        for w in 0..WHEELS {
            let region = soils.and_then(|s| s.soil(truth.region[i + 1][w]));
            let mut add = |name: &str, predicted: f64, value: f64| {
                out.entry(format!("{name}/all")).or_default().push(predicted, value);
                if let Some(region) = region {
                    out.entry(format!("{name}/{}", region.class)).or_default().push(predicted, value);
                }
            };
            let contact = &output.contacts[w];
            let (sin, cos) = (yaw + transition.input.wheels.angle_rad[w]).sin_cos();
            let [fx, fy, fz] = truth.wheel_force_n[i + 1][w];
            add("sinkage_m", contact.sinkage_m, truth.sinkage_max_m[i + 1][w]);
            add("load_n", contact.normal_n, fz);
            add("forward_n", contact.forward_n, cos * fx + sin * fy);
            add("left_n", contact.left_n, cos * fy - sin * fx);
            add("slip", contact.slip, truth.slip[i + 1][w]);
        }
        if let Some(true_soil) = soils.and_then(|s| mean_log_soil(s, &truth.region[i])) {
            for (p, name) in nesam_physics::SOIL_NAMES.iter().enumerate() {
                let said = transition.input.soil.to_array()[p].max(f64::MIN_POSITIVE).ln();
                out.entry(format!("soil_log_{name}/all")).or_default().push(said, true_soil[p]);
            }
        }
    }
    (out, sums)
}

/// Mean logarithm of the true soils under the four wheels.
fn mean_log_soil(soils: &SoilTruth, regions: &[usize; WHEELS]) -> Option<[f64; SOIL_DIM]> {
    let mut sum = [0.0; SOIL_DIM];
    for region in regions {
        let soil = soils.soil(*region)?.soil.to_array();
        sum.iter_mut().zip(soil).for_each(|(s, v)| *s += v.max(f64::MIN_POSITIVE).ln() / WHEELS as f64);
    }
    Some(sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_agreement_of_a_shifted_and_reversed_line() {
        let shifted = Pairs { predicted: vec![2.0, 3.0, 4.0], truth: vec![1.0, 2.0, 3.0] }.agreement().expect("three pairs");
        assert_eq!((shifted.bias, shifted.mae, shifted.count), (1.0, 1.0, 3));
        assert!((shifted.correlation.expect("varies") - 1.0).abs() < 1e-12);
        // A monotone but bent relation has rank correlation one, a reversed one minus one; ties share their mean rank.
        let bent = Pairs { predicted: vec![1.0, 8.0, 27.0], truth: vec![3.0, 2.0, 1.0] }.agreement().expect("three pairs");
        assert!((bent.rank_correlation.expect("varies") + 1.0).abs() < 1e-12);
        assert_eq!(ranks(&[5.0, 1.0, 5.0]), vec![1.5, 0.0, 1.5]);
        assert!(Pairs { predicted: vec![1.0, 2.0], truth: vec![4.0, 4.0] }.agreement().expect("two pairs").correlation.is_none());
        assert!(Pairs::default().agreement().is_none());
    }
}
