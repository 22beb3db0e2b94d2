//! Large effects of a model that is itself on trial, sought one after the other, each from where those before it led.
//!
//! Signatures are tangents at a model without effects. Against a reference the change is small and they do; a model made from a data sheet may lack a limit that
//! shapes every turn, and what it lacks besides shows only once that is there (a lag of the steering is nothing like its tangent while the model turns at
//! four times the speed). So the strongest effect is sized through the physics, all others are differentiated beside it, and so on: matching pursuit with
//! refits (Pati, Rezaiifar and Krishnaprasad 1993). A fitted effect keeps a column, the secant from without to with it, so that what was found first can still
//! be doubted or refused by everything that follows. It was held against its rivals when it was found, each sized through the physics in its place; their tangents beside
//! it say nothing more of that.

use nesam_physics::SoilCorrection;
use nesam_physics::effects::ScheduledEffect;
use rayon::prelude::*;

use crate::channels::Row;
use crate::claims::{Case, Finding};
use crate::condense::{Beside, Condensed, condense, signatures_beside};
use crate::diagnose::OnProgress;
use crate::error::DiscoveryError;
use crate::evidence::Group;
use crate::fit::{Fit, Term};
use crate::judge::own_yardstick;
use crate::observe::available_in_all;
use crate::onset::Onset;
use crate::own_reference;
use crate::proof::Trial;
use crate::select::{EFFECTS_MAX, FURTHER, Known, Yardstick};

/// Most looks: some more than effects, for what is refused or taken back (chosen).
const LOOKS: usize = 2 * EFFECTS_MAX;
/// Share below which a fitted effect is not there.
const LEAST_SHARE: f64 = 1e-3;

/// What a pursuit leads to.
#[derive(Debug)]
pub(crate) struct Pursued {
    /// What the last look is judged by; the case holds its signatures and scores.
    pub yardstick: Yardstick,
    /// What stood out in a look and does not help predictions.
    pub refused: Vec<Finding>,
}

/// Looks again beside the first effect that stands out and helps, then beside the first two, then beside three.
///
/// # Errors
/// As [`own_yardstick`] and [`Trial::no_better`].
pub(crate) fn pursue(
    case: &mut Case<'_>,
    mut yardstick: Yardstick,
    without: &[String],
    trial: &Trial<'_>,
    progress: OnProgress<'_>,
) -> Result<Pursued, DiscoveryError> {
    let (mut known, mut refused): (Vec<Known>, Vec<Finding>) = (Vec::new(), Vec::new());
    for _ in 0..LOOKS {
        let (mut selection, mut onsets) = case.select(&yardstick);
        let Some(first) = selection.chosen.get(..known.len() + 1) else { break };
        let Some(&new) = first.iter().find(|h| yardstick.known(**h).is_none()) else { break };
        // What was found last is held against its rivals through the physics.
        let chosen = std::iter::once(new).chain(first.iter().copied().filter(|h| *h != new)).collect();
        let group = yardstick.group(case.condensed());
        selection.choose(&yardstick, &group, chosen);
        case.settle(&yardstick, &mut selection, &mut onsets, &[]);
        selection.chosen = needed(case, &yardstick, &group, &selection.chosen, &onsets);
        let Some((fit, fitted)) = sized(case, &yardstick, &group, &selection.chosen, &onsets) else { break };
        let others = case.size(&yardstick, &group, &selection.chosen[1..], &onsets);
        if let Some(why) = trial.no_better(&others.effects(), &fit.effects())? {
            let found = case.findings(&yardstick, &selection, &onsets, &fit, &[]).into_iter().next();
            refused.extend(found.map(|finding| Finding { refused: Some(why), ..finding }));
            yardstick.refused.push(selection.chosen[0]);
            continue;
        }
        known.retain(|k| selection.chosen.contains(&k.hypothesis));
        known.push(Known { hypothesis: selection.chosen[0], rivals: selection.rivals.swap_remove(0) });
        let left = look_beside(case, &fitted, progress)?;
        yardstick = Yardstick { known: known.clone(), refused: yardstick.refused, ..own_yardstick(case, &left, without)? };
        if known.len() == EFFECTS_MAX {
            break;
        }
    }
    Ok(Pursued { yardstick, refused })
}

/// Those of the chosen hypotheses that drives ask for when the others are sized again without them: what was found early may have stood for what was found
/// after it. The newest comes first and stays.
fn needed(case: &Case<'_>, yardstick: &Yardstick, group: &Group, chosen: &[usize], onsets: &[Option<Onset>]) -> Vec<usize> {
    let mut kept = chosen.to_vec();
    for hypothesis in chosen.iter().skip(1).rev() {
        let others: Vec<usize> = kept.iter().copied().filter(|h| h != hypothesis).collect();
        let left = case.left(&case.size(yardstick, group, &others, onsets));
        if yardstick.refitted(&yardstick.group(left.iter()), &others, *hypothesis) < FURTHER * yardstick.threshold() {
            kept = others;
        }
    }
    kept
}

/// Hypotheses sized together; `None` where one cannot stand as a single column that is always there, or ends at its range.
fn sized(case: &Case<'_>, yardstick: &Yardstick, group: &Group, chosen: &[usize], onsets: &[Option<Onset>]) -> Option<(Fit, Vec<Beside>)> {
    let plain = |h: &usize| onsets[*h].is_none() && yardstick.catalogue[*h].columns().len() == 1;
    if !chosen.iter().all(plain) {
        return None;
    }
    let fit = case.size(yardstick, group, chosen, onsets);
    if fit.held.iter().flatten().any(|held| *held) {
        return None;
    }
    let beside = |((term, values), effect): ((&Term, &Vec<f64>), ScheduledEffect)| {
        let share = term.candidate.share(values[0]);
        (share.abs() > LEAST_SHARE).then_some(Beside { candidate: term.candidate, effect, share })
    };
    let fitted = fit.terms.iter().zip(&fit.values).zip(fit.effects()).map(beside).collect::<Option<_>>()?;
    Some((fit, fitted))
}

/// Measures scatter and signatures of every drive beside fitted effects; returns what these leave of each drive.
fn look_beside(case: &mut Case<'_>, fitted: &[Beside], progress: OnProgress<'_>) -> Result<Vec<Condensed>, DiscoveryError> {
    let effects: Vec<ScheduledEffect> = fitted.iter().map(|f| f.effect).collect();
    let bench = case.bench;
    let rows: Vec<Vec<Row>> = case.prepared.par_iter().map(|p| p.drive.deviations(&bench, &effects, &SoilCorrection::NONE)).collect();
    case.metric = own_reference::metric_of(&rows, &available_in_all(case.prepared.iter().map(|p| &p.drive)))?;
    // Signatures that are measured again are whole.
    case.dating = None;
    let total = case.prepared.len();
    let mut left = Vec::with_capacity(total);
    for (done, (prepared, rows)) in case.prepared.iter_mut().zip(&rows).enumerate() {
        progress("drives held against every effect beside those found", done, total);
        prepared.signatures = signatures_beside(&bench, &prepared.drive, fitted);
        let after = condense(&case.metric, rows, &prepared.signatures);
        let before = fitted.iter().fold(after.clone(), |with, f| with.plus(f.candidate.columns()[0], f.share));
        // What soil alone would explain stays that of the first look.
        let Condensed { soil_score, soil_information, .. } = prepared.condensed.clone();
        prepared.condensed = Condensed { soil_score, soil_information, ..before };
        left.push(after);
    }
    Ok(left)
}
