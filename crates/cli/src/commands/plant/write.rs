//! `nesam plant write`: drives of the plant as a data root, for commands that read recorded drives.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use nesam_plant::{Command, Drive, DriveRecorder, Ground, HiddenEffects, Plant, PlantVehicle, Sensors, write_set};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{BEFORE, effects_of, root_of};
use crate::args::check_count;
use crate::bundle_path::inside_bundle;
use crate::failure::{Failure, OrFail};
use crate::output::{say, set_exists};
use crate::progress::Progress;

/// A drive ends this close to the edge of the ground, m.
const BORDER_M: f64 = 4.0;
/// Starts lie inside a square of this half edge about the origin of World, m.
const START_M: f64 = 22.0;

/// Options of `nesam plant write`.
#[derive(Args, Debug)]
pub struct WriteArgs {
    /// Data root with the vehicle's data sheet and worlds with true soil [default: the sample shipped with the repository]
    #[arg(long, value_name = "ROOT")]
    data: Option<PathBuf>,
    /// Data root to write; its vehicle and worlds are copied from the other one
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Set to write
    #[arg(long, value_name = "NAME", default_value = "plant")]
    set: String,
    /// Worlds, one drive after the other
    #[arg(long, value_name = "ID,…", value_delimiter = ',', required = true)]
    worlds: Vec<String>,
    /// Drives
    #[arg(long, default_value_t = 5)]
    drives: usize,
    /// Length of a drive
    #[arg(long, value_name = "SECONDS", default_value_t = 25.0)]
    seconds: f64,
    /// Hidden effect of the vehicle; may be given several times (`nesam plant effects` lists them)
    #[arg(long, value_name = "ID=MAGNITUDE")]
    effect: Vec<String>,
    /// First seed; commands, starts and sensor noise follow from it
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Runs the command.
pub fn run(args: &WriteArgs) -> Result<(), Failure> {
    let asked = Asked { worlds: &args.worlds, drives: args.drives, seconds: args.seconds, seed: args.seed };
    asked.check()?;
    if !args.set.split('/').all(is_plain) {
        return Err(Failure::input("--set must be a plain name"));
    }
    let root = root_of(args.data.as_ref())?;
    if inside_bundle(&args.out) {
        return Err(Failure::input(format!("--out {} lies in a bundle, which no command may change", args.out.display())));
    }
    let set = args.out.join(&args.set);
    if set.exists() {
        return Err(set_exists(&set));
    }
    let effects = effects_of(&args.effect)?;
    copy_vehicle_and_worlds(&root, &args.out, &args.worlds)?;
    let progress = Progress::start("drives", args.drives);
    write_drives(&root, &set, &effects, &asked, &|done| progress.set(done))?;
    progress.finish();
    say!("{} drives in {}", args.drives, set.display());
    Ok(())
}

/// Drives to write.
pub struct Asked<'a> {
    /// Worlds, one drive after the other.
    pub worlds: &'a [String],
    pub drives: usize,
    /// Length of each.
    pub seconds: f64,
    /// Of the first; commands, starts and sensor noise follow from it.
    pub seed: u64,
}

impl Asked<'_> {
    /// Whether it can be written.
    ///
    /// # Errors
    /// `Failure` naming the option.
    pub fn check(&self) -> Result<(), Failure> {
        if !(1.0..=600.0).contains(&self.seconds) {
            return Err(Failure::input(format!("--seconds must be 1 to 600, not {}", self.seconds)));
        }
        check_count("--drives", self.drives, 1..=10_000)?;
        match self.worlds.iter().find(|world| !is_plain(world)) {
            Some(world) => Err(Failure::input(format!("--worlds {world}: must be a plain name"))),
            None => Ok(()),
        }
    }
}

/// Whether a part of a path stays where it is put.
fn is_plain(part: &str) -> bool {
    !part.is_empty() && part != ".." && part.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c))
}

/// Drives of the vehicle and worlds of a data root, as a set in this folder.
pub fn write_drives(root: &Path, set: &Path, effects: &HiddenEffects, asked: &Asked, done: &dyn Fn(usize)) -> Result<(), Failure> {
    let vehicle = Arc::new(PlantVehicle::of_root(root).or_input()?);
    let mut drives = Vec::new();
    for i in 0..asked.drives {
        let world = &asked.worlds[i % asked.worlds.len()];
        let ground = Arc::new(Ground::read(&root.join("worlds").join(world)).or_input()?);
        drives.push(drive(&vehicle, &ground, effects, world, asked.seed + i as u64, asked.seconds));
        done(i + 1);
    }
    write_set(set, &drives).or_failed()
}

/// A drive after the recipe of the recorded ones: sinusoids in steering and speed, in rad/s.
fn drive(vehicle: &Arc<PlantVehicle>, ground: &Arc<Ground>, effects: &HiddenEffects, world: &str, seed: u64, seconds: f64) -> Drive {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut uniform = |low: f64, high: f64| rng.random_range(low..high);
    let (steering_rate, speed_rate) = (uniform(0.1, 0.5), uniform(0.1, 2.5));
    let (slowest, fastest) = (uniform(1.0, 2.0), uniform(3.0, 4.0));
    let side = if uniform(0.0, 1.0) < 0.5 { -1.0 } else { 1.0 };
    let (x, y, yaw) = (uniform(-START_M, START_M), uniform(-START_M, START_M), uniform(0.0, TAU));
    let command = |t: f64| Command {
        speed_m_s: 0.5 * (slowest + fastest) + 0.5 * (fastest - slowest) * (speed_rate * t).sin(),
        steering: side * (steering_rate * t).sin(),
    };
    let mut plant = Plant::at_rest(Arc::clone(vehicle), Arc::clone(ground), *effects, x, y, yaw);
    for (steps, speed_m_s) in BEFORE.into_iter().zip([0.0, command(0.0).speed_m_s]) {
        (0..steps).for_each(|_| plant.advance(Command { speed_m_s, steering: 0.0 }));
    }
    let (mut sensors, mut recorder) = (Sensors::new(seed, effects), DriveRecorder::default());
    for k in 0..=(10.0 * seconds) as usize {
        let truth = plant.truth();
        let near_edge = [-BORDER_M, BORDER_M].iter().any(|dx| ground.height_m(truth.state[0] + dx, truth.state[1]).is_none())
            || [-BORDER_M, BORDER_M].iter().any(|dy| ground.height_m(truth.state[0], truth.state[1] + dy).is_none());
        if near_edge {
            break;
        }
        let now = command(0.1 * k as f64);
        recorder.sample(&sensors.read(&truth), &truth, now);
        plant.advance(now);
    }
    recorder.finish(&format!("p{seed:04}"), world, "test")
}

/// Puts vehicle cards and worlds of a data root into another one, or the same. What is there already stays, and has to be the same.
///
/// # Errors
/// `Failure` naming a world that the first lacks, or a file that the other one has otherwise; nothing is written then.
pub fn copy_vehicle_and_worlds(from: &Path, to: &Path, worlds: &[String]) -> Result<(), Failure> {
    let fail = |e: std::io::Error| Failure::Failed(format!("cannot copy to {}: {e}", to.display()));
    if let Some(missing) = worlds.iter().find(|world| !from.join("worlds").join(world).is_dir()) {
        return Err(Failure::input(format!("--worlds {missing}: {} has no such world", from.display())));
    }
    let is_card = |name: &str| name.starts_with("vehicle_") && name.ends_with(".json");
    let mut names = files(from, Path::new(""), &is_card).map_err(fail)?;
    let others = if to.is_dir() { files(to, Path::new(""), &is_card).map_err(fail)? } else { Vec::new() };
    if let Some(other) = others.iter().find(|card| !names.contains(card)) {
        return Err(Failure::input(format!("{} has a vehicle of its own; choose another --out", to.join(other).display())));
    }
    for world in worlds {
        names.extend(files(from, &Path::new("worlds").join(world), &|_| true).map_err(fail)?);
    }
    let (mut there, mut new) = (Vec::new(), Vec::new());
    names.into_iter().for_each(|name| if to.join(&name).exists() { there.push(name) } else { new.push(name) });
    for name in there {
        if std::fs::read(to.join(&name)).map_err(fail)? != std::fs::read(from.join(&name)).map_err(fail)? {
            let [other, own] = [to, from].map(|root| root.join(&name).display().to_string());
            return Err(Failure::input(format!("{other} is there and is not {own}; choose another --out")));
        }
    }
    for name in new {
        let copy = to.join(&name);
        std::fs::create_dir_all(copy.parent().unwrap_or(to)).map_err(fail)?;
        std::fs::copy(from.join(&name), copy).map_err(fail)?;
    }
    Ok(())
}

/// Names of the files in a folder of a root, from the root on.
fn files(root: &Path, folder: &Path, wanted: &dyn Fn(&str) -> bool) -> std::io::Result<Vec<PathBuf>> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(root.join(folder))? {
        let entry = entry?;
        if entry.file_type()?.is_file() && entry.file_name().to_str().is_some_and(wanted) {
            names.push(folder.join(entry.file_name()));
        }
    }
    Ok(names)
}
