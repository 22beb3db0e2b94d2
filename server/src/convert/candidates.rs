//! Candidates that are drawn here, and what candidates are worth.

use nesam_engine::{Candidates, CostWeights, Drawing, EngineError, PathCost};
use nesam_proto::v1 as pb;

use super::{Precision, decode_f32, encode, unsigned_zero};

/// The candidates of a request. Lengths are checked here, values by the engine.
///
/// # Errors
/// `Invalid` naming the field.
pub(super) fn candidates(message: &pb::PredictRequest) -> Result<Candidates, EngineError> {
    let (samples, horizon) = (message.samples as usize, message.horizon as usize);
    let Some(drawing) = &message.drawing else {
        return decode_f32("controls", &message.controls, samples * horizon * 2).map(Candidates::Given);
    };
    if !message.controls.is_empty() {
        return Err(EngineError::invalid("controls", "are given together with `drawing`, allowed is one of the two"));
    }
    Ok(Candidates::Drawn(Drawing {
        nominal: decode_f32("drawing.nominal", &drawing.nominal, horizon * 2)?,
        sd: [drawing.speed_sd_m_s, drawing.second_sd].map(unsigned_zero),
        correlation: unsigned_zero(drawing.correlation),
        seed: drawing.seed,
    }))
}

/// Commands that are sent, and the drawing where they are drawn.
pub(super) fn candidates_message(candidates: &Candidates) -> (bytes::Bytes, Option<pb::CandidateDrawing>) {
    match candidates {
        Candidates::Given(controls) => (encode(controls, Precision::F32), None),
        Candidates::Drawn(Drawing { nominal, sd: [speed_sd_m_s, second_sd], correlation, seed }) => {
            let drawing = pb::CandidateDrawing {
                nominal: encode(nominal, Precision::F32),
                speed_sd_m_s: *speed_sd_m_s,
                second_sd: *second_sd,
                correlation: *correlation,
                seed: *seed,
            };
            (bytes::Bytes::new(), Some(drawing))
        }
    }
}

/// The cost of a request.
///
/// # Errors
/// `Invalid` naming the field.
pub(super) fn path_cost(message: &pb::PathCost) -> Result<PathCost, EngineError> {
    let pb::PathCost {
        path,
        speed_m_s,
        path_weight,
        speed_weight,
        tilt_weight,
        speed_change_weight,
        second_change_weight,
        best,
        temperature,
    } = message;
    Ok(PathCost {
        path: decode_f32("cost.path", path, path.len() / 4)?,
        speed_m_s: unsigned_zero(*speed_m_s),
        weights: CostWeights {
            path: unsigned_zero(*path_weight),
            speed: unsigned_zero(*speed_weight),
            tilt: unsigned_zero(*tilt_weight),
            change: [*speed_change_weight, *second_change_weight].map(unsigned_zero),
        },
        best: *best as usize,
        temperature: unsigned_zero(*temperature),
    })
}

/// The same as message.
pub(super) fn path_cost_message(cost: &PathCost) -> pb::PathCost {
    let PathCost { path, speed_m_s, weights, best, temperature } = cost;
    let CostWeights { path: path_weight, speed: speed_weight, tilt: tilt_weight, change: [speed_change_weight, second_change_weight] } =
        *weights;
    pb::PathCost {
        path: encode(path, Precision::F32),
        speed_m_s: *speed_m_s,
        path_weight,
        speed_weight,
        tilt_weight,
        speed_change_weight,
        second_change_weight,
        best: u32::try_from(*best).unwrap_or(u32::MAX),
        temperature: *temperature,
    }
}
