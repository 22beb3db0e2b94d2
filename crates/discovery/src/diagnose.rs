//! The whole diagnosis of a set: detect, select, refit, prove on drives that were not fitted.

use std::sync::Arc;

use nesam_evaluation::DriveMaps;
use nesam_model::{ModelBundle, Predictor};
use nesam_physics::effects::written::WRITTEN_MAX;
use nesam_physics::effects::{Effect, Layer, Written};
use nesam_physics::{SOIL_DIM, SoilCorrection};
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;

use crate::candidates::bend::{self, Bend};
use crate::candidates::{Candidate, beside_rims, catalogue};
use crate::claims::{Case, Estimate, Finding, Trace};
use crate::drive_line::{self, DriveLine};
use crate::error::DiscoveryError;
use crate::ground::{Ground, Soils};
use crate::judge::{Judge, case_of, own_yardstick};
use crate::judgement::{Judgement, Verdict, judge, too_few};
use crate::observe::condense::Condensed;
use crate::observe::lack::Lack;
use crate::observe::still::refuse_still;
use crate::observe::{Bench, ObservedDrive, available_in_all, observe_all};
use crate::proof::Trial;
use crate::proof::controls::{Kind, NullDrives, Setting};
use crate::proof::held_out::{HeldOut, Learned, Scoring, far_off, score_held_out};
use crate::proof::proven::{HeldDrives, Proven, keep, prove, said_by_others, said_of_ground};
use crate::reference::own_reference;
use crate::select::pursuit::{Pursued, pursue};
use crate::select::{EFFECTS_MAX, EFFECTS_ON_TRIAL_MAX, Selection, Yardstick};
use crate::work::Work;

/// What drives are held against.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Against {
    /// The frozen bundle: what has changed against drives that it knows.
    #[default]
    Bundle,
    /// The symbolic model itself: what it lacks on average over these drives.
    Physics,
}

/// What the command line says.
#[derive(Clone, Debug)]
pub struct Options {
    /// Ids to fit on, in any order; `None` = each drive is left out once.
    pub fit_on: Option<Vec<String>>,
    /// Ids of effects that are not considered.
    pub without: Vec<String>,
    /// Effects that somebody wrote down, considered beside the catalogue. A reference must have been measured for them; those that it was measured for are
    /// considered anyway.
    pub hypotheses: Vec<Written>,
    /// What drives are held against.
    pub against: Against,
    /// Rollouts of the proof.
    pub scoring: Scoring,
    /// Whether the controls are made too: rivals refitted, a black box, a free form of what is left.
    pub controls: bool,
}

impl Options {
    /// Each drive left out once, everything considered against the bundle, no controls.
    pub fn of(scoring: Scoring) -> Self {
        Self { fit_on: None, without: Vec::new(), hypotheses: Vec::new(), against: Against::Bundle, scoring, controls: false }
    }
}

/// Everything that was found.
#[derive(Debug)]
pub struct Diagnosis {
    /// Outcome.
    pub verdict: Verdict,
    /// Why, in one sentence.
    pub reason: String,
    /// All hypotheses, in the order of the selection's evidence.
    pub catalogue: Vec<Candidate>,
    /// Channels that were compared, in the order of the selection's levels.
    pub channels: Vec<usize>,
    /// Channels that the reference compares and a drive does not measure.
    pub left_out: Vec<usize>,
    /// Ids of effects that cannot be seen without those, which are not asked for.
    pub unseen: Vec<&'static str>,
    /// Mean deviation of each compared channel from its usual level, in its unit.
    pub levels: Vec<f64>,
    /// Course of the most unusual channel of each residual layer.
    pub traces: Vec<Trace>,
    /// What each control of the scores is, with the number of its parameters.
    pub controls: Vec<(Kind, usize)>,
    /// The free form of what is left by all fitted drives; `None` where it explains nothing on drives it was not fitted on.
    pub free_form: Option<Effect>,
    /// The claimed effects on drives that do not have them.
    pub null_drives: Option<NullDrives>,
    /// Judgement on all fitted drives together.
    pub selection: Selection,
    /// Chosen effects, refused or not.
    pub findings: Vec<Finding>,
    /// Parameters of all claimed effects.
    pub estimates: Vec<Estimate>,
    /// The claimed effects; empty when nothing is claimed.
    pub claimed: Vec<nesam_physics::effects::ScheduledEffect>,
    /// Soils under the drives, where a model on trial has no map to tell; else `None`.
    pub soils: Option<Soils>,
    /// Ids of fitted drives.
    pub fit_on: Vec<String>,
    /// Ids of scored drives.
    pub held_out: Vec<String>,
    /// What each held-out drive was predicted with.
    pub learned: Vec<Learned>,
    /// Scores; `None` when no drive is held out. Without a claim nothing is added: after is before.
    pub scores: Option<HeldOut>,
}

impl Diagnosis {
    /// The claimed findings.
    pub fn claims(&self) -> impl Iterator<Item = &Finding> {
        let any = self.verdict.claims();
        self.findings.iter().filter(move |f| any && f.refused.is_none())
    }

    /// How unusual the level of each compared channel is, with the channel.
    pub fn levels_seen(&self) -> Vec<(f64, usize)> {
        self.selection.levels.iter().copied().zip(self.channels.iter().copied()).collect()
    }

    /// How unusually actuators and sensors bend; empty where the model is on trial.
    pub fn bends_seen(&self) -> Vec<(f64, Bend)> {
        self.selection.bends.iter().copied().zip(bend::asked_of(&self.channels)).collect()
    }
}

/// Told how far a diagnosis is: the stage, the parts of it that are done, and those known by now, which may become more.
pub type OnProgress<'a> = &'a (dyn Fn(&str, usize, usize) + Sync);

/// Diagnoses a set with the reference that the predictor's bundle carries.
///
/// # Errors
/// `DiscoveryError::Reference` without a usable reference, `Drives` for unknown ids and for drives in which nothing moves, `NoSegments`, and the model's own errors.
pub fn diagnose(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &DriveMaps,
    options: &Options,
    progress: OnProgress<'_>,
) -> Result<Diagnosis, DiscoveryError> {
    let own;
    let predictor = match options.against {
        Against::Bundle => predictor,
        Against::Physics => {
            own = own_reference::symbolic(predictor.bundle())?;
            &own
        }
    };
    let bundle = predictor.bundle();
    let judge_by = match options.against {
        Against::Bundle => Some(Judge::of(bundle)?),
        Against::Physics => None,
    };
    let all = hypotheses(bundle, judge_by.as_ref(), options)?;
    let fit_at = fitted(drives, options)?;
    // The model itself is judged from the best that is known of each state, and so is a change against drives of which the same was done.
    let fit_drives: Vec<Trajectory> = fit_at.iter().map(|&d| drives[d].clone()).collect();
    refuse_still(&bundle.vehicle, &fit_drives)?;
    let in_hindsight: Option<Vec<Trajectory>> =
        judge_by.as_ref().is_none_or(Judge::in_hindsight).then(|| fit_drives.iter().map(Trajectory::in_hindsight).collect());
    let seen = in_hindsight.as_ref().unwrap_or(&fit_drives);
    let fit_maps: Vec<_> = fit_at.iter().map(|&d| maps[d].clone()).collect();
    let asked = Asked {
        plain: predictor,
        judge_by: judge_by.as_ref(),
        drives,
        maps,
        fit_at: &fit_at,
        fit_drives: &fit_drives,
        seen,
        fit_maps: &fit_maps,
        options,
        progress,
    };
    if options.against == Against::Bundle || !drive_line::tells(&bundle.vehicle, seen) {
        return asked.diagnosed(&DriveLine::default(), &all, Vec::new());
    }
    // Wheel speeds tell the drive line whatever the ground does; everything else is asked of a vehicle that has it.
    let (others, of_rims) = beside_rims(&options.hypotheses);
    let work = Work::begin("wheel speeds", progress);
    let told = DriveLine::told_by(&bundle.vehicle, seen, (&of_rims, others.len()), &options.without, work);
    let found = asked.diagnosed(&told, &others, of_rims)?;
    if told.is_empty() || found.verdict.claims() {
        return Ok(found);
    }
    // What is not proven with it may be without it.
    let mut without = asked.diagnosed(&DriveLine::default(), &all, Vec::new())?;
    without.reason += &format!("; {}, which is not proven", told.named());
    Ok(without)
}

/// What a diagnosis is asked of.
#[derive(Clone, Copy)]
struct Asked<'a> {
    /// The model without effects.
    plain: &'a Predictor,
    judge_by: Option<&'a Judge>,
    drives: &'a [Trajectory],
    maps: &'a DriveMaps,
    fit_at: &'a [usize],
    fit_drives: &'a [Trajectory],
    /// The fitted drives as they are looked at.
    seen: &'a [Trajectory],
    fit_maps: &'a DriveMaps,
    options: &'a Options,
    progress: OnProgress<'a>,
}

impl Asked<'_> {
    /// Asks with hypotheses of a vehicle with what wheel speeds told, which is of `of_rims`.
    fn diagnosed(&self, told: &DriveLine, catalogue: &[Candidate], of_rims: Vec<Candidate>) -> Result<Diagnosis, DiscoveryError> {
        let Self { plain, judge_by, fit_drives, seen, fit_maps, options, progress, .. } = *self;
        let total = fit_drives.len();
        let driven = (!told.is_empty()).then(|| plain.with_effects(&told.effects));
        let predictor = driven.as_ref().unwrap_or(plain);
        let observed = observe_all(predictor, seen, fit_maps, &|done| progress("drives as the model sees them", done, total))?;
        let judge_by = judge_by.map(|j| j.over(Lack::of(fit_drives, fit_maps), &available_in_all(&observed))).transpose()?;
        let judge_by = judge_by.as_deref();
        let bench = Bench::new(predictor.bundle(), catalogue);
        let (mut case, Pursued { yardstick, refused }) =
            held_against(judge_by, bench, observed, options, (plain, predictor, !told.is_empty()), self)?;
        case.work = Work::begin("hypotheses", progress);
        let few = judge_by.is_none() && own_reference::too_few(total);
        let judgement = if few { too_few(&case, &yardstick) } else { judge(&mut case, &yardstick).with_refused(refused) };

        let (held_at, held, held_maps) = self.held_out();
        let proof = Work::begin("held-out windows", progress);
        case.work = proof.clone();
        let fitted = options.fit_on.is_none();
        let held_drives = HeldDrives { predictor: plain, told, drives: &held, maps: &held_maps, options, fitted, work: &proof };
        let Proven { mut judgement, learned, taught, mut scores, verdict, mut reason } =
            self.proven(&mut case, judge_by, &yardstick, judgement, &held_drives)?;
        let claims = verdict.claims();
        let assumed = predictor.bundle().default_soil();
        let soils = soils(&case, assumed, if claims { taught.beside } else { case.bench.ground });
        // Where the map is wrong another soil imitates it.
        let of_map = claims && judgement.claimed().into_iter().any(|i| judgement.findings[i].candidate.layer() == Layer::Map);
        if let Some(scores) = scores.as_ref().filter(|_| soils.is_some() || judge_by.is_some() && !of_map) {
            reason += &said_of_ground(scores, judge_by.is_none());
        }
        let named = claims && judgement.verdict.claims();
        let mut of_rims_found = told.findings.clone();
        for (findings, proven) in [(&mut judgement.findings, named), (&mut of_rims_found, claims)] {
            findings.iter_mut().filter(|f| !proven && f.refused.is_none()).for_each(|f| f.refused = Some(reason.clone()));
        }

        let others = if options.controls && scores.is_some() { Work::begin("controls", progress) } else { proof.clone() };
        case.work = others.clone();
        let held_out: Vec<Option<usize>> = held_at.iter().map(|d| fitted.then_some(*d)).collect();
        let setting = Setting { case: &case, yardstick: &yardstick, judgement: &judgement, claimed: named, predictor, held_out: &held_out };
        let (controls, free_form) = match scores.as_mut().filter(|_| options.controls) {
            Some(scores) => score_controls(&setting, scores, &HeldDrives { work: &others, ..held_drives })?,
            None => (Vec::new(), None),
        };
        if let Some(scores) = scores.as_mut().filter(|_| !claims) {
            scores.add_nothing();
        }
        let null_drives = judge_by.and_then(|j| setting.on_null_drives(&j.nulls));
        let beside_rims = if named { judgement.fit.as_ref().map_or_else(Vec::new, |f| keep(&judgement, f.effects())) } else { Vec::new() };
        let traces = case.traces(&judgement.selection, &beside_rims);
        let findings: Vec<Finding> = of_rims_found.into_iter().chain(judgement.findings).collect();
        let estimates = findings.iter().filter(|f| claims && f.refused.is_none()).flat_map(|f| f.estimates.clone()).collect();
        let claimed = if claims { told.effects.iter().copied().chain(beside_rims).collect() } else { Vec::new() };
        let mut selection = judgement.selection;
        selection.z.extend(of_rims.iter().map(|c| told.findings.iter().find(|f| f.candidate == *c).map(|f| f.z)));
        Ok(Diagnosis {
            verdict,
            reason,
            traces,
            controls,
            free_form,
            null_drives,
            levels: levels(&case),
            catalogue: yardstick.catalogue.into_iter().chain(of_rims).collect(),
            channels: yardstick.channels,
            left_out: judge_by.map_or_else(Vec::new, |j| j.left_out.clone()),
            unseen: judge_by.map_or_else(Vec::new, |j| j.unseen.clone()),
            findings,
            selection,
            estimates,
            claimed,
            soils,
            fit_on: fit_drives.iter().map(|d| d.id.clone()).collect(),
            held_out: held.iter().map(|d| d.id.clone()).collect(),
            learned,
            scores,
        })
    }

    /// Places of the drives that are predicted as a proof, with the drives and their maps: those that were not fitted, or each that the others are enough for.
    fn held_out(&self) -> (Vec<usize>, Vec<Trajectory>, Vec<Option<Arc<WorldMap>>>) {
        let at: Vec<usize> = match self.options.fit_on {
            Some(_) => (0..self.drives.len()).filter(|d| !self.fit_at.contains(d)).collect(),
            None if self.fit_at.len() > 1 => self.fit_at.to_vec(),
            None => Vec::new(),
        };
        let drives = at.iter().map(|&d| self.drives[d].clone()).collect();
        let maps = at.iter().map(|&d| self.maps[d].clone()).collect();
        (at, drives, maps)
    }

    /// A judgement with what predictions say of it. What is claimed follows from the fitted drives alone, others only say what comes of it.
    fn proven(
        &self,
        case: &mut Case<'_>,
        judge_by: Option<&Judge>,
        yardstick: &Yardstick,
        judgement: Judgement,
        held: &HeldDrives<'_>,
    ) -> Result<Proven, DiscoveryError> {
        let (options, total) = (self.options, self.fit_drives.len());
        let fewer = match judge_by {
            Some(judge_by) if total > 1 => Some(judge_by.yardstick(&case.metric.channels, total - 1, &options.without)?),
            _ => None,
        };
        let proving = if held.fitted { *held } else { held.among_fitted(self.fit_drives, self.fit_maps) };
        let mut proven = prove(case, yardstick, fewer.as_ref().unwrap_or(yardstick), judgement, &proving)?;
        // A model on trial that errs to no side is not right for that.
        let on_trial = judge_by.is_none();
        let in_vain = proven.scores.as_ref().filter(|_| on_trial && proven.verdict == Verdict::None);
        let far = in_vain.and_then(|scores| far_off(scores, proving.drives, &options.scoring));
        if !held.fitted {
            proven.learned = vec![proven.taught.clone(); held.drives.len()];
            proven.scores = match options.scoring.windows(held.drives) {
                Ok(_) => Some(score_held_out(self.plain, held.drives, held.maps, &proven.learned, &options.scoring, held.work)?),
                Err(_) => None,
            };
            if let Some(scores) = proven.scores.as_ref().filter(|_| proven.verdict.claims()) {
                proven.reason += &said_by_others(&proven.judgement, held.told, on_trial, scores);
            }
        }
        if let Some(far) = far {
            proven.verdict = Verdict::Unexplained;
            proven.reason += &far;
        }
        Ok(proven)
    }
}

/// Soils under the drives of a case that has no map to tell them, `beside` what is claimed.
fn soils(case: &Case<'_>, assumed: [f64; SOIL_DIM], beside: SoilCorrection) -> Option<Soils> {
    let alone = case.ground_alone.as_ref()?.correction().apply(&assumed);
    Some(Soils { assumed, alone, beside: beside.apply(&assumed) })
}

/// All hypotheses of a diagnosis.
fn hypotheses(bundle: &ModelBundle, judge_by: Option<&Judge>, options: &Options) -> Result<Vec<Candidate>, DiscoveryError> {
    let all = judge_by.map_or_else(|| catalogue(&options.hypotheses), |judge| judge.catalogue.clone());
    let written: Vec<Written> = all.iter().filter_map(Candidate::written).collect();
    if let Some(unknown) = options.hypotheses.iter().find(|h| !written.contains(&h.at(1.0))) {
        let reason = format!(
            "was not measured for `{}` as it is written; run `nesam diagnose --make-reference` with the same --hypotheses first",
            unknown.id()
        );
        return Err(DiscoveryError::Reference { reason });
    }
    let in_bundle = bundle.effects.iter().filter(|e| e.effect.written().is_some()).count();
    let at_once = if judge_by.is_some() { EFFECTS_MAX } else { EFFECTS_ON_TRIAL_MAX };
    if in_bundle + written.len().min(at_once) > WRITTEN_MAX {
        let reason = format!(
            "bundle {} has {in_bundle} written effects; with these hypotheses more than {WRITTEN_MAX} could act at once",
            bundle.name
        );
        return Err(DiscoveryError::Hypotheses { reason });
    }
    if let Some(unknown) = options.without.iter().find(|id| !Effect::IDS.contains(&id.as_str()) && !all.iter().any(|c| c.id() == *id)) {
        let mut known: Vec<&str> = all.iter().map(Candidate::id).collect();
        known.dedup();
        return Err(DiscoveryError::Hypotheses {
            reason: format!("--without {unknown}: no such effect; considered are {}", known.join(", ")),
        });
    }
    Ok(all)
}

/// Drives of a case with what they are compared with: a reference, or themselves.
fn held_against<'a>(
    judge_by: Option<&Judge>,
    bench: Bench<'a>,
    observed: Vec<ObservedDrive>,
    options: &Options,
    (plain, predictor, told): (&Predictor, &Predictor, bool),
    asked: &Asked<'a>,
) -> Result<(Case<'a>, Pursued), DiscoveryError> {
    let (total, progress) = (observed.len(), asked.progress);
    let Some(judge_by) = judge_by else {
        let mut ground_alone = None;
        if asked.fit_maps.iter().all(Option::is_none) {
            let plain_predictor = plain;
            let bundle = plain.bundle();
            let plain = Bench { vehicle: &bundle.vehicle, effects: &bundle.effects, ..bench };
            let drives: Vec<&ObservedDrive> = observed.iter().collect();
            let work = Work::begin("drives predicted on another soil", progress);
            let trial = Trial {
                predictor: plain_predictor,
                drives: asked.fit_drives,
                maps: asked.fit_maps,
                scoring: &options.scoring,
                work: &work,
            };
            let found = Ground::found(plain, &own_reference::metric(&plain, &observed)?, &drives, &trial)?;
            ground_alone = Some(found.unwrap_or_else(Ground::assumed));
        }
        let mut case = case_of(own_reference::metric(&bench, &observed)?, bench, observed, progress);
        case.ground_alone = ground_alone;
        let drives: Vec<Condensed> = case.condensed().cloned().collect();
        let first = own_yardstick(&case, &drives, &options.without)?;
        if own_reference::too_few(total) {
            return Ok((case, Pursued { yardstick: first, refused: Vec::new() }));
        }
        let work = Work::begin("drives held against every effect beside those found", progress);
        case.work = work.clone();
        let trial = Trial { predictor, drives: asked.fit_drives, maps: asked.fit_maps, scoring: &options.scoring, work: &work };
        let pursued = pursue(&mut case, first, &options.without, (&trial, told))?;
        return Ok((case, pursued));
    };
    let case = judge_by.case(bench, observed, progress)?;
    let yardstick = judge_by.yardstick(&case.metric.channels, total, &options.without)?;
    Ok((case, Pursued { yardstick, refused: Vec::new() }))
}

/// Kind and number of parameters of each control, and the free form of what all drives leave.
type Tried = (Vec<(Kind, usize)>, Option<Effect>);

/// Makes the controls and adds their scores on the held-out drives to `scores`.
fn score_controls(setting: &Setting<'_>, scores: &mut HeldOut, held: &HeldDrives<'_>) -> Result<Tried, DiscoveryError> {
    let (made, free_form) = setting.controls()?;
    for control in &made {
        let on_ground: Vec<_> = control.predictors.iter().map(|p| (p, setting.case.bench.ground)).collect();
        let score = held.score(&on_ground, control.parameters, &scores.resamples)?;
        scores.controls.push(score);
    }
    Ok((made.iter().map(|c| (c.kind, c.parameters)).collect(), free_form))
}

/// Indices of the drives to fit on, each once, in the order of the set.
fn fitted(drives: &[Trajectory], options: &Options) -> Result<Vec<usize>, DiscoveryError> {
    let Some(ids) = &options.fit_on else { return Ok((0..drives.len()).collect()) };
    let mut at = ids
        .iter()
        .map(|id| {
            let present = || match drives {
                [first, .., last] => format!("{} drives from {} to {}", drives.len(), first.id, last.id),
                _ => drives.iter().map(|d| d.id.as_str()).collect(),
            };
            drives
                .iter()
                .position(|d| d.id == *id)
                .ok_or_else(|| DiscoveryError::Drives { reason: format!("no drive `{id}` to fit on; the set has {}", present()) })
        })
        .collect::<Result<Vec<usize>, _>>()?;
    at.sort_unstable();
    at.dedup();
    Ok(at)
}

/// Mean deviation of each compared channel from its usual level over all segments.
fn levels(case: &Case<'_>) -> Vec<f64> {
    let count = case.rows.iter().map(Vec::len).sum::<usize>().max(1) as f64;
    let mean = |c: usize| case.rows.iter().flatten().map(|r| r[c]).sum::<f64>() / count;
    case.metric.channels.iter().enumerate().map(|(i, c)| mean(*c) - case.metric.centre[i]).collect()
}
