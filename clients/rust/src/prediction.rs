//! Candidates and predictions.

use std::time::Duration;

use nesam_proto::packed::pack;
use nesam_proto::v1;

use crate::error::ClientError;
use crate::fallback::KinematicFallback;
use crate::message::{state_array, state_message, unpack};

/// Candidate command sequences to roll out.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidates {
    /// Session.
    pub session: String,
    /// State to start from (x y z roll pitch yaw vx vy vz wx wy wz); `None` = the newest measured one.
    pub start: Option<[f64; 12]>,
    /// Instant of the vehicle's clock to start from, ns; `None` = that of the newest measured state. Not together with `start`. It is rounded to the nearest step of
    /// 0.1 s after the newest measurement, so by up to 50 ms; [`Prediction::start_stamp_ns`] says to which.
    pub start_stamp_ns: Option<i64>,
    /// Commands `[speed_m_s, second]` that the vehicle was sent, each with the instant from which it applies it, by ascending instant.
    pub sent: Vec<(i64, [f64; 2])>,
    /// Whether the measured history precedes the start.
    pub use_history: bool,
    /// N.
    pub samples: usize,
    /// Fewest of them that are of use when time is short, 0 = all or nothing; [`Prediction::samples`] says how many were computed.
    pub samples_min: usize,
    /// Time after which the answer is of no use, for streams and Zenoh; [`Client::predict_within`](crate::Client::predict_within) has a deadline of its own.
    pub budget: Option<Duration>,
    /// K.
    pub horizon: usize,
    /// Row-major (samples, horizon, 2): speed in m/s, second command in the unit of the vehicle card; empty where they are drawn.
    pub controls: Vec<f32>,
    /// Lets the service draw the candidates instead.
    pub drawing: Option<v1::CandidateDrawing>,
    /// Lets the service say what each is worth, and send the best only.
    pub cost: Option<v1::PathCost>,
    /// What to return.
    pub output: v1::OutputSelection,
    /// What to compute beyond the states.
    pub extras: Option<v1::PredictExtras>,
    /// Copied to the prediction.
    pub tag: u64,
    /// Answers [`Client::predict`](crate::Client::predict) and [`Client::predict_within`](crate::Client::predict_within) when the service is late, overloaded
    /// or away, or knows no measurement that is new enough for `start_stamp_ns`, from `start` or the newest state that the client knows, which it rolls forward to
    /// `start_stamp_ns` by its own kinematics, no further than 32 steps; a state that is older than 3.2 s by the clock of this program is none. `None` = nothing
    /// does. It has no extras, costs or what-if soils; of a drawing it predicts the nominal sequence alone.
    pub fallback: Option<KinematicFallback>,
}

impl Candidates {
    /// Candidates from the newest measured state, everything returned.
    pub fn new(session: &str, samples: usize, horizon: usize, controls: Vec<f32>) -> Self {
        let output = v1::OutputSelection { wheel_sinkage: true, ..Default::default() };
        let session = session.into();
        Self {
            session,
            start: None,
            start_stamp_ns: None,
            sent: Vec::new(),
            use_history: true,
            samples,
            samples_min: 0,
            budget: None,
            horizon,
            controls,
            drawing: None,
            cost: None,
            output,
            extras: None,
            tag: 0,
            fallback: None,
        }
    }

    /// Candidates that the service draws around a nominal sequence, (horizon, 2), as MPPI does.
    pub fn drawn(session: &str, samples: usize, nominal: &[f32], drawing: v1::CandidateDrawing) -> Self {
        let drawing = v1::CandidateDrawing { nominal: pack(nominal), ..drawing };
        Self { drawing: Some(drawing), ..Self::new(session, samples, nominal.len() / 2, Vec::new()) }
    }

    /// The same candidates, of which only the best along a path, (points, 2), are sent.
    pub fn ranked(self, path: &[f32], cost: v1::PathCost) -> Self {
        Self { cost: Some(v1::PathCost { path: pack(path), ..cost }), ..self }
    }

    /// The same candidates from this instant of the vehicle's clock on, when the vehicle was sent these commands before.
    pub fn starting_at(self, start_stamp_ns: i64, sent: Vec<(i64, [f64; 2])>) -> Self {
        Self { start_stamp_ns: Some(start_stamp_ns), sent, ..self }
    }

    /// The same candidates, predicted by this fallback when the service does not answer in time.
    pub fn or_fall_back(self, fallback: KinematicFallback) -> Self {
        Self { fallback: Some(fallback), ..self }
    }

    /// The same as message, which tells nothing of a fallback.
    pub fn to_message(&self) -> v1::PredictRequest {
        let history_use = if self.use_history { v1::HistoryUse::Measured } else { v1::HistoryUse::None };
        v1::PredictRequest {
            session_id: self.session.clone(),
            start: self.start.map(state_message),
            history_use: history_use.into(),
            samples: u32::try_from(self.samples).unwrap_or(u32::MAX),
            horizon: u32::try_from(self.horizon).unwrap_or(u32::MAX),
            controls: pack(&self.controls),
            output: Some(self.output),
            tag: self.tag,
            start_stamp_ns: self.start_stamp_ns,
            sent: self.sent.iter().map(|(stamp_ns, command)| sent_command(*stamp_ns, *command)).collect(),
            extras: self.extras.clone(),
            drawing: self.drawing.clone(),
            cost: self.cost.clone(),
            samples_min: u32::try_from(self.samples_min).unwrap_or(u32::MAX),
            budget_s: self.budget.map(|budget| budget.as_secs_f64()),
        }
    }
}

fn sent_command(stamp_ns: i64, [speed_m_s, second]: [f64; 2]) -> v1::SentCommand {
    v1::SentCommand { stamp_ns, command: Some(v1::Control { speed_m_s, second }) }
}

/// Who computed a prediction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ComputedBy {
    /// The service.
    #[default]
    Service,
    /// [`Candidates::fallback`], because the service did not answer in time.
    KinematicFallback,
}

/// The service's error that a fallback has answered instead of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FallbackReason {
    /// gRPC code: DEADLINE_EXCEEDED, RESOURCE_EXHAUSTED or UNAVAILABLE; FAILED_PRECONDITION where no measurement is new enough for `start_stamp_ns`.
    pub code: tonic::Code,
    /// What the service or the transport said.
    pub message: String,
}

/// Predicted trajectories. With [`ComputedBy::KinematicFallback`], `soil` is not a number, `validity` is 0 and everything else that only the service
/// knows is empty: provenance, sinkage, soil correction, extras, `costs`, `best` and `mean_controls`.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// Copied from the candidates.
    pub tag: u64,
    /// N.
    pub samples: usize,
    /// Steps returned.
    pub steps: usize,
    /// Indices of the channels returned, in the order x y z roll pitch yaw vx vy vz wx wy wz.
    pub channels: Vec<usize>,
    /// Row-major (rows, steps, channels), rows = samples, or those of `best` where candidates are ranked: m, rad, m/s, rad/s. Positions are in World, also where the reply was packed as f16.
    pub states: Vec<f32>,
    /// Row-major (samples, steps, 4): wheel sinkage, m; empty unless asked for.
    pub sinkage_m: Vec<f32>,
    /// For each sample the sum of its `v1::Validity` bits; 0 = nothing to say against it.
    pub validity: Vec<u32>,
    /// State that the candidates started from.
    pub start: [f64; 12],
    /// Instant of that state, ns of the vehicle's clock; `None` when it was given.
    pub start_stamp_ns: Option<i64>,
    /// Steps of 0.1 s from the newest measured state to the start.
    pub rolled_forward_steps: usize,
    /// Measured steps before the start.
    pub history_steps: usize,
    /// Soil used under the start, order k_phi, k_c, n, c, phi, k_shear.
    pub soil: [f64; 6],
    /// Variance of that soil; `None` while no filter runs.
    pub soil_variance: Option<[f64; 6]>,
    /// What the session knew of the soil.
    pub soil_correction: v1::SoilCorrection,
    /// Time since the newest measurement arrived, s.
    pub measurement_age_s: Option<f64>,
    /// What the prediction was computed from.
    pub provenance: v1::Provenance,
    /// Time in the service's queue, s.
    pub queue_s: f64,
    /// Time of the computation, s.
    pub compute_s: f64,
    /// Groups of trajectories, one for each what-if soil: `states`, `sinkage_m`, `validity` and risk have `soil_groups * samples` rows.
    pub soil_groups: usize,
    /// Jacobians, covariance and risk; empty arrays unless asked for.
    pub extras: ExtraOutputs,
    /// Commands that were drawn, (rows, horizon, 2).
    pub drawn_controls: Vec<f32>,
    /// Cost of each of the samples, infinite where it is worthless; empty unless asked for.
    pub costs: Vec<f32>,
    /// Which samples the rows are, best first; empty unless ranked.
    pub best: Vec<u32>,
    /// (horizon, 2): mean of all samples by their cost.
    pub mean_controls: Vec<f32>,
    /// Who computed it.
    pub computed_by: ComputedBy,
    /// Why a fallback answers; `None` when the service does.
    pub fallback_reason: Option<FallbackReason>,
}

/// What was computed beyond the states, row-major; empty unless asked for. The fields and their shapes are those of `v1::PredictReply`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ExtraOutputs {
    /// (samples, steps, 12, 12).
    pub jacobian_start: Vec<f32>,
    /// (samples, steps, 12, horizon, 2).
    pub jacobian_controls: Vec<f32>,
    /// (samples, steps, 12, 6).
    pub jacobian_soil: Vec<f32>,
    /// (samples, steps, 12, 12).
    pub covariance: Vec<f32>,
    /// Squared Mahalanobis radius that holds 90 % of the measured (x, y), on a map.
    pub region_90_planar: f64,
    /// The same of x, y, z, roll, pitch, yaw alone.
    pub region_90_single: Vec<f64>,
    /// N, (rows, steps, 4).
    pub wheel_load_n: Vec<f32>,
    /// (rows, steps, 4).
    pub wheel_slip: Vec<f32>,
    /// (rows, steps).
    pub load_transfer_ratio: Vec<f32>,
    /// (rows, steps).
    pub traction_reserve: Vec<f32>,
    /// How far interpolation of the terrain moved the first candidate, mean over the horizon, m.
    pub interpolation_deviation_m: Option<f64>,
}

impl ExtraOutputs {
    fn from_message(reply: &v1::PredictReply) -> Result<Self, ClientError> {
        Ok(Self {
            jacobian_start: plain("jacobian_start", &reply.jacobian_start)?,
            jacobian_controls: plain("jacobian_controls", &reply.jacobian_controls)?,
            jacobian_soil: plain("jacobian_soil", &reply.jacobian_soil)?,
            covariance: plain("covariance", &reply.covariance)?,
            region_90_planar: reply.region_90_planar,
            region_90_single: reply.region_90_single.clone(),
            wheel_load_n: plain("wheel_load_n", &reply.wheel_load_n)?,
            wheel_slip: plain("wheel_slip", &reply.wheel_slip)?,
            load_transfer_ratio: plain("load_transfer_ratio", &reply.load_transfer_ratio)?,
            traction_reserve: plain("traction_reserve", &reply.traction_reserve)?,
            interpolation_deviation_m: reply.interpolation_deviation_m,
        })
    }
}

/// Numbers that are f32 whatever the precision of the states.
fn plain(name: &str, packed: &[u8]) -> Result<Vec<f32>, ClientError> {
    unpack(name, packed, packed.len() / 4, v1::Precision::F32)
}

fn soil_array(soil: &v1::SoilVector) -> [f64; 6] {
    [soil.k_phi, soil.k_c, soil.n, soil.c_pa, soil.phi_rad, soil.k_shear_m]
}

impl Prediction {
    /// Unpacks a reply.
    ///
    /// # Errors
    /// `ClientError::Protocol` when a part is missing, or a length or a sample does not fit.
    pub fn from_message(reply: &v1::PredictReply) -> Result<Self, ClientError> {
        let channels: Vec<usize> = (0..12).filter(|i| reply.channels >> i & 1 == 1).collect();
        let (samples, steps) = (reply.samples as usize, reply.steps as usize);
        let soil_groups = (reply.soil_groups as usize).max(1);
        // No reply is as long as numbers that do not fit say.
        let count = |factors: [usize; 3]| factors.into_iter().fold(1, usize::saturating_mul);
        let rows = if reply.costs.is_empty() { soil_groups.saturating_mul(samples) } else { reply.best.len() };
        let sinkage = if reply.sinkage_m.is_empty() { 0 } else { count([rows, steps, 4]) };
        let missing = |part: &str| ClientError::protocol(format!("`{part}` is missing"));
        if reply.validity.len() != rows {
            return Err(ClientError::protocol(format!("`validity` has {} words, {rows} were expected", reply.validity.len())));
        }
        if let Some(sample) = reply.best.iter().find(|sample| **sample as usize >= samples) {
            return Err(ClientError::protocol(format!("`best` names sample {sample} of {samples}")));
        }
        let start = reply.start.as_ref().and_then(state_array).ok_or_else(|| missing("start"))?;
        let mut states = unpack("states", &reply.states, count([rows, steps, channels.len()]), reply.precision())?;
        if reply.precision() == v1::Precision::F16 {
            for row in states.chunks_exact_mut(channels.len().max(1)) {
                let positions = row.iter_mut().zip(&channels).filter(|(_, channel)| **channel < 3);
                positions.for_each(|(value, channel)| *value = (f64::from(*value) + start[*channel]) as f32);
            }
        }
        Ok(Self {
            tag: reply.tag,
            samples,
            steps,
            states,
            sinkage_m: unpack("sinkage_m", &reply.sinkage_m, sinkage, reply.precision())?,
            channels,
            validity: reply.validity.clone(),
            start,
            start_stamp_ns: reply.start_stamp_ns,
            rolled_forward_steps: reply.rolled_forward_steps as usize,
            history_steps: reply.history_steps as usize,
            soil: reply.soil.as_ref().map(soil_array).ok_or_else(|| missing("soil"))?,
            soil_variance: reply.soil_variance.as_ref().map(soil_array),
            soil_correction: reply.soil_correction.clone().ok_or_else(|| missing("soil_correction"))?,
            measurement_age_s: reply.measurement_age_s,
            provenance: reply.provenance.clone().ok_or_else(|| missing("provenance"))?,
            queue_s: reply.queue_s,
            compute_s: reply.compute_s,
            soil_groups,
            extras: ExtraOutputs::from_message(reply)?,
            drawn_controls: plain("drawn_controls", &reply.drawn_controls)?,
            costs: unpack("costs", &reply.costs, if reply.costs.is_empty() { 0 } else { samples }, v1::Precision::F32)?,
            best: reply.best.clone(),
            mean_controls: plain("mean_controls", &reply.mean_controls)?,
            computed_by: ComputedBy::Service,
            fallback_reason: None,
        })
    }

    /// Returned channels of row `n` at returned step `k` (0-based); row = soil group times samples plus sample, or place among the best.
    ///
    /// # Panics
    /// When `n` or `k` is out of range.
    pub fn state(&self, n: usize, k: usize) -> &[f32] {
        let rows = self.validity.len();
        assert!(n < rows && k < self.steps, "row {n}, step {k} of {rows} x {}", self.steps);
        let width = self.channels.len();
        let at = (n * self.steps + k) * width;
        &self.states[at..at + width]
    }
}
