//! `nesam demo`: the whole loop on one machine, nothing simulated but the vehicle, which is a recorded one.
//!
//! The real server starts on loopback. A vehicle task publishes the drive's measurements over Zenoh at the pace at which they were recorded; a
//! planner task asks the server over gRPC for 64 candidates of 3.2 s in every cycle. What was predicted for the commands that the
//! driver then gave is compared with what the vehicle then measured; the live page shows it all. At the end, drives of a vehicle that was changed are diagnosed.

mod diagnosis;
mod ledger;
mod planner;
mod stage;
mod summary;
mod vehicle;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;

use crate::args::{BundleArgs, DataArgs, SplitArg};
use crate::failure::{Failure, OrFail};
use crate::output::{self, say};
use crate::sources::{Drives, check_model_step, load_bundle_for, read_drives};

use stage::{Played, Stage};

/// Options of `nesam demo`.
#[derive(Args, Debug)]
pub struct DemoArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    bundle: BundleArgs,
    /// Drive to play [default: the first test drive of the set]
    #[arg(long, value_name = "ID")]
    trajectory: Option<String>,
    /// Speed of the playback, 1 = as recorded
    #[arg(long, default_value_t = 1.0, value_parser = rate)]
    rate: f64,
    /// Seconds of the drive to play [default: all]
    #[arg(long, value_name = "SECONDS", value_parser = positive_seconds)]
    seconds: Option<f64>,
    /// Play without pauses: the vehicle waits for the planner, which plans twice per second of the drive
    #[arg(long)]
    fast: bool,
    /// Do not diagnose the drives of changed vehicles (sets `effect_open/*` of the data root) at the end
    #[arg(long)]
    no_diagnosis: bool,
    /// Address of the live page [default: a free port of this machine]
    #[arg(long, value_name = "ADDRESS:PORT")]
    http: Option<SocketAddr>,
    /// Keep the live page up at the end, until interrupted
    #[arg(long)]
    hold: bool,
    /// Also write the summary as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if (0.1..=10.0).contains(&rate) => Ok(rate),
        _ => Err("must be a number from 0.1 to 10".into()),
    }
}

fn positive_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds.is_finite() && seconds > 0.0 => Ok(seconds),
        _ => Err("must be a number of seconds above 0".into()),
    }
}

/// Runs the command.
pub fn run(args: &DemoArgs) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| output::check_file(file))?;
    let mut data = args.data.clone();
    if let Some(id) = &args.trajectory {
        data.trajectories = Some(vec![id.clone()]);
    }
    let drives = read_drives(&data, false)?;
    let bundle = load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?;
    check_model_step(&bundle, args.data.dt)?;
    let stage = stage_of(args, &drives)?;
    if !bundle.is_of(drives.root.vehicle()) {
        return Err(Failure::input(format!(
            "bundle {} was trained for `{}`, the drive is of `{}`",
            bundle.name,
            bundle.vehicle.name,
            drives.root.vehicle().name
        )));
    }
    crate::logging::log_to_stderr("warn");
    let provenance = output::provenance(Some(&bundle), &drives);
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().or_failed()?;
    let Played { summary, server, interrupted } = runtime.block_on(stage.play(bundle.clone()))?;
    let is_interrupted = interrupted.is_finished();
    summary.print();
    let diagnoses = if args.no_diagnosis || is_interrupted {
        Vec::new()
    } else {
        diagnosis::close_the_loop(&bundle, &drives, &args.data, &|report| server.show_diagnosis(report))?
    };
    if let Some(file) = &args.json {
        output::write_file(file, summary.to_json(&diagnoses, &provenance).as_bytes())?;
    }
    if args.hold && !is_interrupted {
        say!("\nthe live page stays until ctrl-c");
        // It may have come during the diagnosis.
        let _ = runtime.block_on(interrupted);
    }
    runtime.block_on(server.shutdown());
    Ok(())
}

fn stage_of(args: &DemoArgs, drives: &Drives) -> Result<Stage, Failure> {
    let is_test = |i: &usize| drives.drives[*i].split == Some(nesam_trajectories::Split::Test);
    let at = if args.data.split == SplitArg::All { (0..drives.drives.len()).find(is_test).unwrap_or(0) } else { 0 };
    let drive = drives.drives[at].clone();
    let asked = args.seconds.map_or(usize::MAX, |s| ((s / drive.dt_s).round() as usize).saturating_add(1));
    let samples = drive.states.len().min(asked);
    if samples <= planner::HORIZON {
        let shortest = planner::HORIZON as f64 * drive.dt_s;
        return Err(Failure::input(format!(
            "drive `{}` is played for {samples} samples; predictions need more than {shortest:.1} s",
            drive.id
        )));
    }
    Ok(Stage { drive: Arc::new(drive), map: drives.maps[at].clone(), samples, rate: args.rate, fast: args.fast, http: args.http })
}
