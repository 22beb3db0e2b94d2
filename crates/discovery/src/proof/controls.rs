//! The controls that would expose a fake: what else explains the held-out drives, and whether the named effect helps where it is not.

use nalgebra::DVector;
use nesam_evaluation::EvaluationError;
use nesam_model::Predictor;
use nesam_physics::effects::{Effect, ScheduledEffect};

use crate::candidates::Candidate;
use crate::claims::Case;
use crate::claims::fit::Fit;
use crate::judgement::Judgement;
use crate::observe::condense::Condensed;
use crate::proof::black_box::{self, BlackBox};
use crate::proof::free_form::{self, Leftover};
use crate::proof::ridge::explained;
use crate::select::Yardstick;
use crate::select::onset::Onset;

/// Closest rivals of each named effect that are refitted in its place.
const RIVALS: usize = 3;

/// What a control puts in the place of the named effects, or beside them.
#[derive(Clone, Copy, Debug)]
pub enum Kind {
    /// The strongest hypothesis that is neither named nor a rival, alone.
    Placebo(Candidate),
    /// A rival in the place of the effect that it competes with, refitted.
    Rival(Candidate),
    /// The refitted head of the learned residual, without any effect.
    BlackBox,
    /// The named effects with the free form of what they leave.
    FreeForm,
}

/// One control, ready to predict.
#[derive(Debug)]
pub struct Control {
    /// What it is.
    pub kind: Kind,
    /// Parameters that were fitted.
    pub parameters: usize,
    /// Model for each held-out drive.
    pub predictors: Vec<Predictor>,
}

/// The named effects on drives that do not have them: fall of the squared distance of each drive, in the metric and without its soil.
#[derive(Clone, Debug)]
pub struct NullDrives {
    /// Of the reference's drives without an effect.
    pub null: Vec<f64>,
    /// Of the drives that were fitted.
    pub fitted: Vec<f64>,
}

/// What the controls are made from.
#[derive(Debug)]
pub struct Setting<'a> {
    /// Fitted drives.
    pub case: &'a Case<'a>,
    /// What they were compared with.
    pub yardstick: &'a Yardstick,
    /// What was found.
    pub judgement: &'a Judgement,
    /// Whether the effects of the judgement are claimed after the proof.
    pub claimed: bool,
    /// The frozen model.
    pub predictor: &'a Predictor,
    /// For each held-out drive, its place among the fitted ones, which it was left out of; `None` = it was never among them.
    pub held_out: &'a [Option<usize>],
}

impl Setting<'_> {
    /// All controls, and the free form of what is left by all drives.
    ///
    /// # Errors
    /// Those of the model.
    pub fn controls(&self) -> Result<(Vec<Control>, Option<Effect>), EvaluationError> {
        let mut controls = Vec::new();
        if self.claimed {
            if let Some((candidate, fit)) = self.placebo() {
                controls.push(self.of_fit(Kind::Placebo(candidate), candidate.free().len(), &fit));
            }
            for (candidate, parameters, fit) in self.rivals() {
                controls.push(self.of_fit(Kind::Rival(candidate), parameters, &fit));
            }
        }
        if let Some(head) = BlackBox::of(self.case, self.predictor) {
            let of = |d: &Option<usize>| head.predictor(self.predictor, *d).map_err(|source| self.refused(source));
            let predictors = self.held_out.iter().map(of).collect::<Result<_, _>>()?;
            controls.push(Control { kind: Kind::BlackBox, parameters: black_box::PARAMETERS, predictors });
        }
        let named = self.judgement.fit.as_ref().filter(|_| self.claimed);
        let left = Leftover::of(self.case, named);
        let all = left.effect(None).map(|(effect, _)| effect);
        if all.is_some() {
            let of = |d: &Option<usize>| {
                let mut effects: Vec<ScheduledEffect> = named.map_or_else(Vec::new, |fit| learned(fit, *d));
                effects.extend(left.effect(*d).map(|(effect, _)| ScheduledEffect::from(effect)));
                self.predictor.with_effects(&effects)
            };
            let predictors = self.held_out.iter().map(of).collect();
            controls.push(Control { kind: Kind::FreeForm, parameters: free_form::PARAMETERS, predictors });
        }
        Ok((controls, all))
    }

    fn refused(&self, source: nesam_model::ModelError) -> EvaluationError {
        EvaluationError::Model { trajectory: self.case.prepared[0].drive.id.clone(), start: 0, source }
    }

    fn of_fit(&self, kind: Kind, parameters: usize, fit: &Fit) -> Control {
        let predictors = self.held_out.iter().map(|d| self.predictor.with_effects(&learned(fit, *d))).collect();
        Control { kind, parameters, predictors }
    }

    /// What the named effects would explain of drives that do not have them.
    pub fn on_null_drives(&self, nulls: &[Condensed]) -> Option<NullDrives> {
        let chosen = &self.judgement.selection.chosen;
        if !self.claimed || chosen.is_empty() {
            return None;
        }
        let columns = self.yardstick.columns(chosen);
        let shares = DVector::from_vec(self.yardstick.group(self.case.condensed()).joint_shares(&columns));
        let gain = |d: &Condensed| {
            let information = d.information.select_rows(&columns).select_columns(&columns);
            explained(&d.score.select_rows(&columns), &information, &shares)
        };
        Some(NullDrives { null: nulls.iter().map(gain).collect(), fitted: self.case.condensed().map(gain).collect() })
    }

    /// The strongest hypothesis that is neither chosen nor a rival nor of a chosen id, sized alone.
    fn placebo(&self) -> Option<(Candidate, Fit)> {
        let (judgement, yardstick) = (self.judgement, self.yardstick);
        let named: Vec<&str> = judgement
            .claimed()
            .iter()
            .flat_map(|i| {
                let f = &judgement.findings[*i];
                f.rivals.iter().map(|r| r.candidate.id()).chain([f.candidate.id()])
            })
            .collect();
        let z = &judgement.selection.z;
        let open = (0..z.len()).filter(|h| z[*h].is_some() && !named.contains(&yardstick.catalogue[*h].id()));
        let strongest = open.max_by(|a, b| z[*a].unwrap_or(0.0).total_cmp(&z[*b].unwrap_or(0.0)))?;
        let onsets = vec![None; yardstick.catalogue.len()];
        Some((yardstick.catalogue[strongest], self.size(&[strongest], &onsets)))
    }

    /// The closest hypotheses of other ids, each in the place of the effect it competes with and sized together with the other named ones; with the number
    /// of their parameters.
    fn rivals(&self) -> Vec<(Candidate, usize, Fit)> {
        let (judgement, yardstick) = (self.judgement, self.yardstick);
        let chosen = &judgement.selection.chosen;
        let mut refitted = Vec::new();
        for i in 0..chosen.len() {
            let mut ids: Vec<&str> = chosen.iter().map(|h| yardstick.catalogue[*h].id()).collect();
            let close = judgement.selection.rivals.get(i).map_or(&[][..], Vec::as_slice);
            for rival in close {
                let candidate = yardstick.catalogue[rival.hypothesis];
                if ids.contains(&candidate.id()) || ids.len() >= chosen.len() + RIVALS {
                    continue;
                }
                ids.push(candidate.id());
                let mut instead = chosen.clone();
                instead[i] = rival.hypothesis;
                let onsets = self.onsets(i, rival.hypothesis);
                refitted.push((candidate, candidate.free().len(), self.size(&instead, &onsets)));
            }
        }
        refitted
    }

    /// Onsets of the findings; a rival takes that of the effect in whose place it stands.
    fn onsets(&self, i: usize, rival: usize) -> Vec<Option<Onset>> {
        let mut onsets = vec![None; self.yardstick.catalogue.len()];
        for finding in &self.judgement.findings {
            onsets[finding.hypothesis] = finding.onset;
        }
        onsets[rival] = self.judgement.findings.get(i).and_then(|f| f.onset);
        onsets
    }

    fn size(&self, chosen: &[usize], onsets: &[Option<Onset>]) -> Fit {
        self.case.size(self.yardstick, &self.yardstick.group(self.case.condensed()), chosen, onsets)
    }
}

/// Effects as a held-out drive is predicted with them.
fn learned(fit: &Fit, left_out: Option<usize>) -> Vec<ScheduledEffect> {
    left_out.map_or_else(|| fit.effects(), |d| fit.effects_without(d))
}
