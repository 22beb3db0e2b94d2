//! What a prediction computes beyond states.

use nesam_engine::{CovarianceQuery, EngineError, ExtraOutputs, PredictExtras, WhatIfSoils};
use nesam_physics::{SOIL_DIM, STATE_DIM, WHEELS};
use nesam_proto::v1 as pb;

use super::{OutputSelection, decode_f32};

/// What is asked for. Lengths are checked here, values and limits by the engine.
///
/// # Errors
/// `Invalid` naming the field below `extras`.
pub(super) fn predict_extras(message: &pb::PredictExtras) -> Result<PredictExtras, EngineError> {
    let fail = |field: &str, reason: String| Err(EngineError::invalid(format!("extras.{field}"), reason));
    let start = match message.start_covariance.is_empty() {
        true => None,
        false if !message.covariance => return fail("start_covariance", "is given, but no covariance is asked for".into()),
        false => {
            let packed = decode_f32("extras.start_covariance", &message.start_covariance, STATE_DIM * STATE_DIM)?;
            Some(Box::new(core::array::from_fn(|r| core::array::from_fn(|c| f64::from(packed[r * STATE_DIM + c])))))
        }
    };
    let row_bytes = 4 * SOIL_DIM;
    let soils = match (message.soil_deltas.is_empty(), message.soil_sigma_points) {
        (true, false) => WhatIfSoils::Estimate,
        (true, true) => WhatIfSoils::SigmaPoints,
        (false, true) => return fail("soil_sigma_points", "is asked for together with `soil_deltas`, allowed is one of the two".into()),
        (false, false) if !message.soil_deltas.len().is_multiple_of(row_bytes) => {
            return fail("soil_deltas", format!("has {} bytes, each soil takes {row_bytes}", message.soil_deltas.len()));
        }
        (false, false) => {
            let packed = decode_f32("extras.soil_deltas", &message.soil_deltas, message.soil_deltas.len() / 4)?;
            let rows = packed.chunks_exact(SOIL_DIM);
            WhatIfSoils::Added(rows.map(|row| core::array::from_fn(|i| f64::from(row[i]))).collect())
        }
    };
    Ok(PredictExtras {
        jacobians: message.jacobians,
        covariance: message.covariance.then_some(CovarianceQuery { start }),
        risk: message.risk,
        exact_terrain: message.exact_terrain,
        interpolation_deviation: message.interpolation_deviation,
        soils,
    })
}

/// Writes what came of it into a reply.
pub(super) fn put_extras(reply: &mut pb::PredictReply, extras: &ExtraOutputs, horizon: usize, output: OutputSelection) {
    let packed = |values: &[f32], width: usize| output.steps_of(values, horizon, width);
    reply.interpolation_deviation_m = extras.interpolation_deviation_m;
    if let Some(jacobians) = &extras.jacobians {
        reply.jacobian_start = packed(&jacobians.start, STATE_DIM * STATE_DIM);
        reply.jacobian_controls = packed(&jacobians.controls, STATE_DIM * horizon * 2);
        reply.jacobian_soil = packed(&jacobians.soil, STATE_DIM * SOIL_DIM);
    }
    if let Some(covariance) = &extras.covariance {
        reply.covariance = packed(&covariance.states, STATE_DIM * STATE_DIM);
        reply.region_90_planar = covariance.region_90_planar;
        reply.region_90_single = covariance.region_90_single.to_vec();
    }
    if let Some(risk) = &extras.risk {
        reply.wheel_load_n = packed(&risk.wheel_load_n, WHEELS);
        reply.wheel_slip = packed(&risk.wheel_slip, WHEELS);
        reply.load_transfer_ratio = packed(&risk.load_transfer_ratio, 1);
        reply.traction_reserve = packed(&risk.traction_reserve, 1);
    }
}
