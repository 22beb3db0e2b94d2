//! The command line: names, one-line purposes, examples.

use clap::builder::ValueParser;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use nesam_model::ModelBundle;

use crate::bundle_path::default_bundle;
use crate::commands;
use crate::failure::Failure;
use crate::output::{check_printed, note, say, shell_line};

/// Predicts how an off-road vehicle will move over deformable ground, as a service for planners.
///
/// The model joins Bekker-Wong terramechanics with a Transformer; it is shipped as a bundle. Commands read drives from a data root
/// (without --data: the sample in the repository) and write JSON and HTML where you say (`-` is standard output).
#[derive(Parser, Debug)]
#[command(name = "nesam", disable_version_flag = true, after_help = EXAMPLES, max_term_width = 110)]
struct Cli {
    /// Print the version and the hash of the shipped bundle
    #[arg(short = 'V', long)]
    version: bool,
    #[command(subcommand)]
    command: Option<Command>,
}

const EXAMPLES: &str = "Examples:
  nesam demo                                  the whole loop: server, drive, planner, live table
  nesam evaluate --set nominal --split test   score the shipped model against measured drives
  nesam evaluate --data ROOT --set NAME --html report.html
  nesam diagnose --data ROOT --set NAME       which physical effect does the model lack here?
  nesam adapt --data ROOT --set NAME          what learning the soil while driving gains there
  nesam predict --trajectory n0005 --at 6.2   one rollout as JSON
  nesam serve                                 answer planners and vehicles until interrupted
  nesam serve --record DIR                    the same, and write all of it down
  nesam replay DIR                            does it give the same answers here, bit for bit?
  nesam bench predict                         milliseconds per planner query on this machine
  nesam import LOG.csv --to ROOT --set NAME --vehicle CARD.json
  nesam calibrate --data ROOT --set NAME      the card of a vehicle fitted to its logs
  nesam inspect deploy/bundles/NAME           what a bundle holds and where it comes from
  nesam check ROOT                            what is wrong with a data root, bundle or configuration; do units and frames fit?

Exit codes: 0 done, 1 failed, 2 wrong usage or input. `nesam COMMAND --help` explains one command.";

#[derive(Subcommand, Debug)]
enum Command {
    /// Show the whole loop: real server, recorded drive, planner, live table
    Demo(commands::demo::DemoArgs),
    /// Answer planners over gRPC and vehicles over gRPC and Zenoh until interrupted
    Serve(commands::serve::ServeArgs),
    /// Write the configuration of a Zenoh router that lets each member of a fleet use its own keys only
    RouterConfig(commands::router_config::RouterConfigArgs),
    /// Score models against measured drives, with intervals and plots
    Evaluate(commands::evaluate::EvaluateArgs),
    /// Find the effects that the model lacks, and try them on other drives
    Diagnose(commands::diagnose::DiagnoseArgs),
    /// Put effects on a session of a running server, take them away, list them with the active alarms; write some into a bundle
    Effects(commands::effects::EffectsArgs),
    /// Learn the soil while driving: fixed against adapted predictions on measured drives
    Adapt(commands::adapt::AdaptArgs),
    /// Start on ground that another vehicle has driven: with its soil map against without
    Fleet(commands::fleet::FleetArgs),
    /// Drive laps in closed loop on a simulated vehicle: fixed against adapted soil, an oracle and a kinematic model
    Navigate(commands::navigate::NavigateArgs),
    /// The simulated vehicle of `navigate`: compare it with recorded drives, write drives with hidden effects, let it answer over UDP
    Plant(commands::plant::PlantArgs),
    /// Predict once from an instant of a recorded drive: JSON, CSV or plots
    Predict(commands::predict::PredictArgs),
    /// Repeat a recorded run and compare every answer, or drive recorded drives through a bad radio link
    Replay(commands::replay::ReplayArgs),
    /// Fit the card of a vehicle to its logs, with the physics alone: drive line, contact law, suspension
    Calibrate(commands::calibrate::CalibrateArgs),
    /// Train a bundle on the train split of a set
    Train(commands::train::TrainArgs),
    /// Compare the physics inside with what a simulator says of wheels and soil
    Inside(commands::inside::InsideArgs),
    /// Measure what answers cost on this machine
    Bench(commands::bench::BenchArgs),
    /// Turn logs of other tools (CSV, ROS 2 bags) into a set of a data root: columns, units, frames, gaps
    Import(commands::import::ImportArgs),
    /// Say what a bundle or a data root holds
    Inspect(commands::inspect::InspectArgs),
    /// Say what is wrong with a data root, a bundle or a configuration
    Check(commands::check::CheckArgs),
}

/// Parses the arguments and runs the command, whose results must have been printed whole.
pub fn run() -> Result<(), Failure> {
    let cli = Cli::from_arg_matches(&arguments().get_matches()).unwrap_or_else(|error| error.exit());
    if cli.version {
        say!("{}", version());
    } else {
        command(cli.command)?;
    }
    check_printed()
}

/// The command line. A negative number behind an option is its value, so that who refuses it can name the option.
fn arguments() -> clap::Command {
    fn take_negative_numbers(command: clap::Command) -> clap::Command {
        let taking = |arg: clap::Arg| {
            let is_option = arg.get_long().is_some() && arg.get_action().takes_values();
            if is_option { arg.allow_negative_numbers(true) } else { arg }
        };
        command.mut_args(taking).mut_subcommands(take_negative_numbers)
    }
    take_negative_numbers(Cli::command())
}

/// The command line as it was typed, without the paths of this machine: what stands in a bundle, so that the same work in another folder makes the same bytes.
pub fn command_without_paths() -> String {
    let words: Vec<String> = std::env::args().skip(1).collect();
    shell_line(without_paths(&words).into_iter())
}

/// The words of a command line with `…` in the place of every value that is a path.
fn without_paths(words: &[String]) -> Vec<String> {
    const HIDDEN: &str = "…";
    let is_path = |arg: &clap::Arg| arg.get_value_parser().type_id() == ValueParser::path_buf().type_id();
    let program = arguments();
    let mut command = &program;
    // The option whose value comes next.
    let mut open: Option<&clap::Arg> = None;
    let mut kept = Vec::with_capacity(words.len());
    for word in words {
        if let Some(option) = word.strip_prefix("--") {
            let (name, value) = option.split_once('=').map_or((option, None), |(name, value)| (name, Some(value)));
            let arg = command.get_arguments().find(|arg| arg.get_long() == Some(name) && arg.get_action().takes_values());
            open = arg.filter(|_| value.is_none());
            let hides = value.is_some() && arg.is_some_and(is_path);
            kept.push(if hides { format!("--{name}={HIDDEN}") } else { word.clone() });
        } else if let Some(arg) = open {
            open = open.filter(|arg| arg.get_num_args().is_some_and(|count| count.max_values() > 1));
            kept.push(if is_path(arg) { HIDDEN.into() } else { word.clone() });
        } else if let Some(inner) = command.find_subcommand(word) {
            command = inner;
            kept.push(word.clone());
        } else {
            kept.push(if command.get_positionals().any(is_path) { HIDDEN.into() } else { word.clone() });
        }
    }
    kept
}

fn command(command: Option<Command>) -> Result<(), Failure> {
    match command {
        None => {
            note!("{}", Cli::command().render_help());
            Err(Failure::input("no command given"))
        }
        Some(Command::Demo(args)) => commands::demo::run(&args),
        Some(Command::Serve(args)) => commands::serve::run(&args),
        Some(Command::RouterConfig(args)) => commands::router_config::run(&args),
        Some(Command::Evaluate(args)) => commands::evaluate::run(&args),
        Some(Command::Diagnose(args)) => commands::diagnose::run(&args),
        Some(Command::Effects(args)) => commands::effects::run(&args),
        Some(Command::Adapt(args)) => commands::adapt::run(&args),
        Some(Command::Fleet(args)) => commands::fleet::run(&args),
        Some(Command::Navigate(args)) => commands::navigate::run(&args),
        Some(Command::Plant(args)) => commands::plant::run(&args),
        Some(Command::Predict(args)) => commands::predict::run(&args),
        Some(Command::Replay(args)) => commands::replay::run(&args),
        Some(Command::Calibrate(args)) => commands::calibrate::run(&args),
        Some(Command::Train(args)) => commands::train::run(&args),
        Some(Command::Inside(args)) => commands::inside::run(&args),
        Some(Command::Bench(args)) => commands::bench::run(&args),
        Some(Command::Import(args)) => commands::import::run(&args),
        Some(Command::Inspect(args)) => commands::inspect::run(&args),
        Some(Command::Check(args)) => commands::check::run(&args),
    }
}

fn version() -> String {
    let bundle = default_bundle().and_then(|dir| {
        let name = dir.file_name()?.to_string_lossy().into_owned();
        Some(format!("bundle {name} {}", ModelBundle::hash_of(&dir)?))
    });
    format!("nesam {}\n{}", env!("CARGO_PKG_VERSION"), bundle.unwrap_or_else(|| "no bundle found".into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: a bundle names the command that made it and none of this machine's folders. Method: options with and without `=`, several values, places of their own and flags.
    #[test]
    fn regress_paths_of_a_command_line_are_left_out() {
        let kept = |line: &str| without_paths(&line.split(' ').map(String::from).collect::<Vec<_>>()).join(" ");
        for (line, expected) in [
            (
                "diagnose --data /home/me/root --set a/b --fit-on x,y --no-controls --out found --json=d.json",
                "diagnose --data … --set a/b --fit-on x,y --no-controls --out … --json=…",
            ),
            ("diagnose --recording a.mcap b.mcap --session s --seed 3", "diagnose --recording … … --session s --seed 3"),
            ("effects write --file e.toml --to new --bundle old", "effects write --file … --to … --bundle …"),
            ("replay recordings --force", "replay … --force"),
        ] {
            assert_eq!(kept(line), expected);
        }
    }

    /// Goal: a wrong number is refused by the name of its option. Method: negative numbers, too much history and a name too few, with a space and with `=`.
    #[test]
    fn regress_wrong_values_are_refused_by_the_name_of_their_option() {
        arguments().debug_assert();
        let refused = |words: &[&str]| {
            let words = [&["nesam"], words].concat();
            let parsed = arguments().try_get_matches_from(words).and_then(|matches| Cli::from_arg_matches(&matches));
            parsed.expect_err("a wrong value").to_string()
        };
        for (words, told) in [
            (&["evaluate", "--horizon", "-1"][..], ["'--horizon <STEPS>'", "at least 1"]),
            (&["evaluate", "--horizon=-1"], ["'--horizon <STEPS>'", "at least 1"]),
            (&["evaluate", "--history", "33"], ["'--history <STEPS>'", "32 steps at most"]),
            (&["evaluate", "--trajectories", "n0005,"], ["'--trajectories <ID,…>'", "empty name in --trajectories"]),
            (&["navigate", "--runs", "-3"], ["'--runs <RUNS>'", "invalid"]),
            (&["bench", "predict", "--queries", "-3"], ["'--queries <QUERIES>'", "invalid"]),
        ] {
            let said = refused(words);
            assert!(told.iter().all(|part| said.contains(part)), "{words:?}: {said}");
        }
        let at = arguments().try_get_matches_from(["nesam", "predict", "--at", "-1"]);
        assert!(at.is_ok(), "the drive says whether it has such an instant");
    }
}
