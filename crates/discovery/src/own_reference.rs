//! `--reference physics`: the model itself against measured drives, without drives that are known to lack an effect.
//!
//! The hypothesis is then not "these drives differ from those" but "the model is wrong on average". Deviations are measured against zero, not against what is
//! usual; the scatter is that of the same drives about their mean, the drive being the unit of replication. The null distribution comes from changing the
//! sign of whole drives at random: if the model were right on average, a drive would deviate as often to one side as to the other. What segments say within a
//! drive is believed whole: these drives have the effect that is sought, and its answer would count as disagreement between them.

use nalgebra::DVector;
use nesam_model::{ModelBundle, Predictor};
use nesam_physics::SoilCorrection;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::candidates::Candidate;
use crate::channels::{CHANNELS, Row};
use crate::condense::Condensed;
use crate::error::DiscoveryError;
use crate::evidence::Nulls;
use crate::metric::Metric;
use crate::observe::{Bench, ObservedDrive, available_in_all};
use crate::reference::{DRIVES_MIN, NullGroups, all_evidence};

/// Random choices of signs.
const FLIPS: usize = 1000;

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
/// `DiscoveryError::Drives` with fewer than 8 drives, or drives whose deviations have no scatter.
pub fn metric(bench: &Bench<'_>, drives: &[ObservedDrive]) -> Result<Metric, DiscoveryError> {
    if drives.len() < DRIVES_MIN {
        let reason = format!("--reference physics needs at least {DRIVES_MIN} drives to fit on, there are {}", drives.len());
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

/// Null distribution of the evidence of these drives under random signs.
pub fn sign_flips(drives: &[Condensed], catalogue: &[Candidate], channels: &[usize]) -> Option<NullGroups> {
    let mut rng = ChaCha8Rng::seed_from_u64(drives.len() as u64);
    let signs: Vec<Vec<f64>> = (0..FLIPS).map(|_| drives.iter().map(|_| if rng.random::<bool>() { 1.0 } else { -1.0 }).collect()).collect();
    let groups: Vec<Vec<f64>> = signs
        .par_iter()
        .map(|signs| {
            let flipped: Vec<Condensed> =
                drives.iter().zip(signs).map(|(d, sign)| Condensed { score: &d.score * *sign, ..d.clone() }).collect();
            let group = Nulls::about_zero(&flipped.iter().collect::<Vec<_>>())?.group(flipped.iter());
            Some(all_evidence(&group, catalogue, channels, &[]))
        })
        .collect::<Option<_>>()?;
    Some(NullGroups::of(groups))
}
