//! Goal: bad input to every method is refused with the right code, names the field, and changes nothing.

use nesam_client::{Client, outcome_label, v1};
use tonic::Code;
use v1::upload_map_request::Part;

use crate::stage::*;

/// A server with a session that has a map and 40 steps, and the same session read back.
async fn prepared() -> (nesam_server::RunningServer, Client, Recorded, v1::Session) {
    let (server, mut client, recorded) = driven("s", 39).await;
    let session = client.session("s").await.unwrap();
    (server, client, recorded, session)
}

/// A state message with one of the twelve numbers replaced.
fn with_entry(mut state: v1::VehicleState, i: usize, value: f64) -> v1::VehicleState {
    let part = match i / 3 {
        0 => &mut state.position_m,
        1 => &mut state.attitude_rad,
        2 => &mut state.velocity_m_s,
        _ => &mut state.angular_velocity_rad_s,
    };
    let vector = part.as_mut().unwrap();
    *[&mut vector.x, &mut vector.y, &mut vector.z][i % 3] = value;
    state
}

#[tokio::test(flavor = "multi_thread")]
async fn service_bad_predictions_are_refused() {
    let (server, mut client, recorded, before) = prepared().await;
    let good = candidates("s", &recorded.drive, 39, 2, 3).to_message();
    let state = recorded.drive.states[39].to_array();
    let start = nesam_client::state_message(state);
    let packed = |values: &[f32]| -> prost::bytes::Bytes { values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into() };
    let controls = |i: usize, value: f32| {
        let mut values = [2.0f32, 0.0, 2.0, 0.0, 2.0, 0.0, 2.0, 0.0, 2.0, 0.0, 2.0, 0.0];
        values[i] = value;
        packed(&values)
    };
    let from = |start: v1::VehicleState| v1::PredictRequest { start: Some(start), ..good.clone() };
    let output = |channels, stride| v1::PredictRequest {
        output: Some(v1::OutputSelection { channels, stride, ..Default::default() }),
        ..good.clone()
    };
    use Code::{InvalidArgument, NotFound};
    let mut sweep = vec![
        ("unknown session", v1::PredictRequest { session_id: "nobody".into(), ..good.clone() }, NotFound, "session_id"),
        ("empty session", v1::PredictRequest { session_id: String::new(), ..good.clone() }, NotFound, "session_id"),
        ("N = 0", v1::PredictRequest { samples: 0, ..good.clone() }, InvalidArgument, "samples"),
        ("N = 4097", v1::PredictRequest { samples: 4097, horizon: 1, ..good.clone() }, InvalidArgument, "samples"),
        ("N = 2^32 - 1", v1::PredictRequest { samples: u32::MAX, ..good.clone() }, InvalidArgument, "samples"),
        ("N K above the budget", v1::PredictRequest { samples: 4096, horizon: 32, ..good.clone() }, InvalidArgument, "samples"),
        ("K = 0", v1::PredictRequest { horizon: 0, ..good.clone() }, InvalidArgument, "horizon"),
        ("K = 33", v1::PredictRequest { horizon: 33, ..good.clone() }, InvalidArgument, "horizon"),
        ("K = 2^32 - 1", v1::PredictRequest { horizon: u32::MAX, ..good.clone() }, InvalidArgument, "horizon"),
        ("no controls", v1::PredictRequest { controls: Default::default(), ..good.clone() }, InvalidArgument, "controls"),
        ("one byte less", v1::PredictRequest { controls: good.controls.slice(1..), ..good.clone() }, InvalidArgument, "controls"),
        ("one number more", v1::PredictRequest { controls: packed(&[1.0; 13]), ..good.clone() }, InvalidArgument, "controls"),
        ("NaN control", v1::PredictRequest { controls: controls(7, f32::NAN), ..good.clone() }, InvalidArgument, "controls[1, 0]"),
        (
            "infinite control",
            v1::PredictRequest { controls: controls(4, f32::INFINITY), ..good.clone() },
            InvalidArgument,
            "controls[0, 2]",
        ),
        (
            "speed off the card",
            v1::PredictRequest { controls: controls(2, 99.0), ..good.clone() },
            InvalidArgument,
            "controls[0, 1].speed_m_s",
        ),
        (
            "steering off the card",
            v1::PredictRequest { controls: controls(3, -1.01), ..good.clone() },
            InvalidArgument,
            "controls[0, 1].second",
        ),
        ("start without velocity", from(v1::VehicleState { velocity_m_s: None, ..start }), InvalidArgument, "start.velocity_m_s"),
        ("empty start", from(v1::VehicleState::default()), InvalidArgument, "start.position_m"),
        ("start off the map", from(with_entry(start, 0, 1e4)), InvalidArgument, "start.position_m"),
        ("start off the Earth", from(with_entry(start, 0, 1e9)), InvalidArgument, "start.position_m.x"),
        ("start too fast", from(with_entry(start, 6, 200.0)), InvalidArgument, "start.velocity_m_s.x"),
        ("start upside down twice", from(with_entry(start, 3, 7.0)), InvalidArgument, "start.attitude_rad.x"),
        ("history use 7", v1::PredictRequest { history_use: 7, ..good.clone() }, InvalidArgument, "history_use"),
        ("no time", v1::PredictRequest { budget_s: Some(0.0), ..good.clone() }, InvalidArgument, "budget_s"),
        ("NaN seconds", v1::PredictRequest { budget_s: Some(f64::NAN), ..good.clone() }, InvalidArgument, "budget_s"),
        ("channel 12", output(1 << 12, 1), InvalidArgument, "output.channels"),
        ("stride above K", output(0, 4), InvalidArgument, "output.stride"),
    ];
    let fields = ["position_m.x", "attitude_rad.z", "velocity_m_s.y", "angular_velocity_rad_s.x"].map(|f| format!("start.{f}"));
    for (i, field) in [0, 5, 7, 9].into_iter().zip(&fields) {
        sweep.push(("start not finite", from(with_entry(start, i, f64::NAN)), InvalidArgument, field));
    }
    for (what, request, code, field) in sweep {
        assert_refused(what, client.predict_message(request).await, code, field);
        assert_eq!(client.session("s").await.unwrap(), before, "{what}");
    }
    // A message above the size that any valid request can have is refused before it is read.
    let huge = v1::PredictRequest { controls: vec![0; 3 << 20].into(), ..good.clone() };
    let code = client.predict_message(huge).await.unwrap_err().code();
    assert!(matches!(code, Some(Code::OutOfRange | Code::ResourceExhausted)), "{code:?}");
    client.predict_message(good).await.unwrap();
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_bad_measurements_are_answered_and_change_nothing() {
    let (server, mut client, recorded, before) = prepared().await;
    let good = || v1::Measurement { sequence: 0, ..sample("s", &recorded.drive, 40) };
    let state = nesam_client::state_message(recorded.drive.states[40].to_array());
    let wheels = |speed: usize, angle: usize| v1::Measurement {
        wheels: Some(v1::WheelMeasurement { speed_rad_s: vec![1.0; speed], road_wheel_angle_rad: vec![0.0; angle] }),
        ..good()
    };
    let command = |speed_m_s, second| v1::Measurement { command: Some(v1::Control { speed_m_s, second }), ..good() };
    let mut sweep = vec![
        ("empty", v1::Measurement::default(), "REJECTED", "state"),
        ("unknown session", v1::Measurement { session_id: "nobody".into(), ..good() }, "REJECTED", "session_id"),
        ("no state", v1::Measurement { state: None, ..good() }, "REJECTED", "state"),
        ("no command", v1::Measurement { command: None, ..good() }, "REJECTED", "command"),
        (
            "no attitude",
            v1::Measurement { state: Some(v1::VehicleState { attitude_rad: None, ..state }), ..good() },
            "REJECTED",
            "state.attitude_rad",
        ),
        ("three wheel speeds", wheels(3, 2), "REJECTED", "wheels.speed_rad_s"),
        ("three wheel angles", wheels(4, 3), "REJECTED", "wheels.road_wheel_angle_rad"),
        ("command off the card", command(99.0, 0.0), "REJECTED", "command.speed_m_s"),
        ("second off the card", command(1.0, 1.5), "REJECTED", "command.second"),
        ("NaN command", command(f64::NAN, 0.0), "NOT_FINITE", "command.speed_m_s"),
        ("time going backwards", v1::Measurement { stamp_ns: -1, ..good() }, "TOO_OLD", ""),
        ("time standing", v1::Measurement { stamp_ns: 39 * STEP_NS, ..good() }, "DUPLICATE", ""),
        ("oldest time", v1::Measurement { stamp_ns: i64::MIN, ..good() }, "TOO_OLD", ""),
        ("far future", v1::Measurement { stamp_ns: i64::MAX, ..good() }, "FUTURE", ""),
        ("old number", v1::Measurement { sequence: 3, ..good() }, "TOO_OLD", ""),
        ("same number", v1::Measurement { sequence: 40, ..good() }, "DUPLICATE", ""),
        ("off the Earth", v1::Measurement { state: Some(with_entry(state, 1, -1e12)), ..good() }, "REJECTED", "state.position_m.y"),
        ("spinning", v1::Measurement { state: Some(with_entry(state, 11, 1e3)), ..good() }, "REJECTED", "state.angular_velocity_rad_s.z"),
    ];
    for i in 0..12 {
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            sweep.push(("not finite", v1::Measurement { state: Some(with_entry(state, i, value)), ..good() }, "NOT_FINITE", ""));
        }
    }
    let provenance = before.provenance.clone().unwrap();
    assert_eq!((provenance.history_epoch, provenance.map_version), (40, 1));
    let standing = (provenance.history_epoch, provenance.soil_epoch, provenance.map_version, provenance.bundle_hash.as_str());
    let mut stream = client.measure().await.unwrap();
    for (what, measurement, label, field) in sweep {
        let answer = stream.exchange(measurement).await.unwrap();
        assert_eq!(outcome_label(&answer), label, "{what}");
        match &answer.outcome {
            Some(v1::measurement_answer::Outcome::Rejected(rejected)) => assert_eq!(rejected.field, field, "{what}: {}", rejected.message),
            Some(v1::measurement_answer::Outcome::NotFinite(bad)) => {
                assert!(bad.field.starts_with(field) && !bad.field.is_empty(), "{what}")
            }
            _ => {}
        }
        // Whatever is wrong, the answer says where the session stands, if there is one.
        let named = (answer.history_epoch, answer.soil_epoch, answer.map_version, answer.bundle_hash.as_str());
        assert_eq!(named, if answer.session_id == "s" { standing } else { (0, 0, 0, "") }, "{what}");
        assert_eq!(client.session("s").await.unwrap(), before, "{what}");
    }
    // The stream still works, and nothing was lost.
    assert_eq!(outcome_label(&stream.exchange(good()).await.unwrap()), "APPLIED");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_bad_sessions_are_refused() {
    let (server, mut client, recorded, before) = prepared().await;
    let good = || v1::OpenSessionRequest { vehicle_id: "new".into(), ..Default::default() };
    let mut not_finite = sample("", &recorded.drive, 0);
    not_finite.command.as_mut().unwrap().second = f64::NAN;
    let first = || sample("", &recorded.drive, 0);
    let too_fast = v1::Measurement { state: first().state.map(|state| with_entry(state, 7, -101.0)), ..first() };
    let wheels = v1::Measurement { wheels: Some(v1::WheelMeasurement { speed_rad_s: vec![1.0; 5], ..Default::default() }), ..first() };
    let incomplete = v1::Measurement { state: None, ..sample("", &recorded.drive, 0) };
    let of_another = sample("s", &recorded.drive, 0);
    use Code::{AlreadyExists, InvalidArgument, NotFound};
    for (what, request, code, field) in [
        ("no vehicle", v1::OpenSessionRequest::default(), InvalidArgument, "vehicle_id"),
        ("vehicle with a slash", v1::OpenSessionRequest { vehicle_id: "a/b".into(), ..good() }, InvalidArgument, "vehicle_id"),
        ("vehicle with a wildcard", v1::OpenSessionRequest { vehicle_id: "**".into(), ..good() }, InvalidArgument, "vehicle_id"),
        ("long vehicle", v1::OpenSessionRequest { vehicle_id: "x".repeat(65), ..good() }, InvalidArgument, "vehicle_id"),
        ("session with a space", v1::OpenSessionRequest { session_id: "a b".into(), ..good() }, InvalidArgument, "session_id"),
        ("other card", v1::OpenSessionRequest { vehicle_card: "tank".into(), ..good() }, InvalidArgument, "vehicle_card"),
        ("unknown map", v1::OpenSessionRequest { map_id: "moon".into(), ..good() }, NotFound, "map_id"),
        ("open already", v1::OpenSessionRequest { session_id: "s".into(), ..good() }, AlreadyExists, "session_id"),
        ("initial not finite", v1::OpenSessionRequest { initial: Some(not_finite), ..good() }, InvalidArgument, "initial.command.second"),
        ("initial too fast", v1::OpenSessionRequest { initial: Some(too_fast), ..good() }, InvalidArgument, "initial.state.velocity_m_s.y"),
        ("initial wheels", v1::OpenSessionRequest { initial: Some(wheels), ..good() }, InvalidArgument, "initial.wheels.speed_rad_s"),
        ("initial of another", v1::OpenSessionRequest { initial: Some(of_another), ..good() }, InvalidArgument, "initial.session_id"),
        ("initial incomplete", v1::OpenSessionRequest { initial: Some(incomplete), ..good() }, InvalidArgument, "initial.state"),
    ] {
        assert_refused(what, client.open_session(request).await, code, field);
        assert_eq!(client.list_sessions().await.unwrap(), std::slice::from_ref(&before), "{what}");
    }
    assert_refused("get", client.session("nobody").await, NotFound, "session_id");
    assert_refused("close", client.close_session("nobody").await, NotFound, "session_id");
    assert_refused("watch", client.watch_soil("nobody").await.map(|_| ()), NotFound, "session_id");
    let card = predictor().bundle().vehicle.name.clone();
    let initial = Some(sample("", &recorded.drive, 0));
    let opened = client.open_session(v1::OpenSessionRequest { vehicle_card: card, initial, ..good() }).await.unwrap();
    assert_eq!((opened.session_id.as_str(), opened.history_steps, opened.last_sequence), ("new", 1, Some(1)));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_bad_maps_are_refused() {
    let (server, mut client, recorded, before) = prepared().await;
    let maps = client.list_maps().await.unwrap();
    let world = maps[0].clone();
    let header =
        || v1::MapHeader { map_id: "m".into(), version: 1, resolution_m: 0.5, width: 4, height: 3, semantic: true, ..Default::default() };
    let tile = || v1::MapTile {
        rows: 3,
        columns: 4,
        elevation_m: [1.0f32; 12].iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(),
        semantic_rgb: vec![7; 36].into(),
        ..Default::default()
    };
    let filled =
        |value: f32| v1::MapTile { elevation_m: [value; 12].iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(), ..tile() };
    let upload = |parts: Vec<Part>| parts.into_iter().map(|part| v1::UploadMapRequest { part: Some(part) }).collect::<Vec<_>>();
    let with_header = |header: v1::MapHeader| upload(vec![Part::Header(header), Part::Tile(tile())]);
    let with_tile = |tile: v1::MapTile| upload(vec![Part::Header(header()), Part::Tile(tile)]);
    use Code::{Aborted, AlreadyExists, FailedPrecondition, InvalidArgument, NotFound};
    for (what, messages, code, field) in [
        ("nothing", vec![], InvalidArgument, "header"),
        ("tile first", upload(vec![Part::Tile(tile())]), InvalidArgument, "header"),
        ("two headers", upload(vec![Part::Header(header()), Part::Header(header())]), InvalidArgument, "header"),
        (
            "empty message",
            vec![upload(vec![Part::Header(header())]).remove(0), v1::UploadMapRequest { part: None }],
            InvalidArgument,
            "tile",
        ),
        ("no id", with_header(v1::MapHeader { map_id: String::new(), ..header() }), InvalidArgument, "header.map_id"),
        ("version 0", with_header(v1::MapHeader { version: 0, ..header() }), InvalidArgument, "header.version"),
        ("one column", with_header(v1::MapHeader { width: 1, ..header() }), InvalidArgument, "header.width"),
        ("oversize", with_header(v1::MapHeader { width: 100_000, height: 100_000, ..header() }), InvalidArgument, "header.width"),
        ("overflowing size", with_header(v1::MapHeader { width: u32::MAX, height: u32::MAX, ..header() }), InvalidArgument, "header.width"),
        ("NaN resolution", with_header(v1::MapHeader { resolution_m: f64::NAN, ..header() }), InvalidArgument, "header.resolution_m"),
        ("resolution 0", with_header(v1::MapHeader { resolution_m: 0.0, ..header() }), InvalidArgument, "header.resolution_m"),
        ("infinite origin", with_header(v1::MapHeader { origin_x_m: f64::INFINITY, ..header() }), InvalidArgument, "header.origin_x_m"),
        ("NaN origin", with_header(v1::MapHeader { origin_y_m: f64::NAN, ..header() }), InvalidArgument, "header.origin_y_m"),
        ("far origin", with_header(v1::MapHeader { origin_y_m: -1.1e7, ..header() }), InvalidArgument, "header.origin_y_m"),
        ("long frame", with_header(v1::MapHeader { frame: "x".repeat(65), ..header() }), InvalidArgument, "header.frame"),
        ("tile too high", with_tile(v1::MapTile { row: 1, ..tile() }), InvalidArgument, "tile.rows"),
        ("tile far right", with_tile(v1::MapTile { column: u32::MAX, ..tile() }), InvalidArgument, "tile.columns"),
        ("empty tile", with_tile(v1::MapTile { rows: 0, ..tile() }), InvalidArgument, "tile.rows"),
        ("short elevation", with_tile(v1::MapTile { elevation_m: vec![0; 47].into(), ..tile() }), InvalidArgument, "tile.elevation_m"),
        ("missing colours", with_tile(v1::MapTile { semantic_rgb: Default::default(), ..tile() }), InvalidArgument, "tile.semantic_rgb"),
        ("colours not announced", with_header(v1::MapHeader { semantic: false, ..header() }), InvalidArgument, "tile.semantic_rgb"),
        ("all holes", with_tile(filled(f32::NAN)), InvalidArgument, "tile.elevation_m"),
        ("infinite elevation", with_tile(filled(f32::INFINITY)), InvalidArgument, "tile.elevation_m"),
        ("version held", with_header(v1::MapHeader { map_id: world.map_id.clone(), ..header() }), AlreadyExists, "map_id"),
    ] {
        assert_refused(what, client.upload_messages(messages).await, code, field);
    }
    let patch = |map: &str, base_version, tile| v1::PatchTileRequest { map_id: map.into(), base_version, tile };
    for (what, request, code, field) in [
        ("patch of nothing", patch("moon", 1, Some(tile())), NotFound, "map_id"),
        ("patch without tile", patch(&world.map_id, 1, None), InvalidArgument, "tile"),
        ("patch of another version", patch(&world.map_id, 9, Some(tile())), Aborted, "base_version"),
        ("patch beyond the map", patch(&world.map_id, 1, Some(v1::MapTile { row: world.height, ..tile() })), InvalidArgument, "tile.rows"),
        ("patch to infinity", patch(&world.map_id, 1, Some(filled(f32::NEG_INFINITY))), InvalidArgument, "tile.elevation_m"),
        (
            "patch without its colours",
            patch(&world.map_id, 1, Some(v1::MapTile { semantic_rgb: vec![0; 35].into(), ..tile() })),
            InvalidArgument,
            "tile.semantic_rgb",
        ),
        ("patch too short", patch(&world.map_id, 1, Some(v1::MapTile { rows: 2, ..tile() })), InvalidArgument, "tile.elevation_m"),
    ] {
        assert_refused(what, client.patch_tile(request).await, code, field);
    }
    assert_refused("get", client.map("moon").await, NotFound, "map_id");
    assert_refused("delete unknown", client.delete_map("moon").await, NotFound, "map_id");
    assert_refused("delete used", client.delete_map(&world.map_id).await, FailedPrecondition, "map_id");
    assert_eq!(client.list_maps().await.unwrap(), maps);
    assert_eq!(client.session("s").await.unwrap(), before);

    // A good patch makes the next version, and the session uses it.
    let patched = client.patch_tile(patch(&world.map_id, 1, Some(tile()))).await.unwrap();
    assert_eq!((patched.version, patched.width), (2, world.width));
    assert_ne!(patched.hash, world.hash);
    let prediction = client.predict(candidates("s", &recorded.drive, 39, 1, 1)).await.unwrap();
    assert_eq!((prediction.provenance.map_version, &prediction.provenance.map_hash), (2, &patched.hash));

    // The last version there is takes no patch, and says so.
    let last = v1::MapHeader { map_id: "last".into(), version: u64::MAX, ..header() };
    client.upload_messages(with_header(last)).await.unwrap();
    assert_refused("patch of the last", client.patch_tile(patch("last", u64::MAX, Some(tile()))).await, InvalidArgument, "base_version");
    client.delete_map("last").await.unwrap();

    // Stamp and frame are carried, past a patch too, and are no part of the hash.
    let plain = client.upload_messages(with_header(header())).await.unwrap();
    let local = v1::MapHeader { map_id: "local".into(), stamp_ns: Some(-5), frame: "odom".into(), ..header() };
    let local = client.upload_messages(with_header(local)).await.unwrap();
    assert_eq!((local.stamp_ns, local.frame.as_str(), &local.hash), (Some(-5), "odom", &plain.hash));
    assert_eq!((plain.stamp_ns, plain.frame.as_str()), (None, ""));
    let local = client.patch_tile(patch("local", 1, Some(tile()))).await.unwrap();
    assert_eq!((local.version, local.stamp_ns, local.frame.as_str()), (2, Some(-5), "odom"));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_measured_position_off_the_map_is_said() {
    let (server, mut client, recorded, _) = prepared().await;
    let mut away = sample("s", &recorded.drive, 40);
    away.state.as_mut().unwrap().position_m.as_mut().unwrap().x = 5e3;
    client.feed(vec![away]).await.unwrap();
    let refused = client.predict(candidates("s", &recorded.drive, 40, 1, 1)).await;
    assert_refused("measured off the map", refused, Code::FailedPrecondition, "session_id");
    server.shutdown().await;
}
