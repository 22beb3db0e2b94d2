//! Predictions.

use std::sync::Arc;

use nesam_engine::{EngineError, Limits, PredictQuery, Prediction, Ranking, SentCommand, StartInstant};
use nesam_physics::{STATE_DIM, WHEELS};
use nesam_proto::packed::lend;
use nesam_proto::v1 as pb;

use super::candidates::{candidates, path_cost};
use super::extras::{predict_extras, put_extras};
use super::{Precision, code, control, encode, provenance, soil_correction, soil_vector, vehicle_state, vehicle_state_message};
use crate::call::Timing;

/// What the reply carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutputSelection {
    /// Bit i = channel i.
    pub channels: u32,
    /// Every which step.
    pub stride: usize,
    /// Whether to send the sinkage.
    pub wheel_sinkage: bool,
    /// Width of the numbers.
    pub precision: Precision,
}

const ALL_CHANNELS: u32 = (1 << STATE_DIM) - 1;

/// Largest part of a request that is not candidates, bytes.
const BESIDE_CANDIDATES: usize = 64 << 10;

/// Largest request, bytes: whatever N and K are allowed each by itself, so that a product that is not is refused with its field.
pub fn predict_bytes_max(limits: &Limits) -> usize {
    let candidates = limits.samples_max.saturating_mul(limits.steps_max()).saturating_mul(8);
    candidates.saturating_add(BESIDE_CANDIDATES)
}

/// A query and what its reply shall carry. Shape and lengths are checked before anything is copied.
///
/// # Errors
/// `Invalid` naming the field and the limit.
pub fn predict_query(message: &pb::PredictRequest, limits: &Limits) -> Result<(PredictQuery, OutputSelection), EngineError> {
    let (samples, samples_min, horizon) = (message.samples as usize, message.samples_min as usize, message.horizon as usize);
    limits.check_shape(samples, horizon)?;
    let controls = candidates(message)?;
    let start = message.start.as_ref().map(|state| vehicle_state("start", state)).transpose()?;
    let use_history = match pb::HistoryUse::try_from(message.history_use) {
        Ok(pb::HistoryUse::Unspecified | pb::HistoryUse::Measured) => true,
        Ok(pb::HistoryUse::None) => false,
        Err(_) => {
            let reason = format!("is {}, allowed are 0, 1 (measured) and 2 (none)", message.history_use);
            return Err(EngineError::invalid("history_use", reason));
        }
    };
    let output = output_selection(&message.output.unwrap_or_default(), horizon)?;
    let instant = start_instant(message)?;
    let extras = message.extras.as_ref().map(predict_extras).transpose()?.unwrap_or_default();
    let cost = message.cost.as_ref().map(path_cost).transpose()?;
    Ok((
        PredictQuery {
            session: message.session_id.clone(),
            start,
            instant,
            use_history,
            samples,
            samples_min,
            horizon,
            controls,
            cost,
            extras,
        },
        output,
    ))
}

/// The instant to start from and the commands until then, if one is given.
fn start_instant(message: &pb::PredictRequest) -> Result<Option<StartInstant>, EngineError> {
    let Some(stamp_ns) = message.start_stamp_ns else {
        if message.sent.is_empty() {
            return Ok(None);
        }
        return Err(EngineError::invalid(
            "start_stamp_ns",
            format!("is missing, it is needed for the {} commands of `sent`", message.sent.len()),
        ));
    };
    let command = |(i, sent): (usize, &pb::SentCommand)| {
        let command = sent.command.as_ref().ok_or_else(|| EngineError::invalid(format!("sent[{i}].command"), "is missing"))?;
        Ok(SentCommand { stamp_ns: sent.stamp_ns, command: control(command) })
    };
    let sent = message.sent.iter().enumerate().map(command).collect::<Result<_, EngineError>>()?;
    Ok(Some(StartInstant { stamp_ns, sent }))
}

fn output_selection(message: &pb::OutputSelection, horizon: usize) -> Result<OutputSelection, EngineError> {
    let channels = if message.channels == 0 { ALL_CHANNELS } else { message.channels };
    if channels & !ALL_CHANNELS != 0 {
        let reason = format!("is {channels:#x}, only the lowest {STATE_DIM} bits name a channel");
        return Err(EngineError::invalid("output.channels", reason));
    }
    let stride = message.stride.max(1) as usize;
    if stride > horizon {
        return Err(EngineError::invalid("output.stride", format!("is {stride}, allowed are 0 to horizon = {horizon}")));
    }
    let precision = Precision::of_message("output.precision", message.precision)?;
    Ok(OutputSelection { channels, stride, wheel_sinkage: message.wheel_sinkage, precision })
}

impl OutputSelection {
    /// All there is, as the engine computed it.
    pub const EVERYTHING: Self = Self { channels: ALL_CHANNELS, stride: 1, wheel_sinkage: true, precision: Precision::F32 };

    /// Steps returned of a horizon.
    fn steps(&self, horizon: usize) -> usize {
        horizon / self.stride
    }

    /// Every stride-th step of rows of `width` numbers, packed as f32.
    pub(super) fn steps_of(&self, values: &[f32], horizon: usize, width: usize) -> bytes::Bytes {
        if self.stride == 1 || values.is_empty() {
            return encode(values, Precision::F32);
        }
        let columns: Vec<usize> = (0..width).collect();
        encode(&self.pick(values, horizon, width, &columns), Precision::F32)
    }

    /// Picks every stride-th step and the given columns of rows of `width` numbers.
    fn pick(&self, values: &[f32], horizon: usize, width: usize, columns: &[usize]) -> Vec<f32> {
        let mut picked = Vec::with_capacity(values.len() / width / self.stride * columns.len());
        for sample in values.chunks_exact(horizon * width) {
            for step in sample.chunks_exact(width).skip(self.stride - 1).step_by(self.stride) {
                picked.extend(columns.iter().map(|c| step[*c]));
            }
        }
        picked
    }

    /// Whether every number of every step is returned as the engine computed it.
    fn whole_steps(&self) -> bool {
        self.stride == 1 && self.precision == Precision::F32
    }

    fn states(&self, prediction: &Arc<Prediction>) -> bytes::Bytes {
        if self.channels == ALL_CHANNELS && self.whole_steps() {
            return lend(prediction.clone(), |p| &p.rollout.states);
        }
        let rollout = &prediction.rollout;
        let columns: Vec<usize> = (0..STATE_DIM).filter(|c| self.channels >> c & 1 == 1).collect();
        let mut picked = self.pick(&rollout.states, rollout.horizon, STATE_DIM, &columns);
        if self.precision == Precision::F16 {
            for row in picked.chunks_exact_mut(columns.len()) {
                let positions = row.iter_mut().zip(&columns).filter(|(_, column)| **column < 3);
                positions.for_each(|(value, column)| *value = (f64::from(*value) - prediction.start.position_m[*column]) as f32);
            }
        }
        encode(&picked, self.precision)
    }

    fn sinkage(&self, prediction: &Arc<Prediction>) -> bytes::Bytes {
        if !self.wheel_sinkage {
            return bytes::Bytes::new();
        }
        if self.whole_steps() {
            return lend(prediction.clone(), |p| &p.rollout.sinkage_m);
        }
        let columns: [usize; WHEELS] = core::array::from_fn(|i| i);
        encode(&self.pick(&prediction.rollout.sinkage_m, prediction.rollout.horizon, WHEELS, &columns), self.precision)
    }
}

/// The reply to a query.
pub fn predict_reply(tag: u64, prediction: &Arc<Prediction>, output: OutputSelection, timing: Timing) -> pb::PredictReply {
    let groups = prediction.extras.soil_groups.max(1);
    let mut reply = pb::PredictReply {
        tag,
        samples: prediction.candidates() as u32,
        steps: output.steps(prediction.rollout.horizon) as u32,
        channels: output.channels,
        states: output.states(prediction),
        sinkage_m: output.sinkage(prediction),
        validity: prediction.rollout.flags.clone(),
        start: Some(vehicle_state_message(&prediction.start)),
        history_steps: prediction.history_steps as u32,
        soil: Some(soil_vector(&prediction.rollout.soil)),
        soil_variance: prediction.soil_variance.as_ref().map(soil_vector),
        measurement_age_s: prediction.measurement_age_s,
        provenance: Some(provenance(&prediction.provenance)),
        queue_s: timing.queue_s,
        compute_s: timing.compute_s,
        soil_correction: Some(soil_correction(&prediction.soil)),
        rolled_forward_steps: prediction.rolled_forward_steps as u32,
        start_stamp_ns: prediction.start_stamp_ns,
        precision: output.precision.to_message().into(),
        soil_groups: groups as u32,
        drawn_controls: encode(&prediction.drawn_controls, Precision::F32),
        ..Default::default()
    };
    if let Some(Ranking { costs, best, mean_controls }) = &prediction.ranking {
        reply.costs = encode(costs, Precision::F32);
        reply.best.clone_from(best);
        reply.mean_controls = encode(mean_controls, Precision::F32);
    }
    put_extras(&mut reply, &prediction.extras, prediction.rollout.horizon, output);
    reply
}

/// A refusal inside a stream or a Zenoh reply.
pub fn predict_error(tag: u64, error: &EngineError) -> pb::PredictError {
    pb::PredictError { tag, code: code(error).into(), field: error.field().into(), message: error.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_selection_picks_channels_and_steps() {
        let output = output_selection(&pb::OutputSelection { channels: 0b10_0000_0001, stride: 2, ..Default::default() }, 5).unwrap();
        let (samples, horizon) = (2, 5);
        let values: Vec<f32> = (0..samples * horizon * STATE_DIM).map(|v| v as f32).collect();
        let picked = output.pick(&values, horizon, STATE_DIM, &[0, 9]);
        // Steps 2 and 4 (rows 1 and 3) of both samples.
        assert_eq!(picked, [12.0, 21.0, 36.0, 45.0, 72.0, 81.0, 96.0, 105.0]);
        assert_eq!(output.steps(horizon), 2);
    }
}
