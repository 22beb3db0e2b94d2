//! `nesam bench`: what answers cost on this machine, whether the soil filter knows how wrong it is, how often sessions alarm, and how often a
//! diagnosis is right.

mod alarms;
mod consistency;
mod discovery;
mod page;
mod plant;
mod predict;
mod serve;
mod sweep;
mod wire;

use clap::{Args, Subcommand};
use nesam_client::{measurement, v1};

use crate::failure::Failure;

/// Options of `nesam bench`.
#[derive(Args, Debug)]
pub struct BenchArgs {
    #[command(subcommand)]
    what: Bench,
}

#[derive(Subcommand, Debug)]
enum Bench {
    /// Time the queries of a sampling planner, in process and end to end
    Predict(predict::PredictBench),
    /// Simulate drives on known soils and hold what the soil filter says of its errors against them (NEES, NIS, coverage)
    Consistency(consistency::ConsistencyBench),
    /// Count the alarms of sessions on drives without a change and, with --hide, on drives that change midway
    Alarms(alarms::AlarmBench),
    /// Hide effects in validation drives and score what a diagnosis makes of them
    Discovery(discovery::DiscoveryBench),
    /// Hide effects of several sizes in drives of the simulated vehicle and hold what a diagnosis finds against them
    Plant(plant::PlantBench),
    /// Ask a real server for more than it can give, at random instants, and count what comes in time
    Serve(serve::ServeBench),
    /// Time what lies between the engine and a planner: gRPC, Zenoh through a socket, Zenoh through shared memory
    Wire(wire::WireBench),
}

/// Queries at most.
const QUERIES_MAX: usize = 1_000_000;
/// Measurements of a bench's vehicle before its first query.
const DRIVEN: i64 = 40;

/// Runs the command.
pub fn run(args: &BenchArgs) -> Result<(), Failure> {
    match &args.what {
        Bench::Predict(args) => predict::run(args),
        Bench::Consistency(args) => consistency::run(args),
        Bench::Alarms(args) => alarms::run(args),
        Bench::Discovery(args) => discovery::run(args),
        Bench::Plant(args) => plant::run(args),
        Bench::Serve(args) => serve::run(args),
        Bench::Wire(args) => wire::run(args),
    }
}

/// A measurement of a vehicle that drives straight on.
fn straight_on(session: &str, i: i64) -> v1::Measurement {
    let state = [0.2 * i as f64, 0.0, 0.6, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    v1::Measurement { sequence: i as u64 + 1, ..measurement(session, i * 100_000_000, state, [2.0, 0.0]) }
}

/// Value below which a share of the values lies, by rank.
fn percentile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() as f64 * share).ceil() as usize).clamp(1, values.len()) - 1]
}
