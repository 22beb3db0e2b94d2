//! Goal: Jacobians, covariance, risk and what-if soils over the wire are those of the model, row by row, and cost nothing else.

use std::sync::Arc;

use nesam_client::{Prediction, v1};
use nesam_engine::{Command, Engine, Limits, OpenSession, PredictExtras, PredictQuery, Reply};
use nesam_model::{HistoryStep, RolloutQuery, Variant};
use nesam_terrain::WorldMap;
use tonic::Code;

use crate::stage::*;

fn packed(values: &[f32]) -> prost::bytes::Bytes {
    values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_exact_terrain_is_that_of_the_model_and_near_the_pose_grid() {
    let (server, mut client, recorded) = driven("s", 60).await;
    let mut asked = candidates("s", &recorded.drive, 60, 2, 16);
    let on_grid = client.predict(asked.clone()).await.unwrap();
    let expected = offline_by(&fresh_predictor().exactly(), &recorded, 60, &asked, 31, learned(&recorded, 60).0);
    asked.extras = Some(v1::PredictExtras { exact_terrain: true, ..Default::default() });
    let exactly = client.predict(asked.clone()).await.unwrap();
    assert_same(&exactly, &expected);
    let apart = |n: usize, k: usize| {
        let [a, b] = [&on_grid, &exactly].map(|p| p.state(n, k));
        f64::from(a[0] - b[0]).hypot(f64::from(a[1] - b[1]))
    };
    let last = apart(0, 15).max(apart(1, 15));
    assert!(last > 0.0 && last < 0.05, "interpolation moves a prediction by {last} m after 1.6 s");
    // The reply says it of the first candidate, and is else what it was.
    asked.extras = Some(v1::PredictExtras { interpolation_deviation: true, ..Default::default() });
    let told = client.predict(asked.clone()).await.unwrap();
    let mean = (0..16).map(|k| apart(0, k)).sum::<f64>() / 16.0;
    // Positions of an answer are rounded to f32, 4 µm a hundred metres from the origin; those that the deviation is told from are not.
    assert!((told.extras.interpolation_deviation_m.unwrap() - mean).abs() < 2e-5, "{:?}, {mean}", told.extras.interpolation_deviation_m);
    assert_eq!(bits(&told.states), bits(&on_grid.states));
    assert_eq!((on_grid.extras.interpolation_deviation_m, exactly.extras.interpolation_deviation_m), (None, None));
    asked.extras = Some(v1::PredictExtras { interpolation_deviation: true, exact_terrain: true, ..Default::default() });
    let refused = client.predict(asked.clone()).await.unwrap_err();
    assert!(refused.to_string().contains("interpolation_deviation"), "{refused}");
    asked.extras = None;
    assert_eq!(bits(&client.predict(asked).await.unwrap().states), bits(&on_grid.states), "the next is on the grid again");
    server.shutdown().await;
}

/// Goal: what interpolation moves is told where f32 counts sixteenths of a metre as it is near the origin. Method: one drive on one map, once moved far out, near the end
/// of what positions may be, by whole cells of the grid of poses.
#[test]
fn regress_what_interpolation_moves_is_told_far_from_the_origin() {
    let recorded = recorded();
    let told = |id: &str, moved_m: [f64; 2]| {
        let world = &recorded.world;
        let mut geometry = *world.geometry();
        geometry.origin_m = core::array::from_fn(|i| geometry.origin_m[i] + moved_m[i]);
        let map = WorldMap::from_layers(id, 1, geometry, world.elevation_m(), world.semantic_rgb()).unwrap();
        let mut engine = Engine::new(predictor(), Limits::default()).unwrap();
        let mut call = |command: Command| engine.execute(0, &command).unwrap();
        call(Command::PutMap { map: Arc::new(map), base: None });
        call(Command::Open(OpenSession { vehicle: "truck".into(), map: id.into(), ..Default::default() }));
        for i in 30..=60 {
            let mut measurement = engine_sample(&recorded.drive, i);
            (0..2).for_each(|axis| measurement.state.position_m[axis] += moved_m[axis]);
            call(Command::Measure { session: "truck".into(), vehicle: None, measurement });
        }
        let extras = PredictExtras { interpolation_deviation: true, ..Default::default() };
        let query = PredictQuery { extras, ..engine_query("truck", &recorded.drive, 60, 1, 32) };
        let Reply::Predicted(prediction) = call(Command::Predict(query)) else { panic!("another reply") };
        assert!(prediction.rollout.position_m.is_empty());
        prediction.extras.interpolation_deviation_m.unwrap()
    };
    let (near_m, far_m) = (told("near", [0.0; 2]), told("far", [524_288.0, 786_432.0]));
    assert!(near_m > 2e-5 && (far_m - near_m).abs() < 1e-5, "{near_m} and {far_m} m");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_jacobians_are_those_of_the_model_and_rows_stand_alone() {
    let (server, mut client, recorded) = driven("s", 60).await;
    let (samples, horizon) = (3, 6);
    let mut asked = candidates("s", &recorded.drive, 60, samples, horizon);
    let plain = client.predict(asked.clone()).await.unwrap();
    asked.extras = Some(v1::PredictExtras { jacobians: true, ..Default::default() });
    let full = client.predict(asked.clone()).await.unwrap();
    assert!(bits(&full.states) == bits(&plain.states), "states do not depend on extras");
    assert!(plain.extras.jacobian_start.is_empty() && full.extras.covariance.is_empty() && full.extras.wheel_load_n.is_empty());

    let history: Vec<HistoryStep> =
        (29..60).map(|j| HistoryStep { state: recorded.drive.states[j], control: recorded.drive.controls[j] }).collect();
    let predictor = fresh_predictor();
    let query = RolloutQuery {
        history: &history,
        start: recorded.drive.states[60],
        controls: &asked.controls,
        samples,
        horizon,
        map: Some(&recorded.world),
        soil_correction: learned(&recorded, 60).0,
        variant: Variant::Full,
        start_time_s: None,
        wheels: None,
    };
    for (n, linearisation) in predictor.linearise(&query).unwrap().iter().enumerate() {
        let by_start: Vec<f32> =
            linearisation.by_start_and_soil().iter().flat_map(|j| j.start.as_flattened().to_vec()).map(|v| v as f32).collect();
        let by_controls: Vec<f32> = linearisation.by_controls().iter().map(|v| *v as f32).collect();
        let (a, b) = (by_start.len(), by_controls.len());
        assert_eq!((a, b), (horizon * 144, horizon * 12 * horizon * 2));
        assert!(bits(&full.extras.jacobian_start[n * a..(n + 1) * a]) == bits(&by_start), "row {n}");
        assert!(bits(&full.extras.jacobian_controls[n * b..(n + 1) * b]) == bits(&by_controls), "row {n}");
    }
    let mut alone = asked.clone();
    alone.samples = 1;
    alone.controls = asked.controls[2 * horizon * 2..].to_vec();
    let alone = client.predict(alone).await.unwrap();
    assert!(bits(&alone.extras.jacobian_start) == bits(&full.extras.jacobian_start[2 * horizon * 144..]));

    // Rolled forward by two steps: the first two steps and commands are taken off.
    asked.horizon = 4;
    asked.controls = asked.controls.chunks_exact(2 * horizon).flat_map(|row| row[4..].to_vec()).collect();
    let sent = [1, 2].map(|i| (60 * STEP_NS + i * STEP_NS, [1.0, 0.0])).to_vec();
    let rolled = client.predict(asked.starting_at(62 * STEP_NS, sent)).await.unwrap();
    assert_eq!((rolled.rolled_forward_steps, rolled.extras.jacobian_start.len()), (2, samples * 4 * 144));
    assert_eq!(rolled.extras.jacobian_controls.len(), samples * 4 * 12 * 4 * 2);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_what_if_soils_are_groups_and_none_is_the_plain_prediction() {
    let (server, mut client, recorded) = driven("s", 60).await;
    let (samples, horizon) = (5, 12);
    let plain = client.predict(candidates("s", &recorded.drive, 60, samples, horizon)).await.unwrap();
    let ask = |extras: v1::PredictExtras| {
        let mut asked = candidates("s", &recorded.drive, 60, samples, horizon);
        asked.extras = Some(extras);
        asked
    };
    let mut deltas = [0.0f32; 18];
    deltas[9] = -1.5; // less cohesion in the second group
    let extras = v1::PredictExtras { soil_deltas: packed(&deltas), risk: true, ..Default::default() };
    let what_if = client.predict(ask(extras.clone())).await.unwrap();
    assert_eq!((what_if.samples, what_if.soil_groups, what_if.validity.len()), (samples, 3, 3 * samples));
    let group = samples * horizon * 12;
    let of = |prediction: &Prediction, g: usize| bits(&prediction.states[g * group..(g + 1) * group]);
    assert!(of(&what_if, 0) == bits(&plain.states), "no correction is the plain prediction, bit for bit");
    assert!(of(&what_if, 2) == bits(&plain.states), "wherever it stands in the batch");
    assert!(of(&what_if, 1) != bits(&plain.states), "another soil is another prediction");
    assert_eq!((what_if.extras.wheel_load_n.len(), what_if.extras.traction_reserve.len()), (3 * group / 3, 3 * group / 12));
    assert!(what_if.extras.traction_reserve[..group / 12] != what_if.extras.traction_reserve[group / 12..group / 6]);
    let one = v1::PredictExtras { soil_deltas: packed(&deltas[6..12]), ..extras };
    let alone = client.predict(ask(one)).await.unwrap();
    assert!(of(&alone, 0) == of(&what_if, 1), "a group equals the same question alone");

    let sigma = client.predict(ask(v1::PredictExtras { soil_sigma_points: true, ..Default::default() })).await.unwrap();
    assert_eq!((sigma.soil_groups, sigma.states.len()), (13, 13 * group));
    assert!(of(&sigma, 0) == bits(&plain.states) && of(&sigma, 1) != of(&sigma, 2));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_risk_is_plausible_and_picked_by_stride() {
    let (server, mut client, recorded) = driven("s", 60).await;
    let mut asked = candidates("s", &recorded.drive, 60, 2, 9);
    asked.extras = Some(v1::PredictExtras { risk: true, ..Default::default() });
    let whole = client.predict(asked.clone()).await.unwrap().extras;
    let predictor = predictor();
    let vehicle = &predictor.bundle().vehicle;
    let weight = vehicle.mass_kg * vehicle.gravity_m_s2;
    for (row, loads) in whole.wheel_load_n.chunks_exact(4).enumerate() {
        let total: f64 = loads.iter().map(|l| f64::from(*l)).sum();
        // The vehicle bounces over rough ground, and slopes carry less than the weight.
        assert!(total > 0.3 * weight && total < 2.0 * weight, "row {row}: {loads:?}");
        assert!((0.0..=1.0).contains(&whole.load_transfer_ratio[row]));
        assert!(whole.traction_reserve[row] > -1.0 && whole.traction_reserve[row] < 1.5);
    }
    assert!(whole.wheel_slip.iter().all(|s| (-1.0..=1.0).contains(s)));
    asked.output.stride = 4;
    let part = client.predict(asked).await.unwrap().extras;
    assert_eq!(part.traction_reserve, [3, 7, 12, 16].map(|row| whole.traction_reserve[row]));
    assert_eq!(part.wheel_load_n[4..8], whole.wheel_load_n[28..32]);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_covariance_of_candidates_that_slow_down_stays_small() {
    let (server, mut client, recorded) = driven("s", 40).await;
    // To walking pace and to a stop, straight on and in a turn.
    let mut asked = candidates("s", &recorded.drive, 40, 8, 32);
    asked.controls = (0..8).flat_map(|row| vec![[[0.0, 0.3, 0.6, 1.0][row % 4], [0.0, 0.4][row / 4]]; 32]).flatten().collect();
    asked.extras = Some(v1::PredictExtras { covariance: true, ..Default::default() });
    let covariance = client.predict(asked).await.unwrap().extras.covariance;
    for (row, covariance) in covariance.chunks_exact(32 * 144).enumerate() {
        let sd_m = [0, 1].map(|i| covariance[31 * 144 + 13 * i].sqrt());
        assert!(sd_m.iter().all(|sd_m| (0.01..1.5).contains(sd_m)), "candidate {row}: {sd_m:?} m after 3.2 s");
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_covariance_of_an_exact_start_is_smaller() {
    let (server, mut client, recorded) = driven("s", 60).await;
    let ask = |start_covariance| {
        let mut asked = candidates("s", &recorded.drive, 60, 2, 32);
        asked.extras = Some(v1::PredictExtras { covariance: true, start_covariance, ..Default::default() });
        asked
    };
    let [measured, exact] = [Default::default(), packed(&[0.0; 144])].map(ask);
    let (measured, exact) = (client.predict(measured).await.unwrap().extras, client.predict(exact).await.unwrap().extras);
    assert_eq!((measured.covariance.len(), measured.region_90_single.len()), (2 * 32 * 144, 6));
    for (measured, exact) in measured.covariance.chunks_exact(144).zip(exact.covariance.chunks_exact(144)) {
        for r in 0..12 {
            assert!(measured[13 * r] >= exact[13 * r] && exact[13 * r] >= 0.0);
            assert!((0..r).all(|c| measured[12 * r + c].to_bits() == measured[12 * c + r].to_bits()), "symmetric");
        }
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_bad_extras_are_refused() {
    let (server, mut client, recorded) = driven("s", 60).await;
    let ask = |samples: usize, extras: v1::PredictExtras| v1::PredictRequest {
        extras: Some(extras),
        ..candidates("s", &recorded.drive, 60, samples, 2).to_message()
    };
    let covariance = |values: &[f32]| v1::PredictExtras { covariance: true, start_covariance: packed(values), ..Default::default() };
    let entry = |at: usize, value: f32| {
        let mut values = [0.0; 144];
        (0..12).for_each(|i| values[13 * i] = 1.0);
        values[at] = value;
        values
    };
    let soils = |values: &[f32]| v1::PredictExtras { soil_deltas: packed(values), ..Default::default() };
    let jacobians = v1::PredictExtras { jacobians: true, ..Default::default() };
    for (what, request, field) in [
        ("nine Jacobians", ask(9, jacobians.clone()), "extras.jacobians"),
        ("65 covariances", ask(65, v1::PredictExtras { covariance: true, ..Default::default() }), "extras.covariance"),
        ("Jacobians of what-if soils", ask(1, v1::PredictExtras { soil_sigma_points: true, ..jacobians }), "extras.jacobians"),
        ("no covariance asked", ask(1, v1::PredictExtras { covariance: false, ..covariance(&entry(0, 1.0)) }), "extras.start_covariance"),
        ("short covariance", ask(1, covariance(&[0.0; 143])), "extras.start_covariance"),
        ("NaN covariance", ask(1, covariance(&entry(5, f32::NAN))), "extras.start_covariance"),
        ("negative variance", ask(1, covariance(&entry(13, -1.0))), "extras.start_covariance"),
        ("asymmetric covariance", ask(1, covariance(&entry(1, 0.5))), "extras.start_covariance"),
        ("17 exactly", ask(17, v1::PredictExtras { exact_terrain: true, ..Default::default() }), "extras.exact_terrain"),
        ("half a soil", ask(1, soils(&[0.0; 9])), "extras.soil_deltas"),
        ("17 soils", ask(1, soils(&[0.0; 102])), "extras.soil_deltas"),
        ("infinite soil", ask(1, soils(&[f32::INFINITY; 6])), "extras.soil_deltas"),
        ("16 x 300 rows", ask(300, soils(&[0.0; 96])), "extras.soil_deltas"),
        ("13 x 316 rows", ask(316, v1::PredictExtras { soil_sigma_points: true, ..Default::default() }), "extras.soil_sigma_points"),
        ("both soils", ask(1, v1::PredictExtras { soil_sigma_points: true, ..soils(&[0.0; 6]) }), "extras.soil_sigma_points"),
    ] {
        assert_refused(what, client.predict_message(request).await, Code::InvalidArgument, field);
    }
    server.shutdown().await;
}
