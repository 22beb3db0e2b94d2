//! The reference behind the queries of the predictor: what the fast path is held against, and what a GPU can answer.

use std::sync::Arc;

use candle_core::{Result, Tensor};
use nesam_physics::step::StepModel;
use nesam_physics::{Control, SOIL_DIM, STATE_DIM, SoilCorrection, VehicleState, wrap_angle};

use super::device::ComputeDevice;
use super::network::Network;
use super::rollout::{ReferenceRollout, Row, TerrainProvider};
use crate::ModelError;
use crate::dims::HIDDEN;
use crate::ground::{GroundSource, history_actuators};
use crate::predictor::{Predictor, control, pose, validate};
use crate::rollout::{RolloutQuery, remembered};

/// A predictor whose network is made of candle tensors; terrain tokens are those of the fast path.
pub struct ReferencePredictor {
    predictor: Predictor,
    network: Network,
    model: Arc<StepModel>,
}

impl ReferencePredictor {
    /// The network of a predictor on a device.
    ///
    /// # Errors
    /// `ModelError::Device` when there is no such device, `ModelError::Query` when the bundle carries effects, which the reference does not know.
    pub fn new(predictor: &Predictor, device: ComputeDevice) -> std::result::Result<Self, ModelError> {
        let bundle = predictor.bundle();
        if !bundle.effects.is_empty() {
            return Err(ModelError::Query { field: "bundle", reason: "the reference knows no effects".into() });
        }
        Ok(Self {
            network: Network::from_weights(&bundle.weights, &device.open()?)?,
            model: Arc::new(predictor.step_model().clone()),
            predictor: predictor.clone(),
        })
    }

    /// States of every candidate after each step, (samples, horizon, 12), as [`crate::Rollout::states`].
    ///
    /// # Errors
    /// As [`Predictor::rollout`]; `ModelError::Query` also when the query corrects the soil or gives measured wheels, which the reference does not know; a
    /// candle error.
    pub fn rollout(&self, query: &RolloutQuery<'_>) -> std::result::Result<Vec<f32>, ModelError> {
        validate(query)?;
        for (field, known) in [("soil_correction", query.soil_correction == SoilCorrection::NONE), ("wheels", query.wheels.is_none())] {
            if !known {
                return Err(ModelError::Query { field, reason: "the reference knows none".into() });
            }
        }
        let (scales, variant) = (&self.predictor.bundle().normalization, self.predictor.form_of(query));
        let ground = GroundSource::new(query.map.map(Arc::as_ref), &self.model, &query.start);
        let history = remembered(query.history);
        let row = |sample: usize| {
            let controls: Vec<Control<f64>> = (0..query.horizon).map(|k| control(query, sample, k)).collect();
            Row {
                actuators: history_actuators(&self.model, history, &query.start, &controls[0], scales.dt_s),
                history: history.to_vec(),
                start: query.start,
                controls,
                ground,
            }
        };
        let rows: Vec<Row<'_>> = (0..query.samples).map(row).collect();
        let rollout = ReferenceRollout { network: &self.network, model: &self.model, scales, variant };
        let steps = rollout.run(&rows, query.horizon, &mut Tokens { reference: self, query })?;
        let mut states = vec![0f32; rows.len() * query.horizon * STATE_DIM];
        for (k, step) in steps.iter().enumerate() {
            for (row, relative) in step.state.to_vec2::<f32>()?.into_iter().enumerate() {
                let state = &mut states[(row * query.horizon + k) * STATE_DIM..][..STATE_DIM];
                state.copy_from_slice(&relative);
                state.iter_mut().zip(query.start.position_m).for_each(|(value, origin_m)| *value += origin_m as f32);
                state[5] = wrap_angle(f64::from(state[5])) as f32;
            }
        }
        Ok(states)
    }
}

/// Terrain tokens as the fast path sees them.
struct Tokens<'a> {
    reference: &'a ReferencePredictor,
    query: &'a RolloutQuery<'a>,
}

impl Tokens<'_> {
    fn tensors<'s>(&self, states: impl Iterator<Item = &'s VehicleState<f64>>) -> Result<(Tensor, Tensor)> {
        let tokens = self.reference.predictor.terrain_tokens(self.query.map, &states.map(pose).collect::<Vec<_>>());
        let device = self.reference.network.device();
        let context: Vec<f32> = tokens.iter().flat_map(|token| &token[..HIDDEN]).copied().collect();
        let soil: Vec<f32> = tokens.iter().flat_map(|token| &token[HIDDEN..]).copied().collect();
        Ok((Tensor::from_vec(context, (tokens.len(), HIDDEN), device)?, Tensor::from_vec(soil, (tokens.len(), SOIL_DIM), device)?))
    }
}

impl TerrainProvider for Tokens<'_> {
    fn history(&mut self) -> Result<Tensor> {
        // The same for every candidate.
        let (context, _) = self.tensors(remembered(self.query.history).iter().map(|step| &step.state))?;
        context.repeat((self.query.samples, 1))
    }

    fn at(&mut self, _k: usize, states: &[VehicleState<f64>]) -> Result<(Tensor, Tensor)> {
        self.tensors(states.iter())
    }
}
