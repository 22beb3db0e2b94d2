//! Question: what does one update of the soil filter cost, network along the buffer included and apart? Budget: 1 ms on one core for the update.

use criterion::{Criterion, criterion_group, criterion_main};

fn soil_update(c: &mut Criterion) {
    let mut group = c.benchmark_group("soil filter");
    let works = [
        ("network along one buffer", nesam_benches::network_along_buffer()),
        ("one prediction held against what came", nesam_benches::forecast_held()),
        ("one update, mean of a drive", nesam_benches::next_soil_update()),
        ("the first update", nesam_benches::soil_update(false)),
        ("the first update, literal Algorithm 1", nesam_benches::soil_update(true)),
    ];
    for (name, mut work) in works {
        group.bench_function(name, |b| b.iter(&mut work));
    }
    group.finish();
}

criterion_group!(benches, soil_update);
criterion_main!(benches);
