//! Which queries can be answered.

use crate::ModelError;
use crate::dims::MAX_HORIZON;
use crate::rollout::{HistoryStep, RolloutExtras, RolloutQuery};

/// Refuses a query whose shapes disagree or that holds a number that is not finite.
pub(crate) fn validate(query: &RolloutQuery<'_>) -> Result<(), ModelError> {
    let fail = |field, reason: String| Err(ModelError::Query { field, reason });
    if query.samples == 0 {
        return fail("samples", "is 0, at least one candidate is needed".into());
    }
    if query.horizon == 0 || query.horizon > MAX_HORIZON {
        return fail("horizon", format!("is {}, the model has positions for 1..={MAX_HORIZON} steps", query.horizon));
    }
    let expected = query.samples * query.horizon * 2;
    if query.controls.len() != expected {
        let reason = format!("has {} numbers, expected samples × horizon × 2 = {expected}", query.controls.len());
        return fail("controls", reason);
    }
    if let Some(at) = query.controls.iter().position(|v| !v.is_finite()) {
        return fail("controls", format!("number {at} is not finite"));
    }
    if let Some(wheels) = query.wheels {
        if wheels.len() != query.horizon {
            return fail("wheels", format!("has {} steps, expected horizon = {}", wheels.len(), query.horizon));
        }
        if let Some(at) = wheels.iter().position(|w| !w.speed_rad_s.iter().chain(&w.angle_rad).all(|v| v.is_finite())) {
            return fail("wheels", format!("step {at} holds a number that is not finite"));
        }
    }
    if !query.start.to_array().iter().all(|v| v.is_finite()) {
        return fail("start", "holds a number that is not finite".into());
    }
    if !query.soil_correction.delta.iter().all(|v| v.is_finite()) {
        return fail("soil_correction", "holds a number that is not finite".into());
    }
    let finite = |step: &HistoryStep| {
        step.state.to_array().iter().all(|v| v.is_finite()) && step.control.speed_m_s.is_finite() && step.control.second.is_finite()
    };
    match query.history.iter().position(|step| !finite(step)) {
        Some(at) => fail("history", format!("step {at} holds a number that is not finite")),
        None => Ok(()),
    }
}

/// Refuses corrections that are not finite.
pub(super) fn validate_extras(extras: &RolloutExtras<'_>) -> Result<(), ModelError> {
    match extras.soils.iter().position(|soil| !soil.delta.iter().all(|v| v.is_finite())) {
        Some(at) => Err(ModelError::Query { field: "soils", reason: format!("correction {at} holds a number that is not finite") }),
        None => Ok(()),
    }
}
