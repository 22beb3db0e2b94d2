//! Whether a fitted effect is as large all the time that it is there: an offset that ends, or comes and goes, is fitted well on average and is none of its kind.
//!
//! What the fit leaves is searched for a further onset of the effect's own answer, as when effects are dated. An onset must bring a share of what its effect explains,
//! because answers are not exact; a change of what is sized already must bring what answers of its layer are doubted by, or be as large as that is in the middle of the
//! drives (28 % of the size, of forces and soils 69 %), so that forces, which depend on how the vehicle is driven, are not refused for that. What has no edge, such as a bias that grows, leaves sensors that go on from segment to segment
//! ([`whiteness`](crate::reference::whiteness)).

use nesam_physics::SoilCorrection;
use nesam_physics::effects::ScheduledEffect;
use rayon::prelude::*;

use crate::claims::Case;
use crate::claims::fit::Fit;
use crate::observe::channels::Row;
use crate::observe::condense::difference;
use crate::reference::whiteness::{Succession, Unrest};
use crate::select::dating::dispersion;
use crate::select::onset::{Change, Course, change, loose};
use crate::select::{Yardstick, mismatch, without};

/// What fitted effects leave of a drive.
struct Left {
    rows: Vec<Row>,
    /// The answer to each effect as fitted.
    answers: Vec<Vec<Row>>,
}

impl Case<'_> {
    /// Why the size of each of the chosen effects, which were fitted in this order, is not the same throughout; `None` where it is. A model on trial lacks more than them, so
    /// that no change is looked for there.
    pub(crate) fn changes(&self, yardstick: &Yardstick, fit: &Fit, chosen: &[usize]) -> Vec<Option<String>> {
        if yardstick.model_on_trial {
            return vec![None; chosen.len()];
        }
        let effects = fit.effects();
        let left: Vec<Left> = self
            .prepared
            .par_iter()
            .zip(&self.rows)
            .map(|(prepared, plain)| {
                let with = |effects: &[ScheduledEffect]| prepared.drive.deviations(&self.bench, effects, &SoilCorrection::NONE);
                let rows = with(&effects);
                let answer = |i: usize| match without(&effects, i) {
                    others if others.is_empty() => difference(plain, &rows, 1.0),
                    others => difference(&with(&others), &rows, 1.0),
                };
                let answers = (0..effects.len()).map(answer).collect();
                Left { rows, answers }
            })
            .collect();
        let changes = (0..chosen.len()).map(|i| {
            let step = self.changes_of(yardstick, &left, i, chosen[i]).map(|change| change.to_string());
            step.or_else(|| self.goes_on(yardstick, &left, i, chosen[i]).map(|unrest| format!("with it {unrest}")))
        });
        changes.map(|change| change.map(|what| format!("its size is not the same throughout: {what}"))).collect()
    }

    /// What sensors do within drives that they do not do without an effect.
    pub(crate) fn unrest(&self, yardstick: &Yardstick) -> Option<Unrest> {
        let of = |channel| self.successions(self.rows.iter().map(Vec::as_slice), channel);
        let whiteness = &yardstick.whiteness;
        whiteness.lasting(yardstick.beyond_doubt(), |_| true, of).or_else(|| whiteness.jump(of))
    }

    /// How a channel goes on in each drive.
    fn successions<'r>(&self, rows: impl Iterator<Item = &'r [Row]>, channel: usize) -> Vec<Succession> {
        self.prepared.iter().zip(rows).map(|(p, rows)| Succession::of(&p.drive, &p.signatures.uncounted, rows, channel)).collect()
    }

    /// What goes on from segment to segment of that which the `i`-th of fitted effects leaves, in a channel that it changes: more than its answer there is doubted by.
    fn goes_on(&self, yardstick: &Yardstick, left: &[Left], i: usize, hypothesis: usize) -> Option<Unrest> {
        let of = |channel| self.successions(left.iter().map(|left| left.rows.as_slice()), channel);
        let doubted = mismatch(yardstick.catalogue[hypothesis].layer());
        let more = |channel: usize| {
            let answered: f64 = left.iter().flat_map(|left| &left.answers[i]).map(|row| row[channel].powi(2)).sum();
            answered > 0.0 && of(channel).iter().map(|s| s.lagged).sum::<f64>() > doubted * answered
        };
        yardstick.whiteness.lasting(yardstick.beyond_doubt(), more, of)
    }

    /// The change of the size of the `i`-th of fitted effects, beside the others in whatever size each drive has them.
    fn changes_of(&self, yardstick: &Yardstick, left: &[Left], i: usize, hypothesis: usize) -> Option<Change> {
        let dt_s = self.bench.stepping.dt_s;
        let drives: Vec<Course<'_>> = self
            .prepared
            .iter()
            .zip(left)
            .map(|(prepared, Left { rows, answers })| {
                let others = answers.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, answer)| loose(answer));
                Course {
                    times_s: prepared.drive.times_s(dt_s),
                    rows,
                    shift: answers[i].clone(),
                    beside: prepared.signatures.soil.iter().cloned().chain(others).collect(),
                    uncounted: &prepared.signatures.uncounted,
                }
            })
            .collect();
        change(&self.metric, &drives, dispersion(yardstick, hypothesis), mismatch(yardstick.catalogue[hypothesis].layer()))
    }
}
