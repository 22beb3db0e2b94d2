//! `--reference physics`: the model itself against measured drives, without drives that are known to lack an effect.
//!
//! The hypothesis is then not "these drives differ from those" but "the model is wrong on average". Deviations are measured against zero, not against what is
//! usual; the scatter is that of the same drives about their mean, the drive being the unit of replication. The null distribution comes from changing the
//! sign of whole drives at random: if the model were right on average, a drive would deviate as often to one side as to the other. What segments say within a
//! drive is believed whole: these drives have the effect that is sought, and its answer would count as disagreement between them.
//!
//! Signs of n drives show no probability below 2^-(n - 1). Of fewer than eight drives no effect is claimed; what stands out is told.

use nalgebra::DVector;
use nesam_model::{ModelBundle, Predictor};
use nesam_physics::SoilCorrection;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::candidates::Candidate;
use crate::error::DiscoveryError;
use crate::observe::channels::{CHANNELS, Row};
use crate::observe::condense::Condensed;
use crate::observe::metric::Metric;
use crate::observe::{Bench, ObservedDrive, available_in_all};
use crate::reference::{DRIVES_MIN, NullGroups, all_evidence};
use crate::select::evidence::Nulls;

/// Random choices of signs.
const FLIPS: usize = 1000;
/// Fewest drives that can be held against one another.
const OWN_DRIVES_MIN: usize = 2;

/// Whether some drives are too few to claim an effect by the scatter of their own.
pub fn too_few(drives: usize) -> bool {
    drives < DRIVES_MIN
}

/// The symbolic half of a bundle: what the network says of sinkage and of the next state is silenced, its soil prior stays.
///
/// # Errors
/// Those of [`Predictor::new`].
pub fn symbolic(bundle: &ModelBundle) -> Result<Predictor, DiscoveryError> {
    Predictor::new(std::sync::Arc::new(bundle.silenced()))
        .map_err(|source| nesam_evaluation::EvaluationError::Model { trajectory: String::new(), start: 0, source }.into())
}

/// Metric of drives whose deviations are measured against zero.
///
/// # Errors
/// `DiscoveryError::Drives` with fewer than two drives, or drives whose deviations have no scatter.
pub fn metric(bench: &Bench<'_>, drives: &[ObservedDrive]) -> Result<Metric, DiscoveryError> {
    if drives.len() < OWN_DRIVES_MIN {
        let reason = format!(
            "where the model itself is tested (--reference physics) it takes {OWN_DRIVES_MIN} drives to fit on or more, there is {}: what differs from the model is held against what differs between drives",
            drives.len()
        );
        return Err(DiscoveryError::Drives { reason });
    }
    let rows: Vec<Vec<Row>> = drives.iter().map(|d| d.deviations(bench, &[], &SoilCorrection::NONE)).collect();
    let available = available_in_all(drives);
    for (drive, rows) in drives.iter().zip(&rows) {
        if let Some(segment) = rows.iter().position(|row| row.iter().zip(available).any(|(v, has)| has && !v.is_finite())) {
            let reason = format!(
                "drive `{}`: what the model predicts of segment {segment} (0.8 s each) is no number; are the units and signs of its columns right? `nesam check` compares them",
                drive.id
            );
            return Err(DiscoveryError::Drives { reason });
        }
    }
    metric_of(&rows, &available)
}

/// The same from the deviations of each drive, on the channels that all of them have.
///
/// # Errors
/// `DiscoveryError::Drives` where the deviations have no scatter.
pub fn metric_of(rows: &[Vec<Row>], available: &[bool; CHANNELS]) -> Result<Metric, DiscoveryError> {
    Metric::measure(rows, available)
        .and_then(|m| Metric::new(m.channels, DVector::zeros(m.centre.len()), m.within, m.between))
        .ok_or_else(|| DiscoveryError::Drives { reason: "the deviations of these drives have no scatter".into() })
}

/// Null distribution of the evidence of these drives under random signs; of a few drives under all of them.
pub fn sign_flips(drives: &[Condensed], catalogue: &[Candidate], channels: &[usize]) -> Option<NullGroups> {
    let mut rng = ChaCha8Rng::seed_from_u64(drives.len() as u64);
    let (count, all) = (drives.len(), too_few(drives.len()));
    let sign = |positive: bool| if positive { 1.0 } else { -1.0 };
    let signs: Vec<Vec<f64>> = if all {
        (0..1usize << count).map(|flips| (0..count).map(|d| sign(flips & (1 << d) == 0)).collect()).collect()
    } else {
        (0..FLIPS).map(|_| drives.iter().map(|_| sign(rng.random::<bool>())).collect()).collect()
    };
    let groups: Vec<Vec<f64>> = signs
        .par_iter()
        .map(|signs| {
            let flipped: Vec<Condensed> =
                drives.iter().zip(signs).map(|(d, sign)| Condensed { score: &d.score * *sign, ..d.clone() }).collect();
            let group = Nulls::about_zero(&flipped.iter().collect::<Vec<_>>())?.group(flipped.iter());
            Some(all_evidence(&group, catalogue, channels, &[]))
        })
        .collect::<Option<_>>()?;
    Some(NullGroups::of(groups).of_signs(count, all))
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::*;

    /// Goal: few drives are held against all their signs, and show no more than those can. Method: drives of one score each; of four that agree no signs but theirs and the
    /// reverse show as much, of two of opposite signs all do.
    #[test]
    fn analytic_signs_of_a_few_drives_are_all_looked_at() {
        let drive = |score: f64| Condensed {
            score: DVector::from_element(1, score),
            information: DMatrix::identity(1, 1),
            square: 0.0,
            soil_score: DVector::zeros(0),
            soil_information: DMatrix::zeros(0, 0),
        };
        let shown = |scores: &[f64]| {
            let drives: Vec<Condensed> = scores.iter().copied().map(drive).collect();
            let groups = sign_flips(&drives, &[], &[0]).unwrap();
            let nulls = Nulls::about_zero(&drives.iter().collect::<Vec<_>>()).unwrap();
            let own = all_evidence(&nulls.group(drives.iter()), &[], &[0], &[])[0] / groups.spread[0];
            (groups.largest.len(), groups.probability(own), groups.attainable())
        };
        assert_eq!(shown(&[1.0, 1.1, 0.9, 1.05]), (16, 0.125, 0.125));
        assert_eq!(shown(&[1.0, -1.0]), (4, 1.0, 0.5));
        let (groups, p, least) = shown(&[1.0, 1.1, 0.9, 1.05, 1.0, 0.95, 1.0, 1.1]);
        assert!(groups == FLIPS && least == 1.0 / 128.0 && p < 0.02, "{groups} {p} {least}");
        assert!(Nulls::about_zero(&[&drive(1.0)]).is_none());
    }
}
