//! Chosen effects against their closest rivals once more, each sized through the physics, because a large delay or drag is no multiple of a small one.

use crate::claims::Case;
use crate::observe::condense::Condensed;
use crate::select::evidence::Group;
use crate::select::onset::Onset;
use crate::select::{DECISIVE, RIVALS_MAX, Rival, Selection, Yardstick, without};

/// Criterion within which a rival is sized through the physics before it is judged.
const SETTLED: f64 = 40.0;
/// Most times that each chosen effect is compared: once more where another one took a place beside it.
const SWEEPS: usize = 2;

/// Hypotheses that were compared through the physics: what each, sized on all drives, leaves of each drive.
#[derive(Clone, Debug)]
pub struct Settled {
    /// The hypotheses.
    pub members: Vec<usize>,
    /// Hypotheses that were fitted beside each.
    others: Vec<usize>,
    /// Scores of what each member leaves, drive by drive.
    left: Vec<Vec<Condensed>>,
}

impl Settled {
    fn with(&self, member: usize) -> Vec<usize> {
        std::iter::once(self.members[member]).chain(self.others.iter().copied()).collect()
    }

    /// What a member leaves of the drives for which `inside` holds.
    fn group(&self, yardstick: &Yardstick, member: usize, inside: impl Fn(usize) -> bool) -> Group {
        yardstick.group(self.left[member].iter().enumerate().filter(|(d, _)| inside(*d)).map(|(_, c)| c))
    }

    /// Position of the member that is best of those that `may` be, on the drives for which `inside` holds, whose scores before any fit are `before`, and the others,
    /// closest first.
    fn compare(
        &self,
        yardstick: &Yardstick,
        before: &Group,
        inside: impl Fn(usize) -> bool,
        may: impl Fn(usize) -> bool,
    ) -> (usize, Vec<Rival>) {
        let left: Vec<Group> = (0..self.members.len()).map(|m| self.group(yardstick, m, &inside)).collect();
        let z = |k: usize, j: usize| yardstick.after_fit(&left[j], before, &self.with(j), self.members[k]).0;
        let difference = |j: usize, k: usize| z(j, k).powi(2) - z(k, j).powi(2);
        let admitted = (0..self.members.len()).filter(|m| may(self.members[*m]));
        let best = admitted.reduce(|best, k| if difference(best, k) < 0.0 { k } else { best }).unwrap_or(0);
        let rival = |k: usize| Rival { hypothesis: self.members[k], difference: difference(best, k) };
        let mut rivals: Vec<Rival> = (0..self.members.len()).filter(|k| *k != best).map(rival).collect();
        rivals.sort_by(|a, b| a.difference.total_cmp(&b.difference));
        (best, rivals)
    }

    /// Whether drives that chose `chosen` stand for a hypothesis that `counts`: they chose a member, and of the members one that counts is best on the drives for
    /// which `inside` holds, or not decided against. Effects near zero, which a choice looks at, do not tell a large delay from a lag.
    pub(crate) fn stands(
        &self,
        yardstick: &Yardstick,
        chosen: &[usize],
        before: &Group,
        inside: impl Fn(usize) -> bool,
        counts: impl Fn(usize) -> bool,
    ) -> bool {
        if !chosen.iter().any(|h| self.members.contains(h)) {
            return false;
        }
        let (best, others) = self.compare(yardstick, before, inside, |_| true);
        counts(self.members[best]) || others.iter().any(|r| r.difference < DECISIVE && counts(r.hypothesis))
    }
}

impl Case<'_> {
    /// Compares chosen effects with their closest rivals, each sized through the physics in the place of the effect while the other chosen ones stay: the first always,
    /// further ones where a rival is close. The best takes the place and, without an onset of its own, the onset that was there; the others remain its rivals. What is
    /// left is that of the fit. What is `passed_over` takes no place and stays a rival. `None` for what was not compared, such as what an earlier look settled.
    pub fn settle(
        &self,
        yardstick: &Yardstick,
        selection: &mut Selection,
        onsets: &mut [Option<Onset>],
        passed_over: &[usize],
    ) -> Vec<Option<Settled>> {
        let before = yardstick.group(self.condensed());
        let count = selection.chosen.len();
        let (mut settled, mut closest): (Vec<Option<Settled>>, Vec<Vec<Rival>>) = (vec![None; count], vec![Vec::new(); count]);
        for i in (0..SWEEPS).flat_map(|_| 0..count) {
            if settled[i].as_ref().is_some_and(|own| own.others == without(&selection.chosen, i)) {
                continue;
            }
            let Some(own) = self.compared(yardstick, selection, onsets, &before, i) else {
                settled[i] = None;
                continue;
            };
            let (best, mut rivals) = own.compare(yardstick, &before, |_| true, |h| !passed_over.contains(&h));
            rivals.extend(selection.rivals[i].iter().filter(|r| !own.members.contains(&r.hypothesis)).cloned());
            if best > 0 {
                let mut chosen = selection.chosen.clone();
                chosen[i] = own.members[best];
                onsets[chosen[i]] = onset_in_place(onsets, chosen[i], selection.chosen[i]);
                selection.choose(yardstick, &before, chosen);
            }
            closest[i] = rivals;
            settled[i] = Some(own);
        }
        for (i, own) in settled.iter().enumerate() {
            let Some(own) = own else { continue };
            selection.rivals[i] = std::mem::take(&mut closest[i]);
            let member = own.members.iter().position(|h| *h == selection.chosen[i]);
            if let Some(member) = member.filter(|_| own.others == without(&selection.chosen, i)) {
                let left = own.group(yardstick, member, |_| true);
                yardstick.leave(&left, &before, selection);
            }
        }
        settled
    }

    /// A chosen effect and its close rivals, each sized in its place.
    fn compared(
        &self,
        yardstick: &Yardstick,
        selection: &Selection,
        onsets: &[Option<Onset>],
        before: &Group,
        i: usize,
    ) -> Option<Settled> {
        let own = selection.chosen[i];
        let close: Vec<usize> =
            selection.rivals[i].iter().filter(|r| r.difference < SETTLED).take(2 * RIVALS_MAX).map(|r| r.hypothesis).collect();
        if yardstick.known(own).is_some() || i > 0 && close.is_empty() {
            return None;
        }
        let others = without(&selection.chosen, i);
        let members: Vec<usize> = std::iter::once(own).chain(close).collect();
        self.work.add(members.len());
        let left = members
            .iter()
            .map(|h| {
                let with: Vec<usize> = std::iter::once(*h).chain(others.iter().copied()).collect();
                let mut onsets = onsets.to_vec();
                onsets[*h] = onset_in_place(&onsets, *h, own);
                let left = self.left(&self.size(yardstick, before, &with, &onsets));
                self.work.done();
                left
            })
            .collect();
        Some(Settled { members, others, left })
    }
}

/// Onset of a hypothesis in the place of another: its own, else that of the other.
pub(crate) fn onset_in_place(onsets: &[Option<Onset>], hypothesis: usize, place: usize) -> Option<Onset> {
    onsets[hypothesis].or(onsets[place])
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;
    use crate::candidates::catalogue;
    use crate::select::evidence::Nulls;

    /// Goal: a rival that was not dated competes as what begins midway. Method: onsets of four hypotheses.
    #[test]
    fn analytic_a_rival_without_an_onset_takes_that_of_the_effect_in_whose_place_it_stands() {
        let at = |at_s: f64| Some(Onset { at_s, ci95_s: [at_s - 1.0, at_s + 1.0], gain: 20.0 });
        let onsets = [at(12.0), None, at(9.0), None];
        assert_eq!(onset_in_place(&onsets, 1, 0), at(12.0));
        assert_eq!(onset_in_place(&onsets, 2, 0), at(9.0));
        assert_eq!(onset_in_place(&onsets, 1, 3), None);
        assert_eq!(onset_in_place(&onsets, 0, 0), at(12.0));
    }

    /// Goal: what was refused for its size takes no place again and stays a rival. Method: a centre of mass further ahead or further left with almost the same answer; the
    /// first leaves nothing of a drive, the second something of the first.
    #[test]
    fn analytic_what_is_passed_over_stays_a_rival() {
        let catalogue = catalogue(&[]);
        let at = |id: &str| catalogue.iter().position(|c| c.id() == id).unwrap();
        let members = vec![at("cg_forward"), at("cg_lateral")];
        let [first, second] = [members[0], members[1]].map(|h| catalogue[h].columns()[0]);
        let size = 1 + first.max(second);
        let drive = |scores: [f64; 2]| {
            let (mut score, mut information) = (DVector::<f64>::zeros(size), DMatrix::<f64>::identity(size, size) * 100.0);
            (score[first], score[second]) = (scores[0], scores[1]);
            information[(first, second)] = 90.0;
            information[(second, first)] = 90.0;
            Condensed { score, information, square: 0.0, soil_score: DVector::zeros(0), soil_information: DMatrix::zeros(0, 0) }
        };
        let nulls = [[10.0, 10.0], [10.0, -10.0], [-10.0, 10.0], [-10.0, -10.0]].map(drive);
        let nulls = Nulls::new(&nulls.each_ref()).unwrap();
        let yardstick = Yardstick::new(nulls, None, &catalogue, &[], &[]);
        let left = vec![vec![drive([0.0, 0.0])], vec![drive([100.0, 0.0])]];
        let settled = Settled { members: members.clone(), others: Vec::new(), left };
        let before = yardstick.group([drive([200.0, 180.0])].iter());
        let best = |passed_over: &[usize]| settled.compare(&yardstick, &before, |_| true, |h| !passed_over.contains(&h));
        assert_eq!(best(&[]).0, 0);
        let (place, rivals) = best(&members[..1]);
        assert_eq!((place, rivals[0].hypothesis), (1, members[0]));
        assert!(rivals[0].difference < 0.0, "{rivals:?}");
    }
}
