//! Settings of the filter and what each of them does.

use nalgebra::DMatrix;
use nesam_physics::{SOIL_DIM, SoilCoordinates};
use serde::{Deserialize, Serialize};

use crate::AdaptationError;
use crate::conditions::NoiseConditions;
use crate::noise::{BufferNoise, ChannelNoise, SharedError, VelocityNoise};
use crate::prediction::VELOCITY_DIM;

/// Longest buffer, so that the innovation covariance stays small.
const BUFFER_MAX: usize = 64;
/// More classes would make the update dear.
const CLASSES_MAX: usize = 16;
/// More passes than this do not help: the iteration has converged or never will.
const LINEARISATIONS_MAX: usize = 10;

/// What a buffer is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Innovation {
    /// One step from each measured state, as in the paper.
    OneStep,
    /// One rollout from the first measured state of the buffer.
    #[default]
    Rollout,
}

/// Settings of a [`crate::SoilFilter`].
#[derive(Clone, Debug, PartialEq)]
pub struct FilterConfig {
    /// Transitions B of one update. Longer buffers average noise and cost latency: the soil is B steps old at worst. 1 to 64.
    pub buffer: usize,
    /// Steps whose differences are averaged into one row per channel; divides the buffer. 1 = a row per step, as in the paper. Soil acts slowly,
    /// vibration and sensor noise do not: means keep what the soil says, and their errors are closer to Gaussian.
    pub block: usize,
    /// Coordinates of the estimate and of the two standard deviations below.
    pub coordinates: SoilCoordinates,
    /// What a buffer is compared with. A rollout is closer to what predictions are for, see `predict_along` in `prediction.rs`.
    pub innovation: Innovation,
    /// Standard deviations of P₀: how wrong the soil prior may be. Larger: faster first reaction, and more of the error of the model
    /// taken for soil.
    pub prior_sd: [f64; SOIL_DIM],
    /// Standard deviations of Q_B: how far the soil relative to its prior may move within one buffer. Larger: follows a change of ground
    /// faster, and never settles.
    pub process_sd: [f64; SOIL_DIM],
    /// R_B. Too small: the filter becomes certain of a wrong soil (NIS over its degrees of freedom well above 1); too large: it learns slowly.
    pub noise: BufferNoise,
    /// Beyond Algorithm 1: how R_B grows with speed, turning, relief and softness ([`crate::calibrate`]); `None` = one R_B for all. Without it smooth
    /// driving counts too little and rough driving too much.
    pub noise_conditions: Option<NoiseConditions>,
    /// Beyond Algorithm 1: the part of R_B that carries on from buffer to buffer, estimated beside the soil; `None` = all buffers err independently, or, with
    /// `shared_buffers`, are counted less. With it a constant error of the model is not taken for soil and NIS is honest.
    pub shared_error: Option<SharedError>,
    /// Beyond Algorithm 1: degrees of freedom ν of Student's t in place of the normal distribution, 0 = normal. A buffer with a large NIS has its noise
    /// counted (ν + NIS)/(ν + dof) times. Smaller: wild buffers teach less.
    pub tail_dof: f64,
    /// Beyond Algorithm 1: a buffer from which no parameter could learn more than this share of its prior information, max_i P₀_ii (Hᵀ R_B⁻¹ H)_ii, leaves the
    /// estimate as it is. 0 = every buffer counts.
    pub excitation_min: f64,
    /// Beyond Algorithm 1: classes of ground with a correction of their own, 1 to 16; the first is that of ground that tells no class, further ones than there are
    /// count as the first. 1 = one correction for all, as in the paper.
    pub classes: usize,
    /// Share of P₀ and Q_B that each class has for itself, 0 to 1; the rest is common, so that a class that was never driven on follows the others. 0 = all
    /// classes are one; 1 = they say nothing of each other.
    pub class_share: f64,
    /// Beyond Algorithm 1: consecutive buffers that say together no more than one, at least 1. The model errs alike as long as the vehicle stays on one
    /// patch of ground, which R_B of single buffers cannot say ([`crate::calibrate`] estimates how many); the update counts R_B this many times (a tempered likelihood). The NIS does not.
    pub shared_buffers: f64,
    /// Beyond Algorithm 1: factor, at least 1, by which the update takes the errors of each channel [v, ω] to be larger than R_B says: how far they are from saying
    /// something of the *soil*. Heave, roll and pitch within a second tell more of the ride than of the ground; left to count in full, they move the soil to where
    /// speed and turning come out worse. The NIS does not know of it.
    pub caution: [f64; VELOCITY_DIM],
    /// Beyond Algorithm 1: buffers over which the scale of R_B on the present drive is matched to the NIS, at least 1; 0 = R_B as it is. The model errs more on
    /// ground that it was not trained for; a short memory follows faster and lets single buffers swing the gain.
    pub scale_memory: f64,
    /// Beyond Algorithm 1: buffers over which evidence that the correction predicts better than the prior alone is remembered, at least 1; 0 = the correction is
    /// always used in full. The estimate that goes out is the correction times the probability that it helps.
    pub trust_memory: f64,
    /// Log odds, before any evidence, that the correction helps. Lower: less harm on ground that is what it looks like, and a slower start elsewhere.
    pub trust_log_odds: f64,
    /// Beyond Algorithm 1: probability, before a buffer is looked at, that the ground has changed since the last one to something that nothing learned tells of; 0 =
    /// never. A buffer that fits P₀ better than P⁻ then moves P⁻ towards P₀, as far as it is likely that the ground has changed.
    pub change_probability: f64,
    /// Beyond Algorithm 1: how much the ground varies about the prior where it is what it looks like, as a share of the filter's own variance, above 0 and at most 1. The
    /// covariance that goes out is the average of that and of the filter's own, each with its probability; 1 = the filter's own. Smaller: narrower bands on usual ground.
    pub looks_share: f64,
    /// A buffer whose NIS would be exceeded with less than this probability is rejected. 0 accepts everything.
    pub gate_tail_probability: f64,
    /// Beyond Algorithm 1: times that one buffer is linearised at most, 1 to 10 (Gauss-Newton on the same posterior; 1 = once, at Δθ⁻). Soil acts
    /// far from linearly: a single large step overshoots, and its covariance is certain of where it landed.
    pub linearisations: usize,
    /// Beyond Algorithm 1: the correction stops where every θ_k of the buffer is clipped, instead of running on behind the bound, where H
    /// is zero and nothing would bring it back; and the soil tends back to its prior as fast as Q_B lets it go (ρ² = 1 - Q_B/P₀), so that no variance exceeds
    /// that of P₀ while the drive excites nothing.
    pub bounded: bool,
}

impl Default for FilterConfig {
    /// Relative corrections of the scale-like parameters, bounded. P₀ is the spread of soils within a semantic class and its neighbours
    /// (a factor of two in the moduli, 0.15 in n, 5 degrees of friction); Q_B lets a tenth of it go in a buffer.
    fn default() -> Self {
        let prior_sd = [0.7, 0.7, 0.15, 0.5, 0.08, 0.4];
        Self {
            buffer: 10,
            block: 5,
            coordinates: SoilCoordinates::Logarithmic,
            innovation: Innovation::Rollout,
            prior_sd,
            process_sd: Self::process_sd_of(&prior_sd),
            noise: BufferNoise::Channels(default_noise()),
            noise_conditions: None,
            shared_error: None,
            tail_dof: 0.0,
            excitation_min: 1e-3,
            classes: 1,
            class_share: 0.25,
            shared_buffers: 4.0,
            caution: [1.0; VELOCITY_DIM],
            scale_memory: 5.0,
            trust_memory: 10.0,
            trust_log_odds: -3.0,
            change_probability: 0.0,
            looks_share: 1.0,
            gate_tail_probability: 1e-9,
            linearisations: 4,
            bounded: true,
        }
    }
}

impl FilterConfig {
    /// Q_B of a prior, unless it is told: a tenth of it goes in a buffer.
    pub fn process_sd_of(prior_sd: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        prior_sd.map(|sd| 0.1 * sd)
    }

    /// The same filter on ground of unseen colour: one soil stands in for all that the prior would tell apart, so P₀ is wider by their variance, and no ground is
    /// what it looks like. `soil_sd` are their standard deviations in logarithmic coordinates; with physical ones, the paper's, nothing changes.
    pub fn on_unseen_soil(&self, soil_sd: &[f64; SOIL_DIM]) -> Self {
        match self.coordinates {
            SoilCoordinates::Physical => self.clone(),
            SoilCoordinates::Logarithmic => {
                Self { prior_sd: core::array::from_fn(|i| self.prior_sd[i].hypot(soil_sd[i])), looks_share: 1.0, ..self.clone() }
            }
        }
    }

    /// Algorithm 1 word for word: Δθ in physical units, one linearisation, nothing held at a bound, P⁻ = P⁺ + Q_B without a cap.
    pub fn literal() -> Self {
        let prior_sd = [1.0e6, 3.0e3, 0.15, 1.5e3, 0.08, 0.008];
        Self {
            coordinates: SoilCoordinates::Physical,
            innovation: Innovation::OneStep,
            block: 1,
            shared_buffers: 1.0,
            scale_memory: 0.0,
            trust_memory: 0.0,
            excitation_min: 0.0,
            classes: 1,
            class_share: 0.0,
            prior_sd,
            process_sd: Self::process_sd_of(&prior_sd),
            linearisations: 1,
            bounded: false,
            ..Self::default()
        }
    }

    /// Refuses settings that no filter can run with.
    ///
    /// # Errors
    /// `AdaptationError::Config` naming the setting.
    pub fn check(&self) -> Result<(), AdaptationError> {
        let fail = |setting, reason: String| Err(AdaptationError::Config { setting, reason });
        if self.buffer == 0 || self.buffer > BUFFER_MAX {
            return fail("buffer", format!("is {}, allowed are 1 to {BUFFER_MAX} transitions", self.buffer));
        }
        if !self.prior_sd.iter().all(|v| v.is_finite() && *v > 0.0) {
            return fail("prior_sd", format!("is {:?}; all six must be positive", self.prior_sd));
        }
        if !self.process_sd.iter().all(|v| v.is_finite() && *v >= 0.0) {
            return fail("process_sd", format!("is {:?}; all six must be at least 0", self.process_sd));
        }
        for (setting, value) in [("gate_tail_probability", self.gate_tail_probability), ("change_probability", self.change_probability)] {
            if !(0.0..1.0).contains(&value) {
                return fail(setting, format!("is {value}, it must lie in [0, 1)"));
            }
        }
        if self.linearisations == 0 || self.linearisations > LINEARISATIONS_MAX {
            return fail("linearisations", format!("is {}, allowed are 1 to {LINEARISATIONS_MAX}", self.linearisations));
        }
        if self.block == 0 || !self.buffer.is_multiple_of(self.block) {
            return fail("block", format!("is {}; it must divide the buffer of {} transitions", self.block, self.buffer));
        }
        if !(self.shared_buffers.is_finite() && self.shared_buffers >= 1.0) {
            return fail("shared_buffers", format!("is {}, it must be at least 1", self.shared_buffers));
        }
        if !self.caution.iter().all(|factor| factor.is_finite() && *factor >= 1.0) {
            return fail("caution", format!("is {:?}; all six must be at least 1", self.caution));
        }
        for (setting, memory) in [("scale_memory", self.scale_memory), ("trust_memory", self.trust_memory)] {
            if !(memory == 0.0 || memory.is_finite() && memory >= 1.0) {
                return fail(setting, format!("is {memory}, it must be 0 (off) or at least 1 buffer"));
            }
        }
        if !(self.looks_share > 0.0 && self.looks_share <= 1.0) {
            return fail("looks_share", format!("is {}, it must lie in (0, 1]", self.looks_share));
        }
        if !self.trust_log_odds.is_finite() {
            return fail("trust_log_odds", format!("is {}, it must be finite", self.trust_log_odds));
        }
        if !(1..=CLASSES_MAX).contains(&self.classes) {
            return fail("classes", format!("is {}, allowed are 1 to {CLASSES_MAX}", self.classes));
        }
        if !(0.0..=1.0).contains(&self.class_share) {
            return fail("class_share", format!("is {}, it must lie in [0, 1]", self.class_share));
        }
        for (setting, value) in [("tail_dof", self.tail_dof), ("excitation_min", self.excitation_min)] {
            if !(value.is_finite() && value >= 0.0) {
                return fail(setting, format!("is {value}, it must be at least 0"));
            }
        }
        if let Some(conditions) = &self.noise_conditions
            && !conditions.mean.iter().chain(&conditions.slope).all(|v| v.is_finite())
        {
            return fail("noise_conditions", format!("is {conditions:?}; all numbers must be finite"));
        }
        self.noise.check(self.rows())?;
        self.shared_error.as_ref().map_or(Ok(()), |shared| shared.check(&self.noise.covariance(self.buffer, self.block)))
    }

    /// The noise as what is learned of the soil reckons with it.
    pub(crate) fn with_caution(&self, noise: &DMatrix<f64>) -> DMatrix<f64> {
        let of = |row: usize| self.caution[row % VELOCITY_DIM];
        DMatrix::from_fn(noise.nrows(), noise.ncols(), |r, c| of(r) * noise[(r, c)] * of(c))
    }

    /// Rows of an innovation, a multiple of the six channels.
    pub fn rows(&self) -> usize {
        self.buffer / self.block.max(1) * VELOCITY_DIM
    }
}

/// Noise to start from when nothing was estimated for a bundle: velocity sensors of a few centimetres per second and a model error as large.
fn default_noise() -> VelocityNoise {
    let of = |white_sd, coloured_sd| ChannelNoise { white_sd, coloured_sd, correlation: 0.6 };
    VelocityNoise { channels: [of(0.05, 0.03), of(0.05, 0.03), of(0.06, 0.03), of(0.05, 0.03), of(0.05, 0.03), of(0.02, 0.01)] }
}
