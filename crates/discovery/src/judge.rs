//! What drives are held against: the reference of a bundle, or themselves.

use nesam_model::ModelBundle;
use nesam_physics::SoilCorrection;

use crate::candidates::catalogue;
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

/// What a diagnosis is made with: the reference of a bundle, read once.
#[derive(Clone, Debug)]
pub struct Judge {
    reference: Reference,
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
        Ok(Self::new(Reference::from_json(text)?))
    }

    /// From a reference.
    pub fn new(reference: Reference) -> Self {
        let nulls = reference.condensed();
        Self { reference, nulls }
    }

    /// The same without some drives of the reference: what a pseudo-vehicle made of them is judged by.
    pub fn without(&self, ids: &[&str]) -> Self {
        let mut reference = self.reference.clone();
        reference.drives.retain(|d| !ids.contains(&d.trajectory.as_str()));
        Self::new(reference)
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
        Ok(Yardstick::new(nulls, channels, without, |catalogue| NullGroups::draw(&self.nulls, catalogue, channels, drives)))
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
    let catalogue = catalogue();
    let total = observed.len();
    let rows: Vec<Vec<Row>> = observed.iter().map(|d| d.deviations(&bench, &[], &SoilCorrection::NONE)).collect();
    let prepared = observed
        .into_iter()
        .zip(&rows)
        .enumerate()
        .map(|(done, (drive, rows))| {
            progress("drives held against every effect", done, total);
            let signatures = signatures(&bench, &drive, &catalogue);
            let condensed = condense(&metric, rows, &signatures);
            Prepared { drive, signatures, condensed }
        })
        .collect();
    Case { bench, metric_without: metric.clone(), metric, prepared, rows }
}

/// What drives are compared with that stand for themselves (`--reference physics`), whose scatter is that of `drives`.
///
/// # Errors
/// `DiscoveryError::Drives` with fewer than four.
pub(crate) fn own_yardstick(case: &Case<'_>, drives: &[Condensed], without: &[String]) -> Result<Yardstick, DiscoveryError> {
    let nulls = Nulls::about_zero(&drives.iter().collect::<Vec<_>>())
        .ok_or_else(|| DiscoveryError::Drives { reason: "--reference physics needs more drives".into() })?;
    let channels = &case.metric.channels;
    let yardstick = Yardstick::new(nulls, channels, without, |catalogue| own_reference::sign_flips(drives, catalogue, channels));
    Ok(Yardstick { model_on_trial: true, ..yardstick })
}
