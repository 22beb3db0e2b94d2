//! Whether a fitted effect is as large all the time that it is there: an offset that ends, or comes and goes, is fitted well on average and is none of its kind.
//!
//! What the fit leaves is searched for a further onset of the effect's own answer, as when effects are dated. An onset must bring a share of what its effect explains,
//! because answers are not exact; a change of what is sized already must bring what answers of its layer are doubted by, so that forces, which depend on how the
//! vehicle is driven, are not refused for that.

use nesam_physics::SoilCorrection;
use nesam_physics::effects::ScheduledEffect;
use rayon::prelude::*;

use crate::channels::Row;
use crate::claims::Case;
use crate::condense::difference;
use crate::dating::dispersion;
use crate::fit::Fit;
use crate::onset::{Change, Course, change, loose};
use crate::select::{Yardstick, mismatch, without};

/// What fitted effects leave of a drive.
struct Left {
    rows: Vec<Row>,
    /// The answer to each effect as fitted.
    answers: Vec<Vec<Row>>,
}

impl Case<'_> {
    /// The change of the size of each of the chosen effects, which were fitted in this order. A model on trial lacks more than them, so that none is looked for there.
    pub(crate) fn changes(&self, yardstick: &Yardstick, fit: &Fit, chosen: &[usize]) -> Vec<Option<Change>> {
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
        (0..chosen.len()).map(|i| self.changes_of(yardstick, &left, i, chosen[i])).collect()
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
        let share_min = mismatch(yardstick.catalogue[hypothesis].layer());
        change(&self.metric, &drives, dt_s, dispersion(yardstick, hypothesis), share_min)
    }
}
