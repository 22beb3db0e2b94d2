//! Which of the effects that drives speak for began midway.
//!
//! A column that is there from the start tells little of an effect that begins: another effect may then stand for it, or take half of its size. So what is chosen is
//! dated, the columns begin there, and it is chosen again. Each effect is dated beside the others that are chosen, because what an effect leaves that is always there
//! looks like one that begins wherever the drives happen to show it, and its rivals with it, so that none is ahead for its onset alone.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::claims::Case;
use crate::observe::channels::Row;
use crate::observe::condense::{Signatures, condense};
use crate::select::evidence::Group;
use crate::select::onset::{self, Course, DISPERSION_MIN, Dated, Onset, PossibleOnset};
use crate::select::{DECISIVE, Selection, Yardstick, without};

/// Most times that effects are dated and chosen again (chosen).
const LOOKS: usize = 3;
/// Strongest hypotheses that are dated at first, chosen or not.
const STRONGEST: usize = 3;

/// Hypotheses with the time from which each acts, s; `None` = from the start.
type Acting = Vec<(usize, Option<f64>)>;

/// What is known of the onsets of all hypotheses.
#[derive(Clone, Debug)]
pub(crate) struct Dating {
    /// Onset of each hypothesis, from which on its columns are there.
    onsets: Vec<Option<Onset>>,
    /// Onset of each hypothesis that may have one, which its columns do not have.
    possible: Vec<Option<PossibleOnset>>,
    /// What each hypothesis was last dated beside; `None` = it was not dated.
    beside: Vec<Option<Acting>>,
    /// The whole of each column that begins midway, by drive.
    whole: Vec<BTreeMap<usize, Vec<Row>>>,
}

impl Dating {
    fn none(hypotheses: usize, drives: usize) -> Self {
        Self {
            onsets: vec![None; hypotheses],
            possible: vec![None; hypotheses],
            beside: vec![None; hypotheses],
            whole: vec![BTreeMap::new(); drives],
        }
    }

    /// Onsets of those of some hypotheses that have one.
    fn begins(&self, hypotheses: &[usize]) -> Vec<Onset> {
        hypotheses.iter().filter_map(|h| self.onsets[*h]).collect()
    }

    fn acting(&self, hypotheses: &[usize]) -> Acting {
        hypotheses.iter().map(|h| (*h, self.onsets[*h].map(|o| o.at_s))).collect()
    }
}

impl Case<'_> {
    /// Onset of each hypothesis as far as it was looked for.
    pub fn onsets(&self, yardstick: &Yardstick) -> Vec<Option<Onset>> {
        self.dating.as_ref().map_or_else(|| vec![None; yardstick.catalogue.len()], |dating| dating.onsets.clone())
    }

    /// Selects effects, dates them with their close rivals, lets the columns begin there where an onset is sure, and selects again, until no onset changes. What
    /// was dated by an earlier call is dated again where other effects are chosen beside it. Segments within which a chosen effect may begin count for its onset and that
    /// of others, so that one that begins in them is dated too, and for nothing else.
    pub fn select(&mut self, yardstick: &Yardstick) -> (Selection, Vec<Option<Onset>>) {
        let mut group = yardstick.group(self.condensed());
        let mut selection = yardstick.select(&group);
        if !selection.differs() {
            return (selection, self.onsets(yardstick));
        }
        let strongest = if self.dating.is_none() { strongest(yardstick, &group) } else { Vec::new() };
        let mut dating = self.dating.take().unwrap_or_else(|| Dating::none(yardstick.catalogue.len(), self.prepared.len()));
        for look in 0..LOOKS {
            let mut moved = false;
            let more = if look == 0 { strongest.as_slice() } else { &[] };
            let places = places(&selection, more);
            self.work.add(places.len());
            for (hypothesis, beside) in places {
                self.work.done();
                let acting = dating.acting(&beside);
                if dating.beside[hypothesis].as_ref() == Some(&acting) {
                    continue;
                }
                let dated = self.date(yardstick, &group, &dating, hypothesis, &beside);
                let onset = dated.onset();
                dating.beside[hypothesis] = Some(acting);
                dating.possible[hypothesis] = dated.possible();
                let before = std::mem::replace(&mut dating.onsets[hypothesis], onset);
                if before.map(|o| o.at_s) != onset.map(|o| o.at_s) {
                    self.begin(yardstick, &mut dating, hypothesis);
                    moved = true;
                }
            }
            moved |= self.pass_over(&dating.begins(&selection.chosen));
            if !moved {
                break;
            }
            self.condense_again();
            group = yardstick.group(self.condensed());
            selection = yardstick.select(&group);
        }
        let onsets = dating.onsets.clone();
        self.dating = Some(dating);
        (selection, onsets)
    }

    /// Forgets all onsets: columns are whole and every segment counts again.
    pub(crate) fn forget_onsets(&mut self) {
        let Some(dating) = self.dating.take() else { return };
        for (prepared, whole) in self.prepared.iter_mut().zip(dating.whole) {
            for (column, rows) in whole {
                prepared.signatures.columns[column] = rows;
            }
            prepared.signatures.uncounted.clear();
        }
        self.condense_again();
    }

    /// When a hypothesis may have begun as far as that was looked for and is not decided.
    pub(crate) fn possible_onset(&self, hypothesis: usize) -> Option<PossibleOnset> {
        self.dating.as_ref().and_then(|dating| dating.possible[hypothesis])
    }

    /// When a hypothesis began that acts beside others, each from its own onset on.
    fn date(&self, yardstick: &Yardstick, group: &Group, dating: &Dating, hypothesis: usize, beside: &[usize]) -> Dated {
        let dt_s = self.bench.stepping.dt_s;
        let (columns, others) = (yardstick.catalogue[hypothesis].columns(), yardstick.columns(beside));
        let shares = group.remainder(&others, &columns).shares;
        let drives: Vec<Course<'_>> = self
            .prepared
            .iter()
            .zip(&self.rows)
            .zip(&dating.whole)
            .map(|((prepared, rows), whole)| {
                let signatures = &prepared.signatures;
                let own: Vec<&Vec<Row>> = columns.iter().map(|c| whole.get(c).unwrap_or(&signatures.columns[*c])).collect();
                let shift = |k: usize, c: usize| -> f64 { own.iter().zip(&shares).map(|(column, share)| share * column[k][c]).sum() };
                let loose = others.iter().map(|c| onset::loose(&signatures.columns[*c]));
                Course {
                    times_s: prepared.drive.times_s(dt_s),
                    rows,
                    shift: (0..rows.len()).map(|k| core::array::from_fn(|c| shift(k, c))).collect(),
                    beside: signatures.soil.iter().cloned().chain(loose).collect(),
                    uncounted: &[],
                }
            })
            .collect();
        onset::find(&self.metric, &drives, dt_s, dispersion(yardstick, hypothesis))
    }

    /// Lets the columns of a hypothesis begin at its onset.
    fn begin(&mut self, yardstick: &Yardstick, dating: &mut Dating, hypothesis: usize) {
        let (dt_s, at_s) = (self.bench.stepping.dt_s, dating.onsets[hypothesis].map(|o| o.at_s));
        for (prepared, whole) in self.prepared.iter_mut().zip(&mut dating.whole) {
            let times_s = prepared.drive.times_s(dt_s);
            for column in yardstick.catalogue[hypothesis].columns() {
                begin(whole, &mut prepared.signatures, column, &times_s, at_s);
            }
        }
    }

    /// Lets segments that straddle these onsets no longer count, and all others; whether that is a change.
    fn pass_over(&mut self, onsets: &[Onset]) -> bool {
        let dt_s = self.bench.stepping.dt_s;
        let mut changed = false;
        for prepared in &mut self.prepared {
            let uncounted = onset::straddling(&prepared.drive.times_s(dt_s), dt_s, onsets);
            changed |= uncounted != prepared.signatures.uncounted;
            prepared.signatures.uncounted = uncounted;
        }
        changed
    }

    fn condense_again(&mut self) {
        let metric = &self.metric;
        self.prepared.par_iter_mut().zip(&self.rows).for_each(|(prepared, rows)| {
            prepared.condensed = condense(metric, rows, &prepared.signatures);
        });
    }
}

/// Lets a column of a drive begin at a time, or be there from the start, whatever it was before. `whole` keeps what is cut off.
fn begin(whole: &mut BTreeMap<usize, Vec<Row>>, signatures: &mut Signatures, column: usize, times_s: &[f64], at_s: Option<f64>) {
    let now = &mut signatures.columns[column];
    match at_s {
        Some(at_s) => {
            let all = whole.entry(column).or_insert_with(|| now.clone());
            *now = onset::begun(all, times_s, at_s);
        }
        None => {
            if let Some(all) = whole.remove(&column) {
                *now = all;
            }
        }
    }
}

/// Hypotheses to be dated, each once, with those that act beside it: the chosen ones, rivals that are not decided against, each in the place of the one that it competes
/// with, and `more` in the place of the one that they are closest to.
fn places(selection: &Selection, more: &[usize]) -> Vec<(usize, Vec<usize>)> {
    let chosen = &selection.chosen;
    let mut places: Vec<(usize, Vec<usize>)> = Vec::new();
    for (i, hypothesis) in chosen.iter().enumerate() {
        let close = selection.rivals[i].iter().filter(|r| r.difference < DECISIVE).map(|r| r.hypothesis);
        places.extend(std::iter::once(*hypothesis).chain(close).map(|h| (h, without(chosen, i))));
    }
    for hypothesis in more {
        let against = |i: usize| selection.rivals[i].iter().find(|r| r.hypothesis == *hypothesis).map(|r| (i, r.difference));
        let closest = (0..chosen.len()).filter_map(against).min_by(|a, b| a.1.total_cmp(&b.1));
        places.push((*hypothesis, closest.map_or_else(|| chosen.clone(), |(i, _)| without(chosen, i))));
    }
    let mut seen = Vec::new();
    places.retain(|(hypothesis, _)| {
        let new = !seen.contains(hypothesis);
        seen.push(*hypothesis);
        new
    });
    places
}

/// The hypotheses that explain most for how their scores scatter.
fn strongest(yardstick: &Yardstick, group: &Group) -> Vec<usize> {
    let gain = |h: usize| yardstick.after(group, &[], h).1 / dispersion(yardstick, h);
    let mut gains: Vec<(usize, f64)> = yardstick.open(&[]).map(|h| (h, gain(h))).collect();
    gains.sort_by(|a, b| b.1.total_cmp(&a.1));
    gains.into_iter().take(STRONGEST).filter(|(_, gain)| *gain > 0.0).map(|(h, _)| h).collect()
}

/// How much more the scores of a hypothesis scatter than the metric says.
pub(crate) fn dispersion(yardstick: &Yardstick, hypothesis: usize) -> f64 {
    yardstick.catalogue[hypothesis].columns().into_iter().map(|c| yardstick.nulls.dispersion(c)).fold(DISPERSION_MIN, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observe::channels::CHANNELS;
    use crate::select::Rival;

    fn selection(chosen: &[usize], rivals: &[&[(usize, f64)]]) -> Selection {
        let of = |rivals: &[(usize, f64)]| -> Vec<Rival> {
            rivals.iter().map(|&(hypothesis, difference)| Rival { hypothesis, difference }).collect()
        };
        Selection { chosen: chosen.to_vec(), rivals: rivals.iter().copied().map(of).collect(), ..Selection::empty(4.0) }
    }

    /// Goal: every chosen effect is dated beside the others, and its close rivals in its place. Method: two chosen ones, a close rival of each, one of both, a far one
    /// that is among the strongest, and one that is no rival.
    #[test]
    fn analytic_effects_are_dated_beside_one_another() {
        let two = selection(&[7, 3], &[&[(5, 1.0), (9, 2.0), (4, 80.0)], &[(8, -1.0), (9, 3.0), (4, 60.0)]]);
        let of = |hypothesis: usize, beside: &[usize]| (hypothesis, beside.to_vec());
        assert_eq!(places(&two, &[]), [of(7, &[3]), of(5, &[3]), of(9, &[3]), of(3, &[7]), of(8, &[7])]);
        assert_eq!(places(&two, &[7, 4, 1])[5..], [of(4, &[7]), of(1, &[7, 3])]);
        assert_eq!(places(&selection(&[], &[]), &[2]), [of(2, &[])]);
    }

    /// Goal: an onset can be revised. Method: a column begins late, then earlier, then with the drive.
    #[test]
    fn analytic_a_column_that_begins_earlier_after_all_is_whole_again() {
        let times_s: Vec<f64> = (0..10).map(f64::from).collect();
        let column: Vec<Row> = times_s.iter().map(|t| [1.0 + t; CHANNELS]).collect();
        let mut signatures = Signatures { columns: vec![column.clone()], soil: Vec::new(), driven: Vec::new(), uncounted: Vec::new() };
        let mut whole = BTreeMap::new();
        for at_s in [8.0, 3.0] {
            begin(&mut whole, &mut signatures, 0, &times_s, Some(at_s));
            let there = signatures.columns[0].iter().zip(&times_s).all(|(row, t)| row[0] == if *t >= at_s { 1.0 + t } else { 0.0 });
            assert!(there, "from {at_s} s on: {:?}", signatures.columns[0]);
        }
        begin(&mut whole, &mut signatures, 0, &times_s, None);
        assert_eq!(signatures.columns[0], column);
    }
}
