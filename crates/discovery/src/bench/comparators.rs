//! What other methods make of the same drives, each with every drive left out once, scored by rollouts.
//!
//! | method | what it predicts a drive with |
//! |---|---|
//! | `diagnosis` | the claimed effects, nothing where none is claimed |
//! | `oracle` | the true effects, sized by the same refit |
//! | `soil_only` | the soil that explains the other drives best |
//! | `ridge` | all columns of the catalogue at once, one ridge |
//! | `stlsq` | the same, small shares struck out until none is left to strike (Brunton, Proctor and Kutz 2016) |
//! | `black_box` | the refitted head of the learned residual |
//! | `free_form` | the bounded wrench without a name, nothing named beside it |

use nalgebra::{DMatrix, DVector};
use nesam_evaluation::{DEFAULT_RESAMPLES, DriveMaps, EvaluationError, ModelScore, Resamples};
use nesam_model::Predictor;
use nesam_physics::SoilCorrection;
use nesam_physics::effects::ScheduledEffect;
use nesam_trajectories::Trajectory;
use serde::Serialize;

use super::Hidden;
use crate::candidates::{Candidate, column_count};
use crate::claims::Case;
use crate::claims::fit::Fit;
use crate::judgement::Judgement;
use crate::observe::condense::{Condensed, best_soil};
use crate::proof::black_box::BlackBox;
use crate::proof::free_form::Leftover;
use crate::proof::held_out::{Scoring, score_models};
use crate::proof::ridge;
use crate::select::Yardstick;
use crate::select::onset::Onset;
use crate::work::Work;

/// Share of a column's typical size below which STLSQ strikes it out (chosen).
const STRUCK: f64 = 0.25;
/// Largest share that a linear method is taken at its word for, in typical sizes.
const SHARE_MAX: f64 = 3.0;

/// What a method made of a pseudo-vehicle.
#[derive(Clone, Debug, Serialize)]
pub struct Comparison {
    /// Method.
    pub method: &'static str,
    /// Mean over x, y, z, roll, pitch, yaw and position of (error with the method) / (error before).
    pub error_ratio: f64,
    /// Ids that it names, strongest first; a black box, a free form and a soil name nothing.
    pub named: Vec<&'static str>,
}

/// Drives, their judgement and what is known to be hidden.
pub(super) struct Compared<'a> {
    pub predictor: &'a Predictor,
    pub case: &'a Case<'a>,
    pub yardstick: &'a Yardstick,
    pub judgement: &'a Judgement,
    pub hidden: &'a Hidden,
    pub drives: &'a [Trajectory],
    pub maps: &'a DriveMaps,
}

/// A method's models, one for each drive, and what it names.
struct Entry {
    method: &'static str,
    predictors: Vec<Predictor>,
    soils: Vec<SoilCorrection>,
    named: Vec<&'static str>,
}

impl Compared<'_> {
    /// All methods.
    pub fn all(&self, scoring: &Scoring) -> Result<Vec<Comparison>, EvaluationError> {
        let count = self.drives.len();
        let resamples = Resamples::draw(count, DEFAULT_RESAMPLES.min(10), 1);
        let windows = scoring.windows(self.drives)?;
        let score = |entry: &Entry| {
            let models: Vec<(&Predictor, SoilCorrection)> = entry.predictors.iter().zip(entry.soils.iter().copied()).collect();
            score_models(&windows, self.maps, &models, 0, &resamples, &Work::default())
        };
        let plain = self.entry("before", |_| Vec::new(), Vec::new());
        let before = score(&plain)?;
        let mut entries = vec![self.diagnosis(), self.soil_only()];
        entries.extend(self.oracle());
        entries.extend([self.linear("ridge", ridge_shares), self.linear("stlsq", struck_shares)]);
        if let Some(head) = BlackBox::of(self.case, self.predictor) {
            let of = |d| head.predictor(self.predictor, Some(d));
            let refused = |source| EvaluationError::Model { trajectory: self.drives[0].id.clone(), start: 0, source };
            let predictors = (0..count).map(of).collect::<Result<_, _>>().map_err(refused)?;
            entries.push(Entry { predictors, ..self.entry("black_box", |_| Vec::new(), Vec::new()) });
        }
        let left = Leftover::of(self.case, None);
        entries.push(self.entry("free_form", |d| left.effect(Some(d)).into_iter().map(|(e, _)| e.into()).collect(), Vec::new()));
        entries
            .iter()
            .map(|entry| Ok(Comparison { method: entry.method, error_ratio: ratio(&score(entry)?, &before), named: entry.named.clone() }))
            .collect()
    }

    fn entry(&self, method: &'static str, effects: impl Fn(usize) -> Vec<ScheduledEffect>, named: Vec<&'static str>) -> Entry {
        let predictors = (0..self.drives.len()).map(|d| self.predictor.with_effects(&effects(d))).collect();
        Entry { method, predictors, soils: vec![SoilCorrection::NONE; self.drives.len()], named }
    }

    fn diagnosis(&self) -> Entry {
        let claimed = self.judgement.claimed();
        let named = claimed.iter().map(|i| self.judgement.findings[*i].candidate.id()).collect();
        let fit = self.judgement.fit.as_ref().filter(|_| !claimed.is_empty());
        self.entry("diagnosis", |d| fit.map_or_else(Vec::new, |f| f.effects_without(d)), named)
    }

    fn soil_only(&self) -> Entry {
        let others = |left_out: usize| self.case.condensed().enumerate().filter(move |(d, _)| *d != left_out).map(|(_, c)| c);
        let soils = (0..self.drives.len()).map(|d| best_soil(others(d))).collect();
        Entry { soils, ..self.entry("soil_only", |_| Vec::new(), Vec::new()) }
    }

    /// The true effects refitted; `None` where the catalogue has no such effect.
    fn oracle(&self) -> Option<Entry> {
        let ids: Vec<&'static str> = self.hidden.truth.iter().map(|(id, _)| *id).collect();
        let catalogue = &self.yardstick.catalogue;
        let is = |c: &Candidate, id: &str| {
            let same_place = |e: &nesam_physics::effects::Effect| c.linear_form()[0].values()[0] == e.values()[0];
            c.id() == id && (id != "wheel_drag" || self.hidden.driven.iter().any(same_place))
        };
        let chosen: Vec<usize> = ids.iter().filter_map(|id| catalogue.iter().position(|c| is(c, id))).collect();
        if chosen.is_empty() {
            return None;
        }
        let at_s = self.hidden.onset_s;
        let onset = (at_s > 0.0).then_some(Onset { at_s, ci95_s: [at_s; 2], gain: 0.0 });
        let group = self.yardstick.group(self.case.condensed());
        let fit: Fit = self.case.size(self.yardstick, &group, &chosen, &vec![onset; catalogue.len()]);
        Some(self.entry("oracle", |d| fit.effects_without(d), ids))
    }

    /// A method that is linear in the shares of all columns.
    fn linear(&self, method: &'static str, shares: fn(&[&Condensed]) -> Option<DVector<f64>>) -> Entry {
        let columns = column_count(&self.yardstick.catalogue);
        let drives: Vec<Condensed> = self.case.condensed().map(|d| d.head(columns)).collect();
        let of = |left_out: Option<usize>| {
            shares(&drives.iter().enumerate().filter(|(d, _)| Some(*d) != left_out).map(|(_, c)| c).collect::<Vec<_>>())
        };
        let catalogue = &self.yardstick.catalogue;
        let mut strong: Vec<(f64, &'static str)> = Vec::new();
        if let Some(all) = of(None) {
            let total = drives.iter().fold(DVector::zeros(columns), |sum: DVector<f64>, d| sum + d.information.diagonal());
            for candidate in catalogue {
                let weight = candidate.columns().iter().map(|j| all[*j].abs() * total[*j].sqrt()).fold(0.0, f64::max);
                if weight > 0.0 {
                    strong.push((weight, candidate.id()));
                }
            }
            strong.sort_by(|a, b| b.0.total_cmp(&a.0));
        }
        // A ridge keeps every column; it is asked for the one that counts most.
        let named = strong.into_iter().map(|(_, id)| id).take(if method == "ridge" { 1 } else { usize::MAX }).collect();
        self.entry(method, |d| of(Some(d)).map_or_else(Vec::new, |s| effects_of(catalogue, &s)), named)
    }
}

/// Mean over the dimensions of the errors of a model over those of another.
fn ratio(with: &ModelScore, before: &ModelScore) -> f64 {
    let rows = with.summary.tree.row(false).into_iter().zip(before.summary.tree.row(false));
    let ratios: Vec<f64> = rows.filter_map(|(w, b)| Some(w? / b?.max(1e-9))).collect();
    ratios.iter().sum::<f64>() / ratios.len().max(1) as f64
}

fn ridge_shares(drives: &[&Condensed]) -> Option<DVector<f64>> {
    ridge::fit(drives, None).map(|r| r.coefficients)
}

/// Sequentially thresholded least squares.
fn struck_shares(drives: &[&Condensed]) -> Option<DVector<f64>> {
    let size = drives.first()?.score.len();
    let (mut score, mut information) = (DVector::zeros(size), DMatrix::identity(size, size));
    for drive in drives {
        score += &drive.score;
        information += &drive.information;
    }
    let mut kept: Vec<usize> = (0..size).collect();
    loop {
        if kept.is_empty() {
            return None;
        }
        let own = information.select_rows(&kept).select_columns(&kept);
        let shares = own.cholesky()?.solve(&score.select_rows(&kept));
        let next: Vec<usize> = kept.iter().zip(shares.iter()).filter(|(_, s)| s.abs() >= STRUCK).map(|(j, _)| *j).collect();
        if next.len() == kept.len() {
            let mut all = DVector::zeros(size);
            kept.iter().zip(shares.iter()).for_each(|(j, s)| all[*j] = *s);
            return Some(all);
        }
        kept = next;
    }
}

/// Shares of all columns as effects; one that has no counterpart of the other sign is left out there.
fn effects_of(catalogue: &[Candidate], shares: &DVector<f64>) -> Vec<ScheduledEffect> {
    let mut effects = Vec::new();
    for candidate in catalogue {
        for (column, effect) in candidate.columns().into_iter().zip(candidate.linear_form()) {
            let share = shares[column].clamp(-SHARE_MAX, SHARE_MAX);
            if share.abs() < 1e-3 || (candidate.forward() && share < 0.0) {
                continue;
            }
            effects.push(ScheduledEffect::from(effect.scaled(share)));
        }
    }
    effects
}
