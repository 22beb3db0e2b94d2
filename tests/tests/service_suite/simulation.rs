//! Goal: whatever the network does and whenever the server dies, no measurement that was called durable is lost and the estimate is that of a drive without
//! failures, bit for bit. Server, store and clients are the real ones; network, crashes and time are simulated from a seed, on one thread.
//!
//! `NESAM_SIMULATION_SEEDS=1000..2000 cargo test --release -p nesam-tests --test service_suite simulation` tries others. A failure says its seed.

use std::cell::{Cell, RefCell};
use std::error::Error;
use std::io;
use std::path::Path;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll};
use std::time::Duration;

use hyper_util::rt::TokioIo;
use nesam_client::{Client, Outbox, Prediction, outcome_label, v1};
use nesam_server::store::{Change, Contents, RedbStore, SessionStore, StoreError};
use nesam_server::{Config, serve, serve_on_one_thread};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, sleep, timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;
use tonic::transport::Endpoint;
use tonic::transport::server::Connected;
use turmoil::Sim;
use turmoil::net::{TcpListener, TcpStream};

use crate::stage::*;

type Failure = Box<dyn Error>;

/// Vehicles, each with a session of its name.
const VEHICLES: [&str; 2] = ["s", "t"];
/// Last sample that they send.
const LAST: usize = 80;
/// Measurements on their way at once.
const BURST: usize = 8;
/// How long a client waits for an answer before it connects again.
const PATIENCE: Duration = Duration::from_millis(1500);
/// Faults begin within this time.
const FAULTS_WITHIN_MS: u64 = 9000;
const SIMULATED: Duration = Duration::from_secs(120);
const TICK: Duration = Duration::from_millis(2);
const PORT: u16 = 50051;

/// What goes wrong between these instants, ms.
#[derive(Clone, Copy, Debug)]
struct Fault {
    begins: u64,
    ends: u64,
    kind: Kind,
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    /// The server dies, and starts again on the same folder.
    Crash,
    /// Nothing passes between server and this host.
    Cut(&'static str),
    /// Nothing passes from this host to the server.
    Deaf(&'static str),
    /// What passes between them comes later, all at once.
    Hold(&'static str),
}

impl Fault {
    fn begin(&self, sim: &mut Sim<'_>) {
        match self.kind {
            Kind::Crash => sim.crash("server"),
            Kind::Cut(host) => sim.partition("server", host),
            Kind::Deaf(host) => sim.partition_oneway(host, "server"),
            Kind::Hold(host) => sim.hold("server", host),
        }
    }

    fn end(&self, sim: &mut Sim<'_>) {
        match self.kind {
            Kind::Crash if sim.is_host_running("server") => {}
            Kind::Crash => sim.bounce("server"),
            Kind::Cut(host) => sim.repair("server", host),
            Kind::Deaf(host) => sim.repair_oneway(host, "server"),
            Kind::Hold(host) => sim.release("server", host),
        }
    }
}

/// Two to six faults. Turmoil does not hold what is cut in one direction, so a seed has one of the two.
fn faults(rng: &mut ChaCha8Rng) -> Vec<Fault> {
    let holds = rng.random::<bool>();
    let hosts = [VEHICLES[0], VEHICLES[1], "planner"];
    (0..rng.random_range(2..=6))
        .map(|_| {
            let host = hosts[rng.random_range(0..3)];
            let kind = match rng.random_range(0..4) {
                0 | 1 => Kind::Crash,
                2 => Kind::Cut(host),
                _ if holds => Kind::Hold(host),
                _ => Kind::Deaf(host),
            };
            let begins = rng.random_range(0..FAULTS_WITHIN_MS);
            Fault { begins, ends: begins + rng.random_range(50..3000), kind }
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

/// A simulated connection as the server takes it.
struct Socket(TcpStream);

impl Connected for Socket {
    type ConnectInfo = ();

    fn connect_info(&self) {}
}

impl AsyncRead for Socket {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_read(context, buffer)
    }
}

impl AsyncWrite for Socket {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.0).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.0).poll_shutdown(context)
    }
}

/// The server's software, until it is crashed.
async fn server(folder: &Path, seed: u64) -> Result<(), Failure> {
    let (sender, connections) = tokio::sync::mpsc::channel(8);
    let listener = TcpListener::bind(("0.0.0.0", PORT)).await?;
    tokio::spawn(async move {
        while let Ok((socket, _)) = listener.accept().await {
            let _ = sender.send(Ok(Socket(socket))).await;
        }
    });
    let store = Unreliable { folder: RedbStore::open(folder)?, rng: ChaCha8Rng::seed_from_u64(seed) };
    let mut config = Config::ephemeral();
    config.store.interval_s = 0.3;
    Ok(serve_on_one_thread(config, predictor(), ReceiverStream::new(connections), Box::new(store)).await?)
}

async fn connect() -> Result<Client, Failure> {
    let connector = tower::service_fn(|_| async { TcpStream::connect(("server", PORT)).await.map(TokioIo::new) });
    let endpoint = Endpoint::from_static("http://server");
    Ok(Client::over(timeout(PATIENCE, endpoint.connect_with_connector(connector)).await??))
}

/// A vehicle that drives once, whatever happens.
struct Vehicle {
    session: &'static str,
    recorded: Rc<Recorded>,
    outbox: Outbox,
    begun: Instant,
    pushed: usize,
    /// The server has said that the session is open, so that it must be there from now on.
    opened: bool,
}

/// What a vehicle and its planner get at the end.
struct Seen {
    session: v1::Session,
    prediction: Prediction,
}

impl Vehicle {
    async fn drive(mut self) -> Result<Seen, Failure> {
        loop {
            match self.connected().await {
                Ok(seen) => return Ok(seen),
                Err(failure) if failure.is::<Violation>() => return Err(failure),
                Err(_) => sleep(Duration::from_millis(100)).await,
            }
        }
    }

    /// Over one connection, until everything is durable.
    async fn connected(&mut self) -> Result<Seen, Failure> {
        let mut client = connect().await?;
        self.enter(&mut client).await?;
        self.outbox.reconnected();
        let mut stream = timeout(PATIENCE, client.measure()).await??;
        loop {
            let driven = self.begun.elapsed().as_nanos() as usize / STEP_NS as usize;
            while self.pushed <= driven.min(LAST) {
                self.outbox.push(sample(self.session, &self.recorded.drive, self.pushed));
                self.pushed += 1;
            }
            let mut sent = 0;
            while sent < BURST
                && let Some(measurement) = self.outbox.next_unsent()
            {
                timeout(PATIENCE, stream.send(measurement)).await??;
                sent += 1;
            }
            for _ in 0..sent {
                let answer = timeout(PATIENCE, stream.answer()).await??.ok_or("the stream ended")?;
                let label = outcome_label(&answer);
                if !["APPLIED", "BUFFERED", "DUPLICATE"].contains(&label) {
                    return Err(Violation(format!("{}: sample {}: {label} {:?}", self.session, answer.sequence, answer.outcome)).into());
                }
                self.outbox.answered(&answer);
            }
            if sent == 0 {
                let session = timeout(PATIENCE, client.session(self.session)).await??;
                self.outbox.durable(session.run, session.durable_place);
                if self.pushed > LAST && self.outbox.is_empty() {
                    let query = candidates(self.session, &self.recorded.drive, LAST, 3, 16);
                    return Ok(Seen { prediction: timeout(PATIENCE, client.predict(query)).await??, session });
                }
                sleep(Duration::from_millis(20)).await;
            }
        }
    }

    /// Opens the session, once.
    async fn enter(&mut self, client: &mut Client) -> Result<(), Failure> {
        let Err(error) = timeout(PATIENCE, client.session(self.session)).await? else { return Ok(()) };
        if error.code() != Some(Code::NotFound) {
            return Err(error.into());
        }
        if self.opened {
            return Err(Violation(format!("{}: the session is gone", self.session)).into());
        }
        let (vehicle_id, map_id) = (self.session.into(), self.recorded.world.id().into());
        let request = v1::OpenSessionRequest { vehicle_id, map_id, ..Default::default() };
        timeout(PATIENCE, client.open_session(request)).await??;
        self.opened = true;
        Ok(())
    }
}

/// What must not happen.
#[derive(Debug)]
struct Violation(String);

impl std::fmt::Display for Violation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl Error for Violation {}

/// Asks for predictions until the vehicles have arrived, and counts those that it gets.
async fn plan(recorded: &Recorded, arrived: &Cell<usize>, got: &Cell<usize>) {
    let query = || candidates(VEHICLES[0], &recorded.drive, 20, 2, 8);
    while arrived.get() < VEHICLES.len() {
        sleep(Duration::from_millis(100)).await;
        let Ok(mut client) = connect().await else { continue };
        while let Ok(answer) = timeout(PATIENCE, client.predict(query())).await {
            match answer {
                Ok(prediction) => got.set(got.get() + usize::from(prediction.states.iter().all(|value| value.is_finite()))),
                // Not open yet, nothing to predict from yet, or the connection is gone.
                Err(error) if [Some(Code::NotFound), Some(Code::FailedPrecondition)].contains(&error.code()) => {}
                Err(_) => break,
            }
            sleep(Duration::from_millis(200)).await;
            if arrived.get() == VEHICLES.len() {
                return;
            }
        }
    }
}

/// What a simulation came to.
struct Run {
    /// What each vehicle has at its end.
    seen: Vec<Seen>,
    /// Starts of the server.
    starts: usize,
    /// That the planner got on the way.
    predictions: usize,
    simulated: Duration,
}

/// One simulation, on a folder that holds the world.
fn simulate(seed: u64, folder: &Path, recorded: &Rc<Recorded>) -> Result<Run, Failure> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let faults = faults(&mut rng);
    let latency_ms = rng.random_range(1..60);
    let starts = Rc::new(Cell::new(0));
    let mut sim = turmoil::Builder::new()
        .rng_seed(seed)
        .tick_duration(TICK)
        .simulation_duration(SIMULATED)
        .min_message_latency(Duration::from_millis(1))
        .max_message_latency(Duration::from_millis(latency_ms))
        .tcp_capacity(4096)
        .enable_random_order()
        .build();
    sim.host("server", || {
        starts.set(starts.get() + 1);
        let (folder, seed) = (folder.to_path_buf(), seed ^ (starts.get() as u64) << 32);
        async move { server(&folder, seed).await }
    });
    let (arrived, got, seen) = (Rc::new(Cell::new(0)), Rc::new(Cell::new(0)), Rc::new(RefCell::new(Vec::new())));
    for session in VEHICLES {
        let (arrived, seen, recorded) = (arrived.clone(), seen.clone(), recorded.clone());
        sim.client(session, async move {
            let vehicle = Vehicle { session, recorded, outbox: Outbox::default(), begun: Instant::now(), pushed: 0, opened: false };
            let arrives = vehicle.drive().await?;
            seen.borrow_mut().push(arrives);
            arrived.set(arrived.get() + 1);
            Ok(())
        });
    }
    sim.client("planner", {
        let (arrived, got, recorded) = (arrived.clone(), got.clone(), recorded.clone());
        async move {
            plan(&recorded, &arrived, &got).await;
            Ok(())
        }
    });
    let mut now = 0;
    // Of faults that overlap the first end ends both.
    let mut begun: Vec<Fault> = Vec::new();
    while !sim.step()? {
        let before = std::mem::replace(&mut now, sim.elapsed().as_millis() as u64);
        for fault in faults.iter().filter(|fault| (before..now).contains(&fault.begins)) {
            fault.begin(&mut sim);
            begun.push(*fault);
        }
        begun.extract_if(.., |fault| fault.ends <= now).for_each(|fault| fault.end(&mut sim));
    }
    let simulated = sim.elapsed();
    drop(sim);
    let seen = Rc::into_inner(seen).ok_or("somebody still drives")?.into_inner();
    Ok(Run { seen, starts: starts.get(), predictions: got.get(), simulated })
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

fn seeds() -> std::ops::Range<u64> {
    let asked = std::env::var("NESAM_SIMULATION_SEEDS").unwrap_or_else(|_| "0..12".into());
    let (first, end) = asked.split_once("..").expect("NESAM_SIMULATION_SEEDS is FIRST..END");
    first.parse().unwrap()..end.parse().unwrap()
}

#[test]
fn simulation_of_crashes_and_networks_loses_nothing() {
    let recorded = Rc::new(recorded());
    let prepared_folder = tempfile::tempdir().unwrap();
    tokio::runtime::Runtime::new().unwrap().block_on(prepared(prepared_folder.path(), &recorded));
    let query = candidates(VEHICLES[0], &recorded.drive, LAST, 3, 16);
    let expected = offline(&recorded, LAST, &query, 31, learned(&recorded, LAST).0);
    let (mut restarts, mut answers) = (0, 0);
    for seed in seeds() {
        let folder = tempfile::tempdir().unwrap();
        for entry in std::fs::read_dir(prepared_folder.path()).unwrap() {
            let file = entry.unwrap().path();
            std::fs::copy(&file, folder.path().join(file.file_name().unwrap())).unwrap();
        }
        let run = simulate(seed, folder.path(), &recorded).unwrap_or_else(|failure| panic!("seed {seed}: {failure}"));
        let Run { seen, starts, predictions, simulated } = run;
        println!("seed {seed}: {starts} starts, {predictions} predictions on the way, {:.1} s", simulated.as_secs_f64());
        assert_eq!(seen.len(), VEHICLES.len(), "seed {seed}");
        for Seen { session, prediction } in &seen {
            assert_eq!(session.accepted, LAST as u64 + 1, "seed {seed}: {}", session.session_id);
            assert_same(prediction, &expected);
        }
        (restarts, answers) = (restarts + starts - 1, answers + predictions);
    }
    assert!(restarts > 0 && answers > 0, "{restarts} restarts, {answers} predictions: nothing was tried");
}
