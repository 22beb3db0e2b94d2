//! What drives are held against: the reference of a bundle, or themselves.

use nesam_model::ModelBundle;
use nesam_physics::SoilCorrection;

use crate::candidates::Candidate;
use crate::channels::Row;
use crate::claims::Case;
use crate::condense::{Condensed, condense, signatures};
use crate::diagnose::OnProgress;
use crate::error::DiscoveryError;
use crate::evidence::Nulls;
use crate::fit::Prepared;
use crate::metric::Metric;
use crate::observe::{Bench, ObservedDrive, available_in_all};
use crate::own_reference;
use crate::reference::{NullGroups, Reference};
use crate::select::Yardstick;
use crate::work::Work;

/// What a diagnosis is made with: the reference of a bundle, read once.
#[derive(Clone, Debug)]
pub struct Judge {
    reference: Reference,
    /// All hypotheses that it can judge.
    pub catalogue: Vec<Candidate>,
    /// Scores of the drives behind the reference.
    pub(crate) nulls: Vec<Condensed>,
}

impl Judge {
    /// From the reference that a bundle carries.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` without a usable reference.
    pub fn of(bundle: &ModelBundle) -> Result<Self, DiscoveryError> {
        let text = bundle.reference_json.as_deref().ok_or_else(|| DiscoveryError::Reference {
            reason: format!(
                "bundle {} carries none; make it with `nesam diagnose --make-reference --bundle DIR --data ROOT --set NAME --split train`",
                bundle.name
            ),
        })?;
        Self::new(Reference::from_json(text)?)
    }

    /// From a reference.
    ///
    /// # Errors
    /// As [`Reference::catalogue`].
    pub fn new(reference: Reference) -> Result<Self, DiscoveryError> {
        Ok(Self { catalogue: reference.catalogue()?, nulls: reference.condensed(), reference })
    }

    /// The same without some drives of the reference: what a pseudo-vehicle made of them is judged by.
    pub fn without(&self, ids: &[&str]) -> Self {
        let mut reference = self.reference.clone();
        reference.drives.retain(|d| !ids.contains(&d.trajectory.as_str()));
        Self { nulls: reference.condensed(), catalogue: self.catalogue.clone(), reference }
    }

    /// Ids of the drives behind the reference.
    pub fn drives(&self) -> Vec<String> {
        self.reference.drives.iter().map(|d| d.trajectory.clone()).collect()
    }

    /// What `drives` drives are compared with.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` with fewer than four null drives.
    pub fn yardstick(&self, channels: &[usize], drives: usize, without: &[String]) -> Result<Yardstick, DiscoveryError> {
        let nulls = Nulls::new(&self.nulls.iter().collect::<Vec<_>>())
            .ok_or_else(|| DiscoveryError::Reference { reason: "has too few drives".into() })?;
        let groups = NullGroups::draw(&self.nulls, &self.catalogue, channels, drives);
        let yardstick = Yardstick::new(nulls, groups, &self.catalogue, channels, without);
        Ok(Yardstick { whiteness: self.reference.whiteness(), ..yardstick })
    }

    /// Compares observed drives with the reference.
    ///
    /// # Errors
    /// As [`Reference::metric`].
    pub fn case<'a>(&self, bench: Bench<'a>, observed: Vec<ObservedDrive>, progress: OnProgress<'_>) -> Result<Case<'a>, DiscoveryError> {
        let available = available_in_all(&observed);
        let metric = self.reference.metric(&available)?;
        Ok(case_of(metric, bench, observed, progress))
    }
}

/// Condenses observed drives in a metric.
pub(crate) fn case_of<'a>(metric: Metric, bench: Bench<'a>, observed: Vec<ObservedDrive>, progress: OnProgress<'_>) -> Case<'a> {
    let total = observed.len();
    let rows: Vec<Vec<Row>> = observed.iter().map(|d| d.deviations(&bench, &[], &SoilCorrection::NONE)).collect();
    let prepared = observed
        .into_iter()
        .zip(&rows)
        .enumerate()
        .map(|(done, (drive, rows))| {
            progress("drives held against every effect", done, total);
            let signatures = signatures(&bench, &drive);
            let condensed = condense(&metric, rows, &signatures);
            Prepared { drive, signatures, condensed }
        })
        .collect();
    Case { bench, metric_without: metric.clone(), metric, prepared, rows, dating: None, ground_alone: None, work: Work::default() }
}

/// What drives are compared with that stand for themselves (`--reference physics`), whose scatter is that of `drives`.
///
/// # Errors
/// `DiscoveryError::Drives` with fewer than four.
pub(crate) fn own_yardstick(case: &Case<'_>, drives: &[Condensed], without: &[String]) -> Result<Yardstick, DiscoveryError> {
    let nulls = Nulls::about_zero(&drives.iter().collect::<Vec<_>>())
        .ok_or_else(|| DiscoveryError::Drives { reason: "--reference physics needs more drives".into() })?;
    let (channels, catalogue) = (&case.metric.channels, case.bench.catalogue);
    let groups = own_reference::sign_flips(drives, catalogue, channels);
    let yardstick = Yardstick::new(nulls, groups, catalogue, channels, without);
    Ok(Yardstick { model_on_trial: true, ..yardstick })
}
