//! The reference behind the queries of the predictor: what the fast path is held against, and what a GPU can answer.

use std::sync::Arc;

use candle_core::{Result, Tensor};
use nesam_physics::step::StepModel;
use nesam_physics::{Control, SOIL_DIM, STATE_DIM, SoilCorrection, VehicleState, wrap_angle};
use nesam_terrain::{Pose2, WorldMap};

use super::device::ComputeDevice;
use super::network::Network;
use super::rollout::{ReferenceRollout, Row, TerrainProvider};
use crate::dims::{HIDDEN, HISTORY};
use crate::ground::{GroundSource, history_actuators};
use crate::predictor::Predictor;
use crate::rollout::{HistoryStep, RolloutQuery, Variant};
use crate::{ModelError, TerrainToken};

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
    /// `ModelError::Query` when the query corrects the soil, which the reference does not know; a candle error.
    pub fn rollout(&self, query: &RolloutQuery<'_>) -> std::result::Result<Vec<f32>, ModelError> {
        if query.soil_correction != SoilCorrection::NONE {
            return Err(ModelError::Query { field: "soil_correction", reason: "the reference knows none".into() });
        }
        let bundle = self.predictor.bundle();
        let variant = if query.variant == Variant::Full { bundle.form } else { query.variant };
        let ground = GroundSource::new(query.map.map(Arc::as_ref), &self.model, &query.start);
        let history = remembered(query);
        let row = |commands: &[f32]| {
            let command = |c: &[f32]| Control { speed_m_s: f64::from(c[0]), second: f64::from(c[1]) };
            let controls: Vec<Control<f64>> = commands.chunks_exact(2).map(command).collect();
            let dt_s = bundle.normalization.dt_s;
            Row {
                actuators: history_actuators(&self.model, history, &query.start, &controls[0], dt_s),
                history: history.to_vec(),
                start: query.start,
                controls,
                ground,
            }
        };
        let rows: Vec<Row<'_>> = query.controls.chunks_exact(2 * query.horizon).map(row).collect();
        let rollout = ReferenceRollout { network: &self.network, model: &self.model, scales: &bundle.normalization, variant };
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

/// The part of a query's history that the network has positions for.
fn remembered<'a>(query: &RolloutQuery<'a>) -> &'a [HistoryStep] {
    &query.history[query.history.len().saturating_sub(HISTORY - 1)..]
}

/// Terrain tokens as the fast path sees them.
struct Tokens<'a> {
    reference: &'a ReferencePredictor,
    query: &'a RolloutQuery<'a>,
}

impl Tokens<'_> {
    fn tensors(&self, states: impl Iterator<Item = VehicleState<f64>>) -> Result<(Tensor, Tensor)> {
        let pose = |s: VehicleState<f64>| Pose2 { x_m: s.position_m[0], y_m: s.position_m[1], yaw_rad: s.attitude_rad[2] };
        let map: Option<&Arc<WorldMap>> = self.query.map;
        let tokens: Vec<TerrainToken> = self.reference.predictor.terrain_tokens(map, &states.map(pose).collect::<Vec<_>>());
        let device = self.reference.network.device();
        let context: Vec<f32> = tokens.iter().flat_map(|token| &token[..HIDDEN]).copied().collect();
        let soil: Vec<f32> = tokens.iter().flat_map(|token| &token[HIDDEN..]).copied().collect();
        Ok((Tensor::from_vec(context, (tokens.len(), HIDDEN), device)?, Tensor::from_vec(soil, (tokens.len(), SOIL_DIM), device)?))
    }
}

impl TerrainProvider for Tokens<'_> {
    fn history(&mut self) -> Result<Tensor> {
        // The same for every candidate.
        let (context, _) = self.tensors(remembered(self.query).iter().map(|step| step.state))?;
        context.repeat((self.query.samples, 1))
    }

    fn at(&mut self, _k: usize, states: &[VehicleState<f64>]) -> Result<(Tensor, Tensor)> {
        self.tensors(states.iter().copied())
    }
}
