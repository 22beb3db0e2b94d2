//! Question: what does one pair of patches cost, cropped and encoded? Budget: 0.3 ms on one core, since every new node of the pose grid pays it.

use criterion::{Criterion, criterion_group, criterion_main};

fn encoder(c: &mut Criterion) {
    let (mut crop, mut encode) = (nesam_benches::crop(), nesam_benches::encode());
    c.bench_function("crop a patch pair", |b| b.iter(&mut crop));
    c.bench_function("encode a patch pair", |b| b.iter(&mut encode));
}

criterion_group!(benches, encoder);
criterion_main!(benches);
