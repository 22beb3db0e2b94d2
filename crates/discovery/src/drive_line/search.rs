//! The search for effects of a drive line: chosen one after the other, sized together, doubted beside what was found after them.

use super::proof::Doubt;
use super::rims::Rims;
use super::sized::Sized;

/// Most effects of a drive line (chosen): gain, delay, lag and limits of speed and of turning.
const EFFECTS_MAX: usize = 8;
/// Share by which another effect in the place of one leaves less, before it takes the place.
const BETTER: f64 = 0.01;
/// Candidates of each turn that are sized together with what was found.
const TRIED: usize = 4;
/// Rounds of the search for sizes.
const ROUNDS: usize = 12;
/// Steps of Gauss-Newton in each of them, which follow what the sizes explain together.
const STEPS: usize = 3;
/// Share of the error below which a round of it gains nothing.
const GAIN_MIN: f64 = 5e-4;

impl Rims<'_> {
    /// Effects that explain the wheel speeds.
    pub(super) fn chosen(&self) -> Sized {
        let mut found = self.sized(Vec::new(), Vec::new());
        for _ in 0..2 * EFFECTS_MAX {
            if found.terms.len() == EFFECTS_MAX {
                break;
            }
            let open = (0..self.family.len()).filter(|term| !found.terms.contains(term));
            // What a size does shows only once the others have made room for it.
            let begun = open.map(|term| self.first(&found, term));
            let mut first: Vec<Sized> = begun
                .map(|begun| (0..STEPS).try_fold(begun.clone(), |at, _| self.stepped(&at).ok_or(at)).unwrap_or_else(|at| at))
                .collect();
            first.sort_by(|a, b| a.error().total_cmp(&b.error()));
            let tried = first
                .into_iter()
                .take(TRIED)
                .map(|sized| self.polished(sized))
                .filter(|sized| sized.falls_from(&found) && self.inside(sized));
            let Some(best) = tried.min_by(|a, b| a.error().total_cmp(&b.error())) else { break };
            found = self.doubted(best);
        }
        self.proven(found)
    }

    /// What was found once nothing in the place of an effect leaves less, with what was held against each.
    pub(super) fn settled(&self, mut found: Sized) -> (Sized, Vec<Doubt>) {
        let mut left = EFFECTS_MAX;
        loop {
            let doubts: Vec<Doubt> = (0..found.terms.len()).map(|i| self.doubt(&found, i)).collect();
            let instead = doubts.iter().flat_map(|doubt| &doubt.instead).min_by(|a, b| a.error().total_cmp(&b.error()));
            match instead.filter(|instead| left > 0 && instead.error() < (1.0 - BETTER) * found.error()) {
                Some(better) => (found, left) = (self.proven(better.clone()), left - 1),
                None => return (found, doubts),
            }
        }
    }

    /// The best of the first sizes of a term beside what was found.
    pub(super) fn first(&self, found: &Sized, term: usize) -> Sized {
        let tried = self.begun(term).into_iter().map(|value| {
            let (mut terms, mut values) = (found.terms.clone(), found.values.clone());
            terms.push(term);
            values.push(value);
            self.sized(terms, values)
        });
        tried.min_by(|a, b| a.error().total_cmp(&b.error())).expect("every effect has a size; this is a bug")
    }

    /// Sizes at which a term is tried first.
    fn begun(&self, term: usize) -> Vec<f64> {
        let candidate = &self.family[term];
        let ([low, high], free) = (candidate.range(0), &candidate.free()[0]);
        if free.mean != 0.0 {
            let steps = ((high / low).ln() / 1.4f64.ln()).floor() as i32;
            return (0..=steps).map(|k| low * 1.4f64.powi(k)).collect();
        }
        let sizes = (0..6).map(|k| free.step * f64::from(1 << k)).filter(|size| *size <= high);
        sizes.flat_map(|size| [size, -size]).filter(|size| *size >= low).collect()
    }

    /// All sizes sought together from where they are, one after the other with steps that shrink and all together.
    pub(super) fn polished(&self, mut best: Sized) -> Sized {
        self.work.add(1);
        let mut error = best.error();
        for round in 0..ROUNDS {
            let before = error;
            for i in 0..best.terms.len() {
                let mut reach = 0.4 / f64::from(1 << round.min(6));
                for _ in 0..6 {
                    let by = reach * self.scale(best.terms[i], best.values[i]);
                    let trial = |by: f64| {
                        let mut values = best.values.clone();
                        let [low, high] = self.family[best.terms[i]].range(0);
                        values[i] = (values[i] + by).clamp(low, high);
                        self.sized(best.terms.clone(), values)
                    };
                    let better = [by, -by].into_iter().map(trial).find(|trial| trial.error() < error);
                    match better {
                        Some(trial) => (error, best) = (trial.error(), trial),
                        None => reach *= 0.5,
                    }
                }
            }
            for _ in 0..STEPS {
                let Some(to) = self.stepped(&best) else { break };
                (error, best) = (to.error(), to);
            }
            if round > 1 && before - error < GAIN_MIN * before {
                break;
            }
        }
        self.work.done();
        best
    }

    /// What was found without one of its terms, the others sized again.
    pub(super) fn dropped(&self, found: &Sized, i: usize) -> Sized {
        let (mut terms, mut values) = (found.terms.clone(), found.values.clone());
        terms.remove(i);
        values.remove(i);
        self.polished(self.sized(terms, values))
    }

    /// Whether a size is held by the end of its range.
    pub(super) fn is_held(&self, sized: &Sized, i: usize) -> bool {
        self.family[sized.terms[i]].clamp(&mut [sized.values[i]])[0]
    }

    /// Whether no size is held by the end of its range.
    fn inside(&self, sized: &Sized) -> bool {
        (0..sized.terms.len()).all(|i| !self.is_held(sized, i))
    }

    /// What was found, but for what is not needed beside what was found after it.
    fn doubted(&self, mut found: Sized) -> Sized {
        let mut i = 0;
        while i + 1 < found.terms.len() {
            let without = self.dropped(&found, i);
            if found.falls_from(&without) {
                i += 1;
            } else {
                found = without;
                i = 0;
            }
        }
        found
    }
}
