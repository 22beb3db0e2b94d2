//! Every reader of files and texts that come from outside, each as a function of bytes: what it gets may be refused, and must not panic, hang or take memory
//! without bound.
//!
//! `tests/corpus.rs` feeds the corpora and seeded mutations of them on every run of the tests; `fuzz/` has the same readers as libFuzzer targets, for campaigns
//! (`tests/hostile/fuzz.sh`). What a campaign finds goes into the corpus of its reader. What comes over the network is not here: `random_bytes.rs`
//! of the service suite sends that to a real server.
#![forbid(unsafe_code)]

use std::cell::RefCell;
use std::path::Path;

use nesam_degradation::Degradation;
use nesam_import::{Mapping, Options, Topics, drives, read_bag, read_csv};
use nesam_model::{ModelBundle, Weights, effects_from_toml};
use nesam_terrain::WorldMap;
use nesam_trajectories::{DataRoot, SetQuery, SplitFilter, read_vehicle_card};
use tempfile::TempDir;

/// A reader: its name, which is also that of its corpus, and what feeds it.
pub type Reader = (&'static str, fn(&[u8]));

/// All of them.
pub const READERS: [Reader; 13] = [
    ("bag", bag),
    ("csv_log", csv_log),
    ("mapping", mapping),
    ("degradation", degradation),
    ("effects", effects),
    ("weights", weights),
    ("manifest", manifest),
    ("world_json", world_json),
    ("elevation_png", elevation_png),
    ("vehicle_card", vehicle_card),
    ("index_json", index_json),
    ("index_parquet", index_parquet),
    ("samples_parquet", samples_parquet),
];

thread_local! {
    /// A folder of this thread's own, in which files lie where a reader looks for them.
    static FOLDER: RefCell<Option<TempDir>> = const { RefCell::new(None) };
}

/// Calls `read` with the thread's folder, which has the valid files of `around` in it.
fn in_folder(read: impl FnOnce(&Path)) {
    FOLDER.with_borrow_mut(|folder| {
        let folder = folder.get_or_insert_with(|| {
            let made = tempfile::tempdir().expect("a temporary folder");
            copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("around"), made.path());
            made
        });
        read(folder.path());
    });
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("a folder can be made");
    for entry in std::fs::read_dir(from).expect("the folder is part of the repository").flatten() {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).expect("a file can be copied");
        }
    }
}

/// Writes the bytes to a file of the folder, reads, and puts back what was there.
fn instead(name: &str, bytes: &[u8], read: impl FnOnce(&Path)) {
    in_folder(|folder| {
        let path = folder.join(name);
        let before = std::fs::read(&path).ok();
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

fn world_json(bytes: &[u8]) {
    instead("worlds/w01/world.json", bytes, |folder| drop(WorldMap::load(&folder.join("worlds/w01"))));
}

fn elevation_png(bytes: &[u8]) {
    instead("worlds/w01/elevation.png", bytes, |folder| drop(WorldMap::load(&folder.join("worlds/w01"))));
}

fn vehicle_card(bytes: &[u8]) {
    instead("vehicle_card.json", bytes, |folder| drop(read_vehicle_card(&folder.join("vehicle_card.json"))));
}

/// Loads a set of the folder, with what only evaluation reads.
fn load(folder: &Path, set: &str) {
    if let Ok(root) = DataRoot::open(folder, Some(&folder.join("vehicle.json"))) {
        let query = SetQuery { set: set.into(), split: SplitFilter::All, trajectories: None, dt_s: 0.1, ground_truth: true };
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
