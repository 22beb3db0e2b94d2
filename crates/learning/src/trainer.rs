//! The training loop: fully autoregressive rollouts, two shards of a batch side by side, validation.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use candle_core::{DType, Result, Tensor};
use nesam_model::reference::{ComputeDevice, Network, ReferenceRollout};
use nesam_model::{HISTORY, ModelError, Normalization, Variant, Weights};
use nesam_physics::step::StepModel;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Deserializer, Serialize};

use crate::batch::{Dropout, PathTerrain, Sight, Window, absolute_errors, rows, state_loss, sustained_residual, targets};
use crate::checkpoint::Checkpoint;
use crate::drives::Drive;
use crate::origin::{self, Origin};
use crate::pooling::Pooling;
use crate::schedule::{cosine, curriculum};

/// What a training run was told.
#[derive(Clone, Debug)]
pub struct TrainingPlan {
    /// Optimiser steps in all (paper: 40 × 250).
    pub steps: usize,
    /// Windows per step (paper: 32).
    pub batch: usize,
    /// Peak learning rate.
    pub rate: f64,
    /// Longest horizon K.
    pub horizon: usize,
    /// Seed of the batches.
    pub seed: u64,
    /// Steps between validations and checkpoints.
    pub epoch: usize,
    /// Where the tensors live.
    pub device: ComputeDevice,
    /// Threads that each take a share of the batch.
    pub shards: usize,
    /// Share of the terrain features that each window is trained without.
    pub dropout: f32,
    /// Decoupled decay of the weight matrices per unit of learning rate (Loshchilov & Hutter 2019).
    pub decay: f32,
    /// What is trained, towards what.
    pub objective: Objective,
    /// Where checkpoints go.
    pub folder: PathBuf,
    /// What the run hangs on beside these: drives, vehicle, what is done before the first step.
    pub origin: Origin,
}

impl TrainingPlan {
    /// Threads of a shard. Where a GPU does the rest, the shards are all that the processor has to do.
    fn physics_threads(&self) -> usize {
        match self.device {
            ComputeDevice::Cpu => 1,
            ComputeDevice::Cuda(_) => std::thread::available_parallelism().map_or(1, |n| n.get()).div_ceil(self.shards),
        }
    }
}

/// What a form is trained towards.
#[derive(Clone, Copy, Debug)]
pub struct Objective {
    /// Form trained.
    pub variant: Variant,
    /// Weight of the sustained residual in the loss (`batch::sustained_residual`).
    pub sustained: f64,
    /// Weight in the loss of soils that are not what the map says of their class (`PathTerrain::off_class`).
    pub soil_prior: f64,
}

/// One line of the loss curve. A number that is none is null in JSON.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct EpochReport {
    /// Optimiser steps taken.
    pub step: usize,
    /// Mean of the finite training losses since the last report.
    #[serde(deserialize_with = "or_nan")]
    pub loss: f32,
    /// Mean absolute errors on validation drives, mean over the horizon: position (m), z (m), roll, pitch, yaw (rad). NaN where every window diverged.
    #[serde(deserialize_with = "each_or_nan")]
    pub validation: [f64; 5],
    /// Validation windows that diverged and are left out of the mean.
    #[serde(default)]
    pub diverged: usize,
    /// Seconds per step since the last report.
    pub step_s: f64,
}

fn or_nan<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<f32, D::Error> {
    Ok(Option::<f32>::deserialize(from)?.unwrap_or(f32::NAN))
}

fn each_or_nan<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<[f64; 5], D::Error> {
    Ok(<[Option<f64>; 5]>::deserialize(from)?.map(|number| number.unwrap_or(f64::NAN)))
}

/// Memory of the running mean of the weights, in steps: about two epochs.
const AVERAGED_STEPS: f32 = 500.0;
/// Score of a window that diverged (chosen: hundreds of kilometres).
const DIVERGED: f64 = 1e6;

/// Result of a run.
pub struct Trained {
    /// Running mean of the weights (Polyak & Juditsky 1992) with the lowest validation error; the last one where no validation gave a number.
    pub weights: Weights,
    /// Loss curve.
    pub curve: Vec<EpochReport>,
    /// Steps of this run and of those it resumed.
    pub steps: usize,
}

/// A run that stopped.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// candle or the bundle.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A checkpoint.
    #[error("checkpoint {}: {reason}", path.display())]
    Checkpoint {
        /// File.
        path: PathBuf,
        /// What was wrong.
        reason: String,
    },
    /// A checkpoint of another run.
    #[error("checkpoint {} {reason}", path.display())]
    Foreign {
        /// File.
        path: PathBuf,
        /// What differs, and what to do.
        reason: String,
    },
    /// The data cannot be trained on.
    #[error("training data: {0}")]
    Drives(String),
    /// The weights are no numbers.
    #[error("training diverged: weights after step {0} are not finite; lower --lr, or look for drives with absurd motions")]
    Diverged(usize),
    /// Stopped on request before the first step, while something was prepared that a run does each time.
    #[error(
        "training was interrupted before its first step, while {0}: that part is not kept, checkpoints and finished encoders are; the same command with \
         --resume does it again and goes on"
    )]
    Unprepared(&'static str),
    /// Stopped on request; the last checkpoint resumes the run.
    #[error("training was interrupted after step {0}; the same command with --resume goes on")]
    Interrupted(usize),
}

impl From<candle_core::Error> for TrainingError {
    fn from(error: candle_core::Error) -> Self {
        Self::Model(ModelError::Tensor(error))
    }
}

/// Everything a run reads.
pub struct TrainingSet<'a> {
    /// Drives to learn from.
    pub train: Vec<&'a Drive>,
    /// Drives to choose the checkpoint on; never the test split. Where none is longer than the horizon, those to learn from.
    pub validation: Vec<&'a Drive>,
    /// Scales.
    pub scales: &'a Normalization,
    /// Physics.
    pub model: Arc<StepModel>,
    /// Sharing of W_c; its weights are equal within blocks from the start.
    pub pooling: Pooling,
}

impl TrainingSet<'_> {
    fn sight(&self, variant: Variant) -> Sight<'_> {
        Sight { variant, pooling: &self.pooling, default_soil: self.scales.default_soil_raw }
    }

    /// Mean loss over steps and windows (paper Eq. 3 with λ_k = 1) with the other terms of the objective, and its gradient in every trainable array.
    ///
    /// # Errors
    /// A candle error.
    pub fn gradients(
        &self,
        network: &Network,
        windows: &[Window<'_>],
        history: usize,
        horizon: usize,
        objective: Objective,
    ) -> Result<(f32, HashMap<String, Vec<f32>>)> {
        let variant = objective.variant;
        let rollout = ReferenceRollout { network, model: &self.model, scales: self.scales, variant };
        let rows = rows(windows, history, horizon, &self.model, self.scales.dt_s);
        let mut terrain = PathTerrain::new(network, windows, history, horizon, self.sight(variant))?;
        let mut total = Tensor::zeros((), DType::F32, network.device())?;
        let steps = rollout.run(&rows, horizon, &mut terrain)?;
        for (k, step) in steps.iter().enumerate() {
            total = (total + state_loss(&step.state, &targets(windows, k, network.device())?, self.scales)?)?;
        }
        let mut loss = (total / horizon as f64)?;
        if objective.sustained > 0.0
            && let Some(sustained) = sustained_residual(&steps)?
        {
            loss = (loss + (sustained * objective.sustained)?)?;
        }
        let store = loss.backward()?;
        let mut gradients = HashMap::new();
        for (name, var) in &network.variables {
            if let Some(gradient) = store.get(var) {
                gradients.insert(name.clone(), gradient.flatten_all()?.to_vec1()?);
            }
        }
        let off_class = if objective.soil_prior > 0.0 { terrain.off_class()? } else { None };
        let of_soil = off_class.map(|off_class| off_class * objective.soil_prior).transpose()?;
        terrain.add_gradients(network, &store, of_soil.as_ref(), &mut gradients)?;
        if let Some(of_soil) = of_soil {
            loss = (loss + of_soil)?;
        }
        Ok((loss.to_scalar::<f32>()?, gradients))
    }

    /// Validation drives that are longer than a horizon. Where there are none, those to learn from stand in for them.
    pub fn validating(&self, horizon: usize) -> usize {
        self.validation.iter().filter(|drive| drive.states.len() > horizon).count()
    }

    /// Mean absolute errors over fixed windows of the validation drives, and how many of these diverged and are left out.
    fn validate(&self, network: &Network, horizon: usize, variant: Variant) -> Result<([f64; 5], usize)> {
        let windows = fixed_windows(if self.validating(horizon) > 0 { &self.validation } else { &self.train }, horizon);
        let rollout = ReferenceRollout { network, model: &self.model, scales: self.scales, variant };
        let mut errors: Vec<[f64; 5]> = Vec::with_capacity(windows.len());
        for windows in windows.chunks(64) {
            let available = windows.iter().map(|w| w.start).min().unwrap_or(0).min(HISTORY - 1);
            let history = steps_needed(variant, available);
            let rows = rows(windows, history, horizon, &self.model, self.scales.dt_s);
            let mut terrain = PathTerrain::new(network, windows, history, horizon, self.sight(variant))?;
            let mut means = vec![[0.0; 5]; windows.len()];
            for (k, step) in rollout.run(&rows, horizon, &mut terrain)?.iter().enumerate() {
                let of_step = absolute_errors(&step.state, &targets(windows, k, network.device())?)?;
                means.iter_mut().flatten().zip(of_step.iter().flatten()).for_each(|(mean, e)| *mean += e / horizon as f64);
            }
            errors.extend(means);
        }
        let count = errors.len();
        errors.retain(|window| window.iter().all(|e| e.is_finite()));
        let mean = core::array::from_fn(|i| errors.iter().map(|window| window[i]).sum::<f64>() / errors.len() as f64);
        Ok((mean, count - errors.len()))
    }
}

/// Every fortieth window of drives.
fn fixed_windows<'a>(drives: &[&'a Drive], horizon: usize) -> Vec<Window<'a>> {
    drives
        .iter()
        .copied()
        .flat_map(|drive| {
            let starts = drive.states.len().saturating_sub(horizon);
            let first = (HISTORY - 1).min(starts.saturating_sub(1));
            (first..starts).step_by(40).map(move |start| Window { drive, start, dropout: None })
        })
        .collect()
}

/// Errors weighted as the targets of the evaluation weigh them: one number to choose a checkpoint by. A window that diverged weighs more than any error.
fn score(line: &EpochReport) -> f64 {
    let errors = &line.validation;
    let weighted = errors[0] / 0.20 + errors[1] / 0.045 + (errors[2] / 0.8 + errors[3] / 0.7 + errors[4] / 1.7).to_degrees();
    weighted + DIVERGED * line.diverged as f64
}

/// Steps of history for a training step: all of it mostly, less one time in six, so that a fresh session predicts well too.
fn draw_history(rng: &mut ChaCha8Rng, available: usize) -> usize {
    if rng.random_range(0..6) > 0 { available } else { rng.random_range(0..=available) }
}

/// Steps of history that a form reads out of those there are: one, for the motion before the start, where it remembers nothing.
fn steps_needed(variant: Variant, available: usize) -> usize {
    if variant.remembers() { available } else { available.min(1) }
}

/// Trains from `weights`; resumes from the folder's checkpoint if asked. `progress(step, loss, norm)` after each step, `report` after each epoch.
/// A run that is interrupted and resumed gives the weights that it gives in one go: what is validated, and may so be chosen, depends on the plan alone.
///
/// # Errors
/// `TrainingError`, also for a checkpoint that was begun with something else. An interruption leaves a checkpoint, also before the first epoch: one that is
/// resumed with a plan of no further steps gives the running mean where nothing was validated yet.
pub fn train(
    set: &TrainingSet<'_>,
    weights: &Weights,
    plan: &TrainingPlan,
    resume: bool,
    interrupted: &dyn Fn() -> bool,
    mut progress: impl FnMut(usize, f32, f32),
    mut report: impl FnMut(&EpochReport),
) -> std::result::Result<Trained, TrainingError> {
    let starts = window_starts(set, plan)?;
    if resume {
        origin::check(plan)?;
    }
    let resumed = if resume { Checkpoint::load(&plan.folder, weights)? } else { None };
    let begun_with = origin::of_plan(plan);
    let mut checkpoint = resumed.unwrap_or_else(|| Checkpoint::new(weights));
    let device = plan.device.open()?;
    let network = Network::from_weights(&checkpoint.latest, &device)?;
    let pools: Vec<rayon::ThreadPool> = (0..plan.shards)
        .map(|_| {
            rayon::ThreadPoolBuilder::new().num_threads(plan.physics_threads()).build().expect("a thread can be started; this is a bug")
        })
        .collect();
    let mut since = Instant::now();
    while checkpoint.step < plan.steps {
        let step = checkpoint.step;
        // Each step has its own random stream, so a resumed run draws the batches that an uninterrupted one would have drawn.
        let mut rng = ChaCha8Rng::seed_from_u64(plan.seed ^ (step as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let horizon = curriculum(plan.horizon, step, plan.steps);
        let mut windows: Vec<Window<'_>> = Vec::with_capacity(plan.batch);
        for _ in 0..plan.batch {
            let (drive, start) = starts[rng.random_range(0..starts.len())];
            let dropout = (plan.dropout > 0.0).then(|| Dropout { share: plan.dropout, seed: rng.random() });
            windows.push(Window { drive, start, dropout });
        }
        let available = windows.iter().map(|w| w.start).min().unwrap_or(0).min(HISTORY - 1);
        let history = steps_needed(plan.objective.variant, draw_history(&mut rng, available));
        let (loss, gradients) = parallel_gradients(set, &network, &windows, history, horizon, plan, &pools)?;
        let norm = checkpoint.adam.update(&network.variables, &gradients, cosine(plan.rate, step, plan.steps), 1.0, plan.decay)?;
        checkpoint.step += 1;
        average_in(&mut checkpoint.average, &network.to_weights()?, checkpoint.step);
        checkpoint.unreported.steps += 1;
        if loss.is_finite() {
            checkpoint.unreported.losses.push(f64::from(loss));
        }
        progress(checkpoint.step, loss, norm);
        let stop = interrupted();
        let due = checkpoint.step % plan.epoch == 0 || checkpoint.step == plan.steps;
        if due || stop {
            checkpoint.unreported.seconds += since.elapsed().as_secs_f64();
            checkpoint.latest = merged(weights, &network.to_weights()?);
        }
        if due {
            let averaged = Network::from_weights(&checkpoint.average, &device)?;
            let (validation, diverged) = set.validate(&averaged, plan.horizon, plan.objective.variant)?;
            let (loss, step_s) = std::mem::take(&mut checkpoint.unreported).means();
            let line = EpochReport { step: checkpoint.step, loss, validation, diverged, step_s };
            if score(&line) < checkpoint.best_score {
                checkpoint.best_score = score(&line);
                checkpoint.best = checkpoint.average.clone();
            }
            checkpoint.curve.push(line);
            checkpoint.save(&plan.folder, &begun_with)?;
            report(&line);
            since = Instant::now();
        } else if stop {
            checkpoint.save(&plan.folder, &begun_with)?;
        }
        if stop {
            return Err(TrainingError::Interrupted(checkpoint.step));
        }
    }
    let chosen = if checkpoint.best_score.is_finite() { checkpoint.best } else { checkpoint.average };
    if chosen.iter().any(|(_, array)| array.values.iter().any(|value| !value.is_finite())) {
        return Err(TrainingError::Diverged(checkpoint.step));
    }
    Ok(Trained { weights: chosen, curve: checkpoint.curve, steps: checkpoint.step })
}

/// Every (drive, start) whose rollout fits.
fn window_starts<'a>(set: &TrainingSet<'a>, plan: &TrainingPlan) -> std::result::Result<Vec<(&'a Drive, usize)>, TrainingError> {
    let mut starts = Vec::new();
    for drive in &set.train {
        let n = drive.states.len();
        let first = if n > HISTORY + plan.horizon { HISTORY - 1 } else { 0 };
        starts.extend((first..n.saturating_sub(plan.horizon)).map(|start| (*drive, start)));
    }
    if starts.is_empty() {
        return Err(TrainingError::Drives(format!(
            "no drive is longer than the horizon of {} steps; use a shorter --horizon",
            plan.horizon
        )));
    }
    Ok(starts)
}

fn parallel_gradients(
    set: &TrainingSet<'_>,
    network: &Network,
    windows: &[Window<'_>],
    history: usize,
    horizon: usize,
    plan: &TrainingPlan,
    pools: &[rayon::ThreadPool],
) -> Result<(f32, HashMap<String, Vec<f32>>)> {
    let size = windows.len().div_ceil(pools.len());
    let parts: Vec<Result<(f32, HashMap<String, Vec<f32>>)>> = std::thread::scope(|scope| {
        let running: Vec<_> = windows
            .chunks(size)
            .zip(pools)
            .map(|(windows, pool)| scope.spawn(move || pool.install(|| set.gradients(network, windows, history, horizon, plan.objective))))
            .collect();
        running.into_iter().map(|thread| thread.join().expect("a shard does not panic; this is a bug")).collect()
    });
    // Summed in the order of the shards: the same batch gives the same bytes.
    let mut total: HashMap<String, Vec<f32>> = HashMap::new();
    let mut loss = 0.0;
    for (part, windows_of_part) in parts.into_iter().zip(windows.chunks(size)) {
        let weight = windows_of_part.len() as f32 / windows.len() as f32;
        let (part_loss, gradients) = part?;
        loss += weight * part_loss;
        for (name, gradient) in gradients {
            let sum = total.entry(name).or_insert_with(|| vec![0.0; gradient.len()]);
            for (s, g) in sum.iter_mut().zip(gradient) {
                *s += weight * g;
            }
        }
    }
    Ok((loss, total))
}

/// Moves the running mean towards the weights after `step` steps; at first it is the plain mean, so that the start is forgotten.
fn average_in(average: &mut Weights, weights: &Weights, step: usize) {
    let share = (1.0 / AVERAGED_STEPS).max(1.0 / (0.1 * step as f32 + 1.0));
    for (name, array) in weights.iter() {
        if let Some(mean) = average.values_mut(name) {
            mean.iter_mut().zip(&array.values).for_each(|(m, w)| *m += share * (w - *m));
        }
    }
}

/// `base` with the arrays of `trained` in place of its own.
fn merged(base: &Weights, trained: &Weights) -> Weights {
    let mut weights = base.clone();
    for (name, array) in trained.iter() {
        weights.insert(name, &array.shape, array.values.clone());
    }
    weights
}
