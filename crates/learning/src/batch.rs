//! A batch of training windows: rows for the reference rollout, targets, and terrain tokens along the driven paths.

use std::collections::HashMap;
use std::ops::Range;

use candle_core::backprop::GradStore;
use candle_core::{DType, Device, Result, Tensor, Var};
use half::f16;
use nesam_model::dims::{CONTEXT, FEATURE_CHANNELS, FEATURE_PX, FEATURES, HIDDEN};
use nesam_model::reference::{Network, PredictedStep, Row, TerrainProvider};
use nesam_model::{GroundSource, Normalization, Variant, history_actuators};
use nesam_physics::step::StepModel;
use nesam_physics::{SOIL_DIM, STATE_DIM, VehicleState, wrap_angle};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::class_soil::ClassSoil;
use crate::drives::{Drive, Place};
use crate::features::{At, gather};
use crate::pooling::Pooling;

/// Samples past the window in which a fast prediction may find its place.
const AHEAD: usize = 8;

/// A window: drive, start sample, horizon and history.
#[derive(Clone, Copy, Debug)]
pub struct Window<'a> {
    /// Drive.
    pub drive: &'a Drive,
    /// Start sample i; prediction starts from its measured state.
    pub start: usize,
    /// Terrain features left out of the whole window, so that no drive is recognised by a few of them; `None` = all stay.
    pub dropout: Option<Dropout>,
}

/// Features that a window is trained without (Srivastava et al. 2014).
#[derive(Clone, Copy, Debug)]
pub struct Dropout {
    /// Share left out, 0..1.
    pub share: f32,
    /// Seed of the choice.
    pub seed: u64,
}

impl Dropout {
    /// Factor of each of `n` features: 0, or what keeps the mean.
    fn factors(&self, n: usize) -> Vec<f32> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let kept = 1.0 / (1.0 - self.share);
        (0..n).map(|_| if rng.random::<f32>() < self.share { 0.0 } else { kept }).collect()
    }
}

/// What of the terrain a form reads, and how.
#[derive(Clone, Copy, Debug)]
pub struct Sight<'a> {
    /// Form.
    pub variant: Variant,
    /// Sharing of W_c.
    pub pooling: &'a Pooling,
    /// Soil where there is no map, raw.
    pub default_soil: [f32; SOIL_DIM],
}

impl Sight<'_> {
    /// Factor of each pooled feature in a window; `None` = one for all.
    fn factors(&self, dropout: Option<Dropout>) -> Option<Vec<f32>> {
        let unseen = self.variant.unseen();
        if dropout.is_none() && unseen.is_empty() {
            return None;
        }
        let width = self.pooling.width();
        let mut factors = dropout.map_or_else(|| vec![1.0; width], |dropout| dropout.factors(width));
        factors[unseen.start * width / CONTEXT..unseen.end * width / CONTEXT].fill(0.0);
        Some(factors)
    }

    /// W_c for pooled contexts, (128, width).
    fn projection(&self, network: &Network) -> Result<Tensor> {
        if self.pooling.cells() == 1 {
            return Ok(network.token_context().detach());
        }
        let full: Vec<f32> = network.token_context().flatten_all()?.to_vec1()?;
        let pooled = full.chunks_exact(CONTEXT).flat_map(|row| self.pooling.sum(row)).collect();
        Tensor::from_vec(pooled, (HIDDEN, self.pooling.width()), network.device())
    }
}

impl Window<'_> {
    /// Last sample whose context the window may use.
    fn last(&self, horizon: usize) -> usize {
        (self.start + horizon + AHEAD).min(self.drive.states.len() - 1)
    }
}

/// Rows of the rollout.
pub fn rows<'a>(windows: &[Window<'a>], history: usize, horizon: usize, model: &StepModel, dt_s: f64) -> Vec<Row<'a>> {
    windows
        .iter()
        .map(|w| {
            let (drive, i) = (w.drive, w.start);
            let steps = drive.history(i - history, i);
            let start = drive.states[i];
            // Actuators remember longer than the tokens: use all the commands there are, up to the model's full history.
            let actuator_steps = drive.history(i.saturating_sub(nesam_model::HISTORY - 1), i);
            Row {
                actuators: history_actuators(model, &actuator_steps, &start, &drive.controls[i], dt_s),
                history: steps,
                start,
                controls: drive.controls[i..i + horizon].to_vec(),
                ground: GroundSource::new(drive.map.as_deref(), model, &start),
            }
        })
        .collect()
}

/// Measured states after step `k` (0-based) relative to the start, scaled as the predictions are: (batch, 12), yaw unwrapped towards the start.
pub fn targets(windows: &[Window<'_>], k: usize, device: &Device) -> Result<Tensor> {
    let mut values = Vec::with_capacity(windows.len() * STATE_DIM);
    for w in windows {
        let start = w.drive.states[w.start].to_array();
        let mut x = w.drive.states[w.start + k + 1].to_array();
        for i in 0..3 {
            x[i] -= start[i];
        }
        values.extend(x.map(|v| v as f32));
    }
    Tensor::from_vec(values, (windows.len(), STATE_DIM), device)
}

/// Mean over rows of Σ_i (√(1 + e_i²) - 1) with e the scaled error: squared near zero, absolute far out (mean absolute error is what is reported).
pub fn state_loss(predicted: &Tensor, target: &Tensor, scales: &Normalization) -> Result<Tensor> {
    let scale = Tensor::from_slice(&scales.loss_scale, (1, STATE_DIM), predicted.device())?;
    let error = (predicted - target)?;
    // The yaw of a prediction is not wrapped, the measured one is: compare modulo a turn.
    let turns = error.narrow(1, 5, 1)?.detach().affine(1.0 / core::f64::consts::TAU, 0.0)?.round()?;
    let yaw = (error.narrow(1, 5, 1)? - turns.affine(core::f64::consts::TAU, 0.0)?)?;
    let error = Tensor::cat(&[error.narrow(1, 0, 5)?, yaw, error.narrow(1, 6, 6)?], 1)?.broadcast_div(&scale)?;
    ((error.sqr()? + 1.0)?.sqrt()? - 1.0)?.sum(1)?.mean_all()
}

/// Mean over rows of Σ_i r̄_i² with r̄ the mean over the horizon of the raw residual: forces that last seconds are wheels' and ground's to carry. Without
/// it a network may hold up a part of the vehicle's weight, and the wheels then stand under too small a load. `None` in a form without residual.
///
/// # Errors
/// A candle error.
pub fn sustained_residual(steps: &[PredictedStep]) -> Result<Option<Tensor>> {
    let residuals: Vec<&Tensor> = steps.iter().filter_map(|step| step.residual.as_ref()).collect();
    if residuals.is_empty() {
        return Ok(None);
    }
    Tensor::stack(&residuals, 0)?.mean(0)?.sqr()?.sum(1)?.mean_all().map(Some)
}

/// Pooled contexts and their projection, cut from the graph: the rollout reads the leaf, and the gradient of W_c is one product at the end.
struct Projected {
    context: Tensor,
    tokens: Var,
}

/// Terrain tokens of a batch, computed once for all samples that its rollouts can reach.
pub struct PathTerrain<'a, 'w> {
    windows: &'w [Window<'a>],
    horizon: usize,
    /// Contexts and their tokens of the history, and of the samples ahead: (rows, width) and (rows, 128).
    past: Option<Projected>,
    ahead: Projected,
    /// Raw soil of the samples ahead with its graph, and the leaf that the rollout reads; `None` where the form or the drives have none.
    soil: Option<(Tensor, Var)>,
    /// First row of each window in the table ahead.
    first_row: Vec<u32>,
    /// Whether any window has terrain features.
    has_map: bool,
    /// 1 for a window with features, 0 for one without: (windows, 1); `None` where all or none have them.
    seeing: Option<Tensor>,
    sight: Sight<'a>,
    device: Device,
}

impl<'a, 'w> PathTerrain<'a, 'w> {
    /// Projects and reads the soil of every reachable sample: one large matrix product instead of one per step. A window of a drive without features has
    /// tokens of zero and the default soil, as alone, whatever the others have.
    ///
    /// # Errors
    /// A candle error.
    pub fn new(network: &Network, windows: &'w [Window<'a>], history: usize, horizon: usize, sight: Sight<'a>) -> Result<Self> {
        let (variant, width) = (sight.variant, sight.pooling.width());
        let seeing: Vec<f32> = windows.iter().map(|w| if w.drive.has_features() { 1.0 } else { 0.0 }).collect();
        let has_map = seeing.contains(&1.0);
        let each = |of: fn(&Window<'_>, usize) -> Range<usize>, steps: usize| -> Vec<At> {
            windows.iter().enumerate().flat_map(|(w, window)| of(window, steps).map(move |i| (w, i))).collect()
        };
        let ahead = each(|w, horizon| w.start..w.last(horizon) + 1, horizon);
        let past = each(|w, history| w.start - history..w.start, history);
        let first_row = ahead.iter().enumerate().filter(|(_, (w, i))| windows[*w].start == *i).map(|(row, _)| row as u32).collect();
        let device = network.device();
        let factors: Vec<Option<Vec<f32>>> = windows.iter().map(|w| sight.factors(w.dropout)).collect();
        let projection = if has_map { Some(sight.projection(network)?.t()?) } else { None };
        let nothing = vec![f16::ZERO; width.max(FEATURES)];
        let project = |samples: &[At]| -> Result<Projected> {
            let Some(projection) = &projection else {
                let tokens = Var::zeros((samples.len(), HIDDEN), DType::F32, device)?;
                return Ok(Projected { context: Tensor::zeros((samples.len(), 1), DType::F32, device)?, tokens });
            };
            let of = |(w, i): At| if seeing[w] > 0.0 { windows[w].drive.context(i) } else { &nothing[..width] };
            let context = gather(samples, width, of, &factors, device)?;
            let tokens = Var::from_tensor(&context.matmul(projection)?)?;
            Ok(Projected { context, tokens })
        };
        let soil = if has_map && variant.has_soil() {
            let of = |(w, i): At| if seeing[w] > 0.0 { windows[w].drive.semantic(i) } else { &nothing[..FEATURES] };
            let features = gather(&ahead, FEATURES, of, &[], device)?;
            let graph = network.soil.raw(&features.reshape((ahead.len(), FEATURE_PX, FEATURE_PX, FEATURE_CHANNELS))?)?;
            let leaf = Var::from_tensor(&graph.detach())?;
            Some((graph, leaf))
        } else {
            None
        };
        let is_mixed = has_map && seeing.contains(&0.0);
        Ok(Self {
            windows,
            horizon,
            seeing: if is_mixed { Some(Tensor::from_slice(&seeing, (windows.len(), 1), device)?) } else { None },
            past: if past.is_empty() { None } else { Some(project(&past)?) },
            ahead: project(&ahead)?,
            soil,
            first_row,
            has_map,
            sight,
            device: device.clone(),
        })
    }

    /// How far the soil ahead lies from what the map says of its class: mean over samples of Σ_p ((u_p - mean_p) / sd_p)² with u the raw soil, twice the
    /// negative logarithm of its density by [`ClassSoil`]. A sample without a class counts as none. `None` where there is no soil.
    ///
    /// # Errors
    /// A candle error.
    pub fn off_class(&self) -> Result<Option<Tensor>> {
        let Some((graph, _)) = &self.soil else { return Ok(None) };
        let samples = self.windows.iter().flat_map(|w| (w.start..=w.last(self.horizon)).map(|i| w.drive.class_soil(i)));
        let classes: Vec<Option<ClassSoil>> = samples.collect();
        let table = |of: fn(&ClassSoil) -> [f32; SOIL_DIM]| {
            let values: Vec<f32> = classes.iter().flat_map(|class| class.as_ref().map_or([0.0; SOIL_DIM], of)).collect();
            Tensor::from_vec(values, (classes.len(), SOIL_DIM), &self.device)
        };
        let (mean, per_sd) = (table(|class| class.mean)?, table(|class| class.sd.map(|sd| 1.0 / sd))?);
        ((graph - mean)? * per_sd)?.sqr()?.sum(1)?.mean_all().map(Some)
    }

    /// Completes the gradients of a loss for what lies before the leaves: W_c and the soil prior, with those of a further loss that reads the soil alone.
    ///
    /// # Errors
    /// A candle error.
    pub fn add_gradients(
        &self,
        network: &Network,
        store: &GradStore,
        of_soil: Option<&Tensor>,
        gradients: &mut HashMap<String, Vec<f32>>,
    ) -> Result<()> {
        if !self.has_map {
            return Ok(());
        }
        let mut projection: Option<Tensor> = None;
        for part in self.past.iter().chain(core::iter::once(&self.ahead)) {
            if let Some(upstream) = store.get(&part.tokens) {
                let own = upstream.t()?.matmul(&part.context)?;
                projection = Some(match projection {
                    Some(sum) => (sum + own)?,
                    None => own,
                });
            }
        }
        if let Some(projection) = projection {
            // Steepest descent among the weights that are equal within a block: each gets the block's mean gradient, upstream · mean feature.
            let pooled: Vec<Vec<f32>> = projection.to_vec2()?;
            gradients.insert("token.context.weight".into(), pooled.iter().flat_map(|row| self.sight.pooling.spread(row)).collect());
        }
        if let Some((graph, leaf)) = &self.soil
            && let Some(upstream) = store.get(leaf)
        {
            let mut loss = (graph * upstream.detach())?.sum_all()?;
            if let Some(further) = of_soil {
                loss = (loss + further)?;
            }
            let pulled = loss.backward()?;
            for (name, var) in network.variables.iter().filter(|(name, _)| name.starts_with("soil.")) {
                if let Some(gradient) = pulled.get(var) {
                    gradients.insert(name.clone(), gradient.flatten_all()?.to_vec1()?);
                }
            }
        }
        Ok(())
    }

    /// (1 - share) · row(at) + share · row(at + 1) of each place.
    fn interpolate(&self, table: &Tensor, places: &[Place]) -> Result<Tensor> {
        let device = &self.device;
        let n = places.len();
        let row = |b: usize, extra: usize| self.first_row[b] + (places[b].at + extra - self.windows[b].start) as u32;
        let pick = |extra: usize| {
            let last = |b: usize| self.windows[b].last(self.horizon) - self.windows[b].start;
            let rows: Vec<u32> = (0..n).map(|b| row(b, extra).min(self.first_row[b] + last(b) as u32)).collect();
            table.index_select(&Tensor::from_vec(rows, n, device)?, 0)
        };
        let share = Tensor::from_vec(places.iter().map(|p| p.share).collect::<Vec<f32>>(), (n, 1), device)?;
        let rest = share.affine(-1.0, 1.0)?;
        pick(0)?.broadcast_mul(&rest)? + pick(1)?.broadcast_mul(&share)?
    }
}

impl TerrainProvider for PathTerrain<'_, '_> {
    fn history(&mut self) -> Result<Tensor> {
        self.past
            .as_ref()
            .map(|past| past.tokens.as_tensor().clone())
            .ok_or_else(|| candle_core::Error::Msg("a batch without history has no history tokens".into()))
    }

    fn at(&mut self, _k: usize, states: &[VehicleState<f64>]) -> Result<(Tensor, Tensor)> {
        let n = states.len();
        let default_soil =
            || Tensor::from_slice(&self.sight.default_soil, (1, SOIL_DIM), &self.device)?.broadcast_as((n, SOIL_DIM))?.contiguous();
        if !self.has_map {
            return Ok((Tensor::zeros((n, HIDDEN), DType::F32, &self.device)?, default_soil()?));
        }
        let places: Vec<Place> =
            self.windows.iter().zip(states).map(|(w, state)| w.drive.nearest_place(state, w.start, w.last(self.horizon))).collect();
        let soil = match &self.soil {
            Some((_, leaf)) => {
                let read = self.interpolate(leaf, &places)?;
                match &self.seeing {
                    Some(seeing) => (read.broadcast_mul(seeing)? + default_soil()?.broadcast_mul(&seeing.affine(-1.0, 1.0)?)?)?,
                    None => read,
                }
            }
            None => default_soil()?,
        };
        Ok((self.interpolate(&self.ahead.tokens, &places)?, soil))
    }
}

/// Absolute errors of each prediction of a batch: horizontal position (m), z (m), roll, pitch, yaw (rad).
pub fn absolute_errors(predicted: &Tensor, target: &Tensor) -> Result<Vec<[f64; 5]>> {
    let (p, t): (Vec<Vec<f32>>, Vec<Vec<f32>>) = (predicted.to_vec2()?, target.to_vec2()?);
    let of_row = |(p, t): (&Vec<f32>, &Vec<f32>)| {
        let e = |i: usize| f64::from(p[i] - t[i]);
        [e(0).hypot(e(1)), e(2).abs(), e(3).abs(), e(4).abs(), wrap_angle(e(5)).abs()]
    };
    Ok(p.iter().zip(&t).map(of_row).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Σᵢ r̄ᵢ² of rows, and its derivative 2 r̄ᵢ / (steps · rows) at each residual.
    #[test]
    fn analytic_what_lasts_counts_and_what_alternates_does_not() -> Result<()> {
        let residuals = [[1.0, 3.0, 0.0], [3.0, -3.0, 0.0]].map(|row: [f32; 3]| Var::new(&[row, [0.0; 3]], &Device::Cpu));
        let [first, second] = residuals.map(|residual| residual.expect("a tensor"));
        let step = |residual: &Var| PredictedStep { state: residual.as_tensor().clone(), residual: Some(residual.as_tensor().clone()) };
        let loss = sustained_residual(&[step(&first), step(&second)])?.expect("there are residuals");
        // Means over the two steps: 2 and 0 in the first row, nothing in the second.
        assert_eq!(loss.to_scalar::<f32>()?, 4.0 / 2.0);
        let gradients = loss.backward()?;
        for residual in [&first, &second] {
            let gradient: Vec<Vec<f32>> = gradients.get(residual).expect("it is reached").to_vec2()?;
            assert_eq!(gradient, [[1.0, 0.0, 0.0], [0.0; 3]], "2 · 2 / (2 · 2)");
        }
        let none = PredictedStep { state: first.as_tensor().clone(), residual: None };
        assert!(sustained_residual(&[none])?.is_none());
        Ok(())
    }
}
