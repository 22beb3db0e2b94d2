//! Twin experiments: drives simulated by the physics itself on soils that the filter believes possible, with the noise that it is told, so that what it says of
//! its own errors can be held against them.

use nalgebra::{DMatrix, DVector, SMatrix};
use nesam_adaptation::{AdaptationError, BufferedTransition, FilterConfig, SoilFilter, SoilPosterior, conditions};
use nesam_physics::driveline::{DrivelineState, command_wheels};
use nesam_physics::step::{Ground, StepInput, StepModel};
use nesam_physics::{Control, SOIL_BOUNDS, SOIL_DIM, SecondCommand, Soil, SoilCorrection, VehicleState};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{ChiSquared, Distribution, StandardNormal};
use rayon::prelude::*;
use serde::Serialize;

use crate::known_soil::{Held, inside_95};

/// Priors of the runs in turn: firm ground, loam, sand (chosen in the middle of published ranges).
const PRIORS: [[f64; SOIL_DIM]; 3] =
    [[2.2e6, 9.0e3, 0.75, 4.0e3, 0.50, 0.020], [1.5e6, 5.3e3, 0.80, 1.7e3, 0.45, 0.025], [8.0e5, 1.5e3, 1.00, 1.2e3, 0.52, 0.018]];
/// Steps before the first buffer in which the vehicle settles on its ground.
const SETTLING: usize = 20;

/// What to simulate.
#[derive(Clone, Copy, Debug)]
pub struct TwinPlan {
    /// Independent drives.
    pub runs: usize,
    /// Buffers of each.
    pub buffers: usize,
    /// Buffer before which the vehicle crosses onto ground that was drawn anew; the filter is not told.
    pub border: Option<usize>,
    /// Seed.
    pub seed: u64,
}

/// How honest the filter is, over all runs.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TwinReport {
    /// Runs that ended.
    pub runs: usize,
    /// Buffers in all of them.
    pub buffers: usize,
    /// Mean of NEES over its six degrees of freedom at the end of a run, 1 for a consistent filter.
    pub nees_mean_over_dof: f64,
    /// Median of the same ratio (0.89 for χ² of six): a few runs in which the filter settles on a wrong soil and is certain of it rule the mean.
    pub nees_median_over_dof: f64,
    /// Share of runs with NEES inside the two-sided 95 % interval of χ² at the end.
    pub nees_inside_95: f64,
    /// Share of runs with NEES above it: the filter is too sure.
    pub nees_above_95: f64,
    /// Mean of NIS over its degrees of freedom.
    pub nis_mean_over_dof: f64,
    /// Share of buffers with NIS inside the two-sided 95 % interval.
    pub nis_inside_95: f64,
    /// Share of 90 % intervals of Δθ⁺ that hold the truth at the end, all parameters.
    pub coverage_90: f64,
    /// The same by parameter.
    pub coverage_90_by_parameter: [f64; SOIL_DIM],
    /// The same of the posterior as it goes out, with the trust in it.
    pub coverage_90_posterior: f64,
    /// Share of runs in which each parameter was learned at the end.
    pub learned: [f64; SOIL_DIM],
    /// Root mean square error of Δθ⁺ over that of the prior, learned parameters; below 1 = learning pays. `None` when nothing was learned.
    pub error_over_prior: Option<f64>,
    /// Buffers that the gate refused.
    pub rejected: usize,
}

/// End of one run.
struct Outcome {
    estimate: Held,
    posterior: Held,
    learned: [bool; SOIL_DIM],
    /// Squared errors of Δθ⁺ and of the prior.
    squared: [[f64; 2]; SOIL_DIM],
    nis: Vec<(usize, f64, bool)>,
}

/// Runs the plan on all cores. Drives, soils and noise are drawn from ChaCha8 streams of the seed, so the same plan gives the same report.
///
/// # Errors
/// `AdaptationError` when the settings are unusable or a simulation leaves the finite numbers.
pub fn run_twins(model: &StepModel, config: &FilterConfig, plan: &TwinPlan) -> Result<TwinReport, AdaptationError> {
    run_twins_against(model, config, config, plan)
}

/// The same where soils and noise are drawn from other settings (same buffer, block and coordinates) than the filter believes in.
///
/// # Errors
/// As [`run_twins`].
pub fn run_twins_against(
    model: &StepModel,
    believed: &FilterConfig,
    truth: &FilterConfig,
    plan: &TwinPlan,
) -> Result<TwinReport, AdaptationError> {
    SoilFilter::new(truth.clone())?;
    let filter = SoilFilter::new(believed.clone())?;
    let drive = |run| Twin::new(model, truth, plan, run).drive(plan, filter.clone());
    Ok(report(&(0..plan.runs).into_par_iter().map(drive).collect::<Result<Vec<_>, _>>()?, &believed.prior_sd))
}

fn report(outcomes: &[Outcome], prior_sd: &[f64; SOIL_DIM]) -> TwinReport {
    let runs = outcomes.len().max(1) as f64;
    let dof = SOIL_DIM as f64;
    let buffers: Vec<&(usize, f64, bool)> = outcomes.iter().flat_map(|o| &o.nis).collect();
    let count = buffers.len().max(1) as f64;
    let share = |of: &dyn Fn(&Outcome, usize) -> bool, i: usize| outcomes.iter().filter(|o| of(o, i)).count() as f64 / runs;
    let mean = |values: [f64; SOIL_DIM]| values.iter().sum::<f64>() / dof;
    let by_parameter = std::array::from_fn(|i| share(&|o, i| o.estimate.inside[i], i));
    let posterior = std::array::from_fn(|i| share(&|o, i| o.posterior.inside[i], i));
    let mut squared = [0.0; 2];
    for (o, i) in outcomes.iter().flat_map(|o| (0..SOIL_DIM).map(move |i| (o, i))).filter(|(o, i)| o.learned[*i]) {
        squared = std::array::from_fn(|which| squared[which] + o.squared[i][which] / prior_sd[i].powi(2));
    }
    TwinReport {
        runs: outcomes.len(),
        buffers: buffers.len(),
        nees_mean_over_dof: outcomes.iter().map(|o| o.estimate.nees / dof).sum::<f64>() / runs,
        nees_median_over_dof: crate::median(&outcomes.iter().map(|o| o.estimate.nees / dof).collect::<Vec<_>>()),
        nees_inside_95: outcomes.iter().filter(|o| o.estimate.nees_inside_95()).count() as f64 / runs,
        nees_above_95: outcomes.iter().filter(|o| o.estimate.nees_above_95()).count() as f64 / runs,
        nis_mean_over_dof: buffers.iter().map(|(dof, nis, _)| nis / *dof as f64).sum::<f64>() / count,
        nis_inside_95: buffers.iter().filter(|(dof, nis, _)| inside_95(*dof, *nis)).count() as f64 / count,
        coverage_90: mean(by_parameter),
        coverage_90_by_parameter: by_parameter,
        coverage_90_posterior: mean(posterior),
        learned: std::array::from_fn(|i| share(&|o, i| o.learned[i], i)),
        error_over_prior: (squared[1] > 0.0).then(|| (squared[0] / squared[1]).sqrt()),
        rejected: buffers.iter().filter(|(_, _, rejected)| *rejected).count(),
    }
}

/// One simulated drive.
struct Twin<'a> {
    model: &'a StepModel,
    config: &'a FilterConfig,
    rng: ChaCha8Rng,
    prior: [f64; SOIL_DIM],
    truth: [f64; SOIL_DIM],
    state: VehicleState<f64>,
    actuators: DrivelineState,
    step: usize,
    /// Angular frequencies and phases of speed, steering and two slopes.
    waves: [[f64; 2]; 4],
    noise: Noise,
}

/// Draws the errors of buffers as the settings describe them.
struct Noise {
    single: DMatrix<f64>,
    carried: DMatrix<f64>,
    /// Of each row, from one buffer to the next.
    correlation: DVector<f64>,
    shared: DVector<f64>,
    tail_dof: f64,
}

impl Noise {
    fn new(config: &FilterConfig, rng: &mut ChaCha8Rng) -> Self {
        let noise = config.noise.covariance(config.buffer, config.block);
        let rows = noise.nrows();
        let lower = |m: DMatrix<f64>| m.cholesky().map_or_else(|| DMatrix::zeros(rows, rows), |c| c.l());
        let slight = DMatrix::from_diagonal(&noise.diagonal()) * 1e-9;
        let (single, carried, correlation) = match &config.shared_error {
            Some(shared) => {
                (lower(&noise - &shared.covariance), lower(&shared.covariance + slight), DVector::repeat(rows, shared.correlation))
            }
            // The design effect of a first-order autoregressive series is (1 + a)/(1 - a).
            None => {
                let alike = |row: usize| config.shared_buffers * config.caution[row % config.caution.len()].powi(2);
                let correlation = DVector::from_fn(rows, |row, _| (alike(row) - 1.0) / (alike(row) + 1.0));
                (DMatrix::zeros(rows, rows), lower(noise), correlation)
            }
        };
        let mut drawn = Self { single, carried, correlation, shared: DVector::zeros(rows), tail_dof: config.tail_dof };
        drawn.shared = &drawn.carried * normals(rows, rng);
        drawn
    }

    fn draw(&mut self, factor: f64, rng: &mut ChaCha8Rng) -> DVector<f64> {
        let rows = self.shared.len();
        let renewed = self.correlation.map(|a| (1.0 - a * a).sqrt());
        self.shared = self.shared.component_mul(&self.correlation) + (&self.carried * normals(rows, rng)).component_mul(&renewed);
        let tail = match ChiSquared::new(self.tail_dof) {
            Ok(chi) if self.tail_dof > 0.0 => self.tail_dof / chi.sample(rng),
            _ => 1.0,
        };
        (&self.shared + &self.single * normals(rows, rng) * tail.sqrt()) * factor.sqrt()
    }
}

fn normals(rows: usize, rng: &mut ChaCha8Rng) -> DVector<f64> {
    DVector::from_fn(rows, |_, _| StandardNormal.sample(rng))
}

impl<'a> Twin<'a> {
    fn new(model: &'a StepModel, config: &'a FilterConfig, plan: &TwinPlan, run: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(plan.seed);
        rng.set_stream(run as u64 + 1);
        let prior = PRIORS[run % PRIORS.len()];
        let waves = [(0.2, 2.0), (0.1, 0.6), (0.1, 0.6), (0.1, 0.6)]
            .map(|(low, high)| [rng.random_range(low..high), rng.random_range(0.0..std::f64::consts::TAU)]);
        let mut state = VehicleState::zero();
        state.position_m[2] = model.vehicle().wheel_radius_m - model.vehicle().wheel_centre_m[0][2];
        state.velocity_m_s[0] = 2.0;
        let noise = Noise::new(config, &mut rng);
        let mut twin =
            Self { model, config, rng, prior, truth: [0.0; SOIL_DIM], state, actuators: DrivelineState::default(), step: 0, waves, noise };
        twin.truth = twin.drawn_soil();
        twin
    }

    /// A correction from P₀, moved to where the soil is admissible.
    fn drawn_soil(&mut self) -> [f64; SOIL_DIM] {
        let drawn = std::array::from_fn(|i| {
            let unit: f64 = StandardNormal.sample(&mut self.rng);
            self.config.prior_sd[i] * unit
        });
        self.admissible(drawn)
    }

    fn admissible(&self, delta: [f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        let coordinates = self.config.coordinates;
        let [low, high] = [SOIL_BOUNDS.map(|b| b.0), SOIL_BOUNDS.map(|b| b.1)].map(|bound| coordinates.between(&self.prior, &bound));
        std::array::from_fn(|i| delta[i].clamp(low[i], high[i]))
    }

    /// The soil of the next buffer, by the process that the filter believes in.
    fn advance_soil(&mut self) {
        let config = self.config;
        let moved = std::array::from_fn(|i| {
            let unit: f64 = StandardNormal.sample(&mut self.rng);
            let process = config.process_sd[i];
            let kept = if config.bounded { (1.0 - (process / config.prior_sd[i]).powi(2)).max(0.0).sqrt() } else { 1.0 };
            kept * self.truth[i] + process * unit
        });
        self.truth = self.admissible(moved);
    }

    fn correction(&self) -> SoilCorrection {
        SoilCorrection { coordinates: self.config.coordinates, delta: self.truth }
    }

    /// One step on the true soil: its transition as the filter sees it, without noise.
    fn transition(&mut self) -> BufferedTransition {
        let t = self.step as f64 * self.model.dt_s();
        let wave = |[frequency, phase]: [f64; 2]| (frequency * t + phase).sin();
        let card = self.model.vehicle();
        let [_, second] = card.command_range;
        let turning = match card.second {
            SecondCommand::YawRateRadS => 0.5 * second[1] * wave(self.waves[1]),
            _ => 0.8 * second[1] * wave(self.waves[1]),
        };
        let control = Control { speed_m_s: 2.5 + 1.2 * wave(self.waves[0]), second: turning };
        let after = self.actuators.advance(card, &control, self.state.velocity_m_s[0], self.model.dt_s());
        let (ahead, left) = (0.12 * wave(self.waves[2]), 0.08 * wave(self.waves[3]));
        let input = StepInput {
            state: self.state,
            wheels: command_wheels(card, &self.actuators, &after, &control),
            sinkage_log_ratio: [0.0; 4],
            soil: Soil::from_array(self.correction().apply(&self.prior)),
            // Slopes that turn with the vehicle: the ground passes under the reference point.
            ground: self.model.wheel_offsets_heading(self.state.attitude_rad[0], self.state.attitude_rad[1]).map(|offset| Ground {
                height_m: ahead * offset[0] + left * offset[1],
                slope_ahead: ahead,
                slope_left: left,
            }),
        };
        let increment = self.model.step(&input).increment.to_array();
        let before = self.state.to_array();
        self.state = VehicleState::from_array(std::array::from_fn(|i| before[i] + increment[i]));
        self.actuators = after;
        self.step += 1;
        let seen = StepInput { soil: Soil::from_array(self.prior), ..input };
        BufferedTransition::new(seen, [0.0; 12], &self.state)
    }

    fn drive(mut self, plan: &TwinPlan, mut filter: SoilFilter) -> Result<Outcome, AdaptationError> {
        for _ in 0..SETTLING {
            self.transition();
        }
        let mut nis = Vec::with_capacity(plan.buffers);
        for k in 0..plan.buffers {
            if plan.border == Some(k) {
                self.truth = self.drawn_soil();
            } else if k > 0 {
                self.advance_soil();
            }
            let mut buffer: Vec<BufferedTransition> = (0..self.config.buffer).map(|_| self.transition()).collect();
            let factor = self.config.noise_conditions.map_or(1.0, |c| c.factor(&conditions(&buffer)));
            let errors = self.noise.draw(factor, &mut self.rng);
            for (step, transition) in buffer.iter_mut().enumerate() {
                for (c, measured) in transition.measured_next.iter_mut().enumerate() {
                    *measured += errors[step / self.config.block * 6 + c];
                }
            }
            for transition in buffer {
                if let Some(update) = filter.push(self.model, transition)? {
                    nis.push((update.dof, update.nis, update.rejected));
                }
            }
        }
        Ok(self.outcome(&filter, nis))
    }

    fn outcome(&self, filter: &SoilFilter, nis: Vec<(usize, f64, bool)>) -> Outcome {
        let (estimate, covariance) = (filter.estimate().delta, filter.covariance());
        let SoilPosterior { correction, covariance: spread, learned } = filter.posterior();
        let away = |from: &[f64; SOIL_DIM]| std::array::from_fn(|i| self.truth[i] - from[i]);
        let error: [f64; SOIL_DIM] = away(&estimate);
        Outcome {
            estimate: Held::of(&error, &covariance),
            posterior: Held::of(&away(&correction.delta), &SMatrix::from_fn(|r, c| spread[r][c])),
            learned,
            squared: std::array::from_fn(|i| [error[i].powi(2), self.truth[i].powi(2)]),
            nis,
        }
    }
}
