//! Normal equations of one drive with its nuisances eliminated.
//!
//! Whitened deviations y = G e + N s + ε, with s ~ N(0, 1) after scaling by its prior: the soil of the drive (Brynjarsdóttir and O'Hagan 2014: an
//! informative prior keeps discrepancy and parameters apart) and a constant offset of each channel. Eliminating s leaves the information
//! I = GᵀWG, the score u = GᵀWy and the misfit yᵀWy with W = 1 - N (NᵀN + 1)⁻¹ Nᵀ: the joint treatment, not "soil first, then what is left".

use nalgebra::{DMatrix, DVector};

use crate::observe::ObservedDrive;
use crate::whitening::Whitening;

/// Prior standard deviation of a drive's soil correction, logarithmic coordinates: ln k_phi, ln k_c, n, ln c, phi (rad), ln k_shear.
/// Chosen from the spread of Wong's published soils within a class of ground.
pub const SOIL_SD: [f64; 6] = [0.5, 0.5, 0.1, 0.5, 0.07, 0.35];

/// What a drive says of a set of directions.
#[derive(Clone, Debug)]
pub struct Normal {
    /// GᵀWG.
    pub information: DMatrix<f64>,
    /// GᵀWy.
    pub score: DVector<f64>,
    /// yᵀWy.
    pub misfit: f64,
    /// Numbers behind it.
    pub numbers: usize,
}

/// Nuisances of a drive, ready to be eliminated.
#[derive(Clone, Debug)]
pub struct Nuisance {
    columns: DMatrix<f64>,
    /// (NᵀN + 1)⁻¹ Nᵀ.
    projector: DMatrix<f64>,
}

impl Nuisance {
    /// Soil directions (already whitened, per prior standard deviation) and channel offsets of a drive.
    pub fn new(whitening: &Whitening<'_>, drive: &ObservedDrive, soil: &[DVector<f64>]) -> Self {
        let all: Vec<DVector<f64>> = soil.iter().cloned().chain(whitening.offsets(drive)).collect();
        let columns = DMatrix::from_columns(&all);
        let mut gram = columns.tr_mul(&columns);
        for i in 0..gram.nrows() {
            gram[(i, i)] += 1.0;
        }
        let projector = gram.cholesky().expect("a Gram matrix plus one is positive definite; this is a bug").solve(&columns.transpose());
        Self { columns, projector }
    }

    /// W v.
    fn kept(&self, v: &DMatrix<f64>) -> DMatrix<f64> {
        v - &self.columns * (&self.projector * v)
    }

    /// Eliminates the nuisances from a residual and directions.
    pub fn normal(&self, residual: &DVector<f64>, directions: &[DVector<f64>]) -> Normal {
        let y = DMatrix::from_columns(core::slice::from_ref(residual));
        let kept_y = self.kept(&y);
        let misfit = residual.dot(&kept_y.column(0));
        if directions.is_empty() {
            return Normal { information: DMatrix::zeros(0, 0), score: DVector::zeros(0), misfit, numbers: residual.len() };
        }
        let g = DMatrix::from_columns(directions);
        let kept_g = self.kept(&g);
        Normal { information: g.tr_mul(&kept_g), score: g.tr_mul(&kept_y).column(0).into_owned(), misfit, numbers: residual.len() }
    }
}

impl Normal {
    /// Sum over drives.
    pub fn sum<'a>(parts: impl IntoIterator<Item = &'a Normal>) -> Option<Normal> {
        parts.into_iter().fold(None, |sum: Option<Normal>, part| {
            Some(match sum {
                None => part.clone(),
                Some(s) => Normal {
                    information: s.information + &part.information,
                    score: s.score + &part.score,
                    misfit: s.misfit + part.misfit,
                    numbers: s.numbers + part.numbers,
                },
            })
        })
    }
}
