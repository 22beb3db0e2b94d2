//! Goal: whatever the network does and whenever something dies, no measurement that was called durable is lost and the estimate is that of a drive without
//! failures, bit for bit. Servers, stores and clients are the real ones; network, crashes and time are simulated from a seed, on one thread.
//!
//! `NESAM_SIMULATION_SEEDS=1000..2000 cargo test --release -p nesam-tests --test service_suite simulation` tries others. A failure says its seed.

mod alone;
mod conformance;
pub mod etcd;
mod shared;

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::error::Error;
use std::io;
use std::ops::Range;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll};
use std::time::Duration;

use http::Uri;
use hyper_util::rt::TokioIo;
use nesam_client::{Client, Outbox, Prediction, outcome_label, v1};
use nesam_model::Rollout;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;
use tonic::transport::Endpoint;
use tonic::transport::server::Connected;
use tower::Service;
use turmoil::Sim;
use turmoil::net::{TcpListener, TcpStream};

use crate::stage::*;

type Failure = Box<dyn Error>;

/// Vehicles, each with a session of its name.
const VEHICLES: [&str; 2] = ["s", "t"];
/// Measurements on their way at once.
const BURST: usize = 8;
/// How long a vehicle waits for an answer before it connects again.
const PATIENCE: Duration = Duration::from_millis(1500);
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
    /// A host dies, and starts again on what it had written.
    Crash(&'static str),
    /// Nothing passes between two hosts.
    Cut(&'static str, &'static str),
    /// Nothing passes from the first to the second.
    Deaf(&'static str, &'static str),
    /// What passes between them comes later, all at once.
    Hold(&'static str, &'static str),
}

impl Fault {
    /// Begins within so many ms and takes up to three seconds.
    fn at_random(rng: &mut ChaCha8Rng, within_ms: u64, kind: Kind) -> Self {
        let begins = rng.random_range(0..within_ms);
        Self { begins, ends: begins + rng.random_range(50..3000), kind }
    }

    fn begin(&self, sim: &mut Sim<'_>) {
        match self.kind {
            Kind::Crash(host) => sim.crash(host),
            Kind::Cut(one, other) => sim.partition(one, other),
            Kind::Deaf(from, to) => sim.partition_oneway(from, to),
            Kind::Hold(one, other) => sim.hold(one, other),
        }
    }

    fn end(&self, sim: &mut Sim<'_>) {
        match self.kind {
            Kind::Crash(host) if sim.is_host_running(host) => {}
            Kind::Crash(host) => sim.bounce(host),
            Kind::Cut(one, other) => sim.repair(one, other),
            Kind::Deaf(from, to) => sim.repair_oneway(from, to),
            Kind::Hold(one, other) => sim.release(one, other),
        }
    }
}

/// A network whose messages take up to `latency_ms`.
fn network(seed: u64, latency_ms: u64) -> Sim<'static> {
    turmoil::Builder::new()
        .rng_seed(seed)
        .tick_duration(TICK)
        .simulation_duration(SIMULATED)
        .min_message_latency(Duration::from_millis(1))
        .max_message_latency(Duration::from_millis(latency_ms))
        .tcp_capacity(4096)
        .enable_random_order()
        .build()
}

/// Runs until everybody has arrived, and lets the faults happen. Of faults that overlap the first end ends both.
fn play(sim: &mut Sim<'_>, faults: &[Fault]) -> Result<Duration, Failure> {
    let (mut now, mut begun) = (0, Vec::<Fault>::new());
    while !sim.step()? {
        let before = std::mem::replace(&mut now, sim.elapsed().as_millis() as u64);
        for fault in faults.iter().filter(|fault| (before..now).contains(&fault.begins)) {
            fault.begin(sim);
            begun.push(*fault);
        }
        begun.extract_if(.., |fault| fault.ends <= now).for_each(|fault| fault.end(sim));
    }
    Ok(sim.elapsed())
}

/// A simulated connection as a server takes it.
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

/// Connections to this host, and the task that takes them.
async fn connections() -> Result<(ReceiverStream<io::Result<Socket>>, JoinHandle<()>), Failure> {
    let (sender, connections) = tokio::sync::mpsc::channel(8);
    let listener = TcpListener::bind(("0.0.0.0", PORT)).await?;
    let accepting = tokio::spawn(async move {
        while let Ok((socket, _)) = listener.accept().await {
            let _ = sender.send(Ok(Socket(socket))).await;
        }
    });
    Ok((ReceiverStream::new(connections), accepting))
}

/// The way to a host.
fn connector(host: &'static str) -> impl Service<Uri, Response = TokioIo<TcpStream>, Error = io::Error, Future: Send> + Send {
    tower::service_fn(move |_| async move { TcpStream::connect((host, PORT)).await.map(TokioIo::new) })
}

async fn connect(host: &'static str) -> Result<Client, Failure> {
    Ok(Client::over(timeout(PATIENCE, Endpoint::from_static("http://server").connect_with_connector(connector(host))).await??))
}

/// Owners of sessions as the clients have seen them, at the one time of the simulation.
#[derive(Clone, Debug, Default)]
struct Owners(Rc<RefCell<BTreeMap<String, u64>>>);

impl Owners {
    /// The newest run that anybody has an answer of; an answer to what is asked from now on is of that one or a later one.
    fn newest(&self, session: &str) -> u64 {
        self.0.borrow().get(session).copied().unwrap_or(0)
    }

    /// Takes note of an answer to a question that was asked when `newest` was the newest run.
    fn answered(&self, session: &str, newest: u64, run: u64) -> Result<(), Violation> {
        // 0 = the session has left since.
        if run != 0 && run < newest {
            return Err(Violation(format!("{session}: run {run} answered what was asked after an answer of run {newest}")));
        }
        let mut runs = self.0.borrow_mut();
        let known = runs.entry(session.into()).or_default();
        *known = run.max(*known);
        Ok(())
    }
}

/// The drive that everybody knows, and whom they may ask.
#[derive(Clone)]
struct Scene {
    recorded: Rc<Recorded>,
    /// Last sample that vehicles send.
    last: usize,
    servers: &'static [&'static str],
}

impl Scene {
    /// A connection to one of the servers.
    async fn connect(&self, rng: &mut ChaCha8Rng) -> Result<Client, Failure> {
        connect(self.servers[rng.random_range(0..self.servers.len())]).await
    }
}

/// A vehicle that drives once, whatever happens.
struct Vehicle {
    session: &'static str,
    scene: Scene,
    rng: ChaCha8Rng,
    owners: Owners,
    outbox: Outbox,
    begun: Instant,
    pushed: usize,
    /// A server has said that the session is open, so that it must be there from now on.
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
        let mut client = self.scene.connect(&mut self.rng).await?;
        // Once it is open the stream is the first to ask for it, and meets whatever there is on its way here.
        if !self.opened {
            self.enter(&mut client).await?;
        }
        self.outbox.reconnected();
        let mut stream = timeout(PATIENCE, client.measure()).await??;
        loop {
            let driven = self.begun.elapsed().as_nanos() as usize / STEP_NS as usize;
            while self.pushed <= driven.min(self.scene.last) {
                self.outbox.push(sample(self.session, &self.scene.recorded.drive, self.pushed))?;
                self.pushed += 1;
            }
            let (mut sent, newest) = (0, self.owners.newest(self.session));
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
                self.owners.answered(self.session, newest, answer.run)?;
                self.outbox.answered(&answer);
            }
            if sent == 0 {
                let newest = self.owners.newest(self.session);
                let session = timeout(PATIENCE, client.session(self.session)).await?;
                if self.opened && session.as_ref().is_err_and(|error| error.code() == Some(Code::NotFound)) {
                    return Err(Violation(format!("{}: the session is gone", self.session)).into());
                }
                let session = session?;
                self.owners.answered(self.session, newest, session.run)?;
                self.outbox.durable(session.run, session.durable_place);
                if self.pushed > self.scene.last && self.outbox.is_empty() {
                    let query = candidates(self.session, &self.scene.recorded.drive, self.scene.last, 3, 16);
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
        let (vehicle_id, map_id) = (self.session.into(), self.scene.recorded.world.id().into());
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

/// Asks for predictions from the first vehicle's session.
struct Planner {
    scene: Scene,
    rng: ChaCha8Rng,
    /// From then on nothing fails any more, and who asks is answered, or told to ask again, within the time after it.
    calm: Option<(Duration, Duration)>,
}

impl Planner {
    /// Until the vehicles have arrived; counts what it gets.
    async fn plan(mut self, arrived: &Cell<usize>, got: &Cell<usize>) -> Result<(), Failure> {
        while arrived.get() < VEHICLES.len() {
            sleep(Duration::from_millis(100)).await;
            let Ok(mut client) = self.scene.connect(&mut self.rng).await else { continue };
            // On to another server now and then.
            for _ in 0..self.rng.random_range(1..=8) {
                let asked = turmoil::sim_elapsed().unwrap_or_default();
                let calm = self.calm.filter(|(since, _)| asked > *since).map(|(_, within)| within);
                let query = candidates(VEHICLES[0], &self.scene.recorded.drive, 20, 2, 8);
                let answer = timeout(calm.unwrap_or(PATIENCE), client.predict(query)).await;
                match answer {
                    Ok(Ok(prediction)) => got.set(got.get() + usize::from(prediction.states.iter().all(|value| value.is_finite()))),
                    // Not open yet, or nothing to predict from yet.
                    Ok(Err(error)) if [Some(Code::NotFound), Some(Code::FailedPrecondition)].contains(&error.code()) => {}
                    Ok(Err(_)) => break,
                    Err(_) => match calm {
                        Some(within) => {
                            let (asked_s, within_s) = (asked.as_secs_f64(), within.as_secs_f64());
                            return Err(Violation(format!(
                                "asked after {asked_s:.1} s, when nothing fails any more, and not answered within {within_s} s"
                            ))
                            .into());
                        }
                        None => break,
                    },
                }
                sleep(Duration::from_millis(200)).await;
                if arrived.get() == VEHICLES.len() {
                    return Ok(());
                }
            }
        }
        Ok(())
    }
}

/// The vehicles and their planner in a network, and what they come to.
struct Crew {
    seen: Rc<RefCell<Vec<Seen>>>,
    got: Rc<Cell<usize>>,
}

impl Crew {
    /// Vehicles begin when they are `ready` to.
    fn join(sim: &mut Sim<'_>, scene: &Scene, mut rng: ChaCha8Rng, ready: &Rc<Cell<bool>>, calm: Option<(Duration, Duration)>) -> Self {
        let (arrived, got, seen) = (Rc::new(Cell::new(0)), Rc::new(Cell::new(0)), Rc::new(RefCell::new(Vec::new())));
        let owners = Owners::default();
        for session in VEHICLES {
            let (arrived, seen, ready) = (arrived.clone(), seen.clone(), ready.clone());
            let (scene, owners, rng) = (scene.clone(), owners.clone(), ChaCha8Rng::seed_from_u64(rng.random()));
            sim.client(session, async move {
                while !ready.get() {
                    sleep(Duration::from_millis(20)).await;
                }
                let (outbox, begun) = (Outbox::default(), Instant::now());
                let arrives = Vehicle { session, scene, rng, owners, outbox, begun, pushed: 0, opened: false }.drive().await?;
                seen.borrow_mut().push(arrives);
                arrived.set(arrived.get() + 1);
                Ok(())
            });
        }
        let planner = Planner { scene: scene.clone(), rng, calm };
        let counted = got.clone();
        sim.client("planner", async move { planner.plan(&arrived, &counted).await });
        Self { seen, got }
    }

    /// When the simulation is over: predictions that the planner got on the way. Every vehicle has the session and the prediction of a drive without failures.
    fn check(self, seed: u64, last: usize, expected: &Rollout) -> usize {
        let seen = self.seen.borrow();
        assert_eq!(seen.len(), VEHICLES.len(), "seed {seed}");
        for Seen { session, prediction } in seen.iter() {
            assert_eq!(session.accepted, last as u64 + 1, "seed {seed}: {}", session.session_id);
            assert_same(prediction, expected);
        }
        self.got.get()
    }
}

/// What a vehicle is to get at its end.
fn without_failures(scene: &Scene) -> Rollout {
    let Scene { recorded, last, .. } = scene;
    let query = candidates(VEHICLES[0], &recorded.drive, *last, 3, 16);
    offline(recorded, *last, &query, 31, learned(recorded, *last).0)
}

/// Seeds that are tried when nothing is asked for, or those that are asked for.
fn seeds(usual: Range<u64>) -> Range<u64> {
    let Ok(asked) = std::env::var("NESAM_SIMULATION_SEEDS") else { return usual };
    let (first, end) = asked.split_once("..").expect("NESAM_SIMULATION_SEEDS is FIRST..END");
    first.parse().unwrap()..end.parse().unwrap()
}
