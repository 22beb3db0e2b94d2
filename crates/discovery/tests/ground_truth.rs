//! Goal: a diagnosis reads no ground truth. Method: the sample's drives with and without their `gt_` columns give the same report, byte for byte.
#![allow(clippy::unwrap_used)]

mod common;
#[path = "../../trajectories/tests/common/mod.rs"]
mod roots;

use std::path::Path;
use std::sync::Arc;

use nesam_discovery::diagnose;
use nesam_discovery::report::Report;
use nesam_evaluation::Provenance;
use nesam_model::Predictor;
use nesam_trajectories::{DataRoot, SetQuery};

const SET: &str = "effect_open/steer_offset";

fn report(root: &Path) -> String {
    let root = DataRoot::open(root, None).unwrap();
    let drives = root.load_set(&SetQuery::all(SET)).unwrap();
    let maps: Vec<_> = drives.iter().map(|d| d.world.as_deref().map(|w| root.world(w).unwrap())).collect();
    let predictor = Predictor::new(Arc::new(common::bundle())).unwrap();
    let found =
        diagnose(&predictor, &drives, &maps, &nesam_discovery::Options { controls: true, ..common::options() }, &|_, _, _| {}).unwrap();
    let provenance = Provenance::default();
    Report {
        set: SET,
        diagnosis: &found,
        bundle: None,
        free_form_bundle: None,
        provenance: &provenance,
        dt_s: 0.1,
        against: Default::default(),
        doubts: &[],
        notes: &[],
    }
    .to_json()
}

#[test]
fn service_a_root_without_ground_truth_gives_the_same_report() {
    let sample = roots::sample_root();
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path();
    std::fs::copy(sample.join("vehicle_hmmwv.json"), copy.join("vehicle_hmmwv.json")).unwrap();
    std::fs::create_dir_all(copy.join(SET)).unwrap();
    for index in ["index.json", "index.parquet"] {
        if sample.join(SET).join(index).exists() {
            std::fs::copy(sample.join(SET).join(index), copy.join(SET).join(index)).unwrap();
        }
    }
    roots::copy_without_truth(&sample.join(SET).join("samples.parquet"), &copy.join(SET).join("samples.parquet"));
    for world in std::fs::read_dir(sample.join("worlds")).unwrap().map(|w| w.unwrap()) {
        let to = copy.join("worlds").join(world.file_name());
        std::fs::create_dir_all(&to).unwrap();
        for file in std::fs::read_dir(world.path()).unwrap().map(|f| f.unwrap()) {
            if !file.file_name().to_string_lossy().starts_with("gt_") {
                std::fs::copy(file.path(), to.join(file.file_name())).unwrap();
            }
        }
    }
    assert_eq!(report(&sample), report(copy));
}
