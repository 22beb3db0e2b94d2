//! Commands of the engine back to the messages that ask for them. Every field is named, so that a new one cannot be forgotten.

use nesam_engine::{Measurement, OpenSession, PredictExtras, PredictQuery, SentCommand, WhatIfSoils, WheelMeasurement};
use nesam_proto::v1 as pb;

use super::candidates::{candidates_message, path_cost_message};
use super::{Precision, control_message, encode, vehicle_state_message};

/// The message that brings a measurement to a session.
pub fn measurement_message(session: &str, measurement: &Measurement) -> pb::Measurement {
    let Measurement { sequence, boot, stamp_ns, state, command, wheels } = measurement;
    let WheelMeasurement { speed_rad_s, road_wheel_angle_rad } = wheels;
    let measured = speed_rad_s.is_some() || road_wheel_angle_rad.is_some();
    pb::Measurement {
        session_id: session.into(),
        sequence: sequence.unwrap_or(0),
        boot_id: boot.unwrap_or(0),
        run: 0,
        stamp_ns: *stamp_ns,
        state: Some(vehicle_state_message(state)),
        command: Some(control_message(command)),
        wheels: measured.then(|| pb::WheelMeasurement {
            speed_rad_s: speed_rad_s.map(Vec::from).unwrap_or_default(),
            road_wheel_angle_rad: road_wheel_angle_rad.map(Vec::from).unwrap_or_default(),
        }),
    }
}

/// The message that opens a session.
pub fn open_message(open: &OpenSession) -> pb::OpenSessionRequest {
    let OpenSession { session, vehicle, vehicle_card, map, initial } = open;
    pb::OpenSessionRequest {
        vehicle_id: vehicle.clone(),
        session_id: session.clone(),
        vehicle_card: vehicle_card.clone(),
        map_id: map.clone(),
        initial: initial.as_ref().map(|measurement| measurement_message("", measurement)),
    }
}

/// The message that asks for a prediction and for everything of it.
pub fn predict_message(query: &PredictQuery) -> pb::PredictRequest {
    let PredictQuery { session, start, instant, use_history, samples, samples_min, horizon, controls, cost, extras } = query;
    let (controls, drawing) = candidates_message(controls);
    let history_use = if *use_history { pb::HistoryUse::Measured } else { pb::HistoryUse::None };
    let sent = |sent: &SentCommand| pb::SentCommand { stamp_ns: sent.stamp_ns, command: Some(control_message(&sent.command)) };
    pb::PredictRequest {
        session_id: session.clone(),
        start: start.as_ref().map(vehicle_state_message),
        history_use: history_use.into(),
        samples: u32::try_from(*samples).unwrap_or(u32::MAX),
        horizon: u32::try_from(*horizon).unwrap_or(u32::MAX),
        controls,
        output: Some(pb::OutputSelection { wheel_sinkage: true, ..Default::default() }),
        tag: 0,
        start_stamp_ns: instant.as_ref().map(|instant| instant.stamp_ns),
        sent: instant.as_ref().map(|instant| instant.sent.iter().map(sent).collect()).unwrap_or_default(),
        extras: (*extras != PredictExtras::default()).then(|| extras_message(extras)),
        drawing,
        cost: cost.as_ref().map(path_cost_message),
        samples_min: u32::try_from(*samples_min).unwrap_or(u32::MAX),
        budget_s: None,
    }
}

/// The message that asks for what a prediction computes beyond states. Its numbers came as f32.
fn extras_message(extras: &PredictExtras) -> pb::PredictExtras {
    let PredictExtras { jacobians, covariance, risk, exact_terrain, interpolation_deviation, soils } = extras;
    let packed = |values: &mut dyn Iterator<Item = &f64>| encode(&values.map(|v| *v as f32).collect::<Vec<f32>>(), Precision::F32);
    let start = covariance.as_ref().and_then(|query| query.start.as_ref());
    pb::PredictExtras {
        jacobians: *jacobians,
        covariance: covariance.is_some(),
        start_covariance: start.map(|start| packed(&mut start.as_flattened().iter())).unwrap_or_default(),
        risk: *risk,
        exact_terrain: *exact_terrain,
        interpolation_deviation: *interpolation_deviation,
        soil_deltas: match soils {
            WhatIfSoils::Added(soils) => packed(&mut soils.as_flattened().iter()),
            WhatIfSoils::Estimate | WhatIfSoils::SigmaPoints => Default::default(),
        },
        soil_sigma_points: *soils == WhatIfSoils::SigmaPoints,
    }
}

#[cfg(test)]
mod tests {
    use nesam_engine::{Candidates, CostWeights, CovarianceQuery, Drawing, Limits, PathCost, StartInstant};
    use nesam_physics::{Control, VehicleState};
    use prost::Message as _;

    use super::*;
    use crate::convert::{measurement, open_session, predict_query};

    fn some_measurement(sequence: Option<u64>, wheels: WheelMeasurement) -> Measurement {
        let state = VehicleState::from_array(core::array::from_fn(|i| 0.1 * i as f64 - 1.0 / 3.0));
        Measurement { sequence, boot: sequence, stamp_ns: -7, state, command: Control { speed_m_s: 2.5, second: -0.25 }, wheels }
    }

    #[test]
    fn property_measurements_come_back_as_they_were() {
        for (sequence, speed_rad_s, road_wheel_angle_rad) in [
            (None, None, None),
            (Some(u64::MAX), Some([1.0, f64::NAN, -0.0, f64::MIN_POSITIVE]), None),
            (Some(1), None, Some([f64::INFINITY, 0.1])),
        ] {
            let given = some_measurement(sequence, WheelMeasurement { speed_rad_s, road_wheel_angle_rad });
            let back = measurement(&measurement_message("s", &given)).unwrap();
            assert_eq!(format!("{back:?}"), format!("{given:?}"));
            let open = OpenSession { session: "s".into(), vehicle: "v".into(), initial: Some(given), ..Default::default() };
            assert_eq!(format!("{:?}", open_session(&open_message(&open)).unwrap()), format!("{open:?}"));
        }
    }

    /// Goal: what is recorded is what the engine had, though the bytes of a message leave out a number that equals 0, whatever its sign. Method: messages with zeros below 0 as
    /// other clients send them, read; then through the bytes of a recording.
    #[test]
    fn regress_a_zero_below_0_is_recorded_as_the_engine_had_it() {
        let below = VehicleState::from_array([-0.0; 12]);
        let command = Control { speed_m_s: -0.0, second: -0.0 };
        let measured = measurement_message("s", &Measurement { state: below, command, ..some_measurement(None, Default::default()) });
        let read = measurement(&measured).unwrap();
        let recorded = pb::Measurement::decode(measurement_message("s", &read).encode_to_vec().as_slice()).unwrap();
        assert_eq!(format!("{:?}", measurement(&recorded).unwrap()), format!("{read:?}"));
        let weights = CostWeights { path: -0.0, speed: -0.0, tilt: -0.0, change: [-0.0; 2] };
        for (start, instant) in
            [(Some(below), None), (None, Some(StartInstant { stamp_ns: 9, sent: vec![SentCommand { stamp_ns: 5, command }] }))]
        {
            let query = PredictQuery {
                session: "s".into(),
                start,
                instant,
                use_history: true,
                samples: 1,
                samples_min: 0,
                horizon: 1,
                controls: Candidates::Drawn(Drawing { nominal: vec![-0.0; 2], sd: [-0.0; 2], correlation: -0.0, seed: 1 }),
                cost: Some(PathCost { path: vec![-0.0, 1.0], speed_m_s: -0.0, weights, best: 1, temperature: -0.0 }),
                extras: PredictExtras::default(),
            };
            let (read, _) = predict_query(&predict_message(&query), &Limits::default()).unwrap();
            let recorded = pb::PredictRequest::decode(predict_message(&read).encode_to_vec().as_slice()).unwrap();
            assert_eq!(format!("{:?}", predict_query(&recorded, &Limits::default()).unwrap().0), format!("{read:?}"));
        }
    }

    #[test]
    fn property_queries_come_back_as_they_were() {
        let asked = PredictExtras {
            jacobians: true,
            covariance: Some(CovarianceQuery { start: Some(Box::new([[0.25; 12]; 12])) }),
            risk: true,
            exact_terrain: true,
            interpolation_deviation: true,
            soils: WhatIfSoils::Added(vec![[0.5; 6], [-0.125; 6]]),
        };
        let sigma = PredictExtras { soils: WhatIfSoils::SigmaPoints, ..Default::default() };
        let sent = vec![SentCommand { stamp_ns: 5, command: Control { speed_m_s: 1.0, second: 0.5 } }];
        for (start, instant, use_history, extras) in [
            (None, None, true, PredictExtras::default()),
            (Some(some_measurement(None, WheelMeasurement::default()).state), None, false, asked),
            (None, Some(StartInstant { stamp_ns: 9, sent: Vec::new() }), true, sigma),
            (None, Some(StartInstant { stamp_ns: i64::MIN, sent }), true, PredictExtras::default()),
        ] {
            let controls = Candidates::Given(vec![1.0, f32::NAN, -0.0, f32::MAX, 2.0, 3.0]);
            let mut query = PredictQuery {
                session: "s".into(),
                start,
                instant,
                use_history,
                samples: 3,
                samples_min: 2,
                horizon: 1,
                controls,
                cost: None,
                extras,
            };
            let drawing = Drawing { nominal: vec![-0.0, f32::NAN], sd: [0.5, f64::NAN], correlation: 0.75, seed: u64::MAX };
            let weights = CostWeights { path: 1.0, speed: 2.0, tilt: 3.0, change: [4.0, 5.0] };
            let cost = PathCost { path: vec![1.0, f32::INFINITY], speed_m_s: 6.0, weights, best: 2, temperature: 7.0 };
            for _ in 0..2 {
                let (back, _) = predict_query(&predict_message(&query), &Limits::default()).unwrap();
                assert_eq!(format!("{back:?}"), format!("{query:?}"));
                (query.controls, query.cost) = (Candidates::Drawn(drawing.clone()), Some(cost.clone()));
            }
        }
    }
}
