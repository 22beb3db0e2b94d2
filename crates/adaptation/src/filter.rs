//! Algorithm 1: buffer, one update per full buffer, gate.

use nalgebra::{DMatrix, DVector, SVector};
use nesam_physics::step::StepModel;
use nesam_physics::{SOIL_BOUNDS, SOIL_DIM, SoilCorrection};

use crate::calibration::UncorrectedBuffer;
use crate::prediction::{BufferedTransition, VELOCITY_DIM, predict_velocities, predict_velocity};
use crate::trust::{NoiseScale, Trust};
use crate::update::{SoilMatrix, kalman_update};
use crate::{AdaptationError, FilterConfig, Innovation, chi_square_tail};

mod snapshot;

pub use snapshot::FilterSnapshot;

/// Share of the prior variance below which a parameter counts as learned.
const LEARNED_SHARE: f64 = 0.5;
/// Share of the prior standard deviation below which another linearisation would change nothing.
const CONVERGED_SHARE: f64 = 1e-3;

type SoilVector = SVector<f64, SOIL_DIM>;

/// What is known of the soil correction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoilPosterior {
    /// Δθ⁺.
    pub correction: SoilCorrection,
    /// P⁺, in the coordinates of the correction.
    pub covariance: [[f64; SOIL_DIM]; SOIL_DIM],
    /// Whether the drive has told something of each parameter: its variance is below half of the prior one. Where it is false, a consumer
    /// should say "not learned" instead of a number; k_phi and k_c for instance act through one sum on a vehicle of one wheel width.
    pub learned: [bool; SOIL_DIM],
}

impl SoilPosterior {
    /// Standard deviation of each parameter in physical units where the prior is `prior`, to first order.
    pub fn sd(&self, prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        let slope = self.correction.coordinates.slope(&self.correction.apply(prior));
        core::array::from_fn(|i| slope[i] * self.covariance[i][i].sqrt())
    }
}

/// What came of a full buffer.
#[derive(Clone, Debug, PartialEq)]
pub struct SoilUpdate {
    /// The estimate from now on; the one from before when the buffer was rejected.
    pub posterior: SoilPosterior,
    /// Y - Ŷ, row 6 k + c for channel c of transition or block k.
    pub innovation: Vec<f64>,
    /// Normalised innovation squared.
    pub nis: f64,
    /// Degrees of freedom of the NIS, 6 B over the block.
    pub dof: usize,
    /// The gate refused the buffer.
    pub rejected: bool,
    /// Weight of the correction in the posterior, 0 to 1.
    pub trust: f64,
    /// Scale of R_B that the NIS was computed with.
    pub noise_scale: f64,
}

/// The soil filter of one drive.
#[derive(Clone, Debug)]
pub struct SoilFilter {
    config: FilterConfig,
    noise: DMatrix<f64>,
    delta: SoilVector,
    covariance: SoilMatrix,
    scale: NoiseScale,
    trust: Trust,
    buffer: Vec<BufferedTransition>,
}

impl SoilFilter {
    /// A filter that knows the prior only: Δθ = 0, P = P₀.
    ///
    /// # Errors
    /// `AdaptationError::Config` naming the setting that is unusable.
    pub fn new(config: FilterConfig) -> Result<Self, AdaptationError> {
        config.check()?;
        Ok(Self {
            noise: config.noise.covariance(config.buffer, config.block),
            delta: SVector::zeros(),
            covariance: diagonal(&config.prior_sd),
            scale: NoiseScale::new(config.scale_memory),
            trust: Trust::new(config.trust_memory, config.trust_log_odds),
            buffer: Vec::with_capacity(config.buffer),
            config,
        })
    }

    /// Settings.
    pub fn config(&self) -> &FilterConfig {
        &self.config
    }

    /// The present estimate as it should be used: the average over "the ground is what it looks like" and "it is what was learned", each with its
    /// probability, and the covariance of that mixture. Without trust ([`FilterConfig::trust_memory`] = 0) it is Δθ⁺ and P⁺.
    pub fn posterior(&self) -> SoilPosterior {
        let weight = self.trust.weight();
        let p = self.covariance + self.delta * self.delta.transpose() * (weight * (1.0 - weight));
        SoilPosterior {
            correction: self.corrected_by(&(self.delta * weight)),
            covariance: core::array::from_fn(|r| core::array::from_fn(|c| p[(r, c)])),
            learned: core::array::from_fn(|i| p[(i, i)] < LEARNED_SHARE * self.config.prior_sd[i].powi(2)),
        }
    }

    /// Δθ⁺ of the filter itself, whether it is trusted or not: where the next buffer is to be linearised.
    pub fn estimate(&self) -> SoilCorrection {
        self.correction()
    }

    /// Transitions that wait for the next update.
    pub fn buffered(&self) -> usize {
        self.buffer.len()
    }

    /// Takes one transition; the B-th makes an update, which empties the buffer.
    ///
    /// Transitions of a buffer must follow each other without a gap: after one, call [`SoilFilter::clear_buffer`] first.
    ///
    /// # Errors
    /// `NotFinite` or `SingularInnovation`; the estimate is unchanged and the buffer is empty.
    pub fn push(&mut self, model: &StepModel, transition: BufferedTransition) -> Result<Option<SoilUpdate>, AdaptationError> {
        if let Some(what) = not_finite(&transition) {
            let index = self.buffer.len();
            self.buffer.clear();
            return Err(AdaptationError::NotFinite { what, index });
        }
        self.buffer.push(transition);
        if self.buffer.len() < self.config.buffer {
            return Ok(None);
        }
        let buffer = core::mem::take(&mut self.buffer);
        let outcome = self.update(model, &buffer);
        self.buffer = buffer;
        self.buffer.clear();
        outcome.map(Some)
    }

    /// Forgets the transitions that wait: measurements were lost, so the next one does not follow the last.
    pub fn clear_buffer(&mut self) {
        self.buffer.clear();
    }

    fn correction(&self) -> SoilCorrection {
        self.corrected_by(&self.delta)
    }

    fn corrected_by(&self, delta: &SoilVector) -> SoilCorrection {
        SoilCorrection { coordinates: self.config.coordinates, delta: core::array::from_fn(|i| delta[i]) }
    }

    /// Lines "Δθ⁻ ← Δθ⁺" to "P⁺" of Algorithm 1. NIS and gate belong to the linearisation at Δθ⁻; later ones, where the settings ask for
    /// them, solve for the same posterior from a better point: e_i = Y - Ŷ(Δ_i) - H_i (Δθ⁻ - Δ_i).
    fn update(&mut self, model: &StepModel, buffer: &[BufferedTransition]) -> Result<SoilUpdate, AdaptationError> {
        let (prior, before) = (self.inflated(), self.delta);
        let first = self.linearise(model, buffer, &self.correction())?;
        let noise_scale = self.scale.value();
        let noise = &self.noise * noise_scale;
        let mut step = kalman_update(&prior, &first.jacobian, &noise, &first.innovation)?;
        let (nis, dof) = (step.nis, first.innovation.len());
        self.scale.observe(nis / dof as f64);
        let shared = &noise * self.config.shared_buffers;
        let rejected = chi_square_tail(dof, nis) < self.config.gate_tail_probability;
        if !rejected {
            self.judge(model, buffer, noise_scale)?;
            if self.config.shared_buffers > 1.0 {
                step = kalman_update(&prior, &first.jacobian, &shared, &first.innovation)?;
            }
            let mut delta = self.held(before + step.change, buffer);
            let mut last_move = step.change;
            for _ in 1..self.config.linearisations {
                if (0..SOIL_DIM).all(|i| last_move[i].abs() < CONVERGED_SHARE * self.config.prior_sd[i]) {
                    break;
                }
                let again = self.linearise(model, buffer, &self.corrected_by(&delta))?;
                let innovation = &again.innovation - &again.jacobian * (before - delta);
                step = kalman_update(&prior, &again.jacobian, &shared, &innovation)?;
                let next = self.held(before + step.change, buffer);
                last_move = next - delta;
                delta = next;
            }
            self.delta = delta;
            self.covariance = step.covariance;
            self.trust.remember(self.delta);
        }
        let innovation = first.innovation.iter().copied().collect();
        let trust = self.trust.weight();
        Ok(SoilUpdate { posterior: self.posterior(), innovation, nis, dof, rejected, trust, noise_scale })
    }

    /// Lets a buffer say whether an earlier correction predicts it better than the prior alone. Both start from the same transitions: what the network says
    /// along the rollout stays as it is.
    fn judge(&mut self, model: &StepModel, buffer: &[BufferedTransition], noise_scale: f64) -> Result<(), AdaptationError> {
        let Some(candidate) = self.trust.candidate() else { return Ok(()) };
        let rows = self.noise.nrows();
        let factor = self.noise.clone().cholesky().ok_or(AdaptationError::SingularInnovation { rows })?;
        let squared = |correction: &SoilCorrection| -> Result<f64, AdaptationError> {
            let innovation = self.linearise(model, buffer, correction)?.innovation;
            Ok(innovation.dot(&factor.solve(&innovation)))
        };
        let (without, with) = (squared(&SoilCorrection::NONE)?, squared(&self.corrected_by(&candidate))?);
        self.trust.vote(0.5 * (without - with) / (noise_scale * self.config.shared_buffers));
        Ok(())
    }

    /// Y - Ŷ and H of a buffer at one correction.
    fn linearise(
        &self,
        model: &StepModel,
        buffer: &[BufferedTransition],
        correction: &SoilCorrection,
    ) -> Result<Linearisation, AdaptationError> {
        linearise(self.config.innovation, self.config.block, model, buffer, correction)
    }

    /// P⁻ = P⁺ + Q_B; with `bounded`, no variance above that of P₀. Rows and columns are scaled together, so correlations stay.
    fn inflated(&self) -> SoilMatrix {
        let prior = self.covariance + diagonal(&self.config.process_sd);
        if !self.config.bounded {
            return prior;
        }
        let scale: [f64; SOIL_DIM] = core::array::from_fn(|i| (self.config.prior_sd[i] / prior[(i, i)].sqrt()).min(1.0));
        SoilMatrix::from_fn(|r, c| prior[(r, c)] * scale[r] * scale[c])
    }

    /// The correction, with `bounded` moved to where at least one transition of the buffer is not clipped beyond its bound.
    fn held(&self, delta: SoilVector, buffer: &[BufferedTransition]) -> SoilVector {
        if !self.config.bounded {
            return delta;
        }
        let [low, high] = [SOIL_BOUNDS.map(|b| b.0), SOIL_BOUNDS.map(|b| b.1)];
        let coordinates = self.config.coordinates;
        let mut reach = [[f64::INFINITY; SOIL_DIM], [f64::NEG_INFINITY; SOIL_DIM]];
        for transition in buffer {
            let prior = transition.input.soil.to_array();
            let (down, up) = (coordinates.between(&prior, &low), coordinates.between(&prior, &high));
            for i in 0..SOIL_DIM {
                reach[0][i] = reach[0][i].min(down[i]);
                reach[1][i] = reach[1][i].max(up[i]);
            }
        }
        SoilVector::from_fn(|i, _| delta[i].max(reach[0][i]).min(reach[1][i]))
    }
}

/// Y - Ŷ and H of a buffer at one correction.
struct Linearisation {
    innovation: DVector<f64>,
    jacobian: DMatrix<f64>,
}

fn linearise(
    kind: Innovation,
    block: usize,
    model: &StepModel,
    buffer: &[BufferedTransition],
    correction: &SoilCorrection,
) -> Result<Linearisation, AdaptationError> {
    let rows = buffer.len() / block * VELOCITY_DIM;
    let (mut innovation, mut jacobian) = (DVector::zeros(rows), DMatrix::zeros(rows, SOIL_DIM));
    let predictions = match kind {
        Innovation::OneStep => buffer.iter().map(|transition| predict_velocity(model, transition, correction)).collect(),
        Innovation::Rollout => predict_velocities(model, buffer, correction),
    };
    let share = 1.0 / block as f64;
    for (index, (transition, predicted)) in buffer.iter().zip(predictions).enumerate() {
        if !predicted.velocity.iter().chain(predicted.jacobian.as_flattened()).all(|v| v.is_finite()) {
            return Err(AdaptationError::NotFinite { what: "prediction", index });
        }
        for c in 0..VELOCITY_DIM {
            let row = index / block * VELOCITY_DIM + c;
            innovation[row] += share * (transition.measured_next[c] - predicted.velocity[c]);
            for i in 0..SOIL_DIM {
                jacobian[(row, i)] += share * predicted.jacobian[c][i];
            }
        }
    }
    Ok(Linearisation { innovation, jacobian })
}

/// A buffer at the soil prior as it is: what the noise of a filter is estimated from.
///
/// # Errors
/// `NotFinite` when a prediction is not a number.
pub fn uncorrected(config: &FilterConfig, model: &StepModel, buffer: &[BufferedTransition]) -> Result<UncorrectedBuffer, AdaptationError> {
    let at_prior = linearise(config.innovation, config.block, model, buffer, &SoilCorrection::NONE)?;
    Ok(UncorrectedBuffer { innovation: at_prior.innovation, jacobian: at_prior.jacobian })
}

fn diagonal(sd: &[f64; SOIL_DIM]) -> SoilMatrix {
    SoilMatrix::from_diagonal(&SVector::from_fn(|i, _| sd[i] * sd[i]))
}

/// Names the part of a transition that is not finite.
fn not_finite(transition: &BufferedTransition) -> Option<&'static str> {
    let input = &transition.input;
    let wheels = &input.wheels;
    let ground = input.ground.iter().flat_map(|g| [g.height_m, g.slope_ahead, g.slope_left]);
    let scalars = [wheels.rim_follow, wheels.rim_gain, wheels.overspeed_limit_m_s, wheels.speed_m_s];
    let mut numbers = input
        .state
        .to_array()
        .into_iter()
        .chain(input.soil.to_array())
        .chain(input.sinkage_log_ratio)
        .chain(wheels.angle_rad)
        .chain(wheels.rim_base_m_s)
        .chain(scalars)
        .chain(ground)
        .chain(transition.residual);
    if !numbers.all(f64::is_finite) {
        return Some("input");
    }
    (!transition.measured_next.iter().all(|v| v.is_finite())).then_some("measurement")
}
