//! Algorithm 1: buffer, one update per full buffer, gate.

use nalgebra::{DMatrix, DVector, SMatrix, SVector};
use nesam_physics::step::StepModel;
use nesam_physics::{SOIL_BOUNDS, SOIL_DIM, SoilCorrection};

use crate::agreement::{Agreement, agreement};
use crate::calibration::UncorrectedBuffer;
use crate::conditions::conditions;
use crate::joint::{JointState, Linearisation, correction_of};
use crate::prediction::{BufferedTransition, VELOCITY_DIM, predict_along, velocities_along};
use crate::trust::{NoiseScale, Trust};
use crate::update::KalmanStep;
use crate::{AdaptationError, FilterConfig, Innovation, chi_square_tail};

mod snapshot;

pub use snapshot::{ClassBelief, FilterSnapshot, JointSnapshot};

/// Share of the prior variance below which a parameter counts as learned.
const LEARNED_SHARE: f64 = 0.5;
/// Weight of the correction above which what was learned counts as such: it is more likely right than the prior alone.
const LEARNED_TRUST: f64 = 0.5;
/// Most that the covariance that goes out is widened by for errors of the model: twice the standard deviation (chosen, ADR 0068).
const WIDENED_MAX: f64 = 4.0;
/// Share of the prior standard deviation below which another linearisation would change nothing: each move is about a tenth of the one before, so what is left
/// is a thousandth.
const CONVERGED_SHARE: f64 = 1e-2;

/// What is known of the soil correction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoilPosterior {
    /// Δθ⁺.
    pub correction: SoilCorrection,
    /// How sure it is, in the coordinates of the correction: see [`SoilFilter::posterior`].
    pub covariance: [[f64; SOIL_DIM]; SOIL_DIM],
    /// Whether the drive has told much of each parameter: its variance, as it is before trust and scale narrow or widen what goes out, is below half of the prior
    /// one, and the correction is trusted more than the prior alone. Where it is false, a consumer should say "not learned" instead of a number; k_phi and k_c for instance act through one sum on a vehicle of
    /// one wheel width. A correction can be right all the same: where the ground may change unannounced, variances seldom stay so small.
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
    /// What the filter itself believed of that ground when it met the buffer, how likely the ground had changed since included: Δ⁻ and P⁻.
    pub before: ClassBelief,
    /// Y - Ŷ, row 6 k + c for channel c of transition or block k.
    pub innovation: Vec<f64>,
    /// Normalised innovation squared.
    pub nis: f64,
    /// Degrees of freedom of the NIS, 6 B over the block.
    pub dof: usize,
    /// How the buffer agrees with what the bundle expects, whatever this drive was like so far.
    pub agreement: Agreement,
    /// The gate refused the buffer.
    pub rejected: bool,
    /// The drive told something of the soil; where it did not, the estimate stays as it was.
    pub excited: bool,
    /// max_i P₀_ii (Hᵀ R_B⁻¹ H)_ii, what the buffer could tell at most, in units of what the prior tells.
    pub excitation: f64,
    /// Logarithm of the likelihood of the buffer before it was learned from, up to a constant: compares settings on the same buffers.
    pub log_likelihood: f64,
    /// Weight of the correction in the posterior, 0 to 1.
    pub trust: f64,
    /// Factor on R_B that the NIS was computed with, conditions included.
    pub noise_scale: f64,
}

/// The soil filter of one drive.
#[derive(Clone, Debug)]
pub struct SoilFilter {
    config: FilterConfig,
    /// R_B, and what of it single buffers err by.
    noise: DMatrix<f64>,
    rest: DMatrix<f64>,
    state: JointState,
    /// The same model with the soil known to be the prior; judges the correction where errors carry on.
    plain: JointState,
    scale: NoiseScale,
    trust: Trust,
    buffer: Vec<BufferedTransition>,
    /// Class of the ground under the newest transition.
    here: usize,
    /// What the next update expects its innovation to err by beyond R_B.
    considered: Option<DMatrix<f64>>,
}

impl SoilFilter {
    /// A filter that knows the prior only: Δθ = 0, P = P₀.
    ///
    /// # Errors
    /// `AdaptationError::Config` naming the setting that is unusable.
    pub fn new(config: FilterConfig) -> Result<Self, AdaptationError> {
        config.check()?;
        let noise = config.noise.covariance(config.buffer, config.block);
        Ok(Self {
            rest: config.shared_error.as_ref().map_or_else(|| noise.clone(), |s| s.rest(&noise)),
            noise,
            state: JointState::prior(&config),
            plain: JointState::without_soil(&config),
            scale: NoiseScale::new(config.scale_memory),
            trust: Trust::new(config.trust_memory, config.trust_log_odds),
            buffer: Vec::with_capacity(config.buffer),
            here: 0,
            considered: None,
            config,
        })
    }

    /// Settings.
    pub fn config(&self) -> &FilterConfig {
        &self.config
    }

    /// The present estimate of the ground under the newest transition as it should be used: the average over "the ground is what it looks like" and "it is what
    /// was learned", each with its probability, and the covariance of that mixture, wider by the factor on R_B of this drive as far as that is above 1: where the model
    /// errs more than R_B says, the one correction that it learns says less of the ground under the vehicle. Without trust and scale
    /// ([`FilterConfig::trust_memory`] = [`FilterConfig::scale_memory`] = 0) it is Δθ⁺ and P⁺.
    pub fn posterior(&self) -> SoilPosterior {
        self.posterior_of(self.here)
    }

    /// The same of one class of ground.
    pub fn posterior_of(&self, class: usize) -> SoilPosterior {
        let class = if class < self.config.classes { class } else { 0 };
        let weight = self.trust.weight();
        let mut correction = correction_of(&self.state.soils(), class, &self.config);
        let delta = SVector::<f64, SOIL_DIM>::from(correction.delta);
        let (own, between) = (self.state.soil_covariance(class), delta * delta.transpose() * (weight * (1.0 - weight)));
        let p = own + between;
        let within = weight + (1.0 - weight) * self.config.looks_share;
        let told = own * (within * self.scale.value().clamp(1.0, WIDENED_MAX)) + between;
        correction.delta = correction.delta.map(|d| weight * d);
        SoilPosterior {
            correction,
            covariance: core::array::from_fn(|r| core::array::from_fn(|c| told[(r, c)])),
            learned: core::array::from_fn(|i| weight > LEARNED_TRUST && p[(i, i)] < LEARNED_SHARE * self.config.prior_sd[i].powi(2)),
        }
    }

    /// The posteriors of all classes, see [`FilterConfig::classes`].
    pub fn posteriors(&self) -> Vec<SoilPosterior> {
        (0..self.config.classes).map(|class| self.posterior_of(class)).collect()
    }

    /// Δθ⁺ of the filter itself for every class, whether it is trusted or not: where the next buffer is to be linearised.
    pub fn estimates(&self) -> Vec<SoilCorrection> {
        (0..self.config.classes).map(|class| correction_of(&self.state.soils(), class, &self.config)).collect()
    }

    /// The same of the ground under the newest transition.
    pub fn estimate(&self) -> SoilCorrection {
        correction_of(&self.state.soils(), self.here, &self.config)
    }

    /// P⁺ of that estimate, in its coordinates.
    pub fn covariance(&self) -> SMatrix<f64, SOIL_DIM, SOIL_DIM> {
        self.state.soil_covariance(if self.here < self.config.classes { self.here } else { 0 })
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
        self.here = transition.ground_class;
        self.buffer.push(transition);
        if self.buffer.len() < self.config.buffer {
            return Ok(None);
        }
        let buffer = core::mem::take(&mut self.buffer);
        let before = (self.scale, self.trust.clone(), self.plain.clone());
        let outcome = self.update(model, &buffer);
        if outcome.is_err() {
            (self.scale, self.trust, self.plain) = before;
        }
        self.buffer = buffer;
        self.buffer.clear();
        outcome.map(Some)
    }

    /// Makes the next update expect what parameters outside of the soil may be wrong by: C = Σ d dᵀ on top of R_B, where d is how the innovation of the
    /// coming buffer changes when one of them is one standard deviation off. `shifted` holds the same buffer as each such model sees it.
    ///
    /// These are consider parameters (Schmidt) without their correlation with the soil: each update takes their error for a new one, so a filter that sees
    /// the same error in every buffer is surer of the soil than it should be.
    ///
    /// # Errors
    /// `NotFinite` when a prediction is not a number; nothing is considered then.
    pub fn consider(
        &mut self,
        model: &StepModel,
        buffer: &[BufferedTransition],
        shifted: &[(&StepModel, Vec<BufferedTransition>)],
    ) -> Result<(), AdaptationError> {
        self.considered = None;
        if shifted.is_empty() {
            return Ok(());
        }
        let at = self.state.predicted(&self.config).soils();
        let usual = innovation(&self.config, model, buffer, &at)?;
        let mut sum = DMatrix::zeros(usual.len(), usual.len());
        for (model, buffer) in shifted {
            let change = innovation(&self.config, model, buffer, &at)? - &usual;
            sum += &change * change.transpose();
        }
        self.considered = Some(sum);
        Ok(())
    }

    /// Forgets the transitions that wait: measurements were lost, so the next one does not follow the last.
    pub fn clear_buffer(&mut self) {
        self.buffer.clear();
    }

    /// Lines "Δθ⁻ ← Δθ⁺" to "P⁺" of Algorithm 1. NIS and gate belong to the linearisation at Δθ⁻; later ones, where the settings ask for
    /// them, solve for the same posterior from a better point: e_i = Y - Ŷ(Δ_i) - H_i (Δθ⁻ - Δ_i). Differences and H are divided by the root of the factor
    /// on R_B, so that what carries on is the same number in every buffer.
    fn update(&mut self, model: &StepModel, buffer: &[BufferedTransition]) -> Result<SoilUpdate, AdaptationError> {
        let mut ahead = self.state.predicted(&self.config);
        let before = ahead.soils();
        let factor = self.config.noise_conditions.map_or(1.0, |c| c.factor(&conditions(buffer)));
        let noise_scale = self.scale.value() * factor;
        let unit = noise_scale.sqrt().recip();
        let raw = self.linearise(model, buffer, &before)?;
        let innovation = raw.innovation.iter().copied().collect();
        // What is considered is as large as it is on any ground: the factor on R_B is not on it.
        let considered = self.considered.take();
        let rest = considered.as_ref().map_or_else(|| self.rest.clone(), |considered| &self.rest + considered / noise_scale);
        let agreement = self.agreement(&raw, &ahead, factor, considered)?;
        let first = raw.scaled(unit);
        let judged = ahead.step(&first, &before, &rest)?;
        let (nis, dof) = (judged.nis, first.innovation.len());
        let excitation = self.excitation(&first.jacobian)?;
        self.scale.observe(nis / dof as f64);
        let mut gated = nis;
        let cautious = self.config.with_caution(&rest);
        if let Some(widened) = ahead.changed(&self.config, &first, &cautious)? {
            gated = widened.step(&first, &before, &rest)?.nis;
            ahead = widened;
        }
        let rejected = chi_square_tail(dof, gated) < self.config.gate_tail_probability;
        let excited = excitation >= self.config.excitation_min;
        if !rejected && excited {
            self.judge(model, buffer, unit, &judged, &rest, &cautious)?;
            let tail = if self.config.tail_dof > 0.0 { (self.config.tail_dof + nis) / (self.config.tail_dof + dof as f64) } else { 1.0 };
            let noise = cautious * (self.config.shared_buffers * tail.max(1.0));
            let mut linear = first;
            let mut step = ahead.step(&linear, &before, &noise)?;
            let mut delta = self.held(ahead.moved_soils(&step), buffer);
            let mut last_move = &delta - before;
            for _ in 1..self.config.linearisations {
                if last_move.iter().enumerate().all(|(i, v)| v.abs() < CONVERGED_SHARE * self.config.prior_sd[i % SOIL_DIM]) {
                    break;
                }
                linear = self.linearise(model, buffer, &delta)?.scaled(unit);
                step = ahead.step(&linear, &delta, &noise)?;
                let next = self.held(ahead.moved_soils(&step), buffer);
                last_move = &next - &delta;
                delta = next;
            }
            self.state = ahead.after(&step, &linear, &noise, &delta);
            self.trust.remember(delta);
        }
        let log_likelihood = -0.5 * (nis + judged.log_det + dof as f64 * noise_scale.ln());
        let trust = self.trust.weight();
        Ok(SoilUpdate {
            posterior: self.posterior(),
            before: self.belief_in(&ahead, self.here),
            innovation,
            nis,
            dof,
            agreement,
            rejected,
            excited,
            excitation,
            log_likelihood,
            trust,
            noise_scale,
        })
    }

    /// How a buffer agrees with R_B under its conditions, `factor` on it.
    fn agreement(
        &self,
        raw: &Linearisation,
        ahead: &JointState,
        factor: f64,
        considered: Option<DMatrix<f64>>,
    ) -> Result<Agreement, AdaptationError> {
        let noise = &self.noise * factor + considered.unwrap_or_else(|| DMatrix::zeros(self.noise.nrows(), self.noise.ncols()));
        let through = |covariance: DMatrix<f64>| &raw.jacobian * covariance * raw.jacobian.transpose();
        let prior = JointState::prior(&self.config).soils_covariance();
        agreement(&raw.innovation, through(ahead.soils_covariance()), through(prior), &noise)
    }

    /// max_i P₀_ii (Hᵀ R_B⁻¹ H)_ii: what a buffer could tell of the parameter that it tells most of, in units of what the prior tells.
    fn excitation(&self, jacobian: &DMatrix<f64>) -> Result<f64, AdaptationError> {
        let rows = self.noise.nrows();
        let factor = self.noise.clone().cholesky().ok_or(AdaptationError::SingularInnovation { rows })?;
        let weighed = factor.solve(jacobian);
        let told = |i: usize| self.config.prior_sd[i % SOIL_DIM].powi(2) * jacobian.column(i).dot(&weighed.column(i));
        Ok((0..jacobian.ncols()).map(told).fold(0.0, f64::max))
    }

    /// Lets a buffer say whether what was learned predicts it better than the prior alone. Both start from the same transitions: what the network says
    /// along the rollout stays as it is. Where errors carry on, both follow them and their predictive likelihoods are compared; else an earlier
    /// correction is compared with none. `rest` is the noise that was not shared, with what is considered, and `cautious` the same with caution.
    fn judge(
        &mut self,
        model: &StepModel,
        buffer: &[BufferedTransition],
        unit: f64,
        judged: &KalmanStep,
        rest: &DMatrix<f64>,
        cautious: &DMatrix<f64>,
    ) -> Result<(), AdaptationError> {
        if self.config.trust_memory == 0.0 {
            return Ok(());
        }
        let none = DVector::zeros(SOIL_DIM * self.config.classes);
        if self.config.shared_error.is_some() {
            // Of a soil that is known nothing is asked how it acts.
            let innovation = innovation(&self.config, model, buffer, &none)?;
            let at_prior = Linearisation { jacobian: DMatrix::zeros(innovation.len(), none.len()), innovation }.scaled(unit);
            let ahead = self.plain.predicted_without_soil(&self.config);
            let step = ahead.step(&at_prior, &none, rest)?;
            self.trust.vote(0.5 * (step.nis + step.log_det - judged.nis - judged.log_det));
            self.plain = ahead.after(&step, &at_prior, rest, &none);
            return Ok(());
        }
        let Some(candidate) = self.trust.candidate() else { return Ok(()) };
        let rows = self.noise.nrows();
        let factor = cautious.clone().cholesky().ok_or(AdaptationError::SingularInnovation { rows })?;
        let squared = |correction: &DVector<f64>| -> Result<f64, AdaptationError> {
            let innovation = innovation(&self.config, model, buffer, correction)? * unit;
            Ok(innovation.dot(&factor.solve(&innovation)))
        };
        let (without, with) = (squared(&none)?, squared(&candidate)?);
        self.trust.vote(0.5 * (without - with) / self.config.shared_buffers);
        Ok(())
    }

    /// Y - Ŷ and H of a buffer at one correction.
    fn linearise(&self, model: &StepModel, buffer: &[BufferedTransition], at: &DVector<f64>) -> Result<Linearisation, AdaptationError> {
        linearise(&self.config, model, buffer, at)
    }

    /// The corrections, with `bounded` moved to where at least one transition of the buffer on that class is not clipped beyond its bound.
    fn held(&self, mut soils: DVector<f64>, buffer: &[BufferedTransition]) -> DVector<f64> {
        if !self.config.bounded {
            return soils;
        }
        let [low, high] = [SOIL_BOUNDS.map(|b| b.0), SOIL_BOUNDS.map(|b| b.1)];
        let coordinates = self.config.coordinates;
        for class in classes_in(buffer, self.config.classes) {
            let mut reach = [[f64::INFINITY; SOIL_DIM], [f64::NEG_INFINITY; SOIL_DIM]];
            for transition in buffer.iter().filter(|t| class_of(t, self.config.classes) == class) {
                let prior = transition.input.soil.to_array();
                let (down, up) = (coordinates.between(&prior, &low), coordinates.between(&prior, &high));
                for i in 0..SOIL_DIM {
                    reach[0][i] = reach[0][i].min(down[i]);
                    reach[1][i] = reach[1][i].max(up[i]);
                }
            }
            for i in 0..SOIL_DIM {
                let at = SOIL_DIM * class + i;
                soils[at] = soils[at].max(reach[0][i]).min(reach[1][i]);
            }
        }
        soils
    }
}

/// Class of a transition; those that the filter does not keep apart are the first.
fn class_of(transition: &BufferedTransition, classes: usize) -> usize {
    if transition.ground_class < classes { transition.ground_class } else { 0 }
}

/// Classes that occur in a buffer, ascending.
fn classes_in(buffer: &[BufferedTransition], classes: usize) -> Vec<usize> {
    (0..classes).filter(|class| buffer.iter().any(|t| class_of(t, classes) == *class)).collect()
}

fn linearise(
    config: &FilterConfig,
    model: &StepModel,
    buffer: &[BufferedTransition],
    at: &DVector<f64>,
) -> Result<Linearisation, AdaptationError> {
    let (block, classes) = (config.block, config.classes);
    let rows = buffer.len() / block * VELOCITY_DIM;
    let (mut innovation, mut jacobian) = (DVector::zeros(rows), DMatrix::zeros(rows, SOIL_DIM * classes));
    let correction = |t: &BufferedTransition| correction_of(at, class_of(t, classes), config);
    let share = 1.0 / block as f64;
    for (pass, class) in classes_in(buffer, classes).into_iter().enumerate() {
        let varies = |t: &BufferedTransition| class_of(t, classes) == class;
        let predictions = match config.innovation {
            Innovation::OneStep => {
                buffer.iter().flat_map(|t| predict_along(model, std::slice::from_ref(t), &correction, &varies)).collect()
            }
            Innovation::Rollout => predict_along(model, buffer, &correction, &varies),
        };
        for (index, (transition, predicted)) in buffer.iter().zip(predictions).enumerate() {
            if !predicted.velocity.iter().chain(predicted.jacobian.as_flattened()).all(|v| v.is_finite()) {
                return Err(AdaptationError::NotFinite { what: "prediction", index });
            }
            for c in 0..VELOCITY_DIM {
                let row = index / block * VELOCITY_DIM + c;
                if pass == 0 {
                    innovation[row] += share * (transition.measured_next[c] - predicted.velocity[c]);
                }
                for i in 0..SOIL_DIM {
                    jacobian[(row, SOIL_DIM * class + i)] += share * predicted.jacobian[c][i];
                }
            }
        }
    }
    Ok(Linearisation { innovation, jacobian })
}

/// Y - Ŷ of a buffer at one correction.
fn innovation(
    config: &FilterConfig,
    model: &StepModel,
    buffer: &[BufferedTransition],
    at: &DVector<f64>,
) -> Result<DVector<f64>, AdaptationError> {
    let correction = |t: &BufferedTransition| correction_of(at, class_of(t, config.classes), config);
    let predicted: Vec<[f64; VELOCITY_DIM]> = match config.innovation {
        Innovation::OneStep => buffer.iter().flat_map(|t| velocities_along(model, std::slice::from_ref(t), &correction)).collect(),
        Innovation::Rollout => velocities_along(model, buffer, &correction),
    };
    if let Some(index) = predicted.iter().position(|velocity| !velocity.iter().all(|v| v.is_finite())) {
        return Err(AdaptationError::NotFinite { what: "prediction", index });
    }
    let mut innovation = DVector::zeros(buffer.len() / config.block * VELOCITY_DIM);
    let share = 1.0 / config.block as f64;
    for (index, (transition, velocity)) in buffer.iter().zip(predicted).enumerate() {
        for c in 0..VELOCITY_DIM {
            innovation[index / config.block * VELOCITY_DIM + c] += share * (transition.measured_next[c] - velocity[c]);
        }
    }
    Ok(innovation)
}

/// A buffer at the soil prior as it is: what the noise of a filter is estimated from.
///
/// # Errors
/// `NotFinite` when a prediction is not a number.
pub fn uncorrected(config: &FilterConfig, model: &StepModel, buffer: &[BufferedTransition]) -> Result<UncorrectedBuffer, AdaptationError> {
    let one = FilterConfig { classes: 1, class_share: 0.0, ..config.clone() };
    let at_prior = linearise(&one, model, buffer, &DVector::zeros(SOIL_DIM))?;
    Ok(UncorrectedBuffer { innovation: at_prior.innovation, jacobian: at_prior.jacobian, conditions: conditions(buffer) })
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
