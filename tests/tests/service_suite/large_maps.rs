//! Goal: nobody waits for a map that somebody else puts or patches.

use std::time::Instant;

use nesam_client::v1;
use nesam_terrain::{GridGeometry, PatchScale, WorldMap};

use crate::stage::*;

/// Level ground with stripes of two colours.
fn striped(side: usize) -> WorldMap {
    let geometry = GridGeometry { origin_m: [-0.05 * side as f64; 2], resolution_m: 0.1, width: side, height: side };
    let colour = |i: usize| if (i / 40).is_multiple_of(2) { [180, 160, 60] } else { [70, 110, 50] };
    WorldMap::from_layers("large", 1, geometry, vec![0.0; side * side], Some((0..side * side).map(colour).collect())).unwrap()
}

/// Colours of a map are smoothed before the engine has it, whole once and around each patch again. Method: the time that the engine takes for the first prediction at
/// places that were never asked for, on the map and after a patch, in parts of the time that smoothing such a map takes here.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_large_map_is_ready_before_the_engine_has_it() {
    let (server, mut client) = start().await;
    let map = striped(2400);
    client.upload_map(&layers(&map)).await.unwrap();
    let begun = Instant::now();
    map.make_ready(&PatchScale { smooth_semantics: true, ..PatchScale::default() });
    let smoothing_s = begun.elapsed().as_secs_f64();
    open(&mut client, "s", "large").await;
    let recorded = recorded();
    let mut question = candidates("s", &recorded.drive, 40, 1, 2);
    question.use_history = false;
    let mut first_at = [0.0; 12];
    (first_at[2], first_at[6]) = (0.6, 2.0);
    for (version, x_m) in [(1, -20.0), (2, 0.0), (3, 20.0)] {
        first_at[0] = x_m;
        question.start = Some(first_at);
        let answer = client.predict(question.clone()).await.unwrap();
        assert_eq!(answer.provenance.map_version, version);
        assert!(answer.compute_s < 0.3 * smoothing_s, "{} s, smoothing takes {smoothing_s} s", answer.compute_s);
        let tile = v1::MapTile {
            column: 1000,
            row: 1190,
            columns: 20,
            rows: 20,
            elevation_m: nesam_proto::packed::pack(&[0.1; 400]),
            semantic_rgb: [[200, 40, 0]; 400].concat().into(),
        };
        client.patch_tile(v1::PatchTileRequest { map_id: "large".into(), base_version: version, tile: Some(tile) }).await.unwrap();
    }
    server.shutdown().await;
}
