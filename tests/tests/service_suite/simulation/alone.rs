//! One server with a folder on a disk that fails, against crashes and a network that fails.

use std::cell::Cell;
use std::path::Path;
use std::rc::Rc;
use std::time::Duration;

use nesam_client::Client;
use nesam_server::store::{Change, Contents, RedbStore, SessionStore, StoreError};
use nesam_server::{Config, Sessions, serve, serve_on_one_thread};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{Crew, Failure, Fault, Kind, Scene, VEHICLES, connections, network, play, seeds, without_failures};
use crate::stage::*;

const SERVERS: &[&str] = &["server"];
/// Last sample that the vehicles send.
const LAST: usize = 80;
/// Faults begin within this time.
const FAULTS_WITHIN_MS: u64 = 9000;

/// Two to six faults. Turmoil does not hold what is cut in one direction, so a seed has one of the two.
fn faults(rng: &mut ChaCha8Rng) -> Vec<Fault> {
    let holds = rng.random::<bool>();
    let hosts = [VEHICLES[0], VEHICLES[1], "planner"];
    (0..rng.random_range(2..=6))
        .map(|_| {
            let host = hosts[rng.random_range(0..3)];
            let kind = match rng.random_range(0..4) {
                0 | 1 => Kind::Crash("server"),
                2 => Kind::Cut("server", host),
                _ if holds => Kind::Hold("server", host),
                _ => Kind::Deaf(host, "server"),
            };
            Fault::at_random(rng, FAULTS_WITHIN_MS, kind)
        })
        .collect()
}

/// A folder on a disk that refuses one commit in ten, and of another one in ten says so although it has written it.
struct Unreliable {
    folder: RedbStore,
    rng: ChaCha8Rng,
}

impl SessionStore for Unreliable {
    fn load(&self) -> Result<Contents, StoreError> {
        self.folder.load()
    }

    fn commit(&mut self, changes: &[Change]) -> Result<Vec<String>, StoreError> {
        let failed = |reason: &str| Err(StoreError::Database { reason: reason.into() });
        match self.rng.random_range(0..10) {
            0 => failed("simulated: nothing was written"),
            1 => self.folder.commit(changes).and_then(|_| failed("simulated: it was written")),
            _ => self.folder.commit(changes),
        }
    }
}

/// The server's software, until it is crashed.
async fn server(folder: &Path, seed: u64) -> Result<(), Failure> {
    let store = Unreliable { folder: RedbStore::open(folder)?, rng: ChaCha8Rng::seed_from_u64(seed) };
    let mut config = Config::ephemeral();
    config.store.interval_s = 0.3;
    Ok(serve_on_one_thread(config, predictor(), connections().await?.0, Sessions::Alone(Box::new(store))).await?)
}

/// One simulation, on a folder that holds the world: who drove, starts of the server, simulated time.
fn simulate(seed: u64, folder: &Path, scene: &Scene) -> Result<(Crew, usize, Duration), Failure> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let faults = faults(&mut rng);
    let mut sim = network(seed, rng.random_range(1..60));
    let starts = Rc::new(Cell::new(0));
    sim.host("server", {
        let (starts, folder) = (starts.clone(), folder.to_path_buf());
        move || {
            starts.set(starts.get() + 1);
            let (folder, seed) = (folder.clone(), seed ^ (starts.get() as u64) << 32);
            async move { server(&folder, seed).await }
        }
    });
    let crew = Crew::join(&mut sim, scene, rng, &Rc::new(Cell::new(true)), None);
    let simulated = play(&mut sim, &faults)?;
    Ok((crew, starts.get(), simulated))
}

/// A folder that holds the recorded world.
async fn prepared(folder: &Path, recorded: &Recorded) {
    let mut config = Config::ephemeral();
    config.store.enabled = true;
    config.store.directory = folder.into();
    let server = serve(config, predictor()).await.unwrap();
    let mut client = Client::connect(&format!("http://{}", server.grpc_addr)).await.unwrap();
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    server.shutdown().await;
}

#[test]
fn simulation_of_crashes_and_networks_loses_nothing() {
    let scene = Scene { recorded: Rc::new(recorded()), last: LAST, servers: SERVERS };
    let prepared_folder = tempfile::tempdir().unwrap();
    tokio::runtime::Runtime::new().unwrap().block_on(prepared(prepared_folder.path(), &scene.recorded));
    let expected = without_failures(&scene);
    let (mut restarts, mut answers) = (0, 0);
    for seed in seeds(0..12) {
        let folder = tempfile::tempdir().unwrap();
        for entry in std::fs::read_dir(prepared_folder.path()).unwrap() {
            let file = entry.unwrap().path();
            std::fs::copy(&file, folder.path().join(file.file_name().unwrap())).unwrap();
        }
        let run = simulate(seed, folder.path(), &scene).unwrap_or_else(|failure| panic!("seed {seed}: {failure}"));
        let (crew, starts, simulated) = run;
        let predictions = crew.check(seed, LAST, &expected);
        println!("seed {seed}: {starts} starts, {predictions} predictions on the way, {:.1} s", simulated.as_secs_f64());
        (restarts, answers) = (restarts + starts - 1, answers + predictions);
    }
    assert!(restarts > 0 && answers > 0, "{restarts} restarts, {answers} predictions: nothing was tried");
}
