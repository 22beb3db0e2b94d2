//! Large effects of a model that is itself on trial, sought one after the other, each from where those before it led.
//!
//! Signatures are tangents at a model without effects. Against a reference the change is small and they do; a model made from a data sheet may lack a limit that
//! shapes every turn, and what it lacks besides shows only once that is there (a lag of the steering is nothing like its tangent while the model turns at
//! four times the speed). So the strongest effect is sized through the physics, all others are differentiated beside it, and so on: matching pursuit with
//! refits (Pati, Rezaiifar and Krishnaprasad 1993). A fitted effect keeps a column, the secant from without to with it, so that what was found first can still
//! be doubted or refused by everything that follows. It was held against its rivals when it was found, each sized through the physics in its place; their tangents beside
//! it say nothing more of that.

use nesam_evaluation::EvaluationError;
use nesam_physics::SoilCorrection;
use nesam_physics::effects::{Layer, ScheduledEffect};
use rayon::prelude::*;

use crate::claims::fit::{Fit, Term};
use crate::claims::{Case, Finding};
use crate::error::DiscoveryError;
use crate::ground::Ground;
use crate::judge::own_yardstick;
use crate::observe::available_in_all;
use crate::observe::channels::Row;
use crate::observe::condense::{Beside, Condensed, condense, signatures_beside};
use crate::proof::Trial;
use crate::reference::own_reference;
use crate::select::evidence::Group;
use crate::select::onset::Onset;
use crate::select::{EFFECTS_ON_TRIAL_MAX, FURTHER, Known, Yardstick};

/// Most looks: some more than effects, for what is refused or taken back (chosen).
const LOOKS: usize = 2 * EFFECTS_ON_TRIAL_MAX;
/// Share below which a fitted effect is not there.
const LEAST_SHARE: f64 = 1e-3;

/// What a pursuit leads to.
#[derive(Debug)]
pub(crate) struct Pursued {
    /// What the last look is judged by; the case holds its signatures and scores.
    pub yardstick: Yardstick,
    /// What stood out in a look and does not help predictions, or ends at its range.
    pub refused: Vec<Finding>,
}

/// Looks again beside the first effect that stands out and helps, then beside the first two, and so on. Where no map tells of the ground one soil is fitted first, and again beside
/// each effect that is found. `told` says that the vehicle has a drive line that wheel speeds told.
///
/// # Errors
/// As [`own_yardstick`] and [`Trial::no_better`].
pub(crate) fn pursue(
    case: &mut Case<'_>,
    mut yardstick: Yardstick,
    without: &[String],
    (trial, told): (&Trial<'_>, bool),
) -> Result<Pursued, DiscoveryError> {
    let (mut known, mut refused): (Vec<Known>, Vec<Finding>) = (Vec::new(), Vec::new());
    let taken = match &case.ground_alone {
        None => false,
        // Tried where it was fitted.
        Some(alone) if !told => {
            case.bench.ground = alone.correction();
            case.bench.ground != SoilCorrection::NONE
        }
        Some(_) => {
            let found = Ground::found(case.bench, &case.metric, &case.drives(), trial)?;
            case.bench.ground = found.as_ref().map_or(SoilCorrection::NONE, Ground::correction);
            found.is_some()
        }
    };
    if taken {
        let left = look_beside(case, &[])?;
        yardstick = own_yardstick(case, &left, without)?;
    }
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
        let Some(fit) = sized(case, &yardstick, &group, &selection.chosen, &onsets) else { break };
        let helpful = match found(&fit) {
            Found::Fitted(fitted) => {
                let why = not_better(case, &yardstick, &group, &selection.chosen, &onsets, &fit, trial)?;
                why.map_or(Ok(fitted), |why| Err(Some(why)))
            }
            // Its finding is refused for its size; without it others may stand out.
            Found::AtItsEnd => Err(None),
            Found::Nothing => break,
        };
        let fitted = match helpful {
            Ok(fitted) => fitted,
            Err(why) => {
                let finding = case.findings(&yardstick, &selection, &onsets, &fit, &[]).into_iter().next();
                refused.extend(finding.map(|own| Finding { refused: why.or_else(|| own.refused.clone()), ..own }));
                yardstick.refused.push(selection.chosen[0]);
                continue;
            }
        };
        known.retain(|k| selection.chosen.contains(&k.hypothesis));
        known.push(Known { hypothesis: selection.chosen[0], rivals: selection.rivals.swap_remove(0) });
        if case.ground_alone.is_some() {
            let soil = Ground::beside(case, &fit.effects()).correction();
            take_ground(case, soil, &fit.effects(), trial)?;
        }
        let left = look_beside(case, &fitted)?;
        yardstick = Yardstick { known: known.clone(), refused: yardstick.refused, ..own_yardstick(case, &left, without)? };
        if known.len() == EFFECTS_ON_TRIAL_MAX {
            break;
        }
    }
    Ok(Pursued { yardstick, refused })
}

/// Takes a soil that was fitted beside effects if predictions of the fitted drives are better on it; tells whether it did.
fn take_ground(case: &mut Case<'_>, soil: SoilCorrection, effects: &[ScheduledEffect], trial: &Trial<'_>) -> Result<bool, EvaluationError> {
    let before = case.bench.ground;
    let taken = trial.ground_is_better((effects, &before), (effects, &soil))?;
    if taken {
        case.bench.ground = soil;
    }
    Ok(taken)
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

/// Hypotheses sized together; `None` where one cannot stand as a single column that is always there.
fn sized(case: &Case<'_>, yardstick: &Yardstick, group: &Group, chosen: &[usize], onsets: &[Option<Onset>]) -> Option<Fit> {
    let plain = |h: &usize| onsets[*h].is_none() && yardstick.catalogue[*h].columns().len() == 1;
    chosen.iter().all(plain).then(|| case.size(yardstick, group, chosen, onsets))
}

/// What a fit makes of hypotheses, the newest first.
#[derive(Debug)]
enum Found {
    /// Effects beside which others can be sought.
    Fitted(Vec<Beside>),
    /// The newest ends at its range.
    AtItsEnd,
    /// An earlier one ends at its range now, or one is not there.
    Nothing,
}

fn found(fit: &Fit) -> Found {
    let mut ends = fit.held.iter().map(|held| held.iter().any(|held| *held));
    if ends.next() == Some(true) {
        return Found::AtItsEnd;
    }
    if ends.any(|held| held) {
        return Found::Nothing;
    }
    let beside = |((term, values), effect): ((&Term, &Vec<f64>), ScheduledEffect)| {
        let share = term.candidate.share(values[0]);
        (share.abs() > LEAST_SHARE).then_some(Beside { candidate: term.candidate, effect, share })
    };
    let fitted: Option<Vec<Beside>> = fit.terms.iter().zip(&fit.values).zip(fit.effects()).map(beside).collect();
    fitted.map_or(Found::Nothing, Found::Fitted)
}

/// Why predictions are not better with the newest of the chosen hypotheses; `None` where they are, or where it is a sensor's that the measurements themselves tell.
fn not_better(
    case: &Case<'_>,
    yardstick: &Yardstick,
    group: &Group,
    chosen: &[usize],
    onsets: &[Option<Onset>],
    fit: &Fit,
    trial: &Trial<'_>,
) -> Result<Option<String>, EvaluationError> {
    let (without, with) = (case.size(yardstick, group, &chosen[1..], onsets).effects(), fit.effects());
    let sensors_tell = yardstick.catalogue[chosen[0]].layer() == Layer::Sensor && {
        let own = trial.agreeing(&without, &with);
        !own.is_empty() && none_stands_out(yardstick, &yardstick.group(case.left(fit).iter()), &own)
    };
    let ground = &case.bench.ground;
    trial.no_better((&without, ground), (&with, ground), sensors_tell)
}

/// Whether the level of none of these channels stands out in what a fit left.
fn none_stands_out(yardstick: &Yardstick, left: &Group, channels: &[usize]) -> bool {
    yardstick.levels_after_fit(left, left, &[]).all(|(channel, z)| !channels.contains(&channel) || z < yardstick.threshold())
}

/// Measures scatter and signatures of every drive beside fitted effects; returns what these leave of each drive.
fn look_beside(case: &mut Case<'_>, fitted: &[Beside]) -> Result<Vec<Condensed>, DiscoveryError> {
    let effects: Vec<ScheduledEffect> = fitted.iter().map(|f| f.effect).collect();
    let bench = case.bench;
    let rows: Vec<Vec<Row>> = case.prepared.par_iter().map(|p| p.drive.deviations(&bench, &effects, &SoilCorrection::NONE)).collect();
    case.metric = own_reference::metric_of(&rows, &available_in_all(case.prepared.iter().map(|p| &p.drive)))?;
    // Signatures that are measured again are whole.
    case.dating = None;
    case.work.add(case.prepared.len());
    let mut left = Vec::with_capacity(case.prepared.len());
    for (prepared, rows) in case.prepared.iter_mut().zip(&rows) {
        prepared.signatures = signatures_beside(&bench, &prepared.drive, fitted);
        let after = condense(&case.metric, rows, &prepared.signatures);
        let before = fitted.iter().fold(after.clone(), |with, f| with.plus(f.candidate.columns()[0], f.share));
        // What soil alone would explain stays that of the first look.
        let Condensed { soil_score, soil_information, .. } = prepared.condensed.clone();
        prepared.condensed = Condensed { soil_score, soil_information, ..before };
        left.push(after);
        case.work.done();
    }
    Ok(left)
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;
    use crate::candidates::{Candidate, catalogue};
    use crate::observe::channels::TURN_AT;
    use crate::observe::condense::level_column;
    use crate::select::evidence::Nulls;

    fn named(id: &str) -> Candidate {
        catalogue(&[]).into_iter().find(|c| c.id() == id).unwrap()
    }

    /// A fit of these sizes, each held by its range or not.
    fn fit(sizes: &[(&str, f64, bool)]) -> Fit {
        Fit {
            terms: sizes.iter().map(|(id, ..)| Term { candidate: named(id), onset_s: 0.0 }).collect(),
            values: sizes.iter().map(|(_, value, _)| vec![*value]).collect(),
            covariance: DMatrix::identity(sizes.len(), sizes.len()),
            held: sizes.iter().map(|(.., held)| vec![*held]).collect(),
            jackknife: Vec::new(),
        }
    }

    /// Goal: only the newest effect is passed over for its range; a pursuit goes on without it. Method: fits by hand, the newest first.
    #[test]
    fn analytic_only_the_newest_effect_is_passed_over_for_its_range() {
        let (offset, gain) = (("steering_offset", 0.1, false), ("speed_gain", 0.2, false));
        assert!(matches!(found(&fit(&[offset, gain])), Found::Fitted(fitted) if fitted.len() == 2));
        assert!(matches!(found(&fit(&[("cg_height", -1.0, true), gain])), Found::AtItsEnd));
        assert!(matches!(found(&fit(&[offset, ("cg_height", -1.0, true)])), Found::Nothing));
        assert!(matches!(found(&fit(&[("steering_offset", 0.0, false)])), Found::Nothing));
    }

    /// Goal: a sensor settles what its own channels show and no other. Method: a level by hand in what is left, of the turn about z, of half and of nine
    /// standard deviations.
    #[test]
    fn analytic_levels_that_stand_out_are_not_settled() {
        let catalogue = catalogue(&[]);
        let [yaw, roll] = [TURN_AT + 2, TURN_AT];
        let (size, at) = (level_column(&catalogue, yaw) + 1, level_column(&catalogue, yaw));
        let drive = |score: f64| {
            let mut scores = DVector::<f64>::zeros(size);
            scores[at] = score;
            let information = DMatrix::<f64>::identity(size, size) * 100.0;
            Condensed { score: scores, information, square: 0.0, soil_score: DVector::zeros(0), soil_information: DMatrix::zeros(0, 0) }
        };
        let nulls = [10.0, -10.0, 10.0, -10.0].map(drive);
        let nulls = Nulls::about_zero(&nulls.each_ref()).unwrap();
        let yardstick = Yardstick::new(nulls, None, &catalogue, &[roll, yaw], &[]);
        let left = |score: f64| yardstick.group([drive(score)].iter());
        assert!(none_stands_out(&yardstick, &left(5.0), &[roll, yaw]));
        assert!(!none_stands_out(&yardstick, &left(100.0), &[roll, yaw]));
        assert!(none_stands_out(&yardstick, &left(100.0), &[roll]), "another's");
    }
}
