//! `nesam bench wire`: what lies between the engine and a planner, for each way there is.

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use nesam_client::zenoh_vehicle::ZenohVehicle;
use nesam_client::{Candidates, Client, ClientError, Prediction, v1};
use nesam_server::Config;
use serde_json::{Value, json};

use super::{DRIVEN, QUERIES_MAX, percentile, straight_on};
use crate::args::{BundleArgs, check_count};
use crate::commands::serve::start;
use crate::environment::{OF_A_SERVER, restart_with};
use crate::failure::{Failure, OrFail};
use crate::interrupt::exit_on_ctrl_c;
use crate::output::{check_file, provenance_of, say, write_json};
use crate::progress::Progress;
use crate::sources::load_bundle;

/// Options of `nesam bench wire`.
#[derive(Args, Debug)]
pub(super) struct WireBench {
    #[command(flatten)]
    bundle: BundleArgs,
    /// Candidate command sequences per query; 1024 of 32 steps are a reply of 1.6 MB
    #[arg(long, default_value_t = 1024)]
    samples: usize,
    /// Steps per rollout
    #[arg(long, value_name = "STEPS", default_value_t = 32)]
    horizon: usize,
    /// Timed queries on each way, in turns
    #[arg(long, default_value_t = 20)]
    queries: usize,
    /// Write the figures as JSON (schema nesam.bench.wire/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

const FLEET: &str = "wire";
const VEHICLE: &str = "planner";

/// A way from a planner to the engine.
enum Way {
    Grpc(Client),
    Zenoh(ZenohVehicle),
}

impl Way {
    async fn ask(&mut self, question: &Candidates) -> Result<Prediction, ClientError> {
        match self {
            Self::Grpc(client) => client.predict(question.clone()).await,
            Self::Zenoh(vehicle) => vehicle.predict(question).await,
        }
    }
}

/// Runs the command.
pub(super) fn run(args: &WireBench) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| check_file(file))?;
    let limits = Config::ephemeral().limits;
    check_count("--horizon", args.horizon, 1..=limits.horizon_max)?;
    // Both together have a limit too.
    check_count("--samples", args.samples, 1..=limits.samples_max.min(limits.sample_steps_max / args.horizon))?;
    check_count("--queries", args.queries, 1..=QUERIES_MAX)?;
    restart_with(&OF_A_SERVER)?;
    exit_on_ctrl_c("nothing was written");
    let bundle = load_bundle(args.bundle.bundle.as_deref())?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().or_failed()?;
    runtime.block_on(measure(args, bundle))
}

async fn measure(args: &WireBench, bundle: nesam_model::ModelBundle) -> Result<(), Failure> {
    let free = std::net::TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr()).or_failed()?;
    let endpoint = format!("tcp/{free}");
    let mut config = Config::ephemeral();
    config.zenoh.enabled = true;
    config.zenoh.listen = vec![endpoint.clone()];
    config.zenoh.fleet = FLEET.into();
    let (server, bundle) = start(config, bundle).await?;
    let mut client = Client::connect(&format!("http://{}", server.grpc_addr)).await.or_failed()?;
    client.open_session(v1::OpenSessionRequest { vehicle_id: VEHICLE.into(), ..Default::default() }).await.or_failed()?;
    client.feed((0..DRIVEN).map(|i| straight_on(VEHICLE, i)).collect()).await.or_failed()?;
    let mut ways = [
        ("gRPC", Way::Grpc(client)),
        ("Zenoh, socket", Way::Zenoh(ZenohVehicle::connect_through_socket(&endpoint, FLEET, VEHICLE).await.or_failed()?)),
        ("Zenoh, shared memory", Way::Zenoh(ZenohVehicle::connect(&endpoint, FLEET, VEHICLE).await.or_failed()?)),
    ];
    let question = question(args);
    let mut took_ms = [const { Vec::new() }; 3];
    let progress = Progress::start("queries", args.queries);
    for turn in 0..=args.queries {
        for ((_, way), took_ms) in ways.iter_mut().zip(&mut took_ms) {
            let sent = Instant::now();
            let answer = way.ask(&question).await.or_failed()?;
            let between_s = sent.elapsed().as_secs_f64() - answer.queue_s - answer.compute_s;
            // The first turn makes connections and memory ready.
            if turn > 0 {
                took_ms.push(between_s * 1e3);
            }
        }
        progress.set(turn);
    }
    progress.finish();
    server.shutdown().await;
    let reply_bytes = args.samples * args.horizon * nesam_physics::STATE_DIM * size_of::<f32>();
    let request_bytes = args.samples * args.horizon * 2 * size_of::<f32>();
    say!("{} candidates of {} steps: {request_bytes} bytes of commands, {reply_bytes} bytes of states", args.samples, args.horizon);
    say!("between planner and engine, decoded numbers in hand, without the engine's own time; planner and server in one process");
    say!("{:24} {:>8} {:>8} {:>8}", "", "p50 ms", "p99 ms", "least");
    let rows: Vec<Value> = ways
        .iter()
        .zip(&mut took_ms)
        .map(|((name, _), took_ms)| {
            let [least, p50, p99] = [0.0, 0.5, 0.99].map(|q| percentile(took_ms, q));
            say!("{name:24} {p50:>8.2} {p99:>8.2} {least:>8.2}");
            json!({ "way": name, "p50_ms": p50, "p99_ms": p99, "least_ms": least })
        })
        .collect();
    let Some(file) = &args.json else { return Ok(()) };
    let document = json!({
        "schema": "nesam.bench.wire/1", "samples": args.samples, "horizon": args.horizon, "queries": args.queries, "request_bytes": request_bytes,
        "reply_bytes": reply_bytes, "ways": rows, "provenance": provenance_of(Some(&bundle), "", ""),
    });
    write_json(file, &document)
}

fn question(args: &WireBench) -> Candidates {
    let turn = |n: usize| 0.4 * n as f32 / args.samples as f32 - 0.2;
    let controls = (0..args.samples).flat_map(|n| std::iter::repeat_n([2.0, turn(n)], args.horizon).flatten()).collect();
    // States alone, so that the reply has as many bytes as are printed.
    let output = v1::OutputSelection::default();
    Candidates { output, ..Candidates::new(VEHICLE, args.samples, args.horizon, controls) }
}
