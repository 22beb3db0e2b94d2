//! Goal: a store is written once for each buffer of the soil filter, and not for each measurement. Method: a recorded drive in pieces as long as a buffer, each
//! awaited until it is durable; an interval that ends after the test, so that nothing else asks for a commit.

use nesam_client::Client;
use nesam_server::RunningServer;

use crate::lifecycle::http_get;
use crate::stage::*;
use crate::zenoh_network::PATIENCE;

/// Measurements of a buffer of the soil filter.
const BUFFER: usize = 10;

async fn commits(server: &RunningServer) -> u64 {
    let (_, metrics) = http_get(server.http_addr.unwrap(), "/metrics").await;
    let line = metrics.lines().find_map(|line| line.strip_prefix("nesam_store_commits_total "));
    line.expect("a server with a store tells").parse().unwrap()
}

async fn durable_place(client: &Client) -> u64 {
    client.clone().session("truck").await.unwrap().durable_place
}

#[tokio::test(flavor = "multi_thread")]
async fn service_each_buffer_of_the_filter_is_one_commit() {
    let (recorded, folder) = (recorded(), tempfile::tempdir().unwrap());
    let (server, mut client) = start_with(|config| {
        (config.store.enabled, config.store.directory, config.store.interval_s) = (true, folder.path().into(), 3600.0);
    })
    .await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "truck", recorded.world.id()).await;
    // The filter is behind by the steps that a late measurement may still change.
    let first = OPEN_STEPS + BUFFER;
    client.feed((0..=first).map(|i| sample("truck", &recorded.drive, i)).collect()).await.unwrap();
    eventually(PATIENCE, "the first buffer is durable", async || durable_place(&client).await > 0).await;
    for buffer in 1..8 {
        let (before, place) = (commits(&server).await, durable_place(&client).await);
        let piece = (1..=BUFFER).map(|i| sample("truck", &recorded.drive, OPEN_STEPS + buffer * BUFFER + i)).collect();
        client.feed(piece).await.unwrap();
        eventually(PATIENCE, "the buffer is durable", async || durable_place(&client).await > place).await;
        let written = (commits(&server).await - before, durable_place(&client).await - place);
        assert_eq!(written, (1, BUFFER as u64), "commits and measurements of buffer {buffer}");
    }
    server.shutdown().await;
}
