//! What the service refuses of candidates whatever the session, for those who answer in its place.

use std::f64::consts::PI;

use nesam_proto::packed::unpack;
use nesam_proto::v1;

use crate::prediction::Candidates;

/// Steps of the model.
const HORIZON_MAX: usize = 32;

/// Whether the service would take these candidates, but for their commands, extras and number, of which it may be told other limits.
pub(crate) fn takes(candidates: &Candidates) -> bool {
    let Candidates { samples, samples_min, horizon, .. } = *candidates;
    let from = match (&candidates.start, candidates.start_stamp_ns) {
        (Some(start), None) => candidates.sent.is_empty() && takes_start(start),
        (None, Some(_)) => true,
        (None, None) => candidates.sent.is_empty(),
        (Some(_), Some(_)) => false,
    };
    let extras = candidates.extras.as_ref().is_some_and(|extras| *extras != v1::PredictExtras::default());
    let shape = samples >= 1 && samples_min <= samples && (1..=HORIZON_MAX).contains(&horizon);
    shape
        && candidates.output.stride as usize <= horizon
        && from
        && candidates.drawing.as_ref().is_none_or(takes_drawing)
        && candidates.cost.as_ref().is_none_or(|cost| !extras && takes_cost(cost, samples))
}

/// Limits by default, which a service may be told otherwise; yaw may be unwrapped.
fn takes_start(start: &[f64; 12]) -> bool {
    start.iter().enumerate().all(|(i, value)| {
        let limit = match i {
            0..3 => 1e6,
            3 | 4 => PI + 1e-6,
            5 => 1e4,
            6..9 => 100.0,
            _ => 50.0,
        };
        value.abs() <= limit
    })
}

fn takes_drawing(drawing: &v1::CandidateDrawing) -> bool {
    [drawing.speed_sd_m_s, drawing.second_sd].iter().all(|sd| (0.0..=1e6).contains(sd)) && (0.0..1.0).contains(&drawing.correlation)
}

fn takes_cost(cost: &v1::PathCost, samples: usize) -> bool {
    let path = unpack(&cost.path);
    let weights =
        [cost.path_weight, cost.speed_weight, cost.tilt_weight, cost.speed_change_weight, cost.second_change_weight, cost.temperature];
    path.len().is_multiple_of(2)
        && (2..=1024).contains(&(path.len() / 2))
        && path.iter().all(|value| value.is_finite())
        && !path.chunks_exact(2).all(|point| point == &path[..2])
        && weights.iter().all(|weight| (0.0..=1e12).contains(weight))
        && cost.speed_m_s.is_finite()
        && cost.best as usize <= samples
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: a fallback answers nothing that the service refuses. Method: one thing wrong at a time, of those that the Python client holds against the service.
    #[test]
    fn regress_one_wrong_thing_is_enough() {
        let path = [0.0, 0.0, 9.0, 0.0];
        let sound = || {
            let drawing = v1::CandidateDrawing { speed_sd_m_s: 0.1, second_sd: 0.1, correlation: 0.5, ..Default::default() };
            Candidates::drawn("s", 4, &[1.0, 0.0, 1.0, 0.0], drawing).ranked(&path, v1::PathCost { best: 4, ..Default::default() })
        };
        assert!(takes(&sound()));
        type Change = fn(&mut Candidates);
        let wrong: [(&str, Change); 16] = [
            ("no sample", |asked| asked.samples = 0),
            ("more than all", |asked| asked.samples_min = 5),
            ("no step", |asked| asked.horizon = 0),
            ("more steps than the model has", |asked| asked.horizon = 33),
            ("a stride beyond the horizon", |asked| asked.output.stride = 3),
            ("far away", |asked| asked.start = Some([1e9; 12])),
            ("not a number", |asked| asked.start = Some([f64::NAN; 12])),
            ("from a state and an instant", |asked| (asked.start, asked.start_stamp_ns) = (Some([0.0; 12]), Some(0))),
            ("sent before no instant", |asked| asked.sent = vec![(0, [1.0, 0.0])]),
            ("a negative deviation", |asked| asked.drawing = Some(v1::CandidateDrawing { second_sd: -0.1, ..Default::default() })),
            ("noise that stays", |asked| asked.drawing = Some(v1::CandidateDrawing { correlation: 1.0, ..Default::default() })),
            ("a path of one point", |asked| *asked = asked.clone().ranked(&[0.0; 2], v1::PathCost::default())),
            ("a path that stays where it is", |asked| *asked = asked.clone().ranked(&[5.0; 6], v1::PathCost::default())),
            ("a path that is none", |asked| *asked = asked.clone().ranked(&[f32::NAN; 4], v1::PathCost::default())),
            ("a negative weight", |asked| {
                *asked = asked.clone().ranked(&[0.0; 4], v1::PathCost { tilt_weight: -1.0, ..Default::default() })
            }),
            ("a cost and extras", |asked| asked.extras = Some(v1::PredictExtras { risk: true, ..Default::default() })),
        ];
        for (name, change) in wrong {
            let mut asked = sound();
            change(&mut asked);
            assert!(!takes(&asked), "{name}");
        }
    }
}
