//! What the filter estimates together: a soil correction for each class of ground, and the error of the model that carries on from buffer to buffer.

use nalgebra::{DMatrix, DVector, SMatrix};
use nesam_physics::{SOIL_DIM, SoilCorrection};

use crate::covariance::check_covariance;
use crate::filter::JointSnapshot;
use crate::noise::SharedError;
use crate::update::{KalmanStep, kalman_update};
use crate::{AdaptationError, FilterConfig};

/// What the correlations of a filter's own covariance may be off by.
const ROUNDING: f64 = 1e-9;

/// Covariance of the Δθ of one class.
pub(crate) type SoilMatrix = SMatrix<f64, SOIL_DIM, SOIL_DIM>;

/// Mean and covariance of [Δθ of class 0, Δθ of class 1, …, b]; without a shared error b has no entries.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct JointState {
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    soils: usize,
}

/// Y - Ŷ at a point and ∂Ŷ/∂(Δθ of every class) there, rows × (6 classes).
pub(crate) struct Linearisation {
    pub(crate) innovation: DVector<f64>,
    pub(crate) jacobian: DMatrix<f64>,
}

impl Linearisation {
    pub(crate) fn scaled(mut self, unit: f64) -> Self {
        self.innovation *= unit;
        self.jacobian *= unit;
        self
    }
}

/// Covariance of all classes from variances of one: what is common to all, and what each has for itself.
fn over_classes(variance: impl Fn(usize) -> f64, config: &FilterConfig) -> DMatrix<f64> {
    let size = SOIL_DIM * config.classes;
    DMatrix::from_fn(size, size, |r, c| {
        if r % SOIL_DIM != c % SOIL_DIM {
            return 0.0;
        }
        variance(r % SOIL_DIM) * if r == c { 1.0 } else { 1.0 - config.class_share }
    })
}

impl JointState {
    /// Δθ = 0 with P₀, b as it is on average.
    pub(crate) fn prior(config: &FilterConfig) -> Self {
        let soils = SOIL_DIM * config.classes;
        let covariance = with_shared(over_classes(|i| config.prior_sd[i].powi(2), config), config.shared_error.as_ref(), 1.0);
        Self { mean: DVector::zeros(covariance.nrows()), covariance, soils }
    }

    /// The same with the soil known to be the prior: what there is to compare a correction with.
    pub(crate) fn without_soil(config: &FilterConfig) -> Self {
        let mut state = Self::prior(config);
        state.know_soil();
        state
    }

    fn know_soil(&mut self) {
        self.mean.rows_mut(0, self.soils).fill(0.0);
        self.covariance.rows_mut(0, self.soils).fill(0.0);
        self.covariance.columns_mut(0, self.soils).fill(0.0);
    }

    /// One buffer on. With `bounded` the soil is an Ornstein-Uhlenbeck process around the prior, Δ⁻ = ρ Δ⁺ and P⁻ = ρ P⁺ ρ + Q_B with
    /// ρ² = 1 - Q_B/P₀, so that what is not excited tends to P₀ and never beyond; else the random walk of Algorithm 1. b forgets itself at its own pace.
    pub(crate) fn predicted(&self, config: &FilterConfig) -> Self {
        let shared = config.shared_error.as_ref();
        let prior = |i: usize| config.prior_sd[i].powi(2);
        let process = |i: usize| if config.bounded { config.process_sd[i].powi(2).min(prior(i)) } else { config.process_sd[i].powi(2) };
        let kept = DVector::from_fn(self.mean.len(), |i, _| match shared {
            Some(shared) if i >= self.soils => shared.correlation,
            _ if config.bounded => (1.0 - process(i % SOIL_DIM) / prior(i % SOIL_DIM)).max(0.0).sqrt(),
            _ => 1.0,
        });
        let renewed = shared.map_or(0.0, |s| 1.0 - s.correlation.powi(2));
        let moved = with_shared(over_classes(process, config), shared, renewed);
        let covariance = DMatrix::from_fn(kept.len(), kept.len(), |r, c| kept[r] * self.covariance[(r, c)] * kept[c]) + moved;
        Self { mean: self.mean.component_mul(&kept), covariance, soils: self.soils }
    }

    /// The same where the ground may have changed; `None` where the settings expect no change. P⁻ moves towards P₀ by the probability of a change that a buffer
    /// tells of, which is [`FilterConfig::change_probability`] before it is looked at. The mean stays: what was learned is the best guess of what is new.
    /// `cautious` is R_B with the caution of the settings on it.
    pub(crate) fn changed(
        &self,
        config: &FilterConfig,
        buffer: &Linearisation,
        cautious: &DMatrix<f64>,
    ) -> Result<Option<Self>, AdaptationError> {
        let before = config.change_probability;
        if before == 0.0 {
            return Ok(None);
        }
        let mut new = self.clone();
        new.covariance.view_mut((0, 0), (self.soils, self.soils)).copy_from(&Self::prior(config).soils_covariance());
        let (at, noise) = (self.soils(), cautious * config.shared_buffers);
        let [usual, wide] = [self, &new].map(|state| state.step(buffer, &at, &noise).map(|step| -0.5 * (step.nis + step.log_det)));
        let odds = before / (1.0 - before) * (wide? - usual?).exp();
        let probability = if odds.is_finite() { odds / (1.0 + odds) } else { 1.0 };
        new.covariance = &self.covariance + (&new.covariance - &self.covariance) * probability;
        Ok(Some(new))
    }

    /// One buffer on with the soil known.
    pub(crate) fn predicted_without_soil(&self, config: &FilterConfig) -> Self {
        let mut next = self.predicted(config);
        next.know_soil();
        next
    }

    /// Δθ of every class, one after the other.
    pub(crate) fn soils(&self) -> DVector<f64> {
        self.mean.rows(0, self.soils).into_owned()
    }

    /// Covariance of the Δθ of all classes.
    pub(crate) fn soils_covariance(&self) -> DMatrix<f64> {
        self.covariance.view((0, 0), (self.soils, self.soils)).into_owned()
    }

    /// Mean and covariance as plain numbers.
    pub(crate) fn snapshot(&self) -> JointSnapshot {
        JointSnapshot { mean: self.mean.iter().copied().collect(), covariance: self.covariance.transpose().iter().copied().collect() }
    }

    /// The state of a snapshot; `None` when it is not of this size, or its covariance is none: then every update would fail.
    pub(crate) fn restored(&self, snapshot: &JointSnapshot) -> Option<Self> {
        let n = self.mean.len();
        if snapshot.mean.len() != n || check_covariance(n, &snapshot.covariance, ROUNDING).is_err() {
            return None;
        }
        let covariance = DMatrix::from_row_slice(n, n, &snapshot.covariance);
        Some(Self { mean: DVector::from_column_slice(&snapshot.mean), covariance, soils: self.soils })
    }

    /// Covariance of the Δθ of one class.
    pub(crate) fn soil_covariance(&self, class: usize) -> SoilMatrix {
        SoilMatrix::from_fn(|r, c| self.covariance[(SOIL_DIM * class + r, SOIL_DIM * class + c)])
    }

    /// The update from a buffer that was linearised at the corrections `at`. Nothing changes yet.
    pub(crate) fn step(&self, buffer: &Linearisation, at: &DVector<f64>, noise: &DMatrix<f64>) -> Result<KalmanStep, AdaptationError> {
        let mut innovation = &buffer.innovation - &buffer.jacobian * (self.mean.rows(0, self.soils) - at);
        let shared = self.mean.len() - self.soils;
        if shared > 0 {
            innovation -= self.mean.rows(self.soils, shared);
        }
        kalman_update(&self.covariance, &self.with_identity(&buffer.jacobian), noise, &innovation)
    }

    /// H of soils and shared error.
    fn with_identity(&self, jacobian: &DMatrix<f64>) -> DMatrix<f64> {
        let shared = self.mean.len() - self.soils;
        let mut both = DMatrix::zeros(jacobian.nrows(), self.mean.len());
        both.view_mut((0, 0), jacobian.shape()).copy_from(jacobian);
        both.view_mut((0, self.soils), (shared, shared)).fill_with_identity();
        both
    }

    /// The soils that a step leads to.
    pub(crate) fn moved_soils(&self, step: &KalmanStep) -> DVector<f64> {
        self.mean.rows(0, self.soils) + step.change.rows(0, self.soils)
    }

    /// Takes a step; the soils end at `soils`, which is where the step leads unless a bound is in the way.
    pub(crate) fn after(&self, step: &KalmanStep, buffer: &Linearisation, noise: &DMatrix<f64>, soils: &DVector<f64>) -> Self {
        let mut mean = &self.mean + &step.change;
        mean.rows_mut(0, self.soils).copy_from(soils);
        let covariance = step.covariance(&self.covariance, &self.with_identity(&buffer.jacobian), noise);
        Self { mean, covariance, soils: self.soils }
    }
}

fn with_shared(soils: DMatrix<f64>, shared: Option<&SharedError>, share: f64) -> DMatrix<f64> {
    let Some(shared) = shared else { return soils };
    let (size, rows) = (soils.nrows(), shared.covariance.nrows());
    let mut all = DMatrix::zeros(size + rows, size + rows);
    all.view_mut((0, 0), (size, size)).copy_from(&soils);
    all.view_mut((size, size), (rows, rows)).copy_from(&(&shared.covariance * share));
    all
}

/// The correction of one class.
pub(crate) fn correction_of(soils: &DVector<f64>, class: usize, config: &FilterConfig) -> SoilCorrection {
    let at = SOIL_DIM * if class < config.classes { class } else { 0 };
    SoilCorrection { coordinates: config.coordinates, delta: core::array::from_fn(|i| soils[at + i]) }
}
