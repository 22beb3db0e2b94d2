//! Goal: a run of the real server is written down whole, comes out bit for bit when it is done again, and every way in which a recording can be
//! incomplete or changed is noticed. Method: sockets, then the files on the disk; what is changed is changed with an independent copy loop.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use nesam_client::{outcome_label, v1};
use nesam_mcap::{Reader, Record, Writer};
use nesam_model::{ModelBundle, Predictor};
use nesam_server::Config;
use nesam_server::recording::{Ending, RecordedWindow, Recording, RecordingError, ReplayReport, replay, window};
use prost::Message as _;
use tonic::Code;

use crate::stage::*;

/// Fed measurements before the fork.
const FED: usize = 45;

/// A run with everything in it: map, patch, soil updates, fork, predictions, refusals. Gives the parts.
async fn record(folder: &Path, change: impl FnOnce(&mut Config)) -> Vec<PathBuf> {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| {
        (config.recording.enabled, config.recording.directory) = (true, folder.into());
        config.fleet_soil.enabled = true;
        change(config);
    })
    .await;
    let world = recorded.world.id();
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "s", world).await;
    client.feed(samples("s", &recorded.drive, FED)).await.unwrap();
    client.predict(candidates("s", &recorded.drive, FED, 3, 16)).await.unwrap();
    client.predict(candidates("s", &recorded.drive, FED, 2, 4).starting_at((FED as i64 + 2) * STEP_NS, vec![])).await.unwrap();
    assert_refused("nobody", client.predict(candidates("nobody", &recorded.drive, 0, 1, 1)).await, Code::NotFound, "session_id");
    client.fork_session("s", "t").await.unwrap();
    let image = client.export_session("s").await.unwrap();
    client.import_session(image, "u").await.unwrap();
    client.predict(candidates("u", &recorded.drive, FED, 1, 8)).await.unwrap();
    let parameters = vec![v1::EffectParameter { name: "second".into(), value: 0.05, sd: 0.01 }];
    client.apply_effects("u", "a test", vec![v1::Effect { id: "steering_offset".into(), parameters }]).await.unwrap();
    client.predict(candidates("u", &recorded.drive, FED, 1, 8)).await.unwrap();
    client.revert_effects("u").await.unwrap();
    assert!(!client.fleet_soil("").await.unwrap().cells.is_empty());
    let tile = v1::MapTile {
        row: 7,
        column: 9,
        rows: 1,
        columns: 2,
        elevation_m: [0.5f32, f32::NAN].map(f32::to_le_bytes).concat().into(),
        ..Default::default()
    };
    client.patch_tile(v1::PatchTileRequest { map_id: world.into(), base_version: 1, tile: Some(tile) }).await.unwrap();
    client
        .feed((FED + 1..=FED + 20).map(|i| sample("t", &recorded.drive, i)).chain([sample("t", &recorded.drive, 3)]).collect())
        .await
        .unwrap();
    client.predict(candidates("t", &recorded.drive, FED + 20, 2, 32)).await.unwrap();
    assert_refused("a used map", client.delete_map(world).await, Code::FailedPrecondition, "map_id");
    assert_refused("unknown", client.session("nobody").await, Code::NotFound, "session_id");
    client.list_sessions().await.unwrap();
    client.list_maps().await.unwrap();
    client.close_session("t").await.unwrap();
    // Whatever is counted has a counter of internal errors beside it.
    let counts = server.metrics().render(0, 0);
    for line in counts.lines().filter_map(|line| line.strip_prefix("nesam_commands_total{command=\"")) {
        let (command, _) = line.split_once('"').unwrap();
        assert!(counts.contains(&format!("nesam_commands_total{{command=\"{command}\",result=\"internal\"}} 0\n")), "{command}: {counts}");
    }
    let recorder = server.recorder().unwrap();
    assert_eq!(recorder.counts().dropped, 0);
    let parts = recorder.parts();
    server.shutdown().await;
    parts
}

/// What comes out when recordings are replayed.
pub fn replayed(paths: &[PathBuf]) -> ReplayReport {
    let mut recording = Recording::open(paths).unwrap();
    replay(&mut recording, Arc::new(fresh_predictor()), false, &mut |_| {}).unwrap()
}

/// A copy of a recording in which `edit` may change the payload of a message; `false` leaves the message out.
fn edited(from: &Path, to: &Path, mut edit: impl FnMut(&str, u32, &mut Vec<u8>) -> bool) {
    let mut reader = Reader::new(std::fs::File::open(from).unwrap());
    let mut writer = Writer::create(Vec::new(), "nesam", "test").unwrap();
    let mut topics = BTreeMap::new();
    while let Some(record) = reader.next_record().unwrap() {
        match record {
            Record::Metadata { name, texts } => writer.write_metadata(&name, &texts).unwrap(),
            Record::Schema { id, name, encoding, data } => assert_eq!(writer.add_schema(&name, &encoding, &data).unwrap(), id),
            Record::Channel { id, schema_id, topic, message_encoding } => {
                assert_eq!(writer.add_channel(schema_id, &topic, &message_encoding).unwrap(), id);
                topics.insert(id, topic);
            }
            Record::Message { channel_id, sequence, log_time_ns, mut data } => {
                if edit(&topics[&channel_id], sequence, &mut data) {
                    writer.write(channel_id, sequence, log_time_ns, &data).unwrap();
                }
            }
            Record::DataEnd | Record::Footer => break,
        }
    }
    std::fs::write(to, writer.finish().unwrap()).unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_recorded_run_comes_out_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let parts = record(folder.path(), |_| {}).await;
    assert_eq!(parts.len(), 1);
    let report = replayed(&[folder.path().into()]);
    assert_eq!(report.first_difference, None);
    assert!(report.all_equal());
    assert_eq!(report.ending, Some(Ending::Finished { reason: "stopped".into(), dropped_commands: 0 }));
    let count = |kind: &str| report.kinds.get(kind).map_or(0, |kind| kind.equal);
    assert_eq!((count("measure"), count("predict"), count("put_map")), (FED as u64 + 1 + 21, 6, 2));
    assert_eq!((count("open"), count("fork"), count("close"), count("get"), count("list"), count("delete_map")), (1, 1, 1, 1, 1, 1));
    assert_eq!((count("export"), count("import"), count("fleet_soil"), count("set_effects")), (1, 1, 1, 2));
    // A viewer finds our messages with their schemas, and the soil on a topic of its own.
    let mut reader = Reader::new(std::fs::File::open(&parts[0]).unwrap());
    let (mut schemas, mut topics, mut seen) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::<String, usize>::new());
    while let Some(record) = reader.next_record().unwrap() {
        match record {
            Record::Schema { id, name, encoding, data } => {
                assert_eq!(encoding, "protobuf");
                prost_types::FileDescriptorSet::decode(data.as_slice()).unwrap();
                schemas.insert(id, name);
            }
            Record::Channel { id, schema_id, topic, message_encoding } => {
                assert_eq!(message_encoding, "protobuf");
                topics.insert(id, format!("{topic} {}", schemas[&schema_id]));
            }
            Record::Message { channel_id, .. } => *seen.entry(topics[&channel_id].clone()).or_default() += 1,
            _ => {}
        }
    }
    assert_eq!(seen["/measurement nesam.v1.Measurement"], seen["/measurement/answer nesam.v1.MeasurementAnswer"]);
    assert!(seen["/soil nesam.v1.SoilEstimate"] > 0 && seen["/map/patch nesam.v1.PatchTileRequest"] == 1, "{seen:?}");
}

/// Measurements of another clock, or of another session of the same name, never come between those of one drive.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_window_keeps_drives_of_one_name_apart() {
    let (folder, recorded) = (tempfile::tempdir().unwrap(), recorded());
    let (server, mut client) =
        start_with(|config| (config.recording.enabled, config.recording.directory) = (true, folder.path().into())).await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "s", "").await;
    // The clock is set back in the middle: the first stamp is taken for an error, the second proves it.
    let at = |number: usize, stamp_ns: i64| v1::Measurement { stamp_ns, ..sample("s", &recorded.drive, number) };
    let set_back: Vec<i64> = (0..5).map(|i| i * STEP_NS + STEP_NS / 2).collect();
    let answers = client.feed(samples("s", &recorded.drive, 7)).await.unwrap();
    assert!(answers.iter().all(|answer| answer.place > 0));
    let answers = client.feed(set_back.iter().enumerate().map(|(i, stamp_ns)| at(8 + i, *stamp_ns)).collect()).await.unwrap();
    assert_eq!(answers.iter().map(outcome_label).collect::<Vec<_>>(), ["TOO_OLD", "CLOCK_JUMP", "APPLIED", "APPLIED", "APPLIED"]);
    // The next session of that name begins with a first measurement and has stamps that were there before.
    client.close_session("s").await.unwrap();
    let (vehicle_id, session_id, initial) = ("truck".into(), "s".into(), Some(at(0, 0)));
    client.open_session(v1::OpenSessionRequest { vehicle_id, session_id, initial, ..Default::default() }).await.unwrap();
    client.feed((1..=3).map(|i| sample("s", &recorded.drive, i)).collect()).await.unwrap();
    // Another one drives on a map, later.
    let late_ns = 1000 * STEP_NS;
    client.close_session("s").await.unwrap();
    open(&mut client, "s", recorded.world.id()).await;
    client.feed((0..=3).map(|i| at(i, late_ns + i as i64 * STEP_NS)).collect()).await.unwrap();
    server.shutdown().await;

    let of = |to_ns: i64| window(&mut Recording::open(&[folder.path().into()]).unwrap(), "s", i64::MIN, to_ns).unwrap();
    let stamps = |window: &RecordedWindow| window.measurements.iter().map(|m| m.stamp_ns).collect::<Vec<_>>();
    let early = of(late_ns - 1);
    let steps = |from_ns: i64, last: i64| (0..=last).map(move |i| from_ns + i * STEP_NS).collect::<Vec<_>>();
    assert_eq!((stamps(&early), early.map.is_some()), ([steps(0, 7), set_back[1..].to_vec(), steps(0, 3)].concat(), false));
    let all = of(i64::MAX);
    assert_eq!((stamps(&all), all.map.is_some()), (steps(late_ns, 3), true), "one map at a time");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_parts_belong_together() {
    let folder = tempfile::tempdir().unwrap();
    // The map alone is larger than a part.
    let parts = record(folder.path(), |config| config.recording.part_bytes_max = 1 << 20).await;
    assert!(parts.len() >= 2, "{parts:?}");
    let report = replayed(&parts);
    assert!(report.all_equal() && report.total().commands > 60, "{report:?}");
    let message = Recording::open(&parts[1..]).unwrap_err().to_string();
    assert!(message.contains("part 1"), "{message}");
    std::fs::remove_file(parts.last().unwrap()).unwrap();
    let report = replayed(&[folder.path().into()]);
    assert!(report.all_equal());
    assert!(matches!(report.ending, Some(Ending::Finished { ref reason, .. }) if reason.contains("next part")), "{report:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_the_limit_ends_the_recording_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let recorded = recorded();
    let (server, mut client) = start_with(|config| {
        (config.recording.enabled, config.recording.directory, config.recording.bytes_max) = (true, folder.path().into(), 40_000);
    })
    .await;
    open(&mut client, "s", "").await;
    let answers = client.feed(samples("s", &recorded.drive, 80)).await.unwrap();
    assert_eq!(answers.len(), 81);
    // What is not recorded any more is not diagnosed as if it were.
    let recorder = server.recorder().unwrap();
    eventually(Duration::from_secs(10), "the recording ends", async || recorder.counts().ended).await;
    let asked = v1::StartDiagnosisRequest { session_id: "s".into(), ..Default::default() };
    assert_refused("an ended recording", client.diagnose(asked).await, Code::FailedPrecondition, "recording");
    server.shutdown().await;
    let report = replayed(&[folder.path().into()]);
    assert!(report.all_equal() && (1..81).contains(&report.kinds["measure"].equal), "{report:?}");
    assert!(matches!(report.ending, Some(Ending::Finished { ref reason, .. }) if reason.contains("bytes_max")), "{report:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_what_was_changed_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let parts = record(folder.path(), |_| {}).await;
    let other = folder.path().join("edited");
    edited(&parts[0], &other, |_, _, _| true);
    assert!(replayed(std::slice::from_ref(&other)).all_equal(), "the copy loop changes nothing");

    let mut done = false;
    edited(&parts[0], &other, |topic, _, data| {
        if topic == "/prediction" && !std::mem::replace(&mut done, true) {
            let mut reply = v1::PredictReply::decode(data.as_slice()).unwrap();
            let mut states = reply.states.to_vec();
            states[4 * 5] ^= 1;
            reply.states = states.into();
            *data = reply.encode_to_vec();
        }
        true
    });
    let report = replayed(std::slice::from_ref(&other));
    let first = report.first_difference.clone().unwrap();
    assert_eq!((report.total().different, first.field.field.as_str(), first.message.as_str()), (1, "states[5]", "nesam.v1.PredictReply"));
    assert!(!report.all_equal() && first.session == "s" && first.field.recorded != first.field.replayed, "{first:?}");

    // A measurement that was another: what is computed from it differs.
    edited(&parts[0], &other, |topic, _, data| {
        if topic == "/measurement" {
            let mut message = v1::Measurement::decode(data.as_slice()).unwrap();
            message.command.as_mut().unwrap().speed_m_s += f64::from(u8::from(message.sequence == 40)) * 1e-3;
            *data = message.encode_to_vec();
        }
        true
    });
    assert!(replayed(std::slice::from_ref(&other)).total().different > 0);

    // A command that is missing ends the replay, and what was before it is compared.
    edited(&parts[0], &other, |_, sequence, _| sequence != 20);
    let report = replayed(std::slice::from_ref(&other));
    assert_eq!((report.ending.clone(), report.total().equal), (Some(Ending::Missing { commands: 1, first: 20 }), 19), "{report:?}");

    // A message that nobody knows, and bits that fell over.
    edited(&parts[0], &other, |topic, _, data| {
        if topic == "/session/open" {
            data[0] = 0xff;
        }
        true
    });
    let mut recording = Recording::open(std::slice::from_ref(&other)).unwrap();
    let error = replay(&mut recording, predictor(), false, &mut |_| {}).unwrap_err();
    assert!(error.to_string().contains("cannot be read"), "{error}");
    let mut bytes = std::fs::read(&parts[0]).unwrap();
    let middle = bytes.len() - bytes.len() / 8;
    bytes[middle] ^= 4;
    std::fs::write(&other, bytes).unwrap();
    let report = replayed(&[other]);
    assert!(matches!(report.ending, Some(Ending::Damaged { .. })) && !report.all_equal(), "{report:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_another_bundle_is_refused_unless_forced() {
    let folder = tempfile::tempdir().unwrap();
    let parts = record(folder.path(), |_| {}).await;
    let other = ModelBundle { hash: "1".repeat(64), ..predictor().bundle().clone() };
    let other = Arc::new(Predictor::new(Arc::new(other)).unwrap());
    let error = replay(&mut Recording::open(&parts).unwrap(), other.clone(), false, &mut |_| {}).unwrap_err();
    assert!(matches!(&error, RecordingError::Bundle { given, .. } if given.starts_with("111")), "{error}");
    let report = replay(&mut Recording::open(&parts).unwrap(), other, true, &mut |_| {}).unwrap();
    assert_eq!(report.first_difference.unwrap().field.field, "provenance.bundle_hash");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_cut_recording_is_read_as_far_as_it_goes_and_garbage_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let parts = record(folder.path(), |_| {}).await;
    let bytes = std::fs::read(&parts[0]).unwrap();
    let cut = folder.path().join("cut");
    let (mut most, mut opened) = (0, 0);
    for i in 0..60 {
        std::fs::write(&cut, &bytes[..bytes.len() * i / 60]).unwrap();
        let Ok(mut recording) = Recording::open(std::slice::from_ref(&cut)) else { continue };
        let mut commands = 0;
        while recording.next_command().unwrap().is_some() {
            commands += 1;
        }
        assert!(commands >= most, "a longer prefix has no fewer commands");
        most = commands;
        opened += 1;
        assert!(recording.ending() == Some(&Ending::CutOff) || commands > 60, "{:?}", recording.ending());
    }
    assert!(opened > 50 && most > 0);
    let report = replayed(std::slice::from_ref(&cut));
    assert!(report.all_equal(), "{report:?}");

    let mut foreign = Writer::create(Vec::new(), "", "somebody").unwrap();
    let channel = foreign.add_channel(0, "/somewhere", "json").unwrap();
    foreign.write(channel, 1, 2, b"{}").unwrap();
    for (content, words) in [
        (b"not mcap at all, but long enough".to_vec(), "not an MCAP file"),
        (Vec::new(), "ends before"),
        (foreign.finish().unwrap(), "no recording of nesam"),
    ] {
        std::fs::write(&cut, content).unwrap();
        let message = Recording::open(std::slice::from_ref(&cut)).unwrap_err().to_string();
        assert!(message.contains(words) && message.contains("cut"), "{message}");
    }
    // Random bytes after the magic neither panic nor hang.
    for garbage in garbage(17, 200) {
        std::fs::write(&cut, [&nesam_mcap::MAGIC[..], garbage.as_ref()].concat()).unwrap();
        assert!(Recording::open(std::slice::from_ref(&cut)).is_err());
    }
    assert!(Recording::open(&[folder.path().join("absent.mcap")]).unwrap_err().to_string().contains("absent.mcap"));
}
