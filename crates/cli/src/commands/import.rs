//! `nesam import`: a log of another tool becomes a set of a data root.

mod draft;
mod page;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use clap::{Args, ValueEnum};
use nesam_import::{
    CONVERT, Drive, FrameConvention, Mapping, Options, Topics, doubts, drives, read_bag, read_csv, recorded_doubts, write_set,
};
use nesam_physics::POINT_MAX_M;
use nesam_trajectories::{DataRoot, SetQuery, Trajectory, read_vehicle_card};

use self::draft::Draft;
use crate::bundle_path::inside_bundle;
use crate::failure::{Failure, OrFail};
use crate::interrupt;
use crate::output::{check_apart, check_file, say, set_exists, write_file};
use crate::sources::beyond_range_note;

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
    /// Columns of tables, or channels of bags (x, …, vbx, vby, vbz, wx, wy, wz), that are not to be read: `vbx,vby,wz` of an odometry without a twist
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    leave_out: Vec<String>,
    /// Axes of the log
    #[arg(long, value_enum, default_value_t = FrameArg::EnuFlu)]
    frame: FrameArg,
    /// Where the reference point of the vehicle card, its centre of gravity, lies from the point whose pose the log tells, m, in the body axes of the log: `1.4,0,0.2` where
    /// the log is of the rear axle
    #[arg(long, value_name = "X,Y,Z", value_parser = point, default_value = "0,0,0", allow_hyphen_values = true)]
    reference: [f64; 3],
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

/// Plots of the drives, in the folder of their set.
const PAGE: &str = "import.html";

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
    /// x north, y east, z down; body x forward, y right, z down (PX4, ArduPilot); the second command and road-wheel angles are positive to the right
    NedFrd,
}

/// Runs the command.
pub fn run(args: &ImportArgs) -> Result<(), Failure> {
    let draft = Draft::new(&args.to, &args.set);
    check_target(args, draft.folder())?;
    args.html.iter().try_for_each(|file| check_file(file))?;
    args.html.iter().flat_map(|html| args.logs.iter().map(move |log| [html, log])).try_for_each(check_apart)?;
    let unfinished = draft.clone();
    interrupt::exit_on_ctrl_c_after("nothing was imported", move || {
        stop_writing();
        unfinished.discard();
    });
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
    let written = write(args, &draft, &all, card);
    // What cannot be read again is no set.
    draft.discard();
    written.map_err(|failure| draft.told_of(failure))?;
    say!("{} drives in {}", all.len(), draft.folder().display());
    Ok(())
}

/// The right to change files: of the import for a stage at a time, and for good of what ends first, the import or its interruption.
static WRITING: Mutex<()> = Mutex::new(());
/// Somebody wants to interrupt: no further stage begins.
static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// The right to change files for a stage; an import that is interrupted never gets it.
fn writing() -> MutexGuard<'static, ()> {
    let stage = WRITING.lock().unwrap_or_else(PoisonError::into_inner);
    if INTERRUPTED.load(Ordering::SeqCst) {
        drop(stage);
        loop {
            std::thread::park();
        }
    }
    stage
}

/// Waits until the stage at work is over and lets no other begin; does not return where that was the last one.
fn stop_writing() {
    INTERRUPTED.store(true, Ordering::SeqCst);
    std::mem::forget(WRITING.lock().unwrap_or_else(PoisonError::into_inner));
}

/// Writes the set and judges it where nobody sees it, puts it in its place, and the card into a data root that has none.
fn write(args: &ImportArgs, draft: &Draft, drives: &[Drive], card: Option<&Path>) -> Result<(), Failure> {
    let stage = writing();
    draft.make()?;
    let notes = write_set(&draft.root().join(&args.set), drives, args.world.as_deref(), args.split.as_deref()).or_input()?;
    notes.iter().for_each(|note| say!("  note: {note}"));
    drop(stage);
    let stage = writing();
    judge(args, card, draft)?;
    drop(stage);
    let last = writing();
    let card = card.map(|card| copy_card(card, draft.root())).transpose()?;
    draft.publish(&args.set)?;
    if let Some((copy, name)) = card
        && let Err(error) = std::fs::rename(copy, args.to.join(name))
    {
        let _ = std::fs::remove_dir_all(draft.folder());
        return Err(Failure::Failed(format!("cannot copy the card: {error}")));
    }
    // The set is there: nothing interrupts what is left to say.
    std::mem::forget(last);
    let html = args.html.clone().unwrap_or_else(|| draft.folder().join(PAGE));
    say!("wrote {}", html.display());
    Ok(())
}

/// Refuses a folder that no new set may have.
fn check_target(args: &ImportArgs, folder: &Path) -> Result<(), Failure> {
    let plain =
        |part: &str| !part.is_empty() && !part.starts_with('.') && part.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c));
    if !args.set.split('/').all(plain) || args.set.starts_with("worlds/") || args.set == "worlds" {
        return Err(Failure::input(format!("--set {}: letters, digits, _ - . and / between them are allowed, and not `worlds`", args.set)));
    }
    if inside_bundle(folder) {
        return Err(Failure::input(format!("--to {} lies in a bundle, which no command may change", args.to.display())));
    }
    if folder.exists() {
        return Err(set_exists(folder));
    }
    if let Some(world) = args.world.as_ref().filter(|world| !args.to.join("worlds").join(world).is_dir()) {
        return Err(Failure::input(format!("--world {world}: no folder {}", args.to.join("worlds").join(world).display())));
    }
    Ok(())
}

/// Three lengths of a vehicle, m.
fn point(text: &str) -> Result<[f64; 3], String> {
    let lengths: Vec<f64> =
        text.split(',').map(|part| part.trim().parse().map_err(|_| format!("`{part}` is no number"))).collect::<Result<_, _>>()?;
    let point = <[f64; 3]>::try_from(lengths).map_err(|_| "expected three lengths in metres, X,Y,Z".to_string())?;
    match point.iter().all(|m| m.abs() <= POINT_MAX_M) {
        true => Ok(point),
        false => Err(format!("a point of the vehicle lies within {POINT_MAX_M} m")),
    }
}

fn extension(log: &Path) -> String {
    log.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

fn read(args: &ImportArgs, log: &Path, mapping: &Mapping) -> Result<Vec<Drive>, Failure> {
    // A folder is a bag whatever its name ends in.
    let (name, kind) = if log.is_dir() { (log.file_name(), "mcap".into()) } else { (log.file_stem(), extension(log)) };
    let name = name.map_or_else(|| "log".into(), |name| name.to_string_lossy().into_owned());
    if std::fs::metadata(log).is_ok_and(|file| file.is_file() && file.len() == 0) {
        return Err(Failure::input(format!("{}: is empty: nothing was recorded, or it was not copied", log.display())));
    }
    let (mut table, mut notes) = match kind.as_str() {
        "mcap" => {
            let topics = Topics { odometry: args.odometry.clone(), command: args.command.clone(), imu: args.imu.clone() };
            read_bag(log, &topics).or_input()?
        }
        "db3" | "bag" | "zstd" => {
            return Err(Failure::input(format!("{}: {CONVERT}", log.display())));
        }
        _ => {
            let of_bags = [("--odometry", &args.odometry), ("--command", &args.command), ("--imu", &args.imu)];
            if let Some((option, _)) = of_bags.into_iter().find(|(_, topic)| topic.is_some()) {
                let reason = "names a topic of a bag, and this is a table, whose columns `--column` names; import tables and bags apart";
                return Err(Failure::input(format!("{}: {option} {reason}", log.display())));
            }
            (read_csv(log).or_input()?, Vec::new())
        }
    };
    table.leave_out(&args.leave_out).or_input()?;
    let frame = match args.frame {
        FrameArg::EnuFlu => FrameConvention::EnuFlu,
        FrameArg::NedFrd => FrameConvention::NedFrd,
    };
    let options = Options { mapping: mapping.clone(), frame, flat: args.flat, reference_m: args.reference, name };
    let (found, more) = drives(&table, &options).or_input()?;
    notes.extend(more);
    say!("{}", log.display());
    notes.iter().for_each(|note| say!("  note: {note}"));
    for drive in &found {
        let t = drive.time_s();
        let length_s = t[t.len() - 1] - t[0];
        let rate_hz = (t.len() - 1) as f64 / length_s;
        say!("  {}: {length_s:.1} s, {} samples, {rate_hz:.1} Hz", drive.id, t.len());
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

/// Copies a card into a folder; gives the copy and its name in a data root.
fn copy_card(card: &Path, folder: &Path) -> Result<(PathBuf, String), Failure> {
    let name = card.file_stem().map_or_else(|| "card".into(), |name| name.to_string_lossy().into_owned());
    let name = format!("vehicle_{}.json", name.trim_start_matches("vehicle_"));
    let copy = folder.join(&name);
    std::fs::copy(card, &copy).map_err(|e| Failure::Failed(format!("cannot copy the card: {e}")))?;
    Ok((copy, name))
}

/// Opens the draft with the card that counts: the one to copy, else that of the data root.
fn open(args: &ImportArgs, card: Option<&Path>, draft: &Draft) -> Result<DataRoot, Failure> {
    if let Some(card) = card {
        return DataRoot::open(draft.root(), Some(card)).or_input();
    }
    let whole = DataRoot::open(&args.to, None).or_input()?;
    let root = DataRoot::open(draft.root(), Some(whole.card())).or_input()?;
    if whole.vehicle().second != root.vehicle().second {
        let card = whole.card().display();
        let reason = "the log and the sets of the data root give the second command another meaning";
        return Err(Failure::input(format!("{card}: {reason}; state it in the card with `second`, or import into another root")));
    }
    Ok(root)
}

/// Reads the set as every other command will, says what does not fit together, and draws what was driven.
fn judge(args: &ImportArgs, card: Option<&Path>, draft: &Draft) -> Result<(), Failure> {
    let root = open(args, card, draft)?;
    let of_card = root.notes();
    let drives: Vec<Trajectory> = root.load_set(&SetQuery::all(&args.set)).or_input()?;
    for note in root.notes().iter().filter(|note| args.world.is_some() || of_card.contains(note)) {
        say!("  note: {note}");
    }
    let recorded = root.recorded(&args.set).or_input()?;
    for doubt in recorded_doubts(&recorded).into_iter().chain(doubts(&drives, root.vehicle())) {
        say!("  doubt: {}; {}", doubt.what, doubt.advice);
    }
    for beyond in root.beyond_range(&drives) {
        say!("  doubt: {}; see the units of the commands", beyond_range_note(&beyond));
    }
    let own = draft.root().join(&args.set);
    let html = match &args.html {
        None => own.join(PAGE),
        // In the folder of the set, which is not there yet.
        Some(file) => file.strip_prefix(draft.folder()).map_or_else(|_| file.clone(), |inside| own.join(inside)),
    };
    write_file(&html, page::page(&args.set, &drives, root.vehicle()).as_bytes())
}
