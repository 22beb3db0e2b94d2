//! What a session learns of the soil: the filter and the transition that waits for its end.

use std::fmt::Display;
use std::sync::Arc;

use nesam_adaptation::{BufferedTransition, ClassBelief, Innovation, SoilFilter, SoilUpdate};
use nesam_fleet_soil::{FleetPrior, FleetSoilError, Increment, SoilBelief};
use nesam_model::{HISTORY, HistoryStep, Predictor, SoilByClass, SoilField};
use nesam_physics::{CONTRADICTIONS, SOIL_DIM, SoilCorrection, contradiction, unseen};
use nesam_terrain::WorldMap;

use super::track::Stamped;
use crate::clock::seconds;
use crate::fleet::Brought;

/// What the fleet may say at most on whether the correction helps, log odds: from odds of e⁻⁴ before any evidence to e, so that a vehicle that finds it wrong
/// unlearns it within a few buffers. Chosen.
const VOTES_MAX: f64 = 5.0;

/// What was learned of the soil in this session.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SoilState {
    /// Counts the updates; 0 = none yet.
    pub epoch: u64,
    /// Stamp of the last measurement that went in, ns of the vehicle's clock.
    pub stamp_ns: Option<i64>,
    /// Correction Δθ of the soil prior, zero before any update.
    pub correction: SoilCorrection,
    /// Variance of the correction in its coordinates; `None` while no filter runs.
    pub variance: Option<[f64; SOIL_DIM]>,
    /// Whether the drive has told much of each parameter, see [`nesam_adaptation::SoilPosterior::learned`].
    pub learned: [bool; SOIL_DIM],
    /// How well the last full buffer agreed with the prediction, whether it was taken or refused; `None` before the first.
    pub last_buffer: Option<BufferTest>,
}

/// The test of a full buffer of the soil filter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BufferTest {
    /// Counts the full buffers of the session from 1, refused ones too.
    pub judged: u64,
    /// Normalised innovation squared.
    pub nis: f64,
    /// Its degrees of freedom.
    pub dof: usize,
    /// The gate refused it.
    pub rejected: bool,
}

impl SoilState {
    /// Whether the prior alone speaks: nothing was told of the soil, or it was forgotten because other effects act now.
    pub fn is_prior(&self) -> bool {
        self.correction.delta == [0.0; SOIL_DIM]
    }

    /// Variance of a corrected soil in physical units squared, to first order.
    pub fn variance_at(&self, soil: &[f64; SOIL_DIM]) -> Option<[f64; SOIL_DIM]> {
        let slope = self.correction.coordinates.slope(soil);
        self.variance.map(|variance| core::array::from_fn(|i| slope[i] * slope[i] * variance[i]))
    }
}

/// What a session predicts with.
#[derive(Clone, Copy)]
pub(super) struct Models<'a> {
    /// The vehicle as it is taken to be.
    pub usual: &'a Predictor,
    /// The same with one uncertain parameter of an applied effect one standard deviation off.
    pub shifted: &'a [Predictor],
}

/// A full buffer.
pub(super) struct Judged {
    /// Its first and last stamp, ns of the vehicle's clock.
    pub stamps_ns: [i64; 2],
    /// What the filter made of it; `None` where the ground under a wheel is not known, and where the filter failed.
    pub learned: Option<Learned>,
    /// How its sensors contradict each other, see [`contradiction`].
    pub contradiction: [f64; CONTRADICTIONS],
    /// How much of that may have happened between two samples, see [`unseen`].
    pub unseen: [f64; CONTRADICTIONS],
    /// The vehicle stood and was told to: nothing moves, so nothing can disagree.
    pub standing: bool,
}

/// What the filter made of a full buffer.
pub(super) struct Learned {
    pub update: SoilUpdate,
    /// What it knows more than its prior, where it was not refused.
    pub brought: Option<Brought>,
}

/// The soil filter of one session. What a step says of the soil is known when the next one is measured.
#[derive(Clone, Debug)]
pub(super) struct SoilLearner {
    filter: SoilFilter,
    /// Up to 31 steps of history, then the steps of the buffer that fills; empty before the first.
    steps: Vec<HistoryStep>,
    /// Place in `steps` where the buffer begins.
    first: usize,
    /// Stamps of the steps from there on, ns: a vehicle whose rate is slightly off makes steps that are slightly longer or shorter than those of the model.
    stamps_ns: Vec<i64>,
    /// What failed since it was asked for last.
    failures: Vec<String>,
}

impl SoilLearner {
    pub(super) fn new(filter: SoilFilter) -> Self {
        Self::from_parts(filter, Vec::new(), 0, Vec::new())
    }

    /// The filter, the steps that it holds, where its open buffer begins among them, and the stamps from there on.
    pub(super) fn parts(&self) -> (&SoilFilter, &[HistoryStep], usize, &[i64]) {
        (&self.filter, &self.steps, if self.steps.is_empty() { 0 } else { self.first }, &self.stamps_ns)
    }

    /// The inverse of [`SoilLearner::parts`].
    pub(super) fn from_parts(filter: SoilFilter, steps: Vec<HistoryStep>, first: usize, stamps_ns: Vec<i64>) -> Self {
        Self { filter, steps, first, stamps_ns, failures: Vec::new() }
    }

    /// Why the filter learned less than it could have since the last time. It goes on with what it knew before.
    pub(super) fn take_failures(&mut self) -> Vec<String> {
        core::mem::take(&mut self.failures)
    }

    /// What came of a step of the filter; why nothing did is kept.
    fn noted<T, E: Display>(&mut self, result: Result<T, E>) -> Option<T> {
        result.map_err(|error| self.failures.push(error.to_string())).ok()
    }

    /// The next step does not follow the last one.
    pub(super) fn forget_open(&mut self) {
        self.steps.clear();
        self.stamps_ns.clear();
        self.filter.clear_buffer();
    }

    /// Takes the newest step with the steps before it. From numbers that are not finite nothing is learned, nor from a vehicle that stands ([`Predictor::stands`]).
    ///
    /// Nor without a map: where the slope of the ground is a guess, its error would be taken for soil. For the same reason a buffer with a wheel off the map
    /// is left out. Whether sensors contradict each other is told of any buffer. No buffer holds a step in which the vehicle sets off ([`Predictor::sets_off`]).
    pub(super) fn step(
        &mut self,
        models: Models<'_>,
        before: &[HistoryStep],
        (stamp_ns, newest): Stamped,
        map: Option<&Arc<WorldMap>>,
    ) -> Option<Judged> {
        if models.usual.sets_off(before, &newest) {
            self.forget_open();
            return None;
        }
        if self.steps.is_empty() {
            self.steps.extend_from_slice(&before[before.len().saturating_sub(HISTORY - 1)..]);
            self.first = self.steps.len();
        }
        self.steps.push(newest);
        self.stamps_ns.push(stamp_ns);
        if self.steps.len() <= self.first + self.filter.config().buffer {
            return None;
        }
        let standing = Predictor::stands(&self.steps[self.first..]);
        let learned = map.filter(|_| !standing).and_then(|map| self.learn_from_buffer(models, map));
        self.filter.clear_buffer();
        let judged = self.judged(models.usual, learned, standing);
        // The end of this buffer is the start of the next.
        self.steps.drain(..self.steps.len().saturating_sub(HISTORY));
        self.first = self.steps.len() - 1;
        self.stamps_ns.drain(..self.stamps_ns.len().saturating_sub(1));
        Some(judged)
    }

    /// The full buffer with what was learned from it.
    fn judged(&self, predictor: &Predictor, learned: Option<Learned>, standing: bool) -> Judged {
        let (first, last) = (self.first, self.steps.len() - 1);
        let states: Vec<_> = self.steps[first..=last].iter().map(|step| predictor.true_state(&step.state)).collect();
        let step_s = |k: usize| seconds(self.stamps_ns[k + 1].saturating_sub(self.stamps_ns[k]));
        let (contradiction, unseen) = (contradiction(&states, step_s), unseen(&states, step_s));
        let stamps_ns = [self.stamps_ns[0], self.stamps_ns[last - first]];
        Judged { stamps_ns, learned, contradiction, unseen, standing }
    }

    /// What the filter makes of the full buffer.
    fn learn_from_buffer(&mut self, models: Models<'_>, map: &Arc<WorldMap>) -> Option<Learned> {
        let (first, last) = (self.first, self.steps.len() - 1);
        let buffer = self.transitions(models.usual, map)?;
        let shifted = models.shifted.iter().map(|model| self.transitions(model, map).map(|buffer| (model.step_model(), buffer)));
        let shifted: Vec<_> = shifted.collect::<Option<_>>()?;
        let considered = self.filter.consider(models.usual.step_model(), &buffer, &shifted);
        self.noted(considered)?;
        let log_odds = self.filter.snapshot().trust_log_odds;
        let mut update = None;
        for buffered in buffer {
            let pushed = self.filter.push(models.usual.step_model(), buffered);
            update = self.noted(pushed)?;
        }
        let update = update?;
        let [x, y, _] = self.steps[(first + last) / 2].state.position_m;
        // A buffer that told nothing left the estimate as it was: it brings nothing, and no vote.
        let told = update.excited && !update.rejected;
        let increment = told.then(|| self.increment(&update.before, log_odds)).and_then(|increment| self.noted(increment));
        let brought = increment.map(|increment| Brought { position_m: [x, y], increment });
        Some(Learned { update, brought })
    }

    /// The transitions of the full buffer as a predictor sees them.
    fn transitions(&self, predictor: &Predictor, map: &Arc<WorldMap>) -> Option<Vec<BufferedTransition>> {
        let (first, last) = (self.first, self.steps.len() - 1);
        let along = (self.filter.config().innovation == Innovation::Rollout).then(|| SoilByClass::new(Some(map), self.filter.estimates()));
        let along = along.as_ref().map(|soil| soil as &dyn SoilField);
        let transitions = predictor.measured_transitions(&self.steps, first..last, along, map)?;
        let buffered = transitions.into_iter().zip(&self.steps[first + 1..]).map(|(transition, end)| {
            let [x, y, _] = transition.input.state.position_m;
            let ground_class = SoilByClass::class_at(Some(map), [x, y]);
            let end = predictor.true_state(&end.state);
            let seen = BufferedTransition::new(transition.input, transition.residual, &end);
            BufferedTransition { observed_share: transition.observed_share, ground_class, ..seen }
        });
        Some(buffered.collect())
    }

    /// What the last update knows more than was believed before it, and how it voted on whether the correction helps.
    fn increment(&self, before: &ClassBelief, log_odds: f64) -> Result<Increment, FleetSoilError> {
        let (after, config) = (self.filter.snapshot(), self.filter.config());
        let kept = 1.0 - 1.0 / config.trust_memory.max(1.0);
        let over = |log_odds: f64| log_odds - config.trust_log_odds;
        let vote = if config.trust_memory > 0.0 { over(after.trust_log_odds) - kept * over(log_odds) } else { 0.0 };
        Increment::between(&soil_belief(before), &soil_belief(&self.filter.belief()), vote)
    }

    /// Begins from what the fleet knows. Says whether it does.
    pub(super) fn begin_from(&mut self, prior: &FleetPrior) -> bool {
        let belief = ClassBelief { delta: prior.belief.delta, covariance: prior.belief.covariance };
        let log_odds = self.filter.config().trust_log_odds + prior.votes.clamp(-VOTES_MAX, VOTES_MAX);
        let begun = self.filter.begun_from(&belief, log_odds);
        self.noted(begun).flatten().map(|filter| self.filter = filter).is_some()
    }

    /// Covariance as the filter gives it out, its own with trust and scale.
    pub(super) fn covariance(&self) -> [[f64; SOIL_DIM]; SOIL_DIM] {
        self.filter.posterior().covariance
    }

    /// The soil that predictions meet: the posterior of every class of ground that the map tells apart.
    pub(super) fn field(&self, map: Option<&Arc<WorldMap>>) -> SoilByClass {
        SoilByClass::new(map, self.corrections())
    }

    /// The corrections of all classes of ground as predictions use them.
    pub(super) fn corrections(&self) -> Vec<SoilCorrection> {
        self.filter.posteriors().iter().map(|p| p.correction).collect()
    }

    /// What the filter says now of the ground under the vehicle.
    pub(super) fn state(&self, epoch: u64, stamp_ns: Option<i64>) -> SoilState {
        let posterior = self.filter.posterior();
        SoilState {
            epoch,
            stamp_ns,
            correction: posterior.correction,
            variance: Some(core::array::from_fn(|i| posterior.covariance[i][i])),
            learned: posterior.learned,
            last_buffer: None,
        }
    }
}

fn soil_belief(belief: &ClassBelief) -> SoilBelief {
    SoilBelief { delta: belief.delta, covariance: belief.covariance }
}
