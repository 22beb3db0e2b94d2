//! `nesam import`: a log of another tool becomes a set of a data root.

mod page;

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use nesam_import::{CONVERT, Drive, FrameConvention, Mapping, Options, Topics, doubts, drives, read_bag, read_csv, write_set};
use nesam_trajectories::{DataRoot, SetQuery, Trajectory, read_vehicle_card};

use crate::bundle_path::inside_bundle;
use crate::failure::{Failure, OrFail};
use crate::output::{check_apart, check_file, say, set_exists, write_file};

/// Options of `nesam import`.
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub struct ImportArgs {
    /// CSV tables and ROS 2 bags (MCAP files, or the folders of `ros2 bag record` with their parts); each is a drive or, with a column `trajectory`, several
    #[arg(value_name = "LOG", required = true)]
    logs: Vec<PathBuf>,
    /// Data root to write into; made where there is none
    #[arg(long, value_name = "ROOT")]
    to: PathBuf,
    /// Set to write; it must not exist
    #[arg(long, value_name = "NAME")]
    set: String,
    /// Vehicle card; copied into a data root that has none
    #[arg(long, value_name = "FILE")]
    vehicle: Option<PathBuf>,
    /// Which column is what, in which unit, with which sign; may be given several times
    #[arg(long, value_name = "TARGET=[-]COLUMN[:UNIT]", allow_hyphen_values = true)]
    column: Vec<String>,
    /// File with one such line per column
    #[arg(long, value_name = "FILE")]
    columns: Option<PathBuf>,
    /// Axes of the log
    #[arg(long, value_enum, default_value_t = FrameArg::EnuFlu)]
    frame: FrameArg,
    /// Do without heights, roll and pitch that the log does not have: they are not written, taken for zero, on level ground, and not scored
    #[arg(long)]
    flat: bool,
    /// World map of the drives, a folder in ROOT/worlds [default: none, flat ground and the default soil]
    #[arg(long, value_name = "ID")]
    world: Option<String>,
    /// Split that the drives belong to [default: none]
    #[arg(long, value_parser = ["train", "test"])]
    split: Option<String>,
    /// Topic of the odometry in a bag [default: the only one]
    #[arg(long, value_name = "TOPIC")]
    odometry: Option<String>,
    /// Topic of the commands in a bag [default: the only one]
    #[arg(long, value_name = "TOPIC")]
    command: Option<String>,
    /// Topic of a gyro in a bag [default: the twist of the odometry]
    #[arg(long, value_name = "TOPIC")]
    imu: Option<String>,
    /// Write the plots of the drives here instead [default: import.html in the set's folder]
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
}

/// Logs that are measured less often are doubted: the model steps at 10 Hz, and stamps tremble.
const RATE_MIN_HZ: f64 = 9.0;

const EXAMPLES: &str =
    "Columns of a data root (TARGET): t x y z, roll pitch yaw or qx qy qz qw, cmd_speed, and cmd_steer, cmd_road_wheel_angle or
cmd_yaw_rate as the card says; where measured vbx vby vbz or vx vy vz, wx wy wz, om_fl om_fr om_rl om_rr or om_l om_r,
steer_fl steer_fr; trajectory where one file has several drives.

Examples:
  nesam import run.csv --to mine --set first --vehicle card.json
  nesam import run.csv --to mine --set first --vehicle card.json --column t=stamp:ns --column yaw=heading:deg
  nesam import bag --to mine --set bags --vehicle card.json --command /cmd_vel
  nesam check mine && nesam diagnose --data mine --set first";

/// Axes of a log.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum FrameArg {
    /// x east, y north, z up; body x forward, y left, z up (ROS)
    EnuFlu,
    /// x north, y east, z down; body x forward, y right, z down (PX4, ArduPilot)
    NedFrd,
}

/// Runs the command.
pub fn run(args: &ImportArgs) -> Result<(), Failure> {
    let folder = target(args)?;
    args.html.iter().try_for_each(|file| check_file(file))?;
    args.html.iter().flat_map(|html| args.logs.iter().map(move |log| [html, log])).try_for_each(check_apart)?;
    let lines = match &args.columns {
        Some(file) => std::fs::read_to_string(file).map_err(|e| Failure::input(format!("{}: {e}", file.display())))?,
        None => String::new(),
    };
    let mapping = Mapping::parse(lines.lines().chain(args.column.iter().map(String::as_str))).or_input()?;
    let mut all: Vec<Drive> = Vec::new();
    for log in &args.logs {
        let found = read(args, log, &mapping)?;
        all.extend(found);
    }
    let card = card(args)?;
    let made = make(&folder)?;
    if let Err(failure) = write(args, &folder, &all, card) {
        // What cannot be read again is no set. Of the folders above it those go that were made for it and hold nothing else.
        let _ = std::fs::remove_dir_all(&folder);
        made.iter().all(|dir| std::fs::remove_dir(dir).is_ok());
        return Err(failure);
    }
    say!("{} drives in {}", all.len(), folder.display());
    Ok(())
}

/// Makes the folder of a set, which nobody else may have made meanwhile; gives those above it that were made, from below.
fn make(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let failed = |e: std::io::Error| Failure::input(format!("cannot make the folder {}: {e}", folder.display()));
    let above = folder.ancestors().skip(1).take_while(|dir| !dir.as_os_str().is_empty() && !dir.exists()).map(PathBuf::from).collect();
    std::fs::create_dir_all(folder.parent().unwrap_or(folder)).map_err(failed)?;
    match std::fs::create_dir(folder) {
        Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => Err(set_exists(folder)),
        made => made.map_err(failed).map(|()| above),
    }
}

/// Writes the set, judges it, and puts the card into a data root that has none.
fn write(args: &ImportArgs, folder: &Path, drives: &[Drive], card: Option<&Path>) -> Result<(), Failure> {
    let notes = write_set(folder, drives, args.world.as_deref(), args.split.as_deref()).or_input()?;
    notes.iter().for_each(|note| say!("  note: {note}"));
    judge(args, card, &args.html.clone().unwrap_or_else(|| folder.join("import.html")))?;
    card.map_or(Ok(()), |card| put_card(args, card))
}

/// The folder of the new set.
fn target(args: &ImportArgs) -> Result<PathBuf, Failure> {
    let plain =
        |part: &str| !part.is_empty() && !part.starts_with('.') && part.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c));
    if !args.set.split('/').all(plain) || args.set == "worlds" {
        return Err(Failure::input(format!("--set {}: letters, digits, _ - . and / between them are allowed, and not `worlds`", args.set)));
    }
    let folder = args.to.join(&args.set);
    if inside_bundle(&folder) {
        return Err(Failure::input(format!("--to {} lies in a bundle, which no command may change", args.to.display())));
    }
    if folder.exists() {
        return Err(set_exists(&folder));
    }
    if let Some(world) = args.world.as_ref().filter(|world| !args.to.join("worlds").join(world).is_dir()) {
        return Err(Failure::input(format!("--world {world}: no folder {}", args.to.join("worlds").join(world).display())));
    }
    Ok(folder)
}

fn extension(log: &Path) -> String {
    log.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

fn read(args: &ImportArgs, log: &Path, mapping: &Mapping) -> Result<Vec<Drive>, Failure> {
    // A folder is a bag whatever its name ends in.
    let (name, kind) = if log.is_dir() { (log.file_name(), "mcap".into()) } else { (log.file_stem(), extension(log)) };
    let name = name.map_or_else(|| "log".into(), |name| name.to_string_lossy().into_owned());
    let (table, mut notes) = match kind.as_str() {
        "mcap" => {
            let topics = Topics { odometry: args.odometry.clone(), command: args.command.clone(), imu: args.imu.clone() };
            read_bag(log, &topics).or_input()?
        }
        "db3" | "bag" | "zstd" => {
            return Err(Failure::input(format!("{}: {CONVERT}", log.display())));
        }
        _ => (read_csv(log).or_input()?, Vec::new()),
    };
    let frame = match args.frame {
        FrameArg::EnuFlu => FrameConvention::EnuFlu,
        FrameArg::NedFrd => FrameConvention::NedFrd,
    };
    let (found, more) = drives(&table, &Options { mapping: mapping.clone(), frame, flat: args.flat, name }).or_input()?;
    notes.extend(more);
    say!("{}", log.display());
    notes.iter().for_each(|note| say!("  note: {note}"));
    for drive in &found {
        let t = drive.time_s();
        let length_s = t[t.len() - 1] - t[0];
        let rate_hz = (t.len() - 1) as f64 / length_s;
        say!("  {}: {length_s:.1} s, {} samples, {rate_hz:.1} Hz", drive.id, t.len());
        if rate_hz < RATE_MIN_HZ {
            say!(
                "  doubt: {rate_hz:.1} Hz is slower than the model's steps of 0.1 s: what lies between is interpolated; record at 10 Hz or faster"
            );
        }
    }
    Ok(found)
}

/// The card to copy: the one given, where the data root has none.
fn card(args: &ImportArgs) -> Result<Option<&Path>, Failure> {
    let given = args.vehicle.as_deref();
    let described = given.map(read_vehicle_card).transpose().or_input()?;
    let is_card = |name: &str| name.starts_with("vehicle_") && name.ends_with(".json");
    let entries = std::fs::read_dir(&args.to).into_iter().flatten().flatten();
    if !entries.map(|e| e.file_name().to_string_lossy().into_owned()).any(|name| is_card(&name)) {
        let missing = || Failure::input(format!("{} has no vehicle card yet; give one with --vehicle FILE", args.to.display()));
        return given.map(Some).ok_or_else(missing);
    }
    if let (Some(given), Some(described)) = (given, described) {
        let root = DataRoot::open(&args.to, None).or_input()?;
        if root.vehicle() != &described {
            say!(
                "  note: {} counts, the card of the data root; {} says something else and is not used",
                root.card().display(),
                given.display()
            );
        }
    }
    Ok(None)
}

fn put_card(args: &ImportArgs, card: &Path) -> Result<(), Failure> {
    let name = card.file_stem().map_or_else(|| "card".into(), |name| name.to_string_lossy().into_owned());
    let name = format!("vehicle_{}.json", name.trim_start_matches("vehicle_"));
    std::fs::copy(card, args.to.join(name)).map(|_| ()).map_err(|e| Failure::Failed(format!("cannot copy the card: {e}")))
}

/// Reads the set as every other command will, says what does not fit together, and draws what was driven.
fn judge(args: &ImportArgs, card: Option<&Path>, html: &Path) -> Result<(), Failure> {
    let root = DataRoot::open(&args.to, card).or_input()?;
    let of_card = root.notes();
    let drives: Vec<Trajectory> = root.load_set(&SetQuery::all(&args.set)).or_input()?;
    for note in root.notes().iter().filter(|note| args.world.is_some() || of_card.contains(note)) {
        say!("  note: {note}");
    }
    for doubt in doubts(&drives, root.vehicle()) {
        say!("  doubt: {}; {}", doubt.what, doubt.advice);
    }
    for beyond in root.beyond_range(&drives) {
        let cost = if beyond.implied { "" } else { ", and no service would take that" };
        say!("  doubt: {} drives command beyond the range of the card{cost}: {beyond}; see the units of the commands", beyond.drives);
    }
    write_file(html, page::page(&args.set, &drives, root.vehicle()).as_bytes())?;
    say!("wrote {}", html.display());
    Ok(())
}
