//! Goal: one session of a store that cannot go on keeps no other vehicle waiting, and its bytes are kept. Method: a store with three sessions, of which one is damaged in the file; the
//! server on it, twice; then the session of that name is opened anew.

use nesam_client::v1;
use nesam_server::store::{Change, RedbStore, SessionStore as _, StoredSession};
use tonic::Code;

use crate::lifecycle::http_get;
use crate::stage::*;

#[tokio::test(flavor = "multi_thread")]
async fn service_a_session_that_cannot_go_on_is_set_aside() {
    let (recorded, folder) = (recorded(), tempfile::tempdir().unwrap());
    let begin = || start_with(|config| (config.store.enabled, config.store.directory) = (true, folder.path().into()));
    let (server, mut client) = begin().await;
    for session in ["bad", "good", "other"] {
        open(&mut client, session, "").await;
        client.feed(samples(session, &recorded.drive, 20)).await.unwrap();
    }
    server.shutdown().await;

    // A state beyond its limits, as no server accepts it, with a checksum that fits.
    let mut store = RedbStore::open(folder.path()).unwrap();
    let stored = store.load().unwrap().sessions.into_iter().find(|stored| stored.name == "bad").unwrap();
    let outer = <v1::SessionImage as prost::Message>::decode(stored.image.as_slice()).unwrap();
    let mut content = <v1::SessionContent as prost::Message>::decode(outer.content.clone()).unwrap();
    content.live.as_mut().unwrap().history[0].state[5] = 1e5;
    let content = prost::Message::encode_to_vec(&content);
    let checksum = <sha2::Sha256 as sha2::Digest>::digest(&content).to_vec();
    let image = prost::Message::encode_to_vec(&v1::SessionImage { checksum: checksum.into(), content: content.into(), ..outer });
    let damaged = StoredSession { image, ..stored };
    store.commit(&[Change::PutSession(damaged.clone())]).unwrap();
    drop(store);

    for start in 0..2 {
        let (server, mut client) = begin().await;
        let accepted: Vec<_> =
            client.list_sessions().await.unwrap().into_iter().map(|s| (s.session_id, s.accepted, s.durable_place)).collect();
        assert_eq!(accepted, ["good", "other"].map(|session| (session.to_string(), 21, 21)), "start {start}");
        assert_refused("set aside", client.session("bad").await, Code::NotFound, "session_id");
        let (_, metrics) = http_get(server.http_addr.unwrap(), "/metrics").await;
        assert!(metrics.contains("nesam_store_set_aside 1\n"), "{metrics}");
        server.shutdown().await;
    }
    let store = RedbStore::open(folder.path()).unwrap();
    assert!(store.load().unwrap().sessions.contains(&damaged) && store.set_aside().unwrap().is_empty(), "it is tried at each start");
    drop(store);

    // Its vehicle begins anew; what was there is kept apart.
    let (server, mut client) = begin().await;
    open(&mut client, "bad", "").await;
    client.feed(samples("bad", &recorded.drive, 20)).await.unwrap();
    server.shutdown().await;
    assert_eq!(RedbStore::open(folder.path()).unwrap().set_aside().unwrap(), [damaged]);
    let (server, mut client) = begin().await;
    assert_eq!(client.session("bad").await.unwrap().accepted, 21);
    let (_, metrics) = http_get(server.http_addr.unwrap(), "/metrics").await;
    assert!(metrics.contains("nesam_store_set_aside 0\n"), "{metrics}");
    server.shutdown().await;
}
