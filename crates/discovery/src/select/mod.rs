//! Which effects a group of drives supports, if any: at most three, each with the rivals that the drives cannot tell from it.
//!
//! Hypotheses are compared in pairs, by what each leaves to the other. If j is fitted and k still has evidence, but not the reverse, k is preferred:
//! Δ(j, k) = z²(j after k) - z²(k after j), which for hypotheses of as many parameters is the difference of a cluster-robust information criterion.

pub(crate) mod dating;
pub mod evidence;
pub(crate) mod manoeuvre;
pub mod onset;
pub mod pursuit;
pub mod settled;

use nesam_physics::effects::Layer;

use crate::candidates::Candidate;
use crate::candidates::bend::{self, Bend};
use crate::observe::channels::{PATH_AT, RIM_AT};
use crate::observe::condense::{Condensed, bend_column, level_column};
use crate::reference::whiteness::Whiteness;
use crate::reference::{NullGroups, all_evidence};
use crate::select::evidence::{Fitted, Group, Nulls};

/// Difference of the criterion that decides between two hypotheses.
pub const DECISIVE: f64 = 6.0;
/// Most effects that one diagnosis names.
pub const EFFECTS_MAX: usize = 3;
/// The same of a model on trial (chosen): a data sheet may leave out gain, limit and lag of speed and of turning.
pub const EFFECTS_ON_TRIAL_MAX: usize = 4;
/// Most rivals of an effect, so that a class has at most three members.
pub const RIVALS_MAX: usize = 2;
/// Threshold without null groups: twice that of 28 candidates at 5 % family-wise.
const THRESHOLD_ALONE: f64 = 6.2;
/// How far beyond the family-wise threshold the largest evidence must be before drives count as different without a known cause (chosen, as in ADR 0008):
/// one set in twenty without an effect is beyond the threshold itself.
const UNEXPLAINED_MARGIN: f64 = 1.5;
/// Share of the strongest gain below which a hypothesis does not compete.
const COMPETING: f64 = 0.3;
/// Evidence that a second or third effect needs, as a multiple of the threshold (chosen): the model's answer to the first is not exact.
pub(crate) const FURTHER: f64 = 1.25;

/// What a group of drives is compared with.
#[derive(Clone, Debug)]
pub struct Yardstick {
    /// Scores of drives without an effect.
    pub nulls: Nulls,
    /// Null groups of as many drives.
    pub groups: Option<NullGroups>,
    /// Channels that are compared.
    pub channels: Vec<usize>,
    /// All hypotheses.
    pub catalogue: Vec<Candidate>,
    /// Which of them are considered.
    pub considered: Vec<bool>,
    /// Whether the model itself is on trial, by the scatter of the judged drives.
    pub model_on_trial: bool,
    /// What earlier looks found, first found first; chosen before anything else.
    pub known: Vec<Known>,
    /// What stood out and was refused by an earlier look; not chosen.
    pub refused: Vec<usize>,
    /// What the proof of an earlier judgement refuted; not chosen and no rival, but it counts in what is left.
    pub withheld: Vec<usize>,
    /// How channels go on from segment to segment in drives without an effect; empty where the model is on trial.
    pub whiteness: Whiteness,
}

/// A hypothesis that an earlier look found, with the rivals that it had then.
#[derive(Clone, Debug)]
pub struct Known {
    /// Index in the catalogue.
    pub hypothesis: usize,
    /// Its rivals, each sized in its place where they were close.
    pub rivals: Vec<Rival>,
}

impl Yardstick {
    /// All hypotheses but for the ids `without`, on these channels.
    pub fn new(nulls: Nulls, groups: Option<NullGroups>, catalogue: &[Candidate], channels: &[usize], without: &[String]) -> Self {
        let considered = catalogue.iter().map(|c| !without.iter().any(|id| id == c.id())).collect();
        Self {
            nulls,
            groups,
            channels: channels.to_vec(),
            catalogue: catalogue.to_vec(),
            considered,
            model_on_trial: false,
            known: Vec::new(),
            refused: Vec::new(),
            withheld: Vec::new(),
            whiteness: Whiteness::default(),
        }
    }
}

/// A hypothesis that the drives cannot tell from a chosen one.
#[derive(Clone, Debug)]
pub struct Rival {
    /// Index in the catalogue.
    pub hypothesis: usize,
    /// Criterion of the chosen one against it, positive = the chosen one is better.
    pub difference: f64,
}

/// What a group of drives says.
#[derive(Clone, Debug)]
pub struct Selection {
    /// Evidence of every hypothesis alone in units of its null spread; `None` for those left out.
    pub z: Vec<Option<f64>>,
    /// Evidence that the level of each compared channel is unusual.
    pub levels: Vec<f64>,
    /// Evidence of each bend; empty where the model is on trial.
    pub bends: Vec<f64>,
    /// Family-wise threshold.
    pub threshold: f64,
    /// Family-wise probability of the largest evidence, and the smallest that could be shown.
    pub probability: Option<[f64; 2]>,
    /// Chosen hypotheses, first found first.
    pub chosen: Vec<usize>,
    /// Evidence of each chosen one after the others.
    pub alone: Vec<f64>,
    /// Rivals of each chosen one, closest first.
    pub rivals: Vec<Vec<Rival>>,
    /// Largest evidence that is left after the chosen ones, and what it is for.
    pub remaining: (f64, String),
    /// The same of the levels of channels alone.
    pub remaining_level: (f64, String),
    /// The same of bends alone.
    pub remaining_bend: (f64, String),
    /// The same of the bends of sensors alone, where an effect of a sensor is chosen: what it was taken for may be one of them.
    pub remaining_bend_of_sensor: (f64, String),
}

impl Selection {
    /// A selection in which nothing was looked at and nothing is chosen, with this threshold.
    #[cfg(test)]
    pub(crate) fn empty(threshold: f64) -> Self {
        Self {
            z: Vec::new(),
            levels: Vec::new(),
            bends: Vec::new(),
            threshold,
            probability: None,
            chosen: Vec::new(),
            alone: Vec::new(),
            rivals: Vec::new(),
            remaining: (0.0, String::new()),
            remaining_level: (0.0, String::new()),
            remaining_bend: (0.0, String::new()),
            remaining_bend_of_sensor: (0.0, String::new()),
        }
    }

    /// Largest evidence of anything before fits.
    pub fn largest(&self) -> f64 {
        self.z.iter().flatten().chain(&self.levels).chain(&self.bends).copied().fold(0.0, f64::max)
    }

    /// Chooses these hypotheses, in this order.
    pub fn choose(&mut self, yardstick: &Yardstick, group: &Group, chosen: Vec<usize>) {
        self.chosen = chosen;
        yardstick.describe(group, self);
    }

    /// Evidence from which drives differ beyond doubt, so that it must be said even when no cause can be named.
    pub(crate) fn beyond_doubt(&self) -> f64 {
        UNEXPLAINED_MARGIN * self.threshold
    }

    /// Whether the drives differ from the reference, known cause or not.
    pub fn differs(&self) -> bool {
        self.largest() >= self.threshold
    }
}

/// How wrong the predicted response to an effect may be, as a share of it (chosen): the angle of a road wheel is geometry, two accepted pressure laws
/// give forces that differ by a quarter, mostly by a common factor that a fit takes up.
pub fn mismatch(layer: Layer) -> f64 {
    if layer.is_force() { 0.12 } else { 0.02 }
}

/// The same of a size over all drives (of a map: chosen): what a network says over ground of another height is known by its slope.
pub(crate) fn mismatch_of_size(layer: Layer) -> f64 {
    if layer == Layer::Map { 0.05 } else { mismatch(layer) }
}

/// The same of what it leaves: a map has a height that geometry tells, and lets wheels sink by forces.
fn mismatch_left(layer: Layer) -> f64 {
    if layer == Layer::Map { mismatch(Layer::Force) } else { mismatch(layer) }
}

impl Yardstick {
    /// What an earlier look said of a hypothesis that it found.
    pub fn known(&self, hypothesis: usize) -> Option<&Known> {
        self.known.iter().find(|k| k.hypothesis == hypothesis)
    }

    /// Family-wise threshold.
    pub fn threshold(&self) -> f64 {
        self.groups.as_ref().map_or(THRESHOLD_ALONE, |n| n.threshold)
    }

    /// As [`Selection::beyond_doubt`].
    pub(crate) fn beyond_doubt(&self) -> f64 {
        UNEXPLAINED_MARGIN * self.threshold()
    }

    fn spread(&self, e: usize) -> f64 {
        self.groups.as_ref().map_or(1.0, |n| n.spread[e])
    }

    /// Scores of drives against the nulls.
    pub fn group<'a>(&self, drives: impl Iterator<Item = &'a Condensed>) -> Group {
        self.nulls.group(drives)
    }

    /// Columns of hypotheses, one after the other.
    pub(crate) fn columns(&self, hypotheses: &[usize]) -> Vec<usize> {
        hypotheses.iter().flat_map(|h| self.catalogue[*h].columns()).collect()
    }

    /// Fitted hypotheses, each with how far what it leaves is believed.
    fn believed(&self, fitted: &[usize]) -> Vec<Fitted> {
        let of = |h: &usize| {
            let candidate = &self.catalogue[*h];
            Fitted { columns: candidate.columns(), mismatch: mismatch_left(candidate.layer()) }
        };
        fitted.iter().map(of).collect()
    }

    /// Evidence of a hypothesis after others, in units of its null spread; zero for one that has the wrong sign.
    pub fn after(&self, group: &Group, fitted: &[usize], hypothesis: usize) -> (f64, f64) {
        self.after_fit(group, group, fitted, hypothesis)
    }

    /// The same where `left` are the scores after the fit of `fitted` went through the physics.
    pub fn after_fit(&self, left: &Group, before: &Group, fitted: &[usize], hypothesis: usize) -> (f64, f64) {
        let candidate = &self.catalogue[hypothesis];
        let found = left.remainder_since(before, &self.believed(fitted), &candidate.columns());
        if candidate.positive() && found.shares[0] <= 0.0 {
            return (0.0, 0.0);
        }
        (found.z / self.spread(hypothesis), found.gain)
    }

    /// Evidence of a hypothesis in what `fitted` left when they were sized through the physics without it, in units of its null spread.
    pub fn refitted(&self, left: &Group, fitted: &[usize], hypothesis: usize) -> f64 {
        left.remainder(&self.columns(fitted), &self.catalogue[hypothesis].columns()).z / self.spread(hypothesis)
    }

    /// Criterion of hypothesis j against k when `others` are fitted too; positive = j is better.
    pub fn difference(&self, group: &Group, others: &[usize], j: usize, k: usize) -> f64 {
        let with = |h: usize| others.iter().copied().chain([h]).collect::<Vec<_>>();
        self.after(group, &with(k), j).0.powi(2) - self.after(group, &with(j), k).0.powi(2)
    }

    /// Judges a group of drives.
    pub fn select(&self, group: &Group) -> Selection {
        let count = self.catalogue.len();
        let evidence = all_evidence(group, &self.catalogue, &self.channels, &self.bending());
        let evidence: Vec<f64> = evidence.into_iter().enumerate().map(|(e, z)| z / self.spread(e)).collect();
        let z: Vec<Option<f64>> = (0..count).map(|e| self.considered[e].then_some(evidence[e])).collect();
        let (levels, bends) = evidence[count..].split_at(self.channels.len());
        let most = |evidence: &[f64]| evidence.iter().copied().fold(0.0, f64::max);
        let largest = z.iter().flatten().copied().fold(most(levels).max(most(bends)), f64::max);
        let mut selection = Selection {
            z,
            levels: levels.to_vec(),
            bends: bends.to_vec(),
            threshold: self.threshold(),
            probability: self.groups.as_ref().map(|n| [n.probability(largest), n.attainable()]),
            chosen: Vec::new(),
            alone: Vec::new(),
            rivals: Vec::new(),
            remaining: (largest, String::new()),
            remaining_level: (most(levels), String::new()),
            remaining_bend: (most(bends), String::new()),
            remaining_bend_of_sensor: (0.0, String::new()),
        };
        if largest < selection.threshold {
            selection.remaining.1 = self.named(&selection, largest);
            return selection;
        }
        while selection.chosen.len() < self.effects_max() && selection.remaining.0 >= selection.threshold {
            let Some(next) = self.next(group, &selection.chosen) else { break };
            selection.chosen.push(next);
            self.exchange(group, &mut selection.chosen);
            self.leave(group, group, &mut selection);
        }
        self.describe(group, &mut selection);
        selection
    }

    /// Most effects that are named.
    pub(crate) fn effects_max(&self) -> usize {
        if self.model_on_trial { EFFECTS_ON_TRIAL_MAX } else { EFFECTS_MAX }
    }

    /// What has this evidence alone; empty where nothing has.
    fn named(&self, selection: &Selection, evidence: f64) -> String {
        let hypothesis = selection.z.iter().position(|z| *z == Some(evidence)).map(|e| self.catalogue[e].label());
        let level = || selection.levels.iter().position(|z| *z == evidence).map(|i| level_name(self.channels[i]));
        let bend = || selection.bends.iter().position(|z| *z == evidence).map(|i| bend_name(self.bending()[i]));
        hypothesis.or_else(level).or_else(bend).unwrap_or_default()
    }

    /// What speaks for each chosen hypothesis, its rivals, and what is left.
    fn describe(&self, group: &Group, selection: &mut Selection) {
        let chosen = selection.chosen.clone();
        let others = |i: usize| without(&chosen, i);
        selection.alone = (0..chosen.len()).map(|i| self.after(group, &others(i), chosen[i]).0).collect();
        selection.rivals = (0..chosen.len()).map(|i| self.rivals(group, &others(i), chosen[i], &chosen)).collect();
        self.leave(group, group, selection);
    }

    /// The hypothesis that is best added to those chosen.
    fn next(&self, group: &Group, chosen: &[usize]) -> Option<usize> {
        let needed = self.threshold() * if chosen.is_empty() { 1.0 } else { FURTHER };
        let mut contenders: Vec<(usize, f64)> = self
            .open(chosen)
            .filter_map(|k| {
                let (z, gain) = self.after(group, chosen, k);
                (z >= needed).then_some((k, gain))
            })
            .collect();
        contenders.sort_by(|a, b| b.1.total_cmp(&a.1));
        if let Some(known) = self.known.iter().find(|known| contenders.iter().any(|c| c.0 == known.hypothesis)) {
            return Some(known.hypothesis);
        }
        let (mut best, top) = *contenders.first()?;
        for (k, _) in contenders.iter().skip(1).filter(|(_, gain)| *gain >= COMPETING * top) {
            if self.difference(group, chosen, best, *k) < 0.0 {
                best = *k;
            }
        }
        Some(best)
    }

    /// Replaces a chosen hypothesis by one that explains more beside the others: a mixture of two effects may first look like a third.
    fn exchange(&self, group: &Group, chosen: &mut [usize]) {
        if chosen.len() < 2 {
            return;
        }
        for i in 0..chosen.len() {
            let others = without(chosen, i);
            for k in self.open(chosen).collect::<Vec<_>>() {
                if self.difference(group, &others, chosen[i], k) < -DECISIVE {
                    chosen[i] = k;
                }
            }
        }
    }

    /// Hypotheses that may be chosen beside others.
    pub(crate) fn open<'a>(&'a self, chosen: &'a [usize]) -> impl Iterator<Item = usize> + 'a {
        self.looked_at(chosen).filter(|k| !self.withheld.contains(k))
    }

    /// Hypotheses that may show in what others leave.
    fn looked_at<'a>(&'a self, chosen: &'a [usize]) -> impl Iterator<Item = usize> + 'a {
        (0..self.catalogue.len()).filter(|k| self.considered[*k] && !chosen.contains(k) && !self.refused.contains(k))
    }

    fn rivals(&self, group: &Group, others: &[usize], j: usize, chosen: &[usize]) -> Vec<Rival> {
        if let Some(known) = self.known(j) {
            return known.rivals.iter().filter(|r| !chosen.contains(&r.hypothesis)).cloned().collect();
        }
        let mut rivals: Vec<Rival> = self
            .open(chosen)
            .filter(|k| self.after(group, others, *k).0 >= self.threshold())
            .map(|k| Rival { hypothesis: k, difference: self.difference(group, others, j, k) })
            .collect();
        rivals.sort_by(|a, b| a.difference.total_cmp(&b.difference));
        rivals
    }

    /// Says of a selection what its chosen ones leave, where `left` are the scores after the fit went through the physics.
    pub(crate) fn leave(&self, left: &Group, before: &Group, selection: &mut Selection) {
        let chosen = &selection.chosen;
        let levels = self.levels_after_fit(left, before, chosen).map(|(channel, z)| (z, level_name(channel)));
        let level = levels.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_default();
        let bends: Vec<(Bend, f64)> = self.bends_after_fit(left, before, chosen).collect();
        let largest_bend = |of: &dyn Fn(&Bend) -> bool| {
            let most = bends.iter().filter(|(bend, _)| of(bend)).max_by(|a, b| a.1.total_cmp(&b.1));
            most.map(|(bend, z)| (*z, bend_name(*bend))).unwrap_or_default()
        };
        let bend = largest_bend(&|_| true);
        let of_sensor = chosen.iter().any(|h| self.catalogue[*h].layer() == Layer::Sensor);
        selection.remaining_bend_of_sensor = largest_bend(&|bend| of_sensor && bend.channel >= PATH_AT);
        let hypotheses = self.looked_at(chosen).map(|k| (self.after_fit(left, before, chosen, k).0, self.catalogue[k].label()));
        let most = hypotheses.chain([level.clone(), bend.clone()]).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_default();
        (selection.remaining, selection.remaining_level, selection.remaining_bend) = (most, level, bend);
    }

    /// Bends that are asked for: those of actuators, but for a model on trial, which lacks more.
    fn bending(&self) -> Vec<Bend> {
        if self.model_on_trial { Vec::new() } else { bend::asked_of(&self.channels) }
    }

    /// Evidence that actuators and sensors bend in what the chosen ones leave.
    fn bends_after_fit(&self, left: &Group, before: &Group, chosen: &[usize]) -> impl Iterator<Item = (Bend, f64)> {
        let first = self.catalogue.len() + self.channels.len();
        let asked = self.bending().into_iter().enumerate().map(move |(i, bend)| (bend, first + i));
        self.nameless_after_fit(left, before, chosen, asked, bend_column)
    }

    /// Evidence of columns without a cause, each with its place among all evidence, in what the chosen ones leave.
    fn nameless_after_fit<C: Copy>(
        &self,
        left: &Group,
        before: &Group,
        chosen: &[usize],
        asked: impl Iterator<Item = (C, usize)>,
        column: impl Fn(&[Candidate], C) -> usize,
    ) -> impl Iterator<Item = (C, f64)> {
        let believed = self.believed(chosen);
        asked.map(move |(what, place)| {
            let found = left.remainder_since(before, &believed, &[column(&self.catalogue, what)]);
            (what, found.z / self.spread(place))
        })
    }

    /// Evidence that the level of a channel is unusual in what the chosen ones leave, for every compared channel that may speak against them.
    ///
    /// What a force or a soil does to the rims follows from the slope of traction, which is known worst (and without torque not at all, ADR 0003), so their
    /// levels do not speak against one.
    pub(crate) fn levels_after_fit(&self, left: &Group, before: &Group, chosen: &[usize]) -> impl Iterator<Item = (usize, f64)> {
        let force = chosen.iter().any(|h| self.catalogue[*h].layer().is_force());
        let told = move |channel: usize| !(force && (RIM_AT..PATH_AT).contains(&channel));
        let first = self.catalogue.len();
        let asked = self.channels.iter().copied().enumerate().filter(move |(_, channel)| told(*channel));
        self.nameless_after_fit(left, before, chosen, asked.map(move |(i, channel)| (channel, first + i)), level_column)
    }
}

fn bend_name(bend: Bend) -> String {
    format!("the {}", bend.name())
}

fn level_name(channel: usize) -> String {
    format!("the {}", crate::observe::channels::level_name(channel))
}

/// All but the `i`-th.
pub fn without<T: Copy>(all: &[T], i: usize) -> Vec<T> {
    all.iter().enumerate().filter(|(at, _)| *at != i).map(|(_, item)| *item).collect()
}
