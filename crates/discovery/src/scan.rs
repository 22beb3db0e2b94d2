//! First look: every hypothesis of the catalogue in one linear form, per drive.

use core::ops::Range;

use nalgebra::{DMatrix, DVector};
use nesam_physics::step::StepModel;
use nesam_physics::{SOIL_DIM, SoilCorrection, Vehicle};
use rayon::prelude::*;

use crate::candidates::{COLUMNS, Candidate, SHARE_SD};
use crate::channels::{CHANNELS, Row};
use crate::normal::{Normal, Nuisance, SOIL_SD};
use crate::observe::ObservedDrive;
use crate::tail::{equivalent_z, ln_chi_square_tail};
use crate::whitening::Whitening;

/// Segments of 0.8 s that share a soil: about six seconds.
const SEGMENTS_PER_PLACE: usize = 8;

/// What the physics needs besides the vehicle.
#[derive(Clone, Copy, Debug)]
pub struct Stepping {
    /// Step, s.
    pub dt_s: f64,
    /// Sub-steps.
    pub substeps: usize,
}

impl Stepping {
    /// The physics of a vehicle.
    pub fn model(&self, vehicle: &Vehicle) -> StepModel {
        StepModel::new(vehicle, self.dt_s, self.substeps)
    }
}

/// A drive with everything that does not depend on which drives it is judged with.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Whitened deviations from the reference.
    pub residual: DVector<f64>,
    /// Whitened soil directions, per prior standard deviation.
    pub soil: Vec<DVector<f64>>,
    /// Soil and offsets.
    pub nuisance: Nuisance,
    /// Offsets alone, for a soil common to all drives.
    pub offsets: Nuisance,
    /// Normal equations of the linear catalogue.
    pub scores: Normal,
}

/// Prepares a drive.
pub fn prepare(whitening: &Whitening<'_>, vehicle: &Vehicle, stepping: Stepping, drive: &ObservedDrive) -> Prepared {
    let base = drive.deviations(&stepping.model(vehicle), &SoilCorrection::NONE);
    let linear = linear_directions(vehicle, stepping, drive);
    let soil: Vec<DVector<f64>> = (0..SOIL_DIM)
        .into_par_iter()
        .flat_map(|i| {
            let rows = soil_direction(vehicle, stepping, drive, i);
            places(drive.starts.len()).into_iter().map(|place| whitening.direction(drive, &within(&rows, place), &base)).collect::<Vec<_>>()
        })
        .collect();
    let nuisance = Nuisance::new(whitening, drive, &soil);
    let residual = whitening.residual(drive, &base);
    let columns: Vec<DVector<f64>> = linear.iter().map(|rows| whitening.direction(drive, rows, &base)).collect();
    let scores = nuisance.normal(&residual, &columns);
    Prepared { residual, offsets: Nuisance::new(whitening, drive, &[]), nuisance, soil, scores }
}

/// Derivatives of the *prediction* with respect to the shares of the linear forms, by central differences: rows per column.
fn linear_directions(vehicle: &Vehicle, stepping: Stepping, drive: &ObservedDrive) -> Vec<Vec<Row>> {
    let effects: Vec<_> = Candidate::ALL.iter().flat_map(|c| c.linear_form()).collect();
    assert_eq!(effects.len(), COLUMNS, "the linear forms fill the columns; this is a bug");
    effects
        .into_par_iter()
        .map(|effect| {
            let at = |share: f64| drive.deviations(&stepping.model(&vehicle.with_effects(&[effect.scaled(share)])), &SoilCorrection::NONE);
            difference(&at(1.0), &at(-1.0), -0.5)
        })
        .collect()
}

/// Derivative of the prediction with respect to one soil parameter, per prior standard deviation.
fn soil_direction(vehicle: &Vehicle, stepping: Stepping, drive: &ObservedDrive, i: usize) -> Vec<Row> {
    let model = stepping.model(vehicle);
    let at = |sign: f64| {
        let mut soil = SoilCorrection::NONE;
        soil.delta[i] = sign * 0.5 * SOIL_SD[i];
        drive.deviations(&model, &soil)
    };
    difference(&at(1.0), &at(-1.0), -1.0)
}

/// Stretches of a drive with a soil of their own: a vehicle crosses into other ground every few seconds, and no map says where.
fn places(segments: usize) -> Vec<Range<usize>> {
    let count = segments.div_ceil(SEGMENTS_PER_PLACE);
    (0..count).map(|p| p * segments / count..(p + 1) * segments / count).collect()
}

/// Rows within a stretch, zero elsewhere.
fn within(rows: &[Row], place: Range<usize>) -> Vec<Row> {
    rows.iter().enumerate().map(|(s, row)| if place.contains(&s) { *row } else { [0.0; CHANNELS] }).collect()
}

/// (a - b) · factor; a deviation falls where the prediction rises, hence the negative factors of the callers.
pub fn difference(a: &[Row], b: &[Row], factor: f64) -> Vec<Row> {
    a.iter().zip(b).map(|(a, b)| core::array::from_fn(|c| (a[c] - b[c]) * factor)).collect()
}

/// How strongly a group of drives speaks for each hypothesis, before comparison with null groups.
#[derive(Clone, Debug)]
pub struct Strength {
    /// Evidence of each hypothesis of [`Candidate::ALL`] as the two-sided standard normal deviate of equal probability.
    pub z: Vec<f64>,
    /// Variance of the whitened deviations that the best hypothesis leaves; above 1 where the set is noisier or rougher than the reference.
    pub dispersion: f64,
}

/// Evidence of a group. The gain in misfit of each hypothesis, divided by the dispersion, is compared with χ² of its degrees of freedom.
pub fn strength(group: &Normal) -> Strength {
    let gains: Vec<(f64, usize)> = Candidate::ALL.iter().map(|c| gain(group, *c)).collect();
    let best = gains.iter().map(|(g, _)| *g).fold(0.0, f64::max);
    let dispersion = ((group.misfit - best) / group.numbers as f64).max(1.0);
    let z = gains.iter().map(|(g, k)| equivalent_z(ln_chi_square_tail(g / dispersion, *k))).collect();
    Strength { z, dispersion }
}

/// Reduction of the misfit by a hypothesis, and its degrees of freedom.
fn gain(group: &Normal, candidate: Candidate) -> (f64, usize) {
    let shares = shares(group, candidate);
    let columns = candidate.columns();
    let gain = columns.clone().zip(&shares).map(|(c, s)| group.score[c] * s).sum::<f64>();
    // A wheel can drag but not push.
    let possible = !matches!(candidate, Candidate::WheelDrag(_)) || shares[0] > 0.0;
    (if possible { gain } else { 0.0 }, columns.len())
}

/// Best shares of a hypothesis' linear form.
pub fn shares(group: &Normal, candidate: Candidate) -> Vec<f64> {
    let c = candidate.columns();
    let mut information: DMatrix<f64> = group.information.view((c.start, c.start), (c.len(), c.len())).into_owned();
    for i in 0..c.len() {
        information[(i, i)] += SHARE_SD.powi(-2);
    }
    let score = group.score.rows(c.start, c.len()).into_owned();
    let solved = information.cholesky().map(|l| l.solve(&score));
    solved.map_or_else(|| vec![0.0; c.len()], |s| s.iter().copied().collect())
}
