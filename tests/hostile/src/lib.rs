//! Every reader of files, texts and messages that come from outside, each as a function of bytes: what it gets may be refused, and must not panic, hang or take memory
//! without bound.
//!
//! `tests/corpus.rs` feeds the corpora and seeded mutations of them on every run of the tests; `fuzz/` has the same readers as libFuzzer targets, for campaigns
//! (`tests/hostile/fuzz.sh`). What a campaign finds goes into the corpus of its reader. The corpora of messages are made by
//! `tests/tools/hostile_messages.py`; `random_bytes.rs` of the service suite sends random bytes to a real server.
#![forbid(unsafe_code)]

mod kept;

use std::cell::RefCell;
use std::path::Path;
use std::sync::{Arc, OnceLock};

use nesam_adaptation::{CalibratedFilter, FilterSettings};
use nesam_client::Prediction;
use nesam_degradation::Degradation;
use nesam_discovery::{DRIVES_MIN, Reference};
use nesam_engine::{AppliedEffects, Command, Engine, Limits, Measurement, OpenSession, Reply, SessionImage, WheelMeasurement};
use nesam_evaluation::Baselines;
use nesam_import::{Mapping, Options, Topics, drives, read_bag, read_csv};
use nesam_model::{ModelBundle, Normalization, Predictor, RolloutNoise, Weights, effects_from_toml};
use nesam_navigation::plant_message::{read_json, twelve};
use nesam_physics::{Control, VehicleState};
use nesam_proto::{Message, v1 as pb};
use nesam_ros2::messages::{CommandType, Odometry, imu_rates};
use nesam_server::access::{self, FleetFile, Identity};
use nesam_server::{Config, TlsConfig, convert, grpc_timeout};
use nesam_terrain::{GridGeometry, WorldMap};
use nesam_trajectories::{DataRoot, SetQuery, SplitFilter, commands_from_csv, read_ground_truth_soil, read_vehicle_card};
use sha2::{Digest as _, Sha256};
use tempfile::TempDir;

/// A reader: its name, which is also that of its corpus, and what feeds it.
pub type Reader = (&'static str, fn(&[u8]));

/// All of them.
pub const READERS: [Reader; 49] = [
    ("bag", bag),
    ("bag_metadata", bag_metadata),
    ("ros2_message", ros2_message),
    ("csv_log", csv_log),
    ("commands_csv", commands_csv),
    ("mapping", mapping),
    ("degradation", degradation),
    ("effects", effects),
    ("weights", weights),
    ("manifest", manifest),
    ("normalization", normalization),
    ("soil_filter", soil_filter),
    ("rollout_noise", rollout_noise),
    ("baselines", baselines),
    ("reference", reference),
    ("world_json", world_json),
    ("elevation_png", elevation_png),
    ("semantic_png", semantic_png),
    ("soil_truth", soil_truth),
    ("vehicle_card", vehicle_card),
    ("index_json", index_json),
    ("index_parquet", index_parquet),
    ("samples_parquet", samples_parquet),
    ("measurement", measurement),
    ("open_session", open_session),
    ("predict", predict),
    ("prediction", prediction),
    ("deadline", deadline),
    ("session_image", kept::session_image),
    ("session_content", session_content),
    ("fleet_soil_shares", fleet_soil_shares),
    ("map_messages", map_messages),
    ("map_tile", map_tile),
    ("stored_map", kept::stored_map),
    ("etcd_record", kept::etcd_record),
    ("store", kept::store),
    ("apply_effects", apply_effects),
    ("plant_datagram", plant_datagram),
    ("recording", kept::recording),
    ("recorded_commands", kept::recorded_commands),
    ("checkpoint", kept::checkpoint),
    ("checkpoint_arrays", kept::checkpoint_arrays),
    ("kept_lap", kept::kept_lap),
    ("diagnosis_report", kept::diagnosis_report),
    ("fleet_file", fleet_file),
    ("identity", identity),
    ("certificate", certificate),
    ("tls_file", tls_file),
    ("configuration", configuration),
];

thread_local! {
    /// A folder of this thread's own, in which files lie where a reader looks for them.
    static FOLDER: RefCell<Option<TempDir>> = const { RefCell::new(None) };
}

/// Valid files, from below this folder, and where a reader looks for them.
const AROUND: [(&str, &str); 17] = [
    ("corpus/bag/valid.mcap", "bag/valid.mcap"),
    ("corpus/vehicle_card/hmmwv.json", "vehicle.json"),
    ("corpus/index_json/valid.json", "run/index.json"),
    ("corpus/samples_parquet/valid.parquet", "run/samples.parquet"),
    ("corpus/index_parquet/valid.parquet", "indexed/index.parquet"),
    ("corpus/samples_parquet/valid.parquet", "indexed/samples.parquet"),
    ("corpus/world_json/valid.json", "worlds/w01/world.json"),
    ("corpus/elevation_png/valid.png", "worlds/w01/elevation.png"),
    ("semantic.png", "worlds/w01/semantic.png"),
    ("corpus/checkpoint/valid.json", "checkpoint/state.json"),
    ("corpus/checkpoint_arrays/moments.safetensors", "checkpoint/adam.safetensors"),
    ("corpus/checkpoint_arrays/weights.safetensors", "checkpoint/average.safetensors"),
    ("corpus/checkpoint_arrays/weights.safetensors", "checkpoint/best.safetensors"),
    ("corpus/checkpoint_arrays/weights.safetensors", "checkpoint/latest.safetensors"),
    ("../../deploy/bundles/hmmwv-nominal/vehicle.json", "bundle/vehicle.json"),
    ("../../deploy/bundles/hmmwv-nominal/normalization.toml", "bundle/normalization.toml"),
    ("../../deploy/bundles/hmmwv-nominal/effects.toml", "bundle/effects.toml"),
];

/// Calls `read` with the thread's folder, in which the files of [`AROUND`] lie.
fn in_folder(read: impl FnOnce(&Path)) {
    FOLDER.with_borrow_mut(|folder| {
        let folder = folder.get_or_insert_with(|| {
            let made = tempfile::tempdir().expect("a temporary folder");
            for (from, to) in AROUND {
                let to = made.path().join(to);
                std::fs::create_dir_all(to.parent().unwrap_or(made.path())).expect("a folder can be made");
                std::fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join(from), to).expect("the file is part of the repository");
            }
            made
        });
        read(folder.path());
    });
}

/// Writes the bytes to a file of the folder, reads, and puts back what was there.
fn instead(name: &str, bytes: &[u8], read: impl FnOnce(&Path)) {
    in_folder(|folder| {
        let path = folder.join(name);
        let before = std::fs::read(&path).ok();
        std::fs::create_dir_all(path.parent().unwrap_or(folder)).expect("a folder can be made");
        std::fs::write(&path, bytes).expect("a file can be written");
        read(folder);
        match before {
            Some(before) => std::fs::write(&path, before).expect("a file can be written"),
            None => std::fs::remove_file(&path).expect("a file can be removed"),
        }
    });
}

fn bag(bytes: &[u8]) {
    instead("log.mcap", bytes, |folder| {
        let path = folder.join("log.mcap");
        if let Ok((log, _)) = read_bag(&path, &Topics::default()) {
            drop(drives(&log, &Options { name: "log".into(), ..Options::default() }));
        }
    });
}

fn bag_metadata(bytes: &[u8]) {
    instead("bag/metadata.yaml", bytes, |folder| drop(read_bag(&folder.join("bag"), &Topics::default())));
}

/// A message of each type that is read.
fn ros2_message(bytes: &[u8]) {
    let _ = (Odometry::read(bytes), imu_rates(bytes), CommandType::ALL.map(|kind| kind.read(bytes)));
}

fn csv_log(bytes: &[u8]) {
    instead("log.csv", bytes, |folder| {
        if let Ok(log) = read_csv(&folder.join("log.csv")) {
            drop(drives(&log, &Options { name: "log".into(), ..Options::default() }));
        }
    });
}

fn text(bytes: &[u8]) -> Option<&str> {
    std::str::from_utf8(bytes).ok()
}

fn commands_csv(bytes: &[u8]) {
    drop(text(bytes).map(commands_from_csv));
}

fn mapping(bytes: &[u8]) {
    drop(text(bytes).map(|text| Mapping::parse(text.lines())));
}

fn degradation(bytes: &[u8]) {
    drop(text(bytes).map(Degradation::parse));
}

fn effects(bytes: &[u8]) {
    drop(text(bytes).map(effects_from_toml));
}

fn weights(bytes: &[u8]) {
    drop(Weights::from_bytes(bytes, Path::new("weights.safetensors")));
}

fn manifest(bytes: &[u8]) {
    instead("bundle/manifest.toml", bytes, |folder| drop(ModelBundle::load(&folder.join("bundle"))));
}

fn normalization(bytes: &[u8]) {
    let read = text(bytes).and_then(|text| toml::from_str::<Normalization>(text).ok());
    drop(read.map(|normalization| normalization.check()));
}

/// The filter of a bundle, and settings by themselves.
fn soil_filter(bytes: &[u8]) {
    drop(text(bytes).map(FilterSettings::from_json));
    drop(text(bytes).map(|text| CalibratedFilter::config_of(Some(text))));
}

fn rollout_noise(bytes: &[u8]) {
    drop(text(bytes).map(RolloutNoise::from_json));
}

fn baselines(bytes: &[u8]) {
    drop(text(bytes).map(Baselines::from_json));
}

/// The shipped reference with eight of its drives, in which the bytes behind the first two stand where those say: in parts of 65 536 of its length.
fn reference(bytes: &[u8]) {
    static SHIPPED: OnceLock<String> = OnceLock::new();
    let shipped = SHIPPED.get_or_init(|| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles/hmmwv-nominal/reference.json");
        let text = std::fs::read_to_string(path).expect("the reference is part of the repository");
        let mut whole: serde_json::Value = serde_json::from_str(&text).expect("it is JSON");
        whole["drives"].as_array_mut().expect("it has drives").truncate(DRIVES_MIN);
        whole.to_string()
    });
    let Some((place, other)) = bytes.split_first_chunk::<2>() else { return };
    let begin = (usize::from(u16::from_le_bytes(*place)) * shipped.len()) >> 16;
    let end = (begin + other.len()).min(shipped.len());
    let mut changed = shipped.clone().into_bytes();
    changed.splice(begin..end, other.iter().copied());
    drop(text(&changed).map(Reference::from_json));
}

fn world_json(bytes: &[u8]) {
    instead("worlds/w01/world.json", bytes, |folder| drop(WorldMap::load(&folder.join("worlds/w01"))));
}

fn elevation_png(bytes: &[u8]) {
    instead("worlds/w01/elevation.png", bytes, |folder| drop(WorldMap::load(&folder.join("worlds/w01"))));
}

fn semantic_png(bytes: &[u8]) {
    instead("worlds/w01/semantic.png", bytes, |folder| drop(WorldMap::load(&folder.join("worlds/w01"))));
}

fn soil_truth(bytes: &[u8]) {
    instead("worlds/w01/gt_soil.json", bytes, |folder| drop(read_ground_truth_soil(&folder.join("worlds/w01"))));
}

fn vehicle_card(bytes: &[u8]) {
    instead("vehicle_card.json", bytes, |folder| drop(read_vehicle_card(&folder.join("vehicle_card.json"))));
}

/// Loads a set of the folder, with what only evaluation reads.
fn load(folder: &Path, set: &str) {
    if let Ok(root) = DataRoot::open(folder, Some(&folder.join("vehicle.json"))) {
        let query = SetQuery {
            set: set.into(),
            split: SplitFilter::All,
            trajectories: None,
            dt_s: 0.1,
            ground_truth: true,
            may_lack_drives: false,
        };
        drop(root.load_set(&query));
    }
}

fn index_json(bytes: &[u8]) {
    instead("run/index.json", bytes, |folder| load(folder, "run"));
}

fn index_parquet(bytes: &[u8]) {
    instead("indexed/index.parquet", bytes, |folder| load(folder, "indexed"));
}

fn samples_parquet(bytes: &[u8]) {
    instead("run/samples.parquet", bytes, |folder| load(folder, "run"));
}

/// A message, if the bytes are one.
fn message<M: Message + Default>(bytes: &[u8]) -> Option<M> {
    M::decode(bytes).ok()
}

fn measurement(bytes: &[u8]) {
    drop(message::<pb::Measurement>(bytes).map(|message| convert::measurement(&message)));
}

fn open_session(bytes: &[u8]) {
    drop(message::<pb::OpenSessionRequest>(bytes).map(|message| convert::open_session(&message)));
}

fn predict(bytes: &[u8]) {
    drop(message::<pb::PredictRequest>(bytes).map(|message| convert::predict_query(&message, &Limits::default()).map(drop)));
}

/// What a client is answered.
fn prediction(bytes: &[u8]) {
    let Some(Ok(prediction)) = message::<pb::PredictReply>(bytes).map(|message| Prediction::from_message(&message)) else { return };
    if !prediction.validity.is_empty() && prediction.steps > 0 {
        prediction.state(prediction.validity.len() - 1, prediction.steps - 1);
    }
}

/// That of the shipped bundle.
fn predictor() -> Arc<Predictor> {
    static SHIPPED: OnceLock<Arc<Predictor>> = OnceLock::new();
    let shipped = SHIPPED.get_or_init(|| {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles/hmmwv-nominal");
        let bundle = ModelBundle::load(&folder).expect("the bundle is part of the repository");
        Predictor::new(bundle.into()).expect("the bundle fits").into()
    });
    Arc::clone(shipped)
}

thread_local! {
    /// An engine, and a session as it exports it.
    static ENGINE: RefCell<Option<(Engine, Box<SessionImage>)>> = const { RefCell::new(None) };
}

/// Calls `read` with the thread's engine.
fn in_engine(read: impl FnOnce(&mut Engine, &SessionImage)) {
    ENGINE.with_borrow_mut(|engine| {
        let (engine, exported) = engine.get_or_insert_with(|| {
            let mut engine = Engine::new(predictor(), Limits::default()).expect("the settings fit");
            let open = OpenSession {
                vehicle: "own".into(),
                session: String::new(),
                vehicle_card: String::new(),
                map: String::new(),
                initial: None,
            };
            engine.execute(0, &Command::Open(open)).expect("it is the first one");
            let Ok(Reply::Image(image)) = engine.execute(0, &Command::Export { session: "own".into() }) else {
                panic!("an open session is exported")
            };
            (engine, image)
        });
        read(engine, exported);
    });
}

/// What a session remembers, sealed as a server seals it, and as if it were of this one: it is opened, fed for a buffer of the soil filter and closed.
fn session_content(bytes: &[u8]) {
    in_engine(|engine, own| {
        let Some(outer) = message::<pb::SessionImage>(&convert::image_bytes(own)) else { return };
        let sealed = pb::SessionImage { checksum: Sha256::digest(bytes).to_vec().into(), content: bytes.to_vec().into(), ..outer };
        let Ok(image) = convert::session_image(&sealed.encode_to_vec()) else { return };
        let of_own =
            SessionImage { bundle_hash: own.bundle_hash.clone(), filter_settings: own.filter_settings.clone(), map: None, ..image };
        let import = Command::Import { image: Box::new(of_own), session: "copy".into() };
        let Ok(Reply::Session(view)) = engine.execute(0, &import) else { return };
        for i in 1..=12 {
            let measurement = Measurement {
                sequence: None,
                boot: None,
                stamp_ns: view.last_stamp_ns.unwrap_or(0).saturating_add(i * 100_000_000),
                state: VehicleState::from_array([0.0; 12]),
                command: Control { speed_m_s: 1.0, second: 0.0 },
                wheels: WheelMeasurement::default(),
            };
            drop(engine.execute(i as u64 * 100_000_000, &Command::Measure { session: "copy".into(), vehicle: None, measurement }));
        }
        engine.execute(0, &Command::Close { session: "copy".into() }).expect("it was opened");
    });
}

fn fleet_soil_shares(bytes: &[u8]) {
    drop(message::<pb::FleetSoilShares>(bytes).map(|message| convert::heard_fleet_soil(&message, "own")));
}

/// The messages of an upload one after the other, each behind its length of two bytes.
fn map_messages(mut bytes: &[u8]) {
    use pb::upload_map_request::Part;
    let limits = Limits { map_cells_max: 1 << 20, ..Limits::default() };
    let mut builder = None;
    while let Some((length, rest)) = bytes.split_first_chunk::<2>() {
        let (one, rest) = rest.split_at(usize::from(u16::from_le_bytes(*length)).min(rest.len()));
        bytes = rest;
        match message::<pb::UploadMapRequest>(one).and_then(|message| message.part) {
            Some(Part::Header(header)) => builder = convert::MapBuilder::new(&header, &limits).ok(),
            Some(Part::Tile(tile)) => drop(builder.as_mut().map(|builder| builder.add(&tile))),
            None => {}
        }
    }
    drop(builder.map(convert::MapBuilder::finish));
}

/// A tile that replaces a part of a map of 11 x 9 cells.
fn map_tile(bytes: &[u8]) {
    static MAP: OnceLock<WorldMap> = OnceLock::new();
    let map = MAP.get_or_init(|| {
        let geometry = GridGeometry { origin_m: [-2.0, -2.0], resolution_m: 0.5, width: 11, height: 9 };
        WorldMap::from_layers("hills", 1, geometry, vec![0.0; 99], Some(vec![[90, 90, 90]; 99])).expect("a sound map")
    });
    drop(message::<pb::MapTile>(bytes).map(|message| convert::patched(map, &message)));
}

/// Effects on a session, which predicts with what was taken.
fn apply_effects(bytes: &[u8]) {
    let Some(message) = message::<pb::ApplyEffectsRequest>(bytes) else { return };
    in_engine(|engine, _| {
        let set = |effects| Command::SetEffects { session: "own".into(), effects };
        if engine.execute(0, &set(convert::applied_effects(&message.source, &message.effects))).is_ok() {
            engine.execute(0, &set(AppliedEffects::default())).expect("effects are taken away");
        }
    });
}

fn plant_datagram(bytes: &[u8]) {
    let _ = read_json(bytes).map(|value| twelve(&value["state"]));
}

/// The deadline of a request.
fn deadline(bytes: &[u8]) {
    let _ = text(bytes).map(grpc_timeout);
}

fn fleet_file(bytes: &[u8]) {
    drop(text(bytes).map(FleetFile::parse));
}

fn identity(bytes: &[u8]) {
    drop(text(bytes).map(Identity::parse));
}

/// The names in a certificate, DER.
fn certificate(bytes: &[u8]) {
    drop(Identity::of_certificate(&bytes.into()));
}

/// Certificates, a key, authorities or the members of a fleet, the other three of which are as they should be.
fn tls_file(bytes: &[u8]) {
    static SOUND: OnceLock<[String; 4]> = OnceLock::new();
    let sound = SOUND.get_or_init(|| {
        let own = rcgen::generate_simple_self_signed(["localhost".to_string()]).expect("a certificate can be made");
        [own.cert.pem(), own.signing_key.serialize_pem(), own.cert.pem(), "[vehicles]\n".into()]
    });
    in_folder(|folder| {
        let names = ["tls.certificate", "tls.key", "tls.authority", "tls.fleet"];
        let [certificate, key, client_ca, fleet] = names.map(|name| folder.join(name));
        let config = TlsConfig { certificate, key, client_ca, fleet, ..TlsConfig::default() };
        for changed in 0..names.len() {
            for (i, (name, sound)) in names.iter().zip(sound).enumerate() {
                let content = if i == changed { bytes } else { sound.as_bytes() };
                std::fs::write(folder.join(name), content).expect("a file can be written");
            }
            if let Ok((Some(credentials), _)) = access::load(&config) {
                drop(credentials.doubts());
            }
        }
    });
}

fn configuration(bytes: &[u8]) {
    instead("nesam.toml", bytes, |folder| drop(Config::load(&folder.join("nesam.toml"))));
}
