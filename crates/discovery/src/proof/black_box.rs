//! The control without physics: the output head of the learned residual, refitted on the drives of the diagnosis.
//!
//! The residual is a linear function of the network's last hidden layer. Its head is changed along the principal directions of that layer over the drives, for
//! all twelve entries of the state, by generalised least squares on the same deviations, with the same metric and the same freedom of the soil as a named
//! effect; the strength of the ridge is chosen by leaving each drive out. This is what fine-tuning of the head converges to, without its noise.

use nalgebra::{DMatrix, DVector};
use nesam_model::{ModelError, Predictor};
use nesam_physics::{STATE_DIM, SoilCorrection};
use rayon::prelude::*;

use crate::claims::Case;
use crate::observe::condense::{Condensed, Parts, difference};
use crate::proof::ridge;

/// Principal directions of the hidden layer that the head may change along (chosen: most of what a few drives vary).
const DIRECTIONS: usize = 6;
/// Features of an entry of the state: a constant and the directions.
const FEATURES: usize = 1 + DIRECTIONS;
/// Parameters of the control.
pub const PARAMETERS: usize = STATE_DIM * FEATURES;

/// The drives' scores in the parameters of the head.
#[derive(Clone, Debug)]
pub struct BlackBox {
    /// Mean of the hidden layer. (128)
    mean: DVector<f64>,
    /// Directions over their standard deviation, one a column. (128, directions)
    directions: DMatrix<f64>,
    parts: Parts,
}

impl BlackBox {
    /// Scores of the drives of a case, whose predictions come from `predictor`; `None` for a form that has no learned residual.
    pub fn of(case: &Case<'_>, predictor: &Predictor) -> Option<Self> {
        let bundle = predictor.bundle();
        if bundle.form == nesam_model::Variant::NoResidual {
            return None;
        }
        let scale = bundle.normalization.residual_scale.map(f64::from);
        let (mean, directions) = principal(case)?;
        let metric = case.metric_without.believing_all();
        case.work.add(case.prepared.len());
        let drives = case
            .prepared
            .par_iter()
            .zip(&case.rows)
            .map(|(prepared, rows)| {
                let features: Vec<DVector<f64>> =
                    (0..prepared.drive.samples()).map(|k| features(&mean, &directions, prepared.drive.hidden(k))).collect();
                let columns: Vec<_> = (0..PARAMETERS)
                    .map(|p| {
                        let (entry, feature) = (p / FEATURES, p % FEATURES);
                        let changed = prepared.drive.with_residual(|k| {
                            let mut added = [0.0; STATE_DIM];
                            added[entry] = scale[entry] * features[k][feature];
                            added
                        });
                        difference(rows, &changed.deviations(&case.bench, &[], &SoilCorrection::NONE), 1.0)
                    })
                    .collect();
                case.work.done();
                prepared.signatures.profiled(&metric, rows, &columns)
            })
            .collect();
        Some(Self { mean, directions, parts: Parts::of(drives) })
    }

    /// A predictor with the head that the drives teach, but for the part of one of them where given; unchanged where they teach nothing.
    ///
    /// # Errors
    /// Those of [`Predictor::with_residual_head`].
    pub fn predictor(&self, predictor: &Predictor, left_out: Option<usize>) -> Result<Predictor, ModelError> {
        let kept: Vec<&Condensed> = self.parts.without(left_out).collect();
        let hidden = self.mean.len();
        let (mut weight, mut bias) = (vec![0.0f32; STATE_DIM * hidden], vec![0.0f32; STATE_DIM]);
        if let Some(found) = ridge::fit(&kept, None) {
            for (entry, (bias, row)) in bias.iter_mut().zip(weight.chunks_exact_mut(hidden)).enumerate() {
                let own = found.coefficients.rows(entry * FEATURES, FEATURES);
                let along = &self.directions * own.rows(1, FEATURES - 1);
                *bias = (own[0] - along.dot(&self.mean)) as f32;
                row.iter_mut().zip(along.iter()).for_each(|(w, a)| *w = *a as f32);
            }
        }
        predictor.with_residual_head(&weight, &bias)
    }
}

fn features(mean: &DVector<f64>, directions: &DMatrix<f64>, hidden: &[f32]) -> DVector<f64> {
    let own = DVector::from_iterator(hidden.len(), hidden.iter().map(|h| f64::from(*h))) - mean;
    directions.tr_mul(&own).insert_row(0, 1.0)
}

/// Mean of the hidden layer over the samples of the drives and its principal directions, each over its standard deviation; `None` where it does not vary.
fn principal(case: &Case<'_>) -> Option<(DVector<f64>, DMatrix<f64>)> {
    let samples: Vec<DVector<f64>> = case
        .prepared
        .iter()
        .flat_map(|p| {
            (0..p.drive.samples()).map(|k| DVector::from_iterator(p.drive.hidden(k).len(), p.drive.hidden(k).iter().map(|h| f64::from(*h))))
        })
        .collect();
    let size = samples.first()?.len();
    let mean = samples.iter().fold(DVector::zeros(size), |sum, s| sum + s) / samples.len() as f64;
    let mut covariance = DMatrix::zeros(size, size);
    for sample in &samples {
        let d = sample - &mean;
        covariance.ger(1.0 / samples.len() as f64, &d, &d, 1.0);
    }
    let eigen = covariance.symmetric_eigen();
    let mut order: Vec<usize> = (0..size).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let mut directions = DMatrix::zeros(size, DIRECTIONS);
    for (column, &i) in order.iter().take(DIRECTIONS).enumerate() {
        let variance = eigen.eigenvalues[i];
        if variance <= 1e-12 {
            return None;
        }
        directions.set_column(column, &(eigen.eigenvectors.column(i) / variance.sqrt()));
    }
    Some((mean, directions))
}
