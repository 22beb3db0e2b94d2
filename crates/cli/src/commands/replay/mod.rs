//! `nesam replay`: a recorded run again, answer by answer; or recorded drives over a bad link.

mod degrade;
mod recording;

use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::str::FromStr;

use clap::{ArgAction, Args};

use crate::args::{BundleArgs, DataArgs, TruthArg};
use crate::failure::Failure;
use crate::output;

/// Options of `nesam replay`.
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub struct ReplayArgs {
    /// Recordings: their .mcap files, or folders that hold them; each start of a server began one
    #[arg(value_name = "FILE.mcap|DIR", conflicts_with = "degrade")]
    recording: Vec<PathBuf>,
    #[command(flatten)]
    bundle: BundleArgs,
    /// Replay with another bundle than the recorded one: every prediction will differ, but it shows whether anything fails
    #[arg(long)]
    force: bool,
    /// Also write the result as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Drive recorded drives (--data, --set) through the service as over a bad link with poor sensors; can be given several times
    #[arg(long, value_name = "SPEC", num_args = 0..=1, default_missing_value = "all", action = ArgAction::Append)]
    degrade: Vec<String>,
    #[command(flatten)]
    data: DataArgs,
    /// Use every N-th drive by name
    #[arg(long, value_name = "N", default_value = "1", value_parser = NonZeroUsize::from_str)]
    every: NonZeroUsize,
    /// Steps to predict [default: 32, or what the longest drive allows]
    #[arg(long, value_name = "STEPS")]
    horizon: Option<usize>,
    /// Score against the noise-free channels, where a set has them
    #[arg(long, value_name = "CHANNELS", value_enum, default_value_t = TruthArg::Measured)]
    truth: TruthArg,
    /// Seed of the degradation and of the bootstrap
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

const EXAMPLES: &str = "A recording (nesam serve --record DIR) holds every command that the server executed, with its instant, and every
answer. Replay executes the commands on a fresh engine and compares all answers bit for bit; only the times that the server waited
and computed are left aside. What a killed server has left is replayed as far as it goes. The bundle is found by its
hash in deploy/bundles; give another place with --bundle.

SPEC of --degrade: `all` (also without SPEC), `none`, or keys with or without a value, separated by commas:
  jitter=10ms       mean of the exponential delay of each message
  stamp=2ms         standard deviation of the error of each stamp
  loss=0.05         probability that a message is lost
  reorder=0.1       probability that a message is overtaken by the next one
  clock-step=0.5s   the vehicle's clock runs ahead by this in the middle third of the drive
  imu=200hz         states at this rate, interpolated between the samples, with the errors of an inertial sensor:
    gyro-bias=0.005 velocity-bias=0.02      constant along a drive, standard deviation over drives, rad/s and m/s
    gyro-noise=0.005 velocity-noise=0.02    coloured noise, standard deviation, rad/s and m/s
    noise-time=1s                           time in which it forgets itself
`all` is jitter, loss, reorder, clock-step and imu. The same seed gives the same messages.

Examples:
  nesam replay recordings                     all recordings in this folder, one after the other
  nesam replay run.0001.mcap --json out.json
  nesam replay --data ROOT --set NAME --degrade
  nesam replay --data ROOT --set NAME --degrade loss=0.05 --degrade imu,loss=0.05

Exit codes: 0 all answers equal, 1 an answer differs, the file is damaged or was cut off before its first answer, 2 not a recording or
not its bundle.";

/// Runs the command.
pub fn run(args: &ReplayArgs) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| output::check_file(file))?;
    if !args.degrade.is_empty() {
        return degrade::run(args);
    }
    if args.recording.is_empty() {
        return Err(Failure::input(
            "nothing to replay: give the files or the folder that `nesam serve --record DIR` wrote, or --degrade with --data and --set",
        ));
    }
    recording::run(args)
}
