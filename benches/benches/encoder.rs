//! Question: what does one pair of patches cost, cropped and encoded? Budget: 0.3 ms on one core, since every new node of the pose grid pays it.

use criterion::{Criterion, criterion_group, criterion_main};
use nesam_model::ModelBundle;
use nesam_model::dims::CONTEXT;
use nesam_model::encoder::{EncoderScratch, TerrainEncoders};
use nesam_terrain::{Patch, Pose2, WorldMap, sample_patch};
use nesam_tests::{sample_root, shipped_bundle};

fn encoder(c: &mut Criterion) {
    let bundle = ModelBundle::load(&shipped_bundle()).expect("a shipped bundle");
    let encoders = TerrainEncoders::new(&bundle.weights).expect("its encoders");
    let map = WorldMap::load(&sample_root().join("worlds/w05")).expect("a map of the sample");
    let (mut patch, mut scratch, mut context) = (Patch::new(), EncoderScratch::default(), vec![0.0; CONTEXT]);
    let scale = bundle.normalization.patch_scale();
    let pose = Pose2 { x_m: 3.2, y_m: -4.1, yaw_rad: 0.7 };
    c.bench_function("crop a patch pair", |b| b.iter(|| sample_patch(&map, pose, &scale, &mut patch)));
    c.bench_function("encode a patch pair", |b| b.iter(|| encoders.encode(&patch, &mut scratch, &mut context)));
}

criterion_group!(benches, encoder);
criterion_main!(benches);
