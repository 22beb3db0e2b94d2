//! A prediction between question and answer: all that it reads of the engine, so that it can be computed while the engine goes on.

use std::sync::Arc;

use nesam_model::{Due, HistoryStep, Predictor, RolloutExtras, RolloutNoise, RolloutQuery, SoilByClass, Variant};
use nesam_physics::{SoilCorrection, VehicleState};
use nesam_terrain::WorldMap;

use crate::candidates::Candidates;
use crate::command::Until;
use crate::engine::Engine;
use crate::error::EngineError;
use crate::extras::ExtraOutputs;
use crate::forward::RollForward;
use crate::query::{PredictQuery, Prediction, Provenance};
use crate::session::{Session, SoilEstimate};

/// What a prediction is computed from. It shares nothing that a later command changes.
pub(crate) struct Prepared {
    predictor: Predictor,
    map: Option<Arc<WorldMap>>,
    /// State that the rollout starts from, before it is rolled forward.
    start: VehicleState<f64>,
    start_stamp_ns: Option<i64>,
    /// Measured steps before the start.
    history: Vec<HistoryStep>,
    forward: RollForward,
    /// What-if soils; none = the one that was learned.
    soils: Vec<SoilCorrection>,
    learned: SoilByClass,
    soil: SoilEstimate,
    noise: Option<Arc<RolloutNoise>>,
    /// Bits that the session adds to those of every row.
    flags: u32,
    measurement_age_s: Option<f64>,
    provenance: Provenance,
    step_ns: i64,
}

impl Engine {
    /// Reads what a prediction is computed from.
    ///
    /// # Errors
    /// Any [`EngineError`] that does not hang on the computation.
    pub(crate) fn prepare(&self, now_ns: u64, query: &PredictQuery) -> Result<Prepared, EngineError> {
        let session = self.session(&query.session)?;
        let predictor = session.predictor().unwrap_or(&self.predictor);
        query.check(&self.limits, self.vehicle())?;
        let map = session.map().map(|id| self.maps.get(id)).transpose()?;
        let newest = session.newest_at().filter(|_| query.start.is_none());
        let forward = match (&query.instant, newest) {
            (Some(instant), Some(newest)) => {
                RollForward::plan(instant, newest, self.step_ns, query.horizon, session.history().len(), &self.limits)?
            }
            _ => RollForward::default(),
        };
        // Steps that were measured after the instant are left aside.
        let before = session.history().len().saturating_sub(1 + forward.back());
        let start = start_state(session, query, before, map)?;
        let soils = query.extras.corrections(session.soil());
        self.limits.check_shape(query.samples * soils.len().max(1), query.horizon)?;
        let history = session.history().iter().take(if query.use_history { before } else { 0 }).copied().collect();
        Ok(Prepared {
            predictor: if query.extras.exact_terrain { predictor.exactly() } else { predictor.clone() },
            map: map.cloned(),
            start,
            start_stamp_ns: newest.map(|newest| newest.stamp_ns.saturating_sub(forward.back() as i64 * self.step_ns)),
            history,
            soils,
            learned: session.soil_field(map),
            soil: *session.soil(),
            noise: self.noise.clone(),
            flags: session.flags(),
            measurement_age_s: session.age_s(now_ns),
            provenance: self.provenance(session),
            step_ns: self.step_ns,
            forward,
        })
    }
}

/// The state that a query starts from: its own, or that of the measured step behind `before` others.
fn start_state(
    session: &Session,
    query: &PredictQuery,
    before: usize,
    map: Option<&Arc<WorldMap>>,
) -> Result<VehicleState<f64>, EngineError> {
    let start = match (query.start, session.history().get(before)) {
        (Some(start), _) => start,
        (None, Some(step)) => step.state,
        (None, None) => {
            let reason = "is absent and the session has no measurement yet; give one or send measurements first";
            return Err(EngineError::NotReady { field: "start".into(), reason: reason.into() });
        }
    };
    if let Some(map) = map
        && !map.contains(start.position_m[0], start.position_m[1])
    {
        let [x, y, _] = start.position_m;
        let reason = format!("({x:.2}, {y:.2}) m lies outside map `{}`", map.id());
        return Err(match query.start {
            Some(_) => EngineError::invalid("start.position_m", reason),
            None => EngineError::NotReady { field: "session_id".into(), reason: format!("the measured position {reason}") },
        });
    }
    Ok(start)
}

impl Prepared {
    /// Nodes of terrain that have been encoded on its map.
    pub fn encoded_nodes(&self) -> u64 {
        self.map.as_ref().map_or(0, |map| self.predictor.terrain_cache(map).encoded)
    }

    /// Computes the answer to the query that it was prepared for.
    ///
    /// # Errors
    /// `Abandoned` where that was raised, `NotReady` and those of the model.
    pub fn compute(&self, query: &PredictQuery, until: Until<'_>) -> Result<Prediction, EngineError> {
        let Self { predictor, map, start, history, forward, soils, learned, soil, .. } = self;
        let map = map.as_ref();
        let horizon = query.horizon + forward.steps();
        let commands = query.controls.commands(query.samples, predictor.bundle().vehicle.command_range);
        let controls = forward.prepend(&commands, query.horizon);
        let asked = RolloutQuery {
            history,
            start: *start,
            controls: &controls,
            samples: query.samples,
            horizon,
            map,
            soil_correction: soil.state.correction,
            variant: Variant::Full,
            start_time_s: None,
            wheels: None,
        };
        let Until { interruption, due } = until;
        let due = due.filter(|_| query.takes_fewer()).map(|flag| Due { flag, least: query.least() });
        let looked_at = query.extras.interpolation_deviation && map.is_some();
        let asked_extras = RolloutExtras { field: Some(learned), soils, risk: query.extras.risk, unrounded: looked_at, interruption, due };
        let (mut rollout, risk) = predictor.rollout_with(&asked, &asked_extras)?;
        let samples = if due.is_some() { rollout.samples } else { query.samples };
        let taken = &commands[..samples * query.horizon * 2];
        let deviation_m = looked_at.then(|| predictor.interpolation_deviation_m(&asked, &asked_extras, &rollout)).transpose()?;
        // An answer carries the states alone.
        rollout.position_m = Vec::new();
        let mut extras = ExtraOutputs {
            soil_groups: soils.len().max(1),
            interpolation_deviation_m: deviation_m.filter(|deviation_m| deviation_m.is_finite()),
            risk: risk.map(|risk| forward.split_risk(risk, horizon)),
            ..Default::default()
        };
        if query.extras.derived() {
            let linearisations = predictor.linearise_with(&asked, interruption)?;
            (extras.jacobians, extras.covariance) = query.extras.derive(&linearisations, forward.steps(), soil, self.noise.as_deref())?;
            if interruption.is_abandoned() {
                return Err(EngineError::Abandoned);
            }
        }
        let (rolled, mut rollout) = forward.split(rollout);
        rollout.flags.iter_mut().for_each(|flags| *flags |= self.flags);
        let ranking = query.cost.as_ref().map(|cost| cost.rank(&rollout, taken));
        if let Some(ranking) = &ranking {
            rollout = ranking.best_of(&rollout);
        }
        let drawn_controls = match (&query.controls, &ranking) {
            (Candidates::Given(_), _) => Vec::new(),
            (Candidates::Drawn(_), None) => taken.to_vec(),
            (Candidates::Drawn(_), Some(ranking)) => ranking.rows_of_best(taken, 2 * query.horizon),
        };
        Ok(Prediction {
            soil_variance: soil.state.variance_at(&rollout.soil),
            rollout,
            start: rolled.unwrap_or(*start),
            start_stamp_ns: self.start_stamp_ns.map(|stamp_ns| stamp_ns.saturating_add(forward.steps() as i64 * self.step_ns)),
            rolled_forward_steps: forward.steps(),
            soil: *soil,
            history_steps: history.len(),
            measurement_age_s: self.measurement_age_s,
            provenance: self.provenance.clone(),
            extras,
            drawn_controls,
            ranking,
        })
    }
}
