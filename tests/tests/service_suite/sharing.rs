//! Goal: servers that share sessions answer as one would, also while sessions move and etcd is slow or refuses. Method: two servers over real sockets on the
//! stand-in for etcd; `simulation` and `tests/fleet` have what dies.

use std::collections::BTreeSet;
use std::time::Duration;

use nesam_client::{Client, MapLayers, v1};
use nesam_proto::etcd::event::EventType;
use nesam_server::RunningServer;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::Code;

use crate::lifecycle::http_get;
use crate::simulation::etcd::{Etcd, Trouble};
use crate::stage::*;

/// Longest wait for what happens by itself.
const PATIENCE: Duration = Duration::from_secs(20);

/// A server among others with a client of its own.
struct Shared {
    server: RunningServer,
    client: Client,
}

/// Two servers that share sessions, and their etcd. Leases last as long as the test.
async fn two_servers() -> (Etcd, Shared, Shared) {
    let (etcd, listener) = (Etcd::default(), tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap());
    let address = format!("http://{}", listener.local_addr().unwrap());
    tokio::spawn(etcd.router().serve_with_incoming(TcpListenerStream::new(listener)));
    let server = async |name: &str| {
        let (server, client) = start_with(|config| {
            (config.cluster.etcd, config.cluster.name) = (vec![address.clone()], name.into());
        })
        .await;
        Shared { server, client }
    };
    let (one, two) = (server("one").await, server("two").await);
    (etcd, one, two)
}

/// How often a key of etcd was written.
fn writes(etcd: &Etcd, key: &str) -> usize {
    let written = |event: &nesam_proto::etcd::Event| event.r#type() == EventType::Put && event.kv.as_ref().is_some_and(|kv| kv.key == key);
    etcd.history().iter().filter(|(_, event)| written(event)).count()
}

async fn shut_down(servers: [Shared; 2]) {
    for shared in servers {
        shared.server.shutdown().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_an_error_of_etcd_refuses_no_measurement() {
    let recorded = recorded();
    let (etcd, mut one, mut two) = two_servers().await;
    open(&mut one.client, "s", "").await;
    one.client.feed(samples("s", &recorded.drive, 3)).await.unwrap();
    for refusal in [Code::NotFound, Code::Unknown, Code::Cancelled, Code::DeadlineExceeded] {
        etcd.trouble(Trouble { refusal: Some(refusal), ..Trouble::default() });
        // Not a rejected measurement, which a vehicle would not send again: the stream ends.
        let error = two.client.measure().await.unwrap().exchange(sample("s", &recorded.drive, 4)).await.unwrap_err();
        assert_eq!(error.code(), Some(Code::Unavailable), "{refusal:?}: {error}");
        assert!(error.retry_after().is_some() && error.to_string().contains("etcd"), "{error}");
    }
    etcd.trouble(Trouble::default());
    let answer = two.client.measure().await.unwrap().exchange(sample("s", &recorded.drive, 4)).await.unwrap();
    assert_eq!(answer.place, 5, "{answer:?}");
    shut_down([one, two]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_map_that_a_session_of_another_server_drives_on_stays() {
    let recorded = recorded();
    let (etcd, mut one, mut two) = two_servers().await;
    let world = recorded.world.id();
    one.client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut one.client, "s", world).await;
    assert_refused("a used map", two.client.delete_map(world).await, Code::FailedPrecondition, "map_id");

    // Deleted although it is used, as by a server that had looked before the session began: whoever has the session writes it again.
    etcd.delete_all(&format!("nesam/part/{world}/"));
    etcd.delete_all("nesam/live/map/");
    let key = format!("nesam/live/map/{world}");
    eventually(PATIENCE, "the map is written again", async || etcd.get(&key).is_some()).await;
    let session = two.client.session("s").await.unwrap();
    assert_eq!(session.provenance.unwrap().map_id, world);

    // Nobody drives on it any more: it goes, also where it only lay about.
    two.client.close_session("s").await.unwrap();
    two.client.delete_map(world).await.unwrap();
    assert!(etcd.get(&key).is_none());
    let client = one.client.clone();
    let gone = async || client.clone().map(world).await.is_err_and(|error| error.code() == Some(Code::NotFound));
    eventually(PATIENCE, "the map is forgotten", gone).await;
    shut_down([one, two]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_an_older_map_replaces_no_newer_one_of_another_server() {
    let recorded = recorded();
    let (_etcd, mut one, mut two) = two_servers().await;
    let layers = |version: u64| MapLayers { version, ..layers(&recorded.world) };
    one.client.upload_map(&layers(2)).await.unwrap();
    for version in [1, 2] {
        let error = two.client.upload_map(&layers(version)).await.unwrap_err();
        assert_eq!(error.code(), Some(Code::AlreadyExists), "version {version}: {error}");
    }
    assert_eq!(two.client.upload_map(&layers(3)).await.unwrap().version, 3);
    // The other server hears of it.
    let client = one.client.clone();
    let renewed = async || client.clone().map(recorded.world.id()).await.is_ok_and(|map| map.version == 3);
    eventually(PATIENCE, "the newer map is there", renewed).await;
    shut_down([one, two]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_name_that_is_taken_moves_nothing() {
    let (etcd, mut one, mut two) = two_servers().await;
    let opened = open(&mut one.client, "s", "").await;
    open(&mut two.client, "t", "").await;
    let request = v1::OpenSessionRequest { vehicle_id: "lorry".into(), session_id: "s".into(), ..Default::default() };
    assert_refused("open", two.client.open_session(request).await, Code::AlreadyExists, "session_id");
    assert_refused("fork", two.client.fork_session("t", "s").await, Code::AlreadyExists, "new_session_id");
    let image = two.client.export_session("t").await.unwrap();
    assert_refused("import", two.client.import_session(image, "s").await, Code::AlreadyExists, "session_id");
    let owner = etcd.get("nesam/live/owner/s").unwrap();
    assert_eq!((owner.create_revision.unsigned_abs(), one.client.session("s").await.unwrap().run), (opened.run, opened.run));

    // A question of somebody who may ask moves it.
    assert!(two.client.session("s").await.unwrap().run > opened.run);
    // A closed one leaves its name to whoever asks.
    two.client.close_session("s").await.unwrap();
    open(&mut one.client, "s", "").await;
    shut_down([one, two]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_whoever_watches_a_session_that_moves_is_told_to_ask_again() {
    let (_etcd, mut one, mut two) = two_servers().await;
    open(&mut one.client, "s", "").await;
    let (mut soil, mut alarms) = (one.client.watch_soil("s").await.unwrap(), one.client.watch_alarms("s").await.unwrap());
    assert_eq!(soil.message().await.unwrap().unwrap().soil_epoch, 0);
    two.client.session("s").await.unwrap();
    assert_eq!(soil.message().await.unwrap_err().code(), Code::Unavailable);
    assert_eq!(alarms.message().await.unwrap_err().code(), Code::Unavailable);

    // The end of a session that is closed is no error.
    let (mut soil, mut alarms) = (two.client.watch_soil("s").await.unwrap(), two.client.watch_alarms("s").await.unwrap());
    soil.message().await.unwrap().unwrap();
    two.client.close_session("s").await.unwrap();
    assert_eq!((soil.message().await.unwrap(), alarms.message().await.unwrap()), (None, None));
    shut_down([one, two]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_what_is_opened_while_its_name_is_given_back_stays() {
    let (etcd, mut one, two) = two_servers().await;
    open(&mut one.client, "s", "").await;
    etcd.trouble(Trouble { delay: Duration::from_millis(300), ..Trouble::default() });
    let mut client = one.client.clone();
    let closing = tokio::spawn(async move { client.close_session("s").await });
    // The engine has closed it by now, and etcd does not know yet.
    tokio::time::sleep(Duration::from_millis(150)).await;
    open(&mut one.client, "s", "").await;
    closing.await.unwrap().unwrap();
    etcd.trouble(Trouble::default());
    one.client.session("s").await.unwrap();
    assert!(etcd.get("nesam/session/s").is_some() && etcd.get("nesam/live/owner/s").is_some());
    shut_down([one, two]).await;
}

/// Goal: a session is not its former owner's for ever because etcd failed once. Method: etcd removes no key of an owner until the owner has tried.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_session_that_could_not_be_given_back_at_once_comes_all_the_same() {
    let (etcd, mut one, two) = two_servers().await;
    let run = open(&mut one.client, "s", "").await.run;
    etcd.trouble(Trouble { keeps: Some("nesam/live/owner/"), ..Trouble::default() });
    let mut client = two.client.clone();
    let asking = tokio::spawn(async move { client.session("s").await });
    eventually(PATIENCE, "the owner has tried to give it back", async || etcd.kept() > 0).await;
    assert_eq!(etcd.get("nesam/live/owner/s").unwrap().create_revision.unsigned_abs(), run, "in vain");
    etcd.trouble(Trouble::default());
    assert!(asking.await.unwrap().unwrap().run > run);
    shut_down([one, two]).await;
}

/// Goal: a key of a server under which it has no session keeps nobody out. Method: such a key as it stays behind when etcd has written it and could not say so.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_key_without_a_session_is_given_back_to_whoever_asks() {
    let (etcd, mut one, mut two) = two_servers().await;
    open(&mut one.client, "other", "").await;
    let owner = etcd.get("nesam/live/owner/other").unwrap();
    etcd.put("nesam/live/owner/s", owner.value, owner.lease);
    open(&mut two.client, "s", "").await;
    assert_ne!(etcd.get("nesam/live/owner/s").unwrap().lease, owner.lease);
    one.client.session("other").await.unwrap();
    shut_down([one, two]).await;
}

/// Goal: servers know of each other, and which of them has another bundle. Method: a key in etcd as such a server writes it, and without it.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_server_with_another_bundle_is_told_of() {
    let (etcd, mut one, two) = two_servers().await;
    open(&mut one.client, "s", "").await;
    let lease = etcd.get("nesam/live/owner/s").unwrap().lease;
    let http = one.server.http_addr.unwrap();
    let counted = async |servers: usize, other_bundles: usize| {
        let (_, metrics) = http_get(http, "/metrics").await;
        let lines = [format!("nesam_cluster_servers {servers}"), format!("nesam_cluster_other_bundles {other_bundles}")];
        lines.iter().all(|line| metrics.lines().any(|own| own == line))
    };
    eventually(PATIENCE, "two servers", async || counted(2, 0).await).await;
    let other = r#"{"name":"two","address":"host:1","bundle":"other","bundle_hash":"ab"}"#;
    etcd.put("nesam/live/member/7", other.into(), lease);
    eventually(PATIENCE, "a third one with another bundle", async || counted(3, 1).await).await;
    etcd.delete_all("nesam/live/member/");
    eventually(PATIENCE, "the others are gone", async || counted(1, 0).await).await;
    shut_down([one, two]).await;
}

/// Goal: whoever does not wait until a session is open leaves no name behind under which there is none. Method: a slow etcd and clients that give up one after the
/// other, some of them while the name is being taken.
#[tokio::test(flavor = "multi_thread")]
async fn service_whoever_gives_up_opening_leaves_no_name_without_a_session() {
    let (etcd, one, mut two) = two_servers().await;
    // To look who has a name and to take it is a quarter of a second each: clients give up before, while and after their names are taken.
    etcd.trouble(Trouble { delay: Duration::from_millis(250), ..Trouble::default() });
    let names: Vec<String> = (0..24).map(|i| format!("s{i}")).collect();
    let owner = |name: &str| format!("nesam/live/owner/{name}");
    let opening = names.iter().zip(0..).map(|(name, i)| {
        let request = v1::OpenSessionRequest { vehicle_id: name.clone(), ..Default::default() };
        let mut client = one.client.clone();
        tokio::spawn(async move { drop(tokio::time::timeout(Duration::from_millis(30 * i), client.open_session(request)).await) })
    });
    for gives_up in opening.collect::<Vec<_>>() {
        gives_up.await.unwrap();
    }
    // What was begun for somebody comes to its end.
    tokio::time::sleep(Duration::from_secs(1)).await;
    etcd.trouble(Trouble::default());
    let client = one.client.clone();
    let sessions = async || -> BTreeSet<String> {
        client.clone().list_sessions().await.unwrap().into_iter().map(|session| session.session_id).collect()
    };
    let fits = async || {
        let sessions = sessions().await;
        names.iter().all(|name| etcd.get(&owner(name)).is_some() == sessions.contains(name))
    };
    eventually(PATIENCE, "whatever name is taken has a session", fits).await;
    let (begun, taken) = (sessions().await, names.iter().filter(|name| writes(&etcd, &owner(name)) > 0).count());
    assert!(taken > begun.len(), "{taken} names taken for {} sessions: nobody gave up in between", begun.len());
    for name in names.iter().filter(|name| !begun.contains(*name)) {
        open(&mut two.client, name, "").await;
    }
    shut_down([one, two]).await;
}

/// Goal: a wish does not outlive whoever has it. Method: a client that gives up as soon as its server has asked the owner.
#[tokio::test(flavor = "multi_thread")]
async fn service_whoever_gives_up_asking_leaves_no_wish() {
    let (etcd, mut one, two) = two_servers().await;
    open(&mut one.client, "s", "").await;
    // Slow enough that the session is on its way meanwhile.
    etcd.trouble(Trouble { delay: Duration::from_millis(250), ..Trouble::default() });
    let mut client = two.client.clone();
    let asking = tokio::spawn(async move { client.session("s").await });
    eventually(PATIENCE, "the owner is asked", async || writes(&etcd, "nesam/live/want/s") > 0).await;
    asking.abort();
    etcd.trouble(Trouble::default());
    eventually(PATIENCE, "the wish is taken back", async || etcd.get("nesam/live/want/s").is_none()).await;
    let client = one.client.clone();
    eventually(PATIENCE, "the session is there", async || client.clone().session("s").await.is_ok()).await;
    shut_down([one, two]).await;
}
