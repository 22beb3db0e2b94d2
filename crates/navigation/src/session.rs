//! The service as a forecaster: one session, fed and asked over the client.

use std::collections::BTreeMap;

use nesam_client::{Candidates, Client, MeasurementStream, measurement, outcome_label, v1};
use nesam_physics::DT_S;

use crate::error::NavigationError;
use crate::forecast::{Poses, Situation};
use crate::oracle::SoilAhead;
use crate::reference_path::ReferencePath;
use crate::trial::{Surroundings, TRIAL_STEPS};

/// Channels x, y, roll and pitch of a prediction.
const CHANNELS: u32 = 1 | 1 << 1 | 1 << 3 | 1 << 4;

/// A session of the service, and the soil that it is told if it is told one.
pub struct ServedForecaster {
    client: Client,
    stream: MeasurementStream,
    session: String,
    sequence: u64,
    /// For the oracle: corrections of the soil prior along the path.
    told: Option<SoilAhead>,
    surroundings: Surroundings,
    /// What became of the measurements.
    pub outcomes: BTreeMap<&'static str, usize>,
    /// Correction of the soil prior that the service holds, in the order of its soil vector.
    pub soil_delta: Option<[f64; 6]>,
}

/// What opens a session of a vehicle on a map.
pub fn session_request(session: &str, map: &str) -> v1::OpenSessionRequest {
    v1::OpenSessionRequest { vehicle_id: "plant".into(), session_id: session.into(), map_id: map.into(), ..Default::default() }
}

impl ServedForecaster {
    /// Opens a session on an uploaded map.
    ///
    /// # Errors
    /// `NavigationError::Service` as the service says.
    pub async fn open(
        mut client: Client,
        session: &str,
        surroundings: Surroundings,
        told: Option<SoilAhead>,
    ) -> Result<Self, NavigationError> {
        client.open_session(session_request(session, surroundings.map.id())).await?;
        let stream = client.measure().await?;
        let outcomes = BTreeMap::new();
        Ok(Self { client, stream, session: session.into(), sequence: 0, told, surroundings, outcomes, soil_delta: None })
    }

    /// Closes the session.
    ///
    /// # Errors
    /// `NavigationError::Service` as the service says.
    pub async fn close(mut self) -> Result<(), NavigationError> {
        Ok(self.client.close_session(&self.session).await?)
    }

    pub(crate) async fn measure(&mut self, situation: &Situation<'_>) -> Result<(), NavigationError> {
        let command = [situation.sent.speed_m_s, situation.sent.second];
        let mut message = measurement(&self.session, situation.stamp_ns, *situation.measured, command);
        self.sequence += 1;
        message.sequence = self.sequence;
        let answer = self.stream.exchange(message).await?;
        *self.outcomes.entry(outcome_label(&answer)).or_insert(0) += 1;
        let delta = answer.soil_correction.and_then(|c| c.delta);
        self.soil_delta = delta.map(|d| [d.k_phi, d.k_c, d.n, d.c_pa, d.phi_rad, d.k_shear_m]).or(self.soil_delta);
        Ok(())
    }

    pub(crate) async fn forecast(
        &mut self,
        situation: &Situation<'_>,
        controls: Vec<f32>,
        horizon: usize,
    ) -> Result<Poses, NavigationError> {
        let samples = controls.len() / (2 * horizon);
        let sent = vec![(situation.stamp_ns, [situation.sent.speed_m_s, situation.sent.second])];
        let from_ns = situation.stamp_ns + (DT_S * 1e9).round() as i64;
        let candidates = Candidates::new(&self.session, samples, horizon, controls).starting_at(from_ns, sent);
        self.predict(candidates, [situation.measured[0], situation.measured[1]]).await
    }

    pub(crate) async fn slide_m(
        &mut self,
        measured: &[f64; 12],
        path: &ReferencePath,
        arc_m: f64,
        speed_m_s: f64,
    ) -> Result<Option<f64>, NavigationError> {
        let Some(start) = self.surroundings.on_path(path, arc_m, speed_m_s, measured) else { return Ok(None) };
        let steerings = self.surroundings.steerings(path, arc_m, speed_m_s);
        let controls = steerings.iter().flat_map(|steering| [speed_m_s as f32, *steering as f32].repeat(TRIAL_STEPS)).collect();
        let mut candidates = Candidates::new(&self.session, steerings.len(), TRIAL_STEPS, controls);
        candidates.start = Some(start);
        candidates.use_history = false;
        let poses = self.predict(candidates, [start[0], start[1]]).await?;
        let ends = poses.chunks_exact(TRIAL_STEPS).map(|rows| rows[TRIAL_STEPS - 1]);
        let slide_m = ends.map(|[x, y, ..]| path.offset(x, y).outside_m).fold(f64::INFINITY, f64::min);
        Ok(slide_m.is_finite().then_some(slide_m))
    }

    /// x, y, roll and pitch of candidates, on the soil that this session is told for a place if it is told one.
    async fn predict(&mut self, mut candidates: Candidates, place_m: [f64; 2]) -> Result<Poses, NavigationError> {
        candidates.output = v1::OutputSelection { channels: CHANNELS, ..Default::default() };
        candidates.extras = self.told.as_ref().map(|told| {
            let packed: Vec<u8> = told.ahead_of(place_m).iter().flat_map(|d| (*d as f32).to_le_bytes()).collect();
            v1::PredictExtras { soil_deltas: packed.into(), ..Default::default() }
        });
        let prediction = self.client.predict(candidates).await?;
        Ok(prediction.states.chunks_exact(4).map(|s| [s[0], s[1], s[2], s[3]].map(f64::from)).collect())
    }
}
