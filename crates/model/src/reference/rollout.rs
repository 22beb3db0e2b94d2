//! The K-step rollout as candle tensors, differentiable end to end (paper Eq. 1-3).
//!
//! Terrain tokens come from a provider, because training looks them up among precomputed poses and inference on a pose grid. Poses are
//! detached there: no gradient flows through the choice of the patch, nor through the height of the ground under a wheel.

use std::sync::Arc;

use candle_core::{Device, Result, Tensor};
use nesam_physics::driveline::{DrivelineState, command_wheels};
use nesam_physics::step::StepModel;
use nesam_physics::{Control, STATE_DIM, VehicleState, wrap_angle};
use rayon::prelude::*;

use super::network::{KvCache, Network, causal_mask, soil_from_raw};
use super::physics_op::physics_increment;
use crate::Normalization;
use crate::dims::*;
use crate::ground::GroundSource;
use crate::rollout::{HistoryStep, Variant};
use crate::step_row::{CONSTANT, pack_constants};
use crate::symbolic::residual_share;
use crate::token::token_entries;

/// One row of a batch.
#[derive(Clone, Debug)]
pub struct Row<'a> {
    /// Past steps, oldest first; all rows of a batch have the same number.
    pub history: Vec<HistoryStep>,
    /// Start state.
    pub start: VehicleState<f64>,
    /// Commands of the K steps.
    pub controls: Vec<Control<f64>>,
    /// Actuators at the start.
    pub actuators: DrivelineState,
    /// Ground.
    pub ground: GroundSource<'a>,
}

/// Where terrain tokens come from.
pub trait TerrainProvider {
    /// W_c c of the history tokens, (batch · tokens, 128), row by row, oldest first.
    ///
    /// # Errors
    /// A candle error.
    fn history(&mut self) -> Result<Tensor>;
    /// W_c c (batch, 128) and raw soil (batch, 6) at the poses (x, y in World m, yaw rad) of the rows before step `k`.
    ///
    /// # Errors
    /// A candle error.
    fn at(&mut self, k: usize, states: &[VehicleState<f64>]) -> Result<(Tensor, Tensor)>;
}

/// Predicted state of every row after one step, relative to its start: x and y from the start position, z from the start height.
#[derive(Clone, Debug)]
pub struct PredictedStep {
    /// (batch, 12): x, y relative (m), z relative (m), roll, pitch, yaw (absolute, not wrapped), velocities in Body.
    pub state: Tensor,
    /// (batch, 12): what the network added to this step, in the raw units of `Normalization::residual_scale`; `None` in a form without residual.
    pub residual: Option<Tensor>,
}

/// A rollout in progress.
pub struct ReferenceRollout<'a> {
    /// Network.
    pub network: &'a Network,
    /// Physics.
    pub model: &'a Arc<StepModel>,
    /// Scales.
    pub scales: &'a Normalization,
    /// Form.
    pub variant: Variant,
}

/// Columns `from .. from + n`.
fn columns(x: &Tensor, from: usize, n: usize) -> Result<Tensor> {
    x.narrow(1, from, n)
}

fn rows_tensor<const N: usize>(rows: &[[f32; N]], device: &Device) -> Result<Tensor> {
    Tensor::from_slice(rows.as_flattened(), (rows.len(), N), device)
}

impl ReferenceRollout<'_> {
    /// Predicts `horizon` steps of every row.
    ///
    /// # Errors
    /// A candle error, also of the provider.
    pub fn run(&self, rows: &[Row<'_>], horizon: usize, provider: &mut dyn TerrainProvider) -> Result<Vec<PredictedStep>> {
        let remembers = self.variant.remembers();
        let mut cache = if remembers { self.prefill(rows, provider)? } else { KvCache::new() };
        let mut states: Vec<VehicleState<f64>> = rows.iter().map(|r| r.start).collect();
        let mut previous: Vec<Option<VehicleState<f64>>> = rows.iter().map(|r| r.history.last().map(|h| h.state)).collect();
        let mut actuators: Vec<DrivelineState> = rows.iter().map(|r| r.actuators).collect();
        let start: Vec<[f32; STATE_DIM]> = rows
            .iter()
            .map(|r| {
                let mut x = r.start.to_array();
                x[..3].fill(0.0);
                x.map(|v| v as f32)
            })
            .collect();
        let mut state = rows_tensor(&start, self.network.device())?;
        let mut last_increment: Option<Tensor> = None;
        let first_position = HISTORY - 1;
        let mut steps = Vec::with_capacity(horizon);
        for k in 0..horizon {
            let controls: Vec<Control<f64>> = rows.iter().map(|r| r.controls[k]).collect();
            let entries = self.entries(rows, &states, &previous, &controls, &state, last_increment.as_ref())?;
            let (context, raw_soil) = provider.at(k, &states)?;
            let position = if remembers { first_position + k } else { first_position };
            let token = self.network.embed(&entries, &context)?.broadcast_add(&self.network.positions(position, 1)?)?;
            if !remembers {
                cache.clear();
            }
            let hidden = self.network.transformer(&token.unsqueeze(1)?, &mut cache, None)?.squeeze(1)?;
            let (raw_sinkage, raw_residual) = self.network.heads(&hidden)?;

            let of_row = |(b, actuators): (usize, &mut DrivelineState)| {
                let (row, state, control) = (&rows[b], &states[b], &controls[b]);
                let after = actuators.advance(self.model.vehicle(), control, state.velocity_m_s[0], self.scales.dt_s);
                let wheels = command_wheels(self.model.vehicle(), actuators, &after, control);
                let (ground, _) = row.ground.under_wheels(self.model, state, row.start.position_m[2]);
                *actuators = after;
                pack_constants(&wheels, &ground, state.attitude_rad[2])
            };
            let constants: Vec<[f32; CONSTANT]> = actuators.par_iter_mut().enumerate().map(of_row).collect();
            let residual = self.residual(raw_residual, &controls)?;
            let increment = self.increment(&state, &raw_sinkage, residual.as_ref(), &raw_soil, &constants)?;
            state = advance(&state, &increment)?;
            previous = states.iter().copied().map(Some).collect();
            states = self.to_states(rows, &state)?;
            last_increment = Some(increment);
            steps.push(PredictedStep { state: state.clone(), residual });
        }
        Ok(steps)
    }

    /// Encodes the history of every row.
    fn prefill(&self, rows: &[Row<'_>], provider: &mut dyn TerrainProvider) -> Result<KvCache> {
        let mut cache = KvCache::new();
        let tokens = rows[0].history.len();
        if tokens == 0 {
            return Ok(cache);
        }
        let of_row = |row: &Row<'_>| -> Vec<[f32; STATE_CONTROL]> {
            let previous = core::iter::once(None).chain(row.history.iter().map(|step| Some(&step.state)));
            row.history
                .iter()
                .zip(previous)
                .map(|(step, previous)| self.scaled_entries(row, &step.state, previous, &step.control))
                .collect()
        };
        let entries: Vec<[f32; STATE_CONTROL]> = rows.par_iter().flat_map_iter(of_row).collect();
        let x = self.network.embed(&rows_tensor(&entries, self.network.device())?, &provider.history()?)?.reshape((
            rows.len(),
            tokens,
            HIDDEN,
        ))?;
        let x = x.broadcast_add(&self.network.positions(HISTORY - 1 - tokens, tokens)?.unsqueeze(0)?)?;
        self.network.transformer(&x, &mut cache, Some(&causal_mask(tokens, self.network.device())?))?;
        Ok(cache)
    }

    fn scaled_entries(
        &self,
        row: &Row<'_>,
        state: &VehicleState<f64>,
        previous: Option<&VehicleState<f64>>,
        control: &Control<f64>,
    ) -> [f32; STATE_CONTROL] {
        let (height, _, _) = row.ground.at(&self.model.vehicle().effects.map, state.position_m[0], state.position_m[1]);
        let known = self.model.as_known(state);
        let entries = token_entries(&known, previous, [control.speed_m_s, control.second], height, self.scales.dt_s);
        self.scales.token_scale().apply(entries)
    }

    /// Token entries (batch, 14) of the current states; differentiable in the predicted state.
    fn entries(
        &self,
        rows: &[Row<'_>],
        states: &[VehicleState<f64>],
        previous: &[Option<VehicleState<f64>>],
        controls: &[Control<f64>],
        state: &Tensor,
        increment: Option<&Tensor>,
    ) -> Result<Tensor> {
        let device = self.network.device();
        let measured: Vec<[f32; STATE_CONTROL]> = (0..rows.len())
            .into_par_iter()
            .map(|b| self.scaled_entries(&rows[b], &states[b], previous[b].as_ref(), &controls[b]))
            .collect();
        let measured = rows_tensor(&measured, device)?;
        let Some(increment) = increment else { return Ok(measured) };
        // Same numbers as `measured`, but as functions of the prediction; only z enters relative to the ground.
        let height: Vec<f32> = (0..rows.len())
            .map(|b| {
                let effects = &self.model.vehicle().effects.map;
                let (ground, _, _) = rows[b].ground.at(effects, states[b].position_m[0], states[b].position_m[1]);
                (ground - rows[b].start.position_m[2]) as f32
            })
            .collect();
        let height = Tensor::from_vec(height, (rows.len(), 1), device)?;
        let parts = [
            (columns(state, 2, 1)? - height)?,
            columns(state, 3, 2)?,
            columns(increment, 5, 1)?,
            columns(state, 6, 6)?,
            columns(increment, 0, 2)?,
        ];
        let raw = Tensor::cat(&parts, 1)?;
        let mut mean: Vec<f32> = self.scales.token_mean[..STATE_DIM].to_vec();
        mean.iter_mut().zip(self.model.ride_shift()).for_each(|(mean, shift)| *mean += *shift as f32);
        let mean = Tensor::from_vec(mean, (1, STATE_DIM), device)?;
        let scale = Tensor::from_slice(&self.scales.token_scale[..STATE_DIM], (1, STATE_DIM), device)?;
        let scaled = raw.broadcast_sub(&mean)?.broadcast_div(&scale)?;
        Tensor::cat(&[scaled, columns(&measured, STATE_DIM, CONTROL_DIM)?], 1)
    }

    /// What is added of the raw residual (batch, 12) under these commands.
    fn residual(&self, raw: Tensor, controls: &[Control<f64>]) -> Result<Option<Tensor>> {
        if self.variant == Variant::NoResidual {
            return Ok(None);
        }
        let shares: Vec<f32> =
            controls.iter().map(|c| residual_share(self.variant, self.scales.trained_speed_m_s[0], c.speed_m_s) as f32).collect();
        if shares.iter().all(|share| *share == 1.0) {
            return Ok(Some(raw));
        }
        let shares = Tensor::from_vec(shares, (controls.len(), 1), raw.device())?;
        raw.broadcast_mul(&shares).map(Some)
    }

    /// Δx_NE + Δx_res (batch, 12).
    fn increment(
        &self,
        state: &Tensor,
        raw_sinkage: &Tensor,
        raw_residual: Option<&Tensor>,
        raw_soil: &Tensor,
        constants: &[[f32; CONSTANT]],
    ) -> Result<Tensor> {
        let ratio = match self.variant {
            Variant::ZeroSinkage => (raw_sinkage.zeros_like()? - 12.0)?,
            _ => (raw_sinkage.tanh()? * f64::from(self.scales.sinkage_log_ratio_max))?,
        };
        let constants = rows_tensor(constants, state.device())?;
        let packed = Tensor::cat(&[columns(state, 2, 3)?, columns(state, 6, 6)?, ratio, soil_from_raw(raw_soil)?, constants], 1)?;
        // z, roll, pitch are columns 2..5; yaw (5) does not enter the step.
        let symbolic = physics_increment(&packed, self.variant, self.model)?;
        let Some(raw_residual) = raw_residual else { return Ok(symbolic) };
        let scale = Tensor::from_slice(&self.scales.residual_scale, (1, STATE_DIM), state.device())?;
        symbolic + raw_residual.broadcast_mul(&scale)?
    }

    /// Predicted tensors as states in World, for the look-ups on the host.
    fn to_states(&self, rows: &[Row<'_>], state: &Tensor) -> Result<Vec<VehicleState<f64>>> {
        let values: Vec<Vec<f32>> = state.to_vec2()?;
        Ok(values
            .iter()
            .zip(rows)
            .map(|(x, row)| {
                let mut next: [f64; STATE_DIM] = core::array::from_fn(|i| f64::from(x[i]));
                for (next, origin_m) in next.iter_mut().zip(row.start.position_m) {
                    *next += origin_m;
                }
                next[5] = wrap_angle(next[5]);
                VehicleState::from_array(next)
            })
            .collect())
    }
}

/// x' = x + Δx with the displacement turned from the heading frame into World.
fn advance(state: &Tensor, increment: &Tensor) -> Result<Tensor> {
    let yaw = columns(state, 5, 1)?;
    let (sin, cos) = (yaw.sin()?, yaw.cos()?);
    let (ahead, left) = (columns(increment, 0, 1)?, columns(increment, 1, 1)?);
    let moved = Tensor::cat(&[((&cos * &ahead)? - (&sin * &left)?)?, ((&sin * &ahead)? + (&cos * &left)?)?], 1)?;
    let change = Tensor::cat(&[moved, columns(increment, 2, STATE_DIM - 2)?], 1)?;
    state + change
}
