//! Question: what does a planner's query cost, terrain warm? Budget: 100 ms for 256 × 32 on two cores until the kernels of a later stage.

use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};

fn rollout(c: &mut Criterion) {
    let mut group = c.benchmark_group("rollout of 32 steps, terrain warm");
    group.sample_size(10);
    let map = Arc::new(nesam_benches::map());
    for samples in [1, 64, 256] {
        let mut ask = nesam_benches::rollout(samples, Some(map.clone()));
        group.bench_function(format!("{samples} candidates"), |b| b.iter(&mut ask));
    }
    group.finish();
}

criterion_group!(benches, rollout);
criterion_main!(benches);
