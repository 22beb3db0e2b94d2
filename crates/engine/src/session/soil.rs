//! What a session learns of the soil: the filter and the transition that waits for its end.

use std::sync::Arc;

use nesam_adaptation::{BufferedTransition, Innovation, SoilFilter, SoilUpdate};
use nesam_model::{HISTORY, HistoryStep, Predictor};
use nesam_physics::{SOIL_DIM, SoilCorrection};
use nesam_terrain::WorldMap;

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
    ) -> Option<SoilUpdate> {
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

    fn learn_from_buffer(&mut self, predictor: &Predictor, map: &Arc<WorldMap>) -> Option<SoilUpdate> {
        let (first, last) = (self.first, self.steps.len() - 1);
        let along = (self.filter.config().innovation == Innovation::Rollout).then(|| self.filter.estimate());
        let transitions = predictor.measured_transitions(&self.steps, first..last, along.as_ref(), map)?;
        let mut update = None;
        for (transition, end) in transitions.into_iter().zip(&self.steps[first + 1..]) {
            let buffered = BufferedTransition::new(transition.input, transition.residual, &end.state);
            update = self.filter.push(predictor.step_model(), buffered).ok()?;
        }
        update
    }

    /// What the filter says now.
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
