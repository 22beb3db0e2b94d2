//! Goal: a session that is exported and imported, on the same or another server, answers as the original, bit for bit; anything else than an export is refused.

use nesam_client::{outcome_label, v1};
use nesam_engine::{Command, Engine, Limits, Measurement, OpenSession, Reply, WheelMeasurement};
use nesam_physics::{Control, VehicleState};
use nesam_server::convert::{image_bytes, session_image};
use prost::Message as _;
use tonic::Code;

use crate::stage::*;

#[tokio::test(flavor = "multi_thread")]
async fn service_an_imported_session_goes_on_as_the_original() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    let (other_server, mut other) = start().await;
    for client in [&mut client, &mut other] {
        client.upload_map(&layers(&recorded.world)).await.unwrap();
    }
    open(&mut client, "s", recorded.world.id()).await;
    // In the middle of a buffer, with measurements in the window and one of them missing.
    let missing = 46;
    client.feed(samples("s", &recorded.drive, 47).into_iter().filter(|m| m.sequence != missing + 1).collect()).await.unwrap();
    let image = client.export_session("s").await.unwrap();
    assert!(image.len() < 64 << 10, "{} bytes", image.len());
    assert_refused("open already", client.import_session(image.clone(), "").await, Code::AlreadyExists, "session_id");
    let moved = other.import_session(image.clone(), "").await.unwrap();
    // Each server counts for itself.
    let uncounted = |session: v1::Session| v1::Session { run: 0, ..session };
    let original = client.session("s").await.unwrap();
    assert!(moved.run != 0 && moved.run != original.run);
    assert_eq!(uncounted(moved.clone()), uncounted(original.clone()));
    let copy = client.import_session(image, "copy").await.unwrap();
    assert_eq!(v1::Session { session_id: "s".into(), ..copy }, original);
    // All three drive on: first what is missing, then a resent one, then the rest.
    let rest =
        |session: &str| [missing as usize, 47].into_iter().chain(48..=90).map(|i| sample(session, &recorded.drive, i)).collect::<Vec<_>>();
    let original = client.feed(rest("s")).await.unwrap();
    let copied = client.feed(rest("copy")).await.unwrap();
    let moved = other.feed(rest("s")).await.unwrap();
    assert_eq!([0, 1, 2].map(|i| outcome_label(&original[i])), ["APPLIED", "DUPLICATE", "APPLIED"]);
    assert!(original.iter().zip(&moved).all(|(a, b)| v1::MeasurementAnswer { run: b.run, ..a.clone() } == *b));
    assert!(original.iter().zip(&copied).all(|(a, b)| (&a.outcome, &a.soil_correction) == (&b.outcome, &b.soil_correction)));
    let query = candidates("s", &recorded.drive, 90, 3, 32);
    let (here, there) = (client.predict(query.clone()).await.unwrap(), other.predict(query.clone()).await.unwrap());
    assert!(here.provenance.soil_epoch >= 5 && here.provenance == there.provenance);
    assert!(bits(&here.states) == bits(&there.states) && bits(&here.sinkage_m) == bits(&there.sinkage_m));
    assert_same(&there, &offline(&recorded, 90, &query, 31, learned(&recorded, 90).0));
    server.shutdown().await;
    other_server.shutdown().await;
}

/// Goal: whatever a session accepts, it can be exported, imported and go on as it was, so a store of it can be opened. Method: streams from a seed at several rates, with losses, late
/// ones, pauses and restarts, whose values lie at either limit, at zero and between; after every few measurements an export, through its bytes and into an engine that holds nothing.
#[test]
fn property_whatever_a_session_accepted_can_be_imported() {
    let (recorded, limits) = (recorded(), Limits::default());
    let range = fresh_predictor().bundle().vehicle.command_range;
    let position_m = limits.position_max_m;
    // Of each entry of a state: its limit, which the first two share with what is on the map.
    let angle_rad = core::f64::consts::PI + 1e-6;
    let ([speed_m_s, rate_rad_s], yaw_rad) = ([limits.speed_max_m_s, limits.angular_speed_max_rad_s], 1e4);
    let most = [
        position_m, position_m, position_m, angle_rad, angle_rad, yaw_rad, speed_m_s, speed_m_s, speed_m_s, rate_rad_s, rate_rad_s,
        rate_rad_s,
    ];
    let engine = || {
        let mut engine = Engine::new(predictor(), limits.clone()).unwrap();
        engine.execute(0, &Command::PutMap { map: recorded.world.clone(), base: None }).unwrap();
        engine
    };
    let (mut accepted, mut imported) = (0, 0);
    for seed in 1..=24_u64 {
        let mut bits = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let mut random = |below: u64| {
            bits = bits.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (bits >> 33) % below
        };
        let mut original = engine();
        let map = if seed % 2 == 0 { recorded.world.id().into() } else { String::new() };
        original.execute(0, &Command::Open(OpenSession { vehicle: "s".into(), map, ..Default::default() })).unwrap();
        let interval_ns = [100_000_000, 66_666_667, 41_000_000, 140_000_000][(seed % 4) as usize];
        let (mut stamp_ns, mut boot) = (if seed % 6 == 5 { i64::MAX - 8_000_000_000 } else { 0 }, 1);
        for i in 0..60_u64 {
            stamp_ns += interval_ns;
            match random(40) {
                0 => boot += 1,
                1 => stamp_ns += 2 * interval_ns,
                2 => continue,
                _ => {}
            }
            let late_ns = if random(8) == 0 { 3 * interval_ns / 2 } else { 0 };
            // Half of the streams jump between the limits, the others drive and have one entry at a limit.
            let mut state = recorded.drive.states[i as usize].to_array();
            for (entry, value) in state.iter_mut().enumerate() {
                if seed % 2 == 1 || entry as u64 == seed % 12 {
                    *value = [1.0, -1.0, 0.0, -0.0, 1.0 - 1e-9, -0.999_7][random(6) as usize] * most[entry];
                }
            }
            let command = |of: usize, random: u64| [range[of][0], range[of][1], 0.0][random as usize];
            let measurement = Measurement {
                sequence: Some(i + 1),
                boot: Some(boot),
                stamp_ns: stamp_ns - late_ns,
                state: VehicleState::from_array(state),
                command: Control { speed_m_s: command(0, random(3)), second: command(1, random(3)) },
                wheels: WheelMeasurement { road_wheel_angle_rad: Some([core::f64::consts::FRAC_PI_2; 2]), ..Default::default() },
            };
            let told = original.execute(i * interval_ns as u64, &Command::Measure { session: "s".into(), vehicle: None, measurement });
            let Reply::Measured(told) = told.unwrap_or_else(|error| panic!("seed {seed}, {i}: {error}")) else { panic!("another reply") };
            accepted += usize::from(told.outcome.accepted());
            if i % 5 != 4 {
                continue;
            }
            let now_ns = i * interval_ns as u64;
            let export = |engine: &mut Engine| match engine.execute(now_ns, &Command::Export { session: "s".into() }).unwrap() {
                Reply::Image(image) => image_bytes(&image),
                other => panic!("{other:?}"),
            };
            let bytes = export(&mut original);
            let image = Box::new(session_image(&bytes).unwrap());
            let mut copy = engine();
            copy.execute(now_ns, &Command::Import { image, session: "s".into() })
                .unwrap_or_else(|error| panic!("seed {seed}, after {i}: {measurement:?}: {error}"));
            assert!(export(&mut copy) == bytes, "seed {seed}, after {i}: another session");
            imported += 1;
        }
    }
    assert!(accepted > 800 && imported > 250, "{accepted} accepted, {imported} imported");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_damaged_foreign_and_old_exports_are_refused() {
    let (server, mut client, _) = driven("s", 40).await;
    let image = client.export_session("s").await.unwrap();
    let before = client.list_sessions().await.unwrap();
    assert_refused("unknown session", client.export_session("nobody").await, Code::NotFound, "session_id");
    assert_refused("empty", client.import_session(vec![], "t").await, Code::InvalidArgument, "image");
    assert_refused("a path", client.import_session(image.clone(), "../t").await, Code::InvalidArgument, "session_id");
    for i in (0..image.len()).step_by(image.len() / 60) {
        assert_refused("cut", client.import_session(image[..i].to_vec(), "t").await, Code::InvalidArgument, "image");
        let mut damaged = image.clone();
        damaged[i] ^= 0x10;
        assert_refused("damaged", client.import_session(damaged, "t").await, Code::InvalidArgument, "image");
    }
    // Changes with a checksum that fits: what a stranger could send.
    let outer = v1::SessionImage::decode(image.as_slice()).unwrap();
    let content = v1::SessionContent::decode(outer.content.clone()).unwrap();
    let sealed = |change: &dyn Fn(&mut v1::SessionContent)| {
        let mut content = content.clone();
        change(&mut content);
        let content = content.encode_to_vec();
        let checksum = <sha2::Sha256 as sha2::Digest>::digest(&content).to_vec();
        v1::SessionImage { version: 3, checksum: checksum.into(), content: content.into() }.encode_to_vec()
    };
    let newer = v1::SessionImage { version: 4, ..outer }.encode_to_vec();
    type Change<'a> = &'a dyn Fn(&mut v1::SessionContent);
    let changes: [(&str, Change<'_>); 20] = [
        ("bundle", &|c| c.bundle_hash = "0".repeat(64)),
        ("filter", &|c| c.filter_settings.push('x')),
        ("NaN state", &|c| c.live.as_mut().unwrap().history[3].state[1] = f64::NAN),
        ("short state", &|c| c.open[0].step.as_mut().unwrap().state.truncate(11)),
        ("NaN covariance", &|c| c.filter.as_mut().unwrap().covariance[7] = f64::NAN),
        ("negative variance", &|c| c.filter.as_mut().unwrap().covariance[0] = -1.0),
        ("no covariance", &|c| c.filter.as_mut().unwrap().covariance[1] = 1e300),
        ("command", &|c| c.filter_steps[0].command[0] = 1e3),
        ("stamps", &|c| c.recent_stamp_ns.reverse()),
        ("numbers", &|c| c.recent_sequence.truncate(3)),
        ("grid", &|c| c.settled.as_mut().unwrap().grid_ns[0] = 0),
        ("buffer", &|c| c.filter_first = 1 << 30),
        ("buffer without a stamp", &|c| c.filter_stamps_ns.truncate(1)),
        ("stamps of the buffer", &|c| c.filter_stamps_ns.reverse()),
        ("no soil", &|c| c.soil = None),
        ("forecast", &|c| c.forecast.as_mut().unwrap().steps.truncate(31)),
        ("half a correction", &|c| c.forecast.as_mut().unwrap().corrections.truncate(5)),
        ("NaN in a forecast", &|c| c.forecast.as_mut().unwrap().corrections[2] = f64::NAN),
        ("impossible check", &|c| c.forecasts[0] = -1.0),
        ("steps before its beginning", &|c| c.asks_fleet = true),
    ];
    assert_refused("newer", client.import_session(newer, "t").await, Code::InvalidArgument, "image");
    for (what, change) in changes {
        assert_refused(what, client.import_session(sealed(change), "t").await, Code::InvalidArgument, "image");
    }
    let other_map = sealed(&|c| c.map_hash = "0".repeat(64));
    assert_refused("another map", client.import_session(other_map, "t").await, Code::FailedPrecondition, "image");
    let no_map = sealed(&|c| c.map_id = "nowhere".into());
    assert_refused("unknown map", client.import_session(no_map, "t").await, Code::NotFound, "map_id");
    assert_eq!(client.list_sessions().await.unwrap(), before);
    client.import_session(sealed(&|_| ()), "t").await.unwrap();
    // As a service wrote it that held no prediction against what came and kept no stamps of the open buffer; which begins anew.
    let older = sealed(&|c| (c.forecast, c.forecasts, c.filter_stamps_ns) = (None, Vec::new(), Vec::new()));
    client.import_session(older, "older").await.unwrap();
    let again = v1::SessionImage::decode(client.export_session("older").await.unwrap().as_slice()).unwrap();
    let again = v1::SessionContent::decode(again.content).unwrap();
    assert!(content.filter_stamps_ns.len() > 1 && again.filter_stamps_ns.is_empty() && again.filter_steps.is_empty());
    server.shutdown().await;
}
