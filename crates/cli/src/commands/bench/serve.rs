//! `nesam bench serve`: what planners get from a server that they ask for more than it can give.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clap::Args;
use nesam_client::{Candidates, Client, ClientError, outcome_label, v1};
use nesam_server::Config;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use tokio::time::{sleep_until, timeout};

use super::{DRIVEN, percentile, straight_on};
use crate::args::BundleArgs;
use crate::commands::serve::start;
use crate::environment::{OF_A_SERVER, restart_with};
use crate::failure::{Failure, OrFail};
use crate::interrupt::exit_on_ctrl_c;
use crate::output::{check_file, provenance_of, say, write_json};
use crate::sources::load_bundle;

/// Options of `nesam bench serve`.
#[derive(Args, Debug)]
pub(super) struct ServeBench {
    #[command(flatten)]
    bundle: BundleArgs,
    /// Vehicles, each with a session, a stream of measurements at 10 Hz and a planner
    #[arg(long, default_value_t = 4)]
    vehicles: usize,
    /// Candidate command sequences per query
    #[arg(long, default_value_t = 128)]
    samples: usize,
    /// The first vehicle asks this many times as often as each other one
    #[arg(long, value_name = "FACTOR", default_value_t = 1)]
    greedy: usize,
    /// One more vehicle, which asks for this many candidates again and again, each time when it has the answer and without a deadline [default: none]
    #[arg(long, value_name = "SAMPLES", default_value_t = 0, hide_default_value = true)]
    beside: usize,
    /// Fewest of them that are of use: the server then answers with fewer when time is short [default: all or nothing]
    #[arg(long, value_name = "SAMPLES", default_value_t = 0, hide_default_value = true)]
    samples_min: usize,
    /// Steps per rollout
    #[arg(long, value_name = "STEPS", default_value_t = 32)]
    horizon: usize,
    /// Deadline of a query, ms
    #[arg(long, default_value_t = 200.0)]
    deadline_ms: f64,
    /// Queries asked for, as multiples of what the server answers when four askers wait for each answer before the next question
    #[arg(long, value_name = "FACTOR,…", value_delimiter = ',', default_values_t = [0.5, 1.0, 2.0, 3.0])]
    loads: Vec<f64>,
    /// Duration of each load, s
    #[arg(long, default_value_t = 8.0)]
    seconds: f64,
    /// Seed of the arrivals
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write the figures as JSON (schema nesam.bench.serve/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Askers that measure the capacity.
const ASKERS: usize = 4;
/// Largest number that an option admits: times beyond are none of a machine.
const NUMBER_MAX: f64 = 1e6;

/// What became of the queries of one load.
#[derive(Debug, Default)]
struct Tally {
    /// Latencies of answers in time, of refusals and of the rest, ms.
    good_ms: Vec<f64>,
    refused_ms: Vec<f64>,
    late: usize,
    measured_ms: Vec<f64>,
    measurements_refused: usize,
    /// Samples of the answers in time.
    samples: usize,
    /// Answers in time by vehicle.
    good_of: Vec<usize>,
    /// Latencies of the answers to the vehicle beside them, ms.
    beside_ms: Vec<f64>,
}

/// Runs the command.
pub(super) fn run(args: &ServeBench) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| check_file(file))?;
    let counts = [("--vehicles", args.vehicles), ("--greedy", args.greedy), ("--samples", args.samples), ("--horizon", args.horizon)];
    let times = [("--deadline-ms", args.deadline_ms), ("--seconds", args.seconds)];
    let loads = args.loads.iter().map(|load| ("--loads", *load));
    let mut numbers = counts.map(|(name, count)| (name, count as f64)).into_iter().chain(times).chain(loads);
    if let Some((name, value)) = numbers.find(|(_, value)| !(*value > 0.0 && *value <= NUMBER_MAX)) {
        return Err(Failure::input(format!("{name} must be positive and at most {NUMBER_MAX}, not {value}")));
    }
    restart_with(&OF_A_SERVER)?;
    exit_on_ctrl_c("nothing was written");
    let bundle = load_bundle(args.bundle.bundle.as_deref())?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().or_failed()?;
    runtime.block_on(measure(args, bundle))
}

async fn measure(args: &ServeBench, bundle: nesam_model::ModelBundle) -> Result<(), Failure> {
    let (server, bundle) = start(Config::ephemeral(), bundle).await?;
    let address = format!("http://{}", server.grpc_addr);
    let mut clients = Vec::new();
    // The one beside them is the last.
    for vehicle in 0..args.vehicles + usize::from(args.beside > 0) {
        let mut client = Client::connect(&address).await.or_failed()?;
        let name = name(vehicle);
        client.open_session(v1::OpenSessionRequest { vehicle_id: name.clone(), ..Default::default() }).await.or_failed()?;
        client.feed((0..DRIVEN).map(|i| straight_on(&name, i)).collect()).await.or_failed()?;
        clients.push(client);
    }
    let woken_late = tokio::task::spawn_blocking(|| woken_late(Duration::from_secs(2))).await.or_failed()?;
    let beside = clients.split_off(args.vehicles).pop();
    let capacity_hz = capacity(args, &clients).await?;
    say!(
        "{} candidates of {} steps on flat ground, {} vehicles, deadline {} ms",
        args.samples,
        args.horizon,
        args.vehicles,
        args.deadline_ms
    );
    say!("capacity: {capacity_hz:.1} answers/s to {ASKERS} askers");
    if args.beside > 0 {
        say!("beside them one asks for {} candidates again and again", args.beside);
    }
    say!("this machine, with nothing to do, wakes who sleeps more than 1 ms late in {:.1} of 100 cases", 100.0 * woken_late);
    say!(
        "{:>6} {:>9} {:>11} {:>19} {:>12} {:>9} {:>7} {:>14} {:>28} {:>14} {:>18} {:>18}",
        "load",
        "asked/s",
        "in time/s",
        "of 1st, each other",
        "samples each",
        "refused/s",
        "late/s",
        "p99 in time ms",
        "p50, p99 refused ms, in 1 ms",
        "by the server",
        "p99 measurement ms",
        "beside/s, p50 ms"
    );
    let mut rows = Vec::new();
    for load in &args.loads {
        let before = server.metrics().refusals();
        let mut tally = offer(args, &clients, beside.as_ref(), load * capacity_hz).await?;
        let after = server.metrics().refusals();
        let [refused, at_once] = core::array::from_fn(|i| (after[i] - before[i]) as f64);
        rows.push(row(*load, args.seconds, &mut tally, at_once / refused));
    }
    server.shutdown().await;
    let peak = rows.iter().filter_map(|row| row["in_time_hz"].as_f64()).fold(0.0, f64::max);
    let last = rows.last().and_then(|row| row["in_time_hz"].as_f64()).unwrap_or(0.0);
    say!("goodput at the last load: {:.0} % of the peak", 100.0 * last / peak.max(f64::MIN_POSITIVE));
    let Some(file) = &args.json else { return Ok(()) };
    let document = json!({
        "schema": "nesam.bench.serve/1",
        "samples": args.samples, "samples_min": args.samples_min, "horizon": args.horizon, "vehicles": args.vehicles, "greedy": args.greedy, "beside": args.beside, "deadline_ms": args.deadline_ms, "seconds": args.seconds,
        "woken_1_ms_late": woken_late, "capacity_hz": capacity_hz, "loads": rows, "goodput_share_of_peak": last / peak.max(f64::MIN_POSITIVE),
        "provenance": provenance_of(Some(&bundle), "", ""),
    });
    write_json(file, &document)
}

/// Share of short sleeps that end more than 1 ms late, for so long: what the machine alone may add to a time that is measured.
fn woken_late(time: Duration) -> f64 {
    const SLEEP: Duration = Duration::from_millis(2);
    let (begin, mut sleeps, mut late) = (Instant::now(), 0_u32, 0_u32);
    while begin.elapsed() < time {
        let slept = Instant::now();
        std::thread::sleep(SLEEP);
        sleeps += 1;
        late += u32::from(slept.elapsed() > SLEEP + Duration::from_millis(1));
    }
    f64::from(late) / f64::from(sleeps)
}

fn name(vehicle: usize) -> String {
    format!("vehicle-{vehicle}")
}

fn question(args: &ServeBench, vehicle: usize) -> Candidates {
    Candidates { samples_min: args.samples_min, ..fan(args, vehicle, args.samples) }
}

/// Candidates that turn further and further.
fn fan(args: &ServeBench, vehicle: usize, samples: usize) -> Candidates {
    let controls = (0..samples).flat_map(|n| {
        let second = 0.4 * n as f32 / samples as f32 - 0.2;
        std::iter::repeat_n([2.0, second], args.horizon).flatten()
    });
    Candidates::new(&name(vehicle), samples, args.horizon, controls.collect())
}

/// Answers per second to askers who each wait for an answer before they ask again.
async fn capacity(args: &ServeBench, clients: &[Client]) -> Result<f64, Failure> {
    let mut rates = Vec::new();
    // The first round warms up.
    for _ in 0..2 {
        let (begin, time) = (Instant::now(), Duration::from_secs_f64(args.seconds.min(4.0)));
        let askers = (0..ASKERS).map(|asker| {
            let (mut client, question) = (clients[asker % clients.len()].clone(), question(args, asker % clients.len()));
            tokio::spawn(async move {
                let mut answers = 0_u32;
                while begin.elapsed() < time {
                    client.predict(question.clone()).await?;
                    answers += 1;
                }
                Ok::<_, ClientError>(answers)
            })
        });
        let mut answers = 0;
        for asker in askers.collect::<Vec<_>>() {
            answers += asker.await.or_failed()?.or_failed()?;
        }
        rates.push(f64::from(answers) / begin.elapsed().as_secs_f64());
    }
    rates.pop().ok_or_else(|| Failure::Failed("no capacity was measured".into()))
}

/// Asks at random instants with this mean rate, whatever comes back, while the vehicles report.
async fn offer(args: &ServeBench, clients: &[Client], beside: Option<&Client>, rate_hz: f64) -> Result<Tally, Failure> {
    let tally = Arc::new(Mutex::new(Tally { good_of: vec![0; args.vehicles], ..Tally::default() }));
    let begin = tokio::time::Instant::now();
    let deadline = Duration::from_secs_f64(args.deadline_ms * 1e-3);
    let vehicles: Vec<_> = clients
        .iter()
        .enumerate()
        .map(|(v, client)| tokio::spawn(report(client.clone(), name(v), args.seconds, Arc::clone(&tally))))
        .collect();
    let beside = beside.map(|client| {
        let (client, question) = (client.clone(), fan(args, args.vehicles, args.beside));
        tokio::spawn(ask_again_and_again(client, question, args.seconds, Arc::clone(&tally)))
    });
    let mut random = ChaCha8Rng::seed_from_u64(args.seed);
    let (mut at_s, mut asked) = (0.0, Vec::new());
    while at_s < args.seconds {
        // Of each round the first `greedy` questions are the first vehicle's.
        let vehicle = (asked.len() % (args.greedy + args.vehicles - 1)).saturating_sub(args.greedy - 1);
        let (mut client, question, tally) = (clients[vehicle].clone(), question(args, vehicle), Arc::clone(&tally));
        sleep_until(begin + Duration::from_secs_f64(at_s)).await;
        asked.push(tokio::spawn(async move {
            let sent = Instant::now();
            // The planner's patience is the deadline, however the transport counts it.
            let outcome = timeout(2 * deadline, client.predict_within(question, Some(deadline))).await;
            let took_ms = sent.elapsed().as_secs_f64() * 1e3;
            let Ok(mut tally) = tally.lock() else { return };
            match outcome {
                Ok(Ok(prediction)) if sent.elapsed() <= deadline => {
                    tally.good_ms.push(took_ms);
                    tally.samples += prediction.samples;
                    tally.good_of[vehicle] += 1;
                }
                Ok(Err(error)) if error.retry_after().is_some() => tally.refused_ms.push(took_ms),
                _ => tally.late += 1,
            }
        }));
        at_s -= (1.0 - random.random::<f64>()).ln() / rate_hz;
    }
    for task in asked.into_iter().chain(vehicles) {
        task.await.or_failed()?;
    }
    if let Some(beside) = beside {
        beside.await.or_failed()?.or_failed()?;
    }
    Arc::try_unwrap(tally).ok().and_then(|tally| tally.into_inner().ok()).ok_or_else(|| Failure::Failed("an asker panicked".into()))
}

/// Asks whenever the answer to the last question is there. An error is what is not for want of room.
async fn ask_again_and_again(mut client: Client, question: Candidates, seconds: f64, tally: Arc<Mutex<Tally>>) -> Result<(), ClientError> {
    let begin = Instant::now();
    while begin.elapsed().as_secs_f64() < seconds {
        let sent = Instant::now();
        match client.predict(question.clone()).await {
            Ok(_) => {
                let Ok(mut tally) = tally.lock() else { return Ok(()) };
                tally.beside_ms.push(sent.elapsed().as_secs_f64() * 1e3);
            }
            Err(error) => tokio::time::sleep(error.retry_after().ok_or(error)?).await,
        }
    }
    Ok(())
}

/// Streams measurements at 10 Hz to a copy of the session, so that every load begins alike.
async fn report(mut client: Client, session: String, seconds: f64, tally: Arc<Mutex<Tally>>) {
    let copy = format!("{session}-now");
    let _ = client.close_session(&copy).await;
    let Ok(_) = client.fork_session(&session, &copy).await else { return };
    let Ok(mut stream) = client.measure().await else { return };
    let begin = tokio::time::Instant::now();
    for i in 0..(10.0 * seconds) as i64 {
        sleep_until(begin + Duration::from_millis(100 * i as u64)).await;
        let sent = Instant::now();
        let Ok(answer) = stream.exchange(straight_on(&copy, DRIVEN + i)).await else { return };
        let Ok(mut tally) = tally.lock() else { return };
        tally.measured_ms.push(sent.elapsed().as_secs_f64() * 1e3);
        tally.measurements_refused += usize::from(outcome_label(&answer) == "REJECTED");
    }
}

/// `at_once_inside`: share of the refusals that took the server itself at most 1 ms; the rest of the way there and back is its asker's.
fn row(load: f64, seconds: f64, tally: &mut Tally, at_once_inside: f64) -> Value {
    let rate = |count: usize| count as f64 / seconds;
    let quantile = |times: &mut Vec<f64>, q| if times.is_empty() { f64::NAN } else { percentile(times, q) };
    let asked = tally.good_ms.len() + tally.refused_ms.len() + tally.late;
    let (good, refused, late) = (rate(tally.good_ms.len()), rate(tally.refused_ms.len()), rate(tally.late));
    let (good_ms, measured_ms) = (quantile(&mut tally.good_ms, 0.99), quantile(&mut tally.measured_ms, 0.99));
    let [refused_p50_ms, refused_ms] = [0.5, 0.99].map(|q| quantile(&mut tally.refused_ms, q));
    let at_once = tally.refused_ms.iter().filter(|ms| **ms <= 1.0).count() as f64 / tally.refused_ms.len() as f64;
    let samples = tally.samples as f64 / tally.good_ms.len() as f64;
    let good_of: Vec<f64> = tally.good_of.iter().map(|count| rate(*count)).collect();
    let others = good_of[1..].iter().sum::<f64>() / (good_of.len() - 1) as f64;
    let each = format!("{:.1}, {others:.1}", good_of[0]);
    let (refusals, inside) = if tally.refused_ms.is_empty() {
        ("-".into(), "-".into())
    } else {
        (format!("{refused_p50_ms:.2}, {refused_ms:.2}, {:.1} %", 100.0 * at_once), format!("{:.1} %", 100.0 * at_once_inside))
    };
    let (beside_hz, beside_ms) = (rate(tally.beside_ms.len()), quantile(&mut tally.beside_ms, 0.5));
    let beside = if tally.beside_ms.is_empty() { "-".into() } else { format!("{beside_hz:.1}, {beside_ms:.0}") };
    say!(
        "{load:>6.2} {:>9.1} {good:>11.1} {each:>19} {samples:>12.1} {refused:>9.1} {late:>7.1} {good_ms:>14.1} {refusals:>28} {inside:>14} {measured_ms:>18.1} {beside:>18}",
        rate(asked)
    );
    json!({
        "load": load, "asked_hz": rate(asked), "in_time_hz": good, "in_time_hz_by_vehicle": good_of, "samples_mean": samples, "refused_hz": refused,
        "late_hz": late, "in_time_p99_ms": good_ms, "refused_p50_ms": refused_p50_ms, "refused_p99_ms": refused_ms, "refused_within_1_ms": at_once, "refused_within_1_ms_inside": at_once_inside, "measurement_p99_ms": measured_ms,
        "beside_hz": beside_hz, "beside_p50_ms": beside_ms,
        "measurements": tally.measured_ms.len(), "measurements_refused": tally.measurements_refused,
    })
}
