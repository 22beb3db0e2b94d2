//! What a session learns of the soil: the filter and the transition that waits for its end.

use std::sync::Arc;

use nesam_adaptation::{BufferedTransition, ClassBelief, Innovation, SoilFilter, SoilUpdate};
use nesam_fleet_soil::{FleetPrior, Increment, SoilBelief};
use nesam_model::{HISTORY, HistoryStep, Predictor, SoilByClass, SoilField};
use nesam_physics::{SOIL_DIM, SoilCorrection};
use nesam_terrain::WorldMap;

use crate::fleet::Brought;

/// What the fleet may say at most on whether the correction helps, log odds: a vehicle that finds it wrong unlearns it within a few buffers. Chosen.
const VOTES_MAX: f64 = 4.0;

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
    /// Whether the drive has told something of each parameter.
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
    /// Variance of a corrected soil in physical units squared, to first order.
    pub fn variance_at(&self, soil: &[f64; SOIL_DIM]) -> Option<[f64; SOIL_DIM]> {
        let slope = self.correction.coordinates.slope(soil);
        self.variance.map(|variance| core::array::from_fn(|i| slope[i] * slope[i] * variance[i]))
    }
}

/// The soil filter of one session. What a step says of the soil is known when the next one is measured.
#[derive(Clone, Debug)]
pub(super) struct SoilLearner {
    filter: SoilFilter,
    /// Up to 31 steps of history, then the steps of the buffer that fills; empty before the first.
    steps: Vec<HistoryStep>,
    /// Place in `steps` where the buffer begins.
    first: usize,
}

impl SoilLearner {
    pub(super) fn new(filter: SoilFilter) -> Self {
        Self { filter, steps: Vec::new(), first: 0 }
    }

    /// The filter, the steps that it holds, and where its open buffer begins among them.
    pub(super) fn parts(&self) -> (&SoilFilter, &[HistoryStep], usize) {
        (&self.filter, &self.steps, if self.steps.is_empty() { 0 } else { self.first })
    }

    /// The inverse of [`SoilLearner::parts`].
    pub(super) fn from_parts(filter: SoilFilter, steps: Vec<HistoryStep>, first: usize) -> Self {
        Self { filter, steps, first }
    }

    /// The next step does not follow the last one.
    pub(super) fn forget_open(&mut self) {
        self.steps.clear();
        self.filter.clear_buffer();
    }

    /// Takes the newest step with the steps before it. Numbers that are not finite end in an empty buffer and nothing else.
    ///
    /// Without a map nothing is learned: where the slope of the ground is a guess, its error would be taken for soil. For the same reason a buffer
    /// with a wheel off the map is left out.
    pub(super) fn step(
        &mut self,
        predictor: &Predictor,
        before: &[HistoryStep],
        newest: &HistoryStep,
        map: Option<&Arc<WorldMap>>,
    ) -> Option<(SoilUpdate, Option<Brought>)> {
        let Some(map) = map else {
            self.forget_open();
            return None;
        };
        if self.steps.is_empty() {
            self.steps.extend_from_slice(&before[before.len().saturating_sub(HISTORY - 1)..]);
            self.first = self.steps.len();
        }
        self.steps.push(*newest);
        if self.steps.len() <= self.first + self.filter.config().buffer {
            return None;
        }
        let update = self.learn_from_buffer(predictor, map);
        self.filter.clear_buffer();
        // The end of this buffer is the start of the next.
        self.steps.drain(..self.steps.len().saturating_sub(HISTORY));
        self.first = self.steps.len() - 1;
        update
    }

    /// The update of the full buffer and, where it was not refused, what it knows more than its prior.
    fn learn_from_buffer(&mut self, predictor: &Predictor, map: &Arc<WorldMap>) -> Option<(SoilUpdate, Option<Brought>)> {
        let (first, last) = (self.first, self.steps.len() - 1);
        let along = (self.filter.config().innovation == Innovation::Rollout).then(|| SoilByClass::new(Some(map), self.filter.estimates()));
        let along = along.as_ref().map(|soil| soil as &dyn SoilField);
        let transitions = predictor.measured_transitions(&self.steps, first..last, along, map)?;
        let (predicted, log_odds) = (self.filter.predicted_beliefs(), self.filter.snapshot().trust_log_odds);
        let mut update = None;
        for (transition, end) in transitions.into_iter().zip(&self.steps[first + 1..]) {
            let [x, y, _] = transition.input.state.position_m;
            let ground_class = SoilByClass::class_at(Some(map), [x, y]);
            let end = predictor.true_state(&end.state);
            let buffered = BufferedTransition { ground_class, ..BufferedTransition::new(transition.input, transition.residual, &end) };
            update = self.filter.push(predictor.step_model(), buffered).ok()?;
        }
        let update = update?;
        let [x, y, _] = self.steps[(first + last) / 2].state.position_m;
        let increment = if update.rejected { None } else { self.increment(&predicted, log_odds) };
        Some((update, increment.map(|increment| Brought { position_m: [x, y], increment })))
    }

    /// What the last update knows more than it was predicted, and how it voted on whether the correction helps.
    fn increment(&self, predicted: &[ClassBelief], log_odds: f64) -> Option<Increment> {
        let (after, config) = (self.filter.snapshot(), self.filter.config());
        let kept = 1.0 - 1.0 / config.trust_memory.max(1.0);
        let over = |log_odds: f64| log_odds - config.trust_log_odds;
        let vote = if config.trust_memory > 0.0 { over(after.trust_log_odds) - kept * over(log_odds) } else { 0.0 };
        let prior = predicted.get(after.ground_class).or(predicted.first())?;
        Increment::between(&soil_belief(prior), &soil_belief(&self.filter.belief()), vote).ok()
    }

    /// Begins from what the fleet knows. Says whether it does.
    pub(super) fn begin_from(&mut self, prior: &FleetPrior) -> bool {
        let belief = ClassBelief { delta: prior.belief.delta, covariance: prior.belief.covariance };
        let log_odds = self.filter.config().trust_log_odds + prior.votes.clamp(-VOTES_MAX, VOTES_MAX);
        self.filter.begun_from(&belief, log_odds).map(|filter| self.filter = filter).is_some()
    }

    /// P⁺ as the filter gives it out.
    pub(super) fn covariance(&self) -> [[f64; SOIL_DIM]; SOIL_DIM] {
        self.filter.posterior().covariance
    }

    /// The soil that predictions meet: the posterior of every class of ground that the map tells apart.
    pub(super) fn field(&self, map: Option<&Arc<WorldMap>>) -> SoilByClass {
        SoilByClass::new(map, self.filter.posteriors().iter().map(|p| p.correction).collect())
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
