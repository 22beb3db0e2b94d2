//! What a session learns of the soil: the filter and the transition that waits for its end.

use std::sync::Arc;

use nesam_adaptation::{BufferedTransition, SoilFilter, SoilUpdate};
use nesam_model::{HistoryStep, Predictor};
use nesam_physics::{SOIL_DIM, SoilCorrection, VehicleState};
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
    /// The transition from the newest step; its end is not measured yet.
    open: Option<BufferedTransition>,
}

impl SoilLearner {
    pub(super) fn new(filter: SoilFilter) -> Self {
        Self { filter, open: None }
    }

    /// The next step does not follow the last one.
    pub(super) fn forget_open(&mut self) {
        self.open = None;
        self.filter.clear_buffer();
    }

    /// Takes the newest step with the steps before it. Numbers that are not finite end in an empty buffer and nothing else.
    ///
    /// Without a map nothing is learned: where the slope of the ground is a guess, its error would be taken for soil.
    pub(super) fn step(
        &mut self,
        predictor: &Predictor,
        before: &[HistoryStep],
        newest: &HistoryStep,
        map: Option<&Arc<WorldMap>>,
    ) -> Option<SoilUpdate> {
        let map = map?;
        let update = self.open.take().and_then(|open| {
            let transition = BufferedTransition { measured_next: velocities(&newest.state), ..open };
            self.filter.push(predictor.step_model(), transition).unwrap_or(None)
        });
        let next = predictor.transition(before, &newest.state, &newest.control, Some(map));
        if next.ground_known {
            self.open = Some(BufferedTransition { input: next.input, residual: next.residual, measured_next: [0.0; 6] });
        } else {
            self.filter.clear_buffer(); // with a wheel off the map the ground there is a guess
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
        }
    }
}

/// y = [v, ω] in Body.
fn velocities(state: &VehicleState<f64>) -> [f64; 6] {
    let ([vx, vy, vz], [wx, wy, wz]) = (state.velocity_m_s, state.angular_velocity_rad_s);
    [vx, vy, vz, wx, wy, wz]
}
