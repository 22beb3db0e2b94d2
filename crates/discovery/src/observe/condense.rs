//! What a drive says about every column of the catalogue: a score and an information matrix, the unit that is compared with drives without an effect.
//!
//! With deviations r, signatures G (how an effect of unit share shifts r) and the metric W, the drive is condensed into Gᵀ W r and Gᵀ W G. Another soil
//! of the drive and what it would do are profiled out with a wide prior (Brynjarsdottir and O'Hagan 2014: discrepancy and parameters are confounded unless
//! the prior is informative), so a column keeps only what no soil can imitate. Everything after this, the evidence, rivals, several effects at once and
//! sub-samples of drives, is algebra on these small matrices.

use nalgebra::{DMatrix, DVector};
use nesam_evaluation::{median, quantile_sorted};
use nesam_physics::{SOIL_DIM, SoilCorrection};
use rayon::prelude::*;

use crate::candidates::bend::{self, Bend, Driven};
use crate::candidates::{Candidate, column_count};
use crate::observe::channels::{CHANNELS, Row, level_name};
use crate::observe::metric::Metric;
use crate::observe::{Bench, ObservedDrive};
use nesam_physics::effects::{Effect, ScheduledEffect};

/// Prior standard deviation of a soil correction common to a drive, logarithmic coordinates: ln k_phi, ln k_c, n, ln c, phi (rad), ln k_shear.
/// Twice the spread of Wong's published soils within a class of ground (chosen), because a claim must not rest on soil that is a little unusual.
pub const SOIL_SD: [f64; SOIL_DIM] = [1.0, 1.0, 0.2, 1.0, 0.14, 0.7];
/// Whitened distance of a segment, per root of the number of channels, beyond which its weight falls (Huber 1964).
const CUT_OFF: f64 = 1.5;
/// Share of the columns whose scores within drives do not scatter more than is believed (chosen: forces, lags and play scatter most).
const FACTOR_QUANTILE: f64 = 0.8;

/// How columns shift the deviations of a drive; one row per segment each.
#[derive(Clone, Debug)]
pub struct Signatures {
    /// Columns of the catalogue.
    pub columns: Vec<Vec<Row>>,
    /// One prior standard deviation of each soil parameter.
    pub soil: Vec<Vec<Row>>,
    /// What was commanded and done in each segment.
    pub driven: Vec<Driven>,
    /// Segments that do not count, because an effect that was chosen last may begin within them ([`straddling`](crate::select::onset)); empty where none does.
    pub uncounted: Vec<usize>,
}

/// Score and information of a drive, soil profiled out.
#[derive(Clone, Debug)]
pub struct Condensed {
    /// Gᵀ W r. (J)
    pub score: DVector<f64>,
    /// Gᵀ W G. (J, J)
    pub information: DMatrix<f64>,
    /// rᵀ W r.
    pub square: f64,
    /// Score of the soil alone, in prior standard deviations. (6)
    pub soil_score: DVector<f64>,
    /// Information of the soil alone, without its prior. (6, 6)
    pub soil_information: DMatrix<f64>,
}

impl Condensed {
    /// Score and information of the first columns alone.
    pub fn head(&self, columns: usize) -> Self {
        Self {
            score: self.score.rows(0, columns).into_owned(),
            information: self.information.view((0, 0), (columns, columns)).into_owned(),
            ..self.clone()
        }
    }

    /// As if a column had been there with a share and were not fitted.
    pub fn plus(mut self, column: usize, share: f64) -> Self {
        self.square += share * (2.0 * self.score[column] + share * self.information[(column, column)]);
        self.score.axpy(share, &self.information.column(column), 1.0);
        self
    }

    fn add(&mut self, other: &Self) {
        self.score += &other.score;
        self.information += &other.information;
        self.square += other.square;
        self.soil_score += &other.soil_score;
        self.soil_information += &other.soil_information;
    }
}

/// Most parts of which a control leaves each out in turn.
const PARTS_MAX: usize = 24;

/// Part of a drive where `drives` drives are cut into at most `parts_max` parts of neighbours; every drive is a part where there are fewer.
pub fn part_of(drive: usize, drives: usize, parts_max: usize) -> usize {
    drive * drives.min(parts_max) / drives
}

/// The drives of a set in at most 24 parts of neighbours, for what would take too long if each drive were left out by itself.
#[derive(Clone, Debug)]
pub struct Parts {
    parts: Vec<Condensed>,
    drives: usize,
}

impl Parts {
    /// Sums of neighbouring drives; every drive is a part where there are few.
    pub fn of(drives: Vec<Condensed>) -> Self {
        let count = drives.len();
        let mut parts: Vec<Condensed> = Vec::new();
        for (d, drive) in drives.into_iter().enumerate() {
            match parts.get_mut(part_of(d, count, PARTS_MAX)) {
                Some(part) => part.add(&drive),
                None => parts.push(drive),
            }
        }
        Self { parts, drives: count }
    }

    /// The parts, but for that of a drive where given.
    pub fn without(&self, drive: Option<usize>) -> impl Iterator<Item = &Condensed> {
        let left_out = drive.map(|d| part_of(d, self.drives, PARTS_MAX));
        self.parts.iter().enumerate().filter(move |(p, _)| Some(*p) != left_out).map(|(_, part)| part)
    }
}

/// An effect beside which others are looked for.
#[derive(Clone, Copy, Debug)]
pub struct Beside {
    /// The hypothesis, of one column.
    pub candidate: Candidate,
    /// The effect as fitted.
    pub effect: ScheduledEffect,
    /// Its share in the column of the hypothesis.
    pub share: f64,
}

/// Signatures of every column of the catalogue and of the soil on one drive, by central differences.
pub fn signatures(bench: &Bench<'_>, drive: &ObservedDrive) -> Signatures {
    signatures_beside(bench, drive, &[])
}

/// The same beside effects that were fitted; their own columns are the secants, from without to with each, one after the other, so that the deviations without
/// them are those with them plus the columns times their shares.
pub fn signatures_beside(bench: &Bench<'_>, drive: &ObservedDrive, fitted: &[Beside]) -> Signatures {
    let beside: Vec<ScheduledEffect> = fitted.iter().map(|f| f.effect).collect();
    let at = |effect: Option<ScheduledEffect>, soil: &SoilCorrection| {
        let effects: Vec<ScheduledEffect> = beside.iter().copied().chain(effect).collect();
        drive.deviations(bench, &effects, soil)
    };
    let base = at(None, &SoilCorrection::NONE);
    let mass_kg = bench.vehicle.mass_kg;
    let form = |c: &Candidate| c.linear_form().into_iter().map(|e| (e, c.forward(), c.share_step(mass_kg))).collect::<Vec<_>>();
    let forms: Vec<(Effect, bool, f64)> = bench.catalogue.iter().flat_map(form).collect();
    let mut columns: Vec<Vec<Row>> = forms
        .par_iter()
        .map(|(effect, forward, step)| {
            let side = |share: f64| at(Some(ScheduledEffect { effect: effect.scaled(share), onset_s: 0.0 }), &SoilCorrection::NONE);
            if *forward { difference(&base, &side(*step), 1.0 / step) } else { difference(&side(-step), &side(*step), 0.5 / step) }
        })
        .collect();
    for (i, own) in fitted.iter().enumerate() {
        let with = |count: usize| drive.deviations(bench, &beside[..count], &SoilCorrection::NONE);
        columns[own.candidate.columns()[0]] = difference(&with(i), &with(i + 1), 1.0 / own.share);
    }
    let soil = (0..SOIL_DIM)
        .into_par_iter()
        .map(|i| {
            let side = |share: f64| {
                let mut correction = SoilCorrection::NONE;
                correction.delta[i] = share * SOIL_SD[i];
                at(None, &correction)
            };
            difference(&side(-0.25), &side(0.25), 2.0)
        })
        .collect();
    Signatures { columns, soil, driven: drive.driven(), uncounted: Vec::new() }
}

/// (less - more) · factor, row by row: what the deviations look like when the effect is there and the prediction lacks it.
pub fn difference(less: &[Row], more: &[Row], factor: f64) -> Vec<Row> {
    less.iter().zip(more).map(|(l, m)| core::array::from_fn(|c| (l[c] - m[c]) * factor)).collect()
}

/// Names of all columns: those of the catalogue, then the level of each channel, then the bends of actuators and sensors.
pub fn column_names(catalogue: &[Candidate]) -> Vec<String> {
    let effects = catalogue.iter().flat_map(|c| c.columns().into_iter().map(|j| format!("{} {j}", c.label())).collect::<Vec<_>>());
    effects.chain((0..CHANNELS).map(level_name)).chain(bend::ALL.map(|bend| bend.name())).collect()
}

/// Column of the level of a channel, after those of all hypotheses.
pub fn level_column(catalogue: &[Candidate], channel: usize) -> usize {
    column_count(catalogue) + channel
}

/// Column of a bend, after those of all levels.
pub fn bend_column(catalogue: &[Candidate], bend: Bend) -> usize {
    column_count(catalogue) + CHANNELS + bend.place()
}

/// Condenses a drive: the catalogue's columns and, after them, the level of every channel and the bends of actuators and sensors as columns of their own, which name no
/// cause.
pub fn condense(metric: &Metric, rows: &[Row], signatures: &Signatures) -> Condensed {
    let mut columns = whitened(metric, &signatures.columns);
    let unit = |c: usize| {
        metric.channels.iter().position(|own| *own == c).map_or_else(|| DVector::zeros(metric.channels.len()), |at| metric.unit(at))
    };
    columns.extend((0..CHANNELS).map(|c| vec![unit(c); rows.len()]));
    columns.extend(bend::ALL.map(|bend| {
        let unit = unit(bend.channel);
        bend.over(&signatures.driven).into_iter().map(|share| &unit * share).collect()
    }));
    let named = columns.len();
    columns.extend(whitened(metric, &signatures.soil));
    profile_soil(&products(metric, rows, &columns, &signatures.uncounted).sum(metric), named)
}

/// Columns as shifts in the metric, segment by segment.
fn whitened(metric: &Metric, columns: &[Vec<Row>]) -> Vec<Vec<DVector<f64>>> {
    columns.iter().map(|column| column.iter().map(|row| metric.shift(row)).collect()).collect()
}

impl Signatures {
    /// Condenses their drive over any columns, without levels.
    pub fn profiled(&self, metric: &Metric, rows: &[Row], columns: &[Vec<Row>]) -> Condensed {
        profiled(metric, rows, columns, &self.soil, &self.uncounted)
    }
}

/// Condenses a drive over any columns, without levels; `uncounted` segments have no weight.
pub fn profiled(metric: &Metric, rows: &[Row], columns: &[Vec<Row>], soil: &[Vec<Row>], uncounted: &[usize]) -> Condensed {
    let shifts: Vec<Vec<DVector<f64>>> = [columns, soil].into_iter().flat_map(|c| whitened(metric, c)).collect();
    profile_soil(&products(metric, rows, &shifts, uncounted).sum(metric), columns.len())
}

/// Weighted products of residual and columns, (1 + columns) square each: variations within the drive, and its level. The residual comes first.
struct Products {
    within: DMatrix<f64>,
    level: DMatrix<f64>,
}

impl Products {
    fn sum(self, metric: &Metric) -> DMatrix<f64> {
        self.within * metric.within_believed + self.level
    }
}

fn products(metric: &Metric, rows: &[Row], columns: &[Vec<DVector<f64>>], uncounted: &[usize]) -> Products {
    let size = metric.channels.len();
    let residuals: Vec<DVector<f64>> = rows.iter().map(|row| metric.residual(row)).collect();
    let weights = weights(&residuals, uncounted);
    let total = weights.iter().sum::<f64>().max(1e-9);
    // One matrix of all segments: rows are segment-channels, columns the residual and the columns.
    let mut stacked = DMatrix::zeros(size * rows.len(), 1 + columns.len());
    let mut mean = DMatrix::zeros(size, 1 + columns.len());
    for (k, residual) in residuals.iter().enumerate() {
        for j in 0..=columns.len() {
            let value = if j == 0 { residual } else { &columns[j - 1][k] };
            stacked.view_mut((k * size, j), (size, 1)).copy_from(value);
            let mut sum = mean.column_mut(j);
            sum.axpy(weights[k] / total, value, 1.0);
        }
    }
    for (k, weight) in weights.iter().enumerate() {
        let mut block = stacked.rows_mut(k * size, size);
        block -= &mean;
        block *= weight.sqrt();
    }
    Products { within: stacked.tr_mul(&stacked), level: mean.tr_mul(&(metric.level_precision(total) * &mean)) }
}

/// How much of what segments say within a drive is to be believed against its level, measured on drives without an effect: one over the factor by which the
/// variance of their scores from drive to drive exceeds that of segments which know nothing of one another. Segments follow one another, and the errors of the
/// model go with what moves the vehicle. Four in five columns of the catalogue have a smaller factor.
pub fn believed_within<'a>(metric: &Metric, drives: impl Iterator<Item = (&'a [Row], &'a Signatures)>) -> f64 {
    let scores: Vec<Vec<(f64, f64)>> = drives
        .map(|(rows, signatures)| {
            let within = products(metric, rows, &whitened(metric, &signatures.columns), &signatures.uncounted).within;
            (1..within.ncols()).map(|j| (within[(0, j)], within[(j, j)])).collect()
        })
        .collect();
    let count = scores.len() as f64;
    let excess = |j: usize| -> Option<f64> {
        let of = |value: &dyn Fn((f64, f64)) -> f64| scores.iter().map(|s| value(s[j])).sum::<f64>();
        let information = of(&|s| s.1);
        let share = of(&|s| s.0) / information;
        (information > 1e-9).then(|| of(&|s| (s.0 - share * s.1).powi(2)) / information * count / (count - 1.0))
    };
    let columns = scores.first().map_or(0, Vec::len);
    let mut excesses: Vec<f64> = (0..columns).filter_map(excess).collect();
    if excesses.is_empty() || scores.len() < 2 {
        return 1.0;
    }
    excesses.sort_by(f64::total_cmp);
    1.0 / quantile_sorted(&excesses, FACTOR_QUANTILE).max(1.0)
}

/// Weight of each segment: below 1 where it is far from the middle of its drive, 0 where it does not count.
fn weights(residuals: &[DVector<f64>], uncounted: &[usize]) -> Vec<f64> {
    let Some(first) = residuals.first() else { return Vec::new() };
    let size = first.len();
    let middle = DVector::from_fn(size, |c, _| median(&residuals.iter().map(|r| r[c]).collect::<Vec<_>>()));
    let bound = CUT_OFF * (size as f64).sqrt();
    let weight = |r: &DVector<f64>| (bound / (r - &middle).norm().max(1e-9)).min(1.0);
    residuals.iter().enumerate().map(|(k, r)| if uncounted.contains(&k) { 0.0 } else { weight(r) }).collect()
}

fn profile_soil(gram: &DMatrix<f64>, named: usize) -> Condensed {
    let soil = gram.ncols() - 1 - named;
    let at = 1 + named;
    let soil_information = gram.view((at, at), (soil, soil)).into_owned();
    let soil_score = gram.view((at, 0), (soil, 1)).column(0).into_owned();
    let cross = gram.view((at, 1), (soil, named)).into_owned();
    let prior = &soil_information + DMatrix::identity(soil, soil);
    let mut score = gram.view((1, 0), (named, 1)).column(0).into_owned();
    let mut information = gram.view((1, 1), (named, named)).into_owned();
    let mut square = gram[(0, 0)];
    if let Some(solved) = prior.cholesky() {
        let half = solved.solve(&cross);
        score -= half.tr_mul(&soil_score);
        information -= cross.tr_mul(&half);
        square -= soil_score.dot(&solved.solve(&soil_score));
    }
    Condensed { score, information, square, soil_score, soil_information }
}

/// The soil correction, common to all drives, that explains them best without an effect.
pub fn best_soil<'a>(drives: impl Iterator<Item = &'a Condensed>) -> SoilCorrection {
    let mut information = DMatrix::identity(SOIL_DIM, SOIL_DIM);
    let mut score = DVector::zeros(SOIL_DIM);
    for drive in drives {
        information += &drive.soil_information;
        score += &drive.soil_score;
    }
    let shares = information.cholesky().map_or_else(|| DVector::zeros(SOIL_DIM), |c| c.solve(&score));
    let mut correction = SoilCorrection::NONE;
    correction.delta = core::array::from_fn(|i| SOIL_SD[i] * shares[i].clamp(-2.0, 2.0));
    correction
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    /// Drives of 40 segments with noise of one in nine channels, so that few segments are far out, and an answer in the first that each drive has a share of, of
    /// this standard deviation.
    fn drives(sd: f64) -> (Metric, Vec<Vec<Row>>, Signatures) {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let answer = |k: usize| if k % 10 < 5 { 0.5 } else { -0.5 };
        let row = |value: f64| -> Row { core::array::from_fn(|c| if c == 0 { value } else { 0.0 }) };
        let mut noisy = |value: f64| -> Row { core::array::from_fn(|c| if c == 0 { value + normal() } else { normal() }) };
        let rows = (0..300)
            .map(|_| {
                let share = sd * noisy(0.0)[0];
                (0..40).map(|k| noisy(share * answer(k))).collect()
            })
            .collect();
        let one = DMatrix::identity(9, 9);
        let metric = Metric::new((0..9).collect(), DVector::zeros(9), one.clone(), one).unwrap();
        (
            metric,
            rows,
            Signatures {
                columns: vec![(0..40).map(|k| row(answer(k))).collect()],
                soil: Vec::new(),
                driven: Vec::new(),
                uncounted: Vec::new(),
            },
        )
    }

    #[test]
    fn analytic_what_drives_do_not_agree_on_is_believed_less() {
        let believed = |sd: f64| {
            let (metric, rows, signatures) = drives(sd);
            believed_within(&metric, rows.iter().map(|r| (r.as_slice(), &signatures)))
        };
        assert!(believed(0.0) > 0.85, "{}", believed(0.0));
        // Variance of the score over its information: 1 + sd² · information, of 40 segments at 0.5² each.
        let want = 1.0 / (1.0 + 0.25 * 10.0);
        assert!((believed(0.5) / want - 1.0).abs() < 0.2, "{} {want}", believed(0.5));
    }

    /// Goal: a segment in which an effect begins says nothing. Method: a drive in small noise that jumps by three in one segment or not, with and without that segment;
    /// and one of which no segment counts.
    #[test]
    fn analytic_a_segment_that_does_not_count_has_no_say() {
        let (metric, rows, signatures) = drives(0.0);
        let small: Vec<Row> = rows[0].iter().map(|row| row.map(|v| 0.1 * v)).collect();
        let mut jumps = small.clone();
        jumps[17][0] += 3.0;
        let score = |rows: &[Row], uncounted: &[usize]| {
            let soil = vec![vec![[0.0; CHANNELS]; rows.len()]];
            let driven = vec![Driven::default(); rows.len()];
            condense(&metric, rows, &Signatures { columns: signatures.columns.clone(), soil, driven, uncounted: uncounted.to_vec() }).score
        };
        assert!((score(&jumps, &[]) - score(&small, &[])).norm() > 1.0, "a jump is seen");
        let apart = (score(&jumps, &[17]) - score(&small, &[17])).norm();
        assert!(apart < 1e-9, "{apart}");
        let every: Vec<usize> = (0..40).collect();
        assert!(score(&jumps, &every).norm() < 1e-9);
    }
}
