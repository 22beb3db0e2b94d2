//! What drives are held against: the reference of a bundle, or themselves.

use std::borrow::Cow;
use std::sync::Arc;

use nesam_model::ModelBundle;
use nesam_physics::SoilCorrection;

use crate::candidates::Candidate;
use crate::claims::Case;
use crate::claims::fit::Prepared;
use crate::diagnose::OnProgress;
use crate::error::DiscoveryError;
use crate::observe::channels::{self, CHANNELS, Row};
use crate::observe::condense::{Condensed, condense, signatures};
use crate::observe::lack::Lack;
use crate::observe::metric::Metric;
use crate::observe::{Bench, ObservedDrive, available_in_all};
use crate::reference::drives::ReferenceDrives;
use crate::reference::own_reference;
use crate::reference::{NullGroups, Reference};
use crate::select::Yardstick;
use crate::select::evidence::Nulls;
use crate::work::Work;

/// Share of what the drives of a reference tell of an effect in all channels below which it cannot be seen in some of them (chosen): its evidence is a
/// hundredth then. A steering offset of hundreds by steering angles is one of tens by the motion.
const UNSEEN: f64 = 1e-4;

/// What a diagnosis is made with: the reference of a bundle, read once.
#[derive(Clone, Debug)]
pub struct Judge {
    reference: Reference,
    /// All hypotheses that it can judge.
    pub catalogue: Vec<Candidate>,
    /// Scores of the drives behind the reference.
    pub(crate) nulls: Vec<Condensed>,
    /// The drives behind the reference, where the bundle carries them.
    drives: Option<Arc<[u8]>>,
    /// Channels that the reference of the bundle compares and this one does not.
    pub left_out: Vec<usize>,
    /// Ids of effects that cannot be seen without those, which are not asked for.
    pub unseen: Vec<&'static str>,
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
        Ok(Self { drives: bundle.reference_drives.clone(), ..Self::new(Reference::from_json(text)?)? })
    }

    /// From a reference.
    ///
    /// # Errors
    /// As [`Reference::catalogue`].
    pub fn new(reference: Reference) -> Result<Self, DiscoveryError> {
        let (catalogue, nulls) = (reference.catalogue()?, reference.condensed());
        Ok(Self { reference, catalogue, nulls, drives: None, left_out: Vec::new(), unseen: Vec::new() })
    }

    /// Whether what drives do not measure of their velocities is estimated in hindsight before they are held against it, as it was for its own drives.
    pub(crate) fn in_hindsight(&self) -> bool {
        self.drives.is_some()
    }

    /// The same for drives that lack something: measured again on its own drives as if they lacked it, in the channels that are available.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` and `ReferenceDrives` where the bundle does not carry these drives as it should, `Drives` where nothing is left to compare.
    pub(crate) fn over(&self, lack: Lack, available: &[bool; CHANNELS]) -> Result<Cow<'_, Self>, DiscoveryError> {
        let left_out: Vec<usize> = self.reference.compared()?.into_iter().filter(|c| !available[*c]).collect();
        let Some(first) = left_out.first() else { return Ok(Cow::Borrowed(self)) };
        let drives = self.drives.as_ref().ok_or_else(|| DiscoveryError::Reference {
            reason: format!(
                "compares {}, which a drive of this set does not measure, and was made without what it takes to do without it; run `nesam diagnose --make-reference`",
                channels::name(*first)
            ),
        })?;
        let reference = self.reference.over(&ReferenceDrives::read(drives, &self.reference, lack)?, available)?;
        let nulls = reference.condensed();
        let unseen = unseen(&self.catalogue, lack, &self.nulls, &nulls);
        Ok(Cow::Owned(Self { reference, nulls, catalogue: self.catalogue.clone(), drives: self.drives.clone(), left_out, unseen }))
    }

    /// The same without some drives of the reference: what a pseudo-vehicle made of them is judged by.
    pub fn without(&self, ids: &[&str]) -> Self {
        let mut reference = self.reference.clone();
        reference.drives.retain(|d| !ids.contains(&d.trajectory.as_str()));
        Self { nulls: reference.condensed(), reference, ..self.clone() }
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
        let without: Vec<String> = without.iter().cloned().chain(self.unseen.iter().map(|id| (*id).into())).collect();
        let yardstick = Yardstick::new(nulls, groups, &self.catalogue, channels, &without);
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

/// Ids of effects that drives which lack something cannot show, and those of which they tell next to nothing in some channels, of which they tell something in all.
fn unseen(catalogue: &[Candidate], lack: Lack, all: &[Condensed], some: &[Condensed]) -> Vec<&'static str> {
    let told = |drives: &[Condensed], candidate: &Candidate| -> f64 {
        let columns = candidate.columns();
        drives.iter().flat_map(|d| columns.iter().map(|c| d.information[(*c, *c)])).sum()
    };
    let lost = catalogue.iter().filter(|c| lack.hides(c) || told(some, c) < UNSEEN * told(all, c));
    let mut ids: Vec<&'static str> = lost.map(Candidate::id).collect();
    ids.dedup();
    ids
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
/// `DiscoveryError::Drives` with fewer than two.
pub(crate) fn own_yardstick(case: &Case<'_>, drives: &[Condensed], without: &[String]) -> Result<Yardstick, DiscoveryError> {
    let nulls = Nulls::about_zero(&drives.iter().collect::<Vec<_>>())
        .ok_or_else(|| DiscoveryError::Drives { reason: "--reference physics needs more drives".into() })?;
    let (channels, catalogue) = (&case.metric.channels, case.bench.catalogue);
    let groups = own_reference::sign_flips(drives, catalogue, channels);
    let yardstick = Yardstick::new(nulls, groups, catalogue, channels, without);
    Ok(Yardstick { model_on_trial: true, ..yardstick })
}
