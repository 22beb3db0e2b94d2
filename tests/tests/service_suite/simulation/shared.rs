//! Servers that share sessions through etcd, against crashes of servers and etcd and a network that fails; vehicles and planner ask now this one, now that.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::rc::Rc;
use std::time::Duration;

use nesam_client::MapLayers;
use nesam_proto::etcd::event::EventType;
use nesam_server::{Config, Sessions, etcd_endpoint, serve_on_one_thread};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tokio::time::{sleep, timeout};

use super::etcd::Etcd;
use super::{
    Crew, Failure, Fault, Kind, Scene, VEHICLES, Violation, connect, connections, connector, network, play, seeds, without_failures,
};
use crate::stage::*;

const SERVERS: &[&str] = &["one", "two", "three"];
const ETCD: &str = "etcd";
const LEASE_S: u32 = 1;
/// Last sample that the vehicles send.
const LAST: usize = 120;
/// Faults begin within this time.
const FAULTS_WITHIN_MS: u64 = 5000;
/// A map is a dozen messages to etcd, one after the other.
const UPLOADED_WITHIN: Duration = Duration::from_secs(10);
/// After the last fault: time for leases to end and for connections to be given up.
const SETTLES: Duration = Duration::from_secs(3);
/// Longest time that anybody waits for an answer then: a session may stay where it is for half a second, and there are a dozen messages to and fro.
const ANSWERED_WITHIN: Duration = Duration::from_secs(5);

/// Two to six faults. Turmoil does not hold what is cut in one direction, so a seed has one of the two.
fn faults(rng: &mut ChaCha8Rng) -> Vec<Fault> {
    let holds = rng.random::<bool>();
    let clients = [VEHICLES[0], VEHICLES[1], "planner"];
    (0..rng.random_range(2..=6))
        .map(|_| {
            let (server, client) = (SERVERS[rng.random_range(0..SERVERS.len())], clients[rng.random_range(0..clients.len())]);
            let kind = match rng.random_range(0..7) {
                0 | 1 => Kind::Crash(server),
                2 => Kind::Crash(ETCD),
                3 => Kind::Cut(server, ETCD),
                4 => Kind::Cut(server, client),
                _ if holds => Kind::Hold(server, ETCD),
                5 => Kind::Deaf(server, ETCD),
                _ => Kind::Deaf(ETCD, server),
            };
            Fault::at_random(rng, FAULTS_WITHIN_MS, kind)
        })
        .collect()
}

/// The software of a server that is called so, until it is crashed; begun again when it gives up, as a service manager does.
async fn server(called: &'static str) -> Result<(), Failure> {
    let mut config = Config::ephemeral();
    config.store.interval_s = 0.3;
    config.cluster.etcd = vec![format!("http://{ETCD}")];
    config.cluster.name = called.into();
    config.cluster.lease_s = LEASE_S;
    loop {
        let (incoming, accepting) = connections().await?;
        let etcd = etcd_endpoint(&config.cluster.etcd[0], &config.cluster)?.connect_with_connector_lazy(connector(ETCD));
        let _ = serve_on_one_thread(config.clone(), predictor(), incoming, Sessions::Shared(etcd)).await;
        accepting.abort();
        let _ = accepting.await;
        sleep(Duration::from_millis(100)).await;
    }
}

async fn etcd(held: Etcd) -> Result<(), Failure> {
    tokio::spawn(held.clone().expire(|| turmoil::sim_elapsed().unwrap_or_default()));
    let (incoming, _accepting) = connections().await?;
    Ok(held.router().serve_with_incoming(incoming).await?)
}

/// Brings the map to one of the servers, in a newer version with each attempt.
async fn upload(recorded: &Recorded) {
    for (version, server) in (1..).zip(SERVERS.iter().cycle()) {
        if let Ok(mut client) = connect(server).await
            && let layers = (MapLayers { version, ..layers(&recorded.world) })
            && matches!(timeout(UPLOADED_WITHIN, client.upload_map(&layers)).await, Ok(Ok(_)))
        {
            return;
        }
        sleep(Duration::from_millis(100)).await;
    }
}

/// Reads in what happened to etcd's keys whether each session had one owner at a time and was written under one only; how many owners there were.
fn audit(etcd: &Etcd) -> Result<usize, Violation> {
    let (mut owned, mut owners) = (BTreeSet::new(), 0);
    for (revision, event) in etcd.history() {
        let Some(kv) = &event.kv else { continue };
        let (key, put) = (String::from_utf8_lossy(&kv.key).into_owned(), event.r#type() == EventType::Put);
        if let Some(session) = key.strip_prefix("nesam/live/owner/") {
            if put && kv.create_revision != kv.mod_revision {
                return Err(Violation(format!("{session}: a second owner in one epoch at revision {revision}")));
            }
            owners += usize::from(put);
            if put {
                owned.insert(session.to_owned())
            } else {
                owned.remove(session)
            };
        } else if let Some(session) = key.strip_prefix("nesam/session/")
            && put
            && !owned.contains(session)
        {
            return Err(Violation(format!("{session}: written without an owner at revision {revision}")));
        }
    }
    Ok(owners)
}

/// One simulation: who drove, starts of servers, owners of sessions, simulated time.
fn simulate(seed: u64, scene: &Scene) -> Result<(Crew, usize, usize, Duration), Failure> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let faults = faults(&mut rng);
    let mut sim = network(seed, rng.random_range(1..120));
    let (starts, ready, held) = (Rc::new(Cell::new(0)), Rc::new(Cell::new(false)), Etcd::default());
    sim.host(ETCD, {
        let held = held.clone();
        move || etcd(held.clone())
    });
    for name in SERVERS {
        let starts = starts.clone();
        sim.host(*name, move || {
            starts.set(starts.get() + 1);
            // Every other time somebody has copied a configuration with its name.
            server(if seed.is_multiple_of(2) { name } else { SERVERS[0] })
        });
    }
    sim.client("uploader", {
        let (recorded, ready) = (scene.recorded.clone(), ready.clone());
        async move {
            upload(&recorded).await;
            ready.set(true);
            Ok(())
        }
    });
    let calm = Duration::from_millis(faults.iter().map(|fault| fault.ends).max().unwrap_or(0)) + SETTLES;
    let crew = Crew::join(&mut sim, scene, rng, &ready, Some((calm, ANSWERED_WITHIN)));
    let simulated = play(&mut sim, &faults)?;
    Ok((crew, starts.get(), audit(&held)?, simulated))
}

#[test]
fn simulation_of_servers_that_share_sessions_loses_nothing() {
    let scene = Scene { recorded: Rc::new(recorded()), last: LAST, servers: SERVERS };
    let expected = without_failures(&scene);
    let (mut restarts, mut answers, mut moves) = (0, 0, 0);
    for seed in seeds(0..8) {
        let run = simulate(seed, &scene).unwrap_or_else(|failure| panic!("seed {seed}: {failure}"));
        let (crew, starts, owners, simulated) = run;
        let (predictions, simulated_s) = (crew.check(seed, LAST, &expected), simulated.as_secs_f64());
        println!("seed {seed}: {starts} starts, {owners} owners, {predictions} predictions on the way, {simulated_s:.1} s");
        (restarts, answers, moves) = (restarts + starts - SERVERS.len(), answers + predictions, moves + owners - VEHICLES.len());
    }
    assert!(restarts > 0 && answers > 0 && moves > 0, "{restarts} restarts, {answers} predictions, {moves} moves: nothing was tried");
}
