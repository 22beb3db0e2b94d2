//! What programs keep and read again: stores, recordings, records of etcd, checkpoints, laps, reports.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::OnceLock;

use nesam_engine::Limits;
use nesam_learning::checkpoint::Checkpoint;
use nesam_mcap::{Record, Writer};
use nesam_model::Weights;
use nesam_navigation::{KeptLap, NavigationReport};
use nesam_server::recording::{Recording, Topic, replay, window};
use nesam_server::store::{Change, RedbStore, SessionStore, StoredSession, StoredSoil, map_of};
use nesam_server::{convert, knows_record, knows_report, shown_reports};

use crate::{instead, predictor};

pub fn session_image(bytes: &[u8]) {
    drop(convert::session_image(bytes));
}

pub fn stored_map(bytes: &[u8]) {
    drop(map_of(bytes, &Limits { map_cells_max: 1 << 20, ..Limits::default() }));
}

/// A value of etcd behind its key, which ends with the first line.
pub fn etcd_record(bytes: &[u8]) {
    let at = bytes.iter().position(|byte| *byte == b'\n').unwrap_or(bytes.len());
    let _ = knows_record("nesam", &bytes[..at], bytes.get(at + 1..).unwrap_or_default());
}

fn committed(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(name)).expect("the corpus is part of the repository")
}

/// A store with a session, a map and evidence of the soil, in which the bytes behind the first four stand where those say: in which page that is not empty, and
/// where in it. It is opened, read, and committed to.
pub fn store(bytes: &[u8]) {
    static WHOLE: OnceLock<(Vec<u8>, Vec<usize>)> = OnceLock::new();
    const FILE: &str = "sessions.redb";
    const PAGE: usize = 4096;
    let change = Change::PutSession(StoredSession { name: "new".into(), saved_unix_ns: 2, image: vec![3; 700] });
    let (whole, used) = WHOLE.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut store = RedbStore::open(folder.path()).expect("a new store");
        let session = StoredSession { name: "truck".into(), saved_unix_ns: 1, image: committed("session_image/valid.bin") };
        let soil = StoredSoil { key: "a/1".into(), saved_unix_ns: 1, share: committed("fleet_soil_shares/valid.bin") };
        let map = Change::PutMap("hills".into(), committed("stored_map/valid.bin"));
        store.commit(&[Change::PutSession(session), map, Change::PutSoil(soil)]).expect("it can be written");
        drop(store);
        let whole = std::fs::read(folder.path().join(FILE)).expect("it was written");
        let used = (0..whole.len() / PAGE).filter(|page| whole[page * PAGE..][..PAGE].iter().any(|byte| *byte != 0)).collect();
        (whole, used)
    });
    let Some(([page @ .., low, high], other)) = bytes.split_first_chunk::<4>() else { return };
    let begin = used[usize::from(u16::from_le_bytes(*page)) % used.len()] * PAGE + usize::from(u16::from_le_bytes([*low, *high])) % PAGE;
    let end = (begin + other.len()).min(whole.len());
    let mut changed = whole.clone();
    changed[begin..end].copy_from_slice(&other[..end - begin]);
    instead(&format!("store/{FILE}"), &changed, |folder| {
        if let Ok(mut store) = RedbStore::open(&folder.join("store")) {
            drop(store.load());
            drop(store.commit(std::slice::from_ref(&change)));
        }
    });
}

pub fn recording(bytes: &[u8]) {
    instead("run.mcap", bytes, |folder| {
        if let Ok(mut recording) = Recording::open(&[folder.join("run.mcap")]) {
            while let Ok(Some(command)) = recording.next_command() {
                drop(command);
            }
        }
    });
}

/// A short recording in which one message is another: the first byte says which, the second its topic (one that no topic has leaves it), the third and fourth where in
/// it the others stand, in parts of 65 536 of its length, and the fifth how many of its bytes go. Its measurements are read, and its commands executed again.
pub fn recorded_commands(bytes: &[u8]) {
    static RECORDS: OnceLock<Vec<Record>> = OnceLock::new();
    let records = RECORDS.get_or_init(|| {
        let whole = committed("recording/valid.mcap");
        let mut reader = nesam_mcap::Reader::new(&whole[..]);
        std::iter::from_fn(|| reader.next_record().expect("a whole file")).collect()
    });
    let Some(([which, topic, place @ .., gone], other)) = bytes.split_first_chunk::<5>() else { return };
    let messages = records.iter().filter(|record| matches!(record, Record::Message { .. })).count();
    let changed = usize::from(*which) % messages;
    let topic = Topic::ALL.get(usize::from(*topic)).map(|topic| topic.name());

    let mut writer = Writer::create(Vec::new(), "nesam", "hostile").expect("memory can be written");
    // Every topic, by its place; numbers of channels are those places.
    for topic in Topic::ALL {
        writer.add_channel(0, topic.name(), "protobuf").expect("memory can be written");
    }
    let number_of = |name: &str| Topic::ALL.iter().position(|topic| topic.name() == name).unwrap_or(0) as u16;
    let mut channels = BTreeMap::new();
    let mut number = 0;
    for record in records {
        match record {
            Record::Channel { id, topic, .. } => drop(channels.insert(*id, number_of(topic))),
            Record::Metadata { name, texts } => writer.write_metadata(name, texts).expect("memory can be written"),
            Record::Message { channel_id, sequence, log_time_ns, data } => {
                let (mut channel, mut data) = (channels[channel_id], data.clone());
                if number == changed {
                    channel = topic.map_or(channel, number_of);
                    let begin = (usize::from(u16::from_le_bytes([place[0], place[1]])) * data.len()) >> 16;
                    let end = (begin + usize::from(*gone)).min(data.len());
                    data.splice(begin..end, other.iter().copied());
                }
                writer.write(channel, *sequence, *log_time_ns, &data).expect("memory can be written");
                number += 1;
            }
            Record::Schema { .. } | Record::DataEnd | Record::Footer => {}
        }
    }
    let file = writer.finish().expect("memory can be written");
    instead("changed.mcap", &file, |folder| {
        let open = || Recording::open(&[folder.join("changed.mcap")]);
        drop(open().and_then(|mut recording| window(&mut recording, "truck", i64::MIN, i64::MAX)));
        drop(open().and_then(|mut recording| replay(&mut recording, predictor(), true, &mut |_| {})));
    });
}

/// What the checkpoint in the thread's folder is to be one of.
fn network() -> &'static Weights {
    static WEIGHTS: OnceLock<Weights> = OnceLock::new();
    let file = "checkpoint_arrays/weights.safetensors";
    WEIGHTS.get_or_init(|| Weights::from_bytes(&committed(file), Path::new(file)).expect("a sound file"))
}

/// The state of a checkpoint beside arrays of step 3.
pub fn checkpoint(bytes: &[u8]) {
    instead("checkpoint/state.json", bytes, |folder| drop(Checkpoint::load(&folder.join("checkpoint"), network())));
}

/// Arrays of a checkpoint as weights and as moments.
pub fn checkpoint_arrays(bytes: &[u8]) {
    for name in ["latest", "adam"] {
        let file = format!("checkpoint/{name}.safetensors");
        instead(&file, bytes, |folder| drop(Checkpoint::load(&folder.join("checkpoint"), network())));
    }
}

/// A lap, and the report of it beside itself with another model.
pub fn kept_lap(bytes: &[u8]) {
    let Ok(KeptLap { settings, run }) = KeptLap::from_json(bytes) else { return };
    let other = nesam_navigation::Run { configuration: "fixed".into(), ..run.clone() };
    let report = NavigationReport { runs: vec![run, other], settings, folder: "laps".into(), warnings: Vec::new(), provenance: Vec::new() };
    drop((report.rows(), report.to_json(), report.page().render()));
}

/// A report of a diagnosis, for whoever asked for it and for the live page.
pub fn diagnosis_report(bytes: &[u8]) {
    instead("diagnosis/diagnose.json", bytes, |folder| {
        let folder = folder.join("diagnosis");
        let _ = (knows_report(&folder), shown_reports(&folder));
    });
}
