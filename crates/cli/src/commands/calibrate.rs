//! `nesam calibrate`: what the card of a vehicle does not say, from its logs, with the physics alone.

mod kinematic;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;
use nesam_evaluation::Kinematic;
use nesam_learning::Drive;
use nesam_learning::at_end::{AtEnd, at_ends};
use nesam_learning::calibrate::{Calibrated, Ground, calibrate_vehicle};
use nesam_learning::recipe::{Reporter, load_drives};
use nesam_learning::symbolic::{HORIZON, symbolic_error};
use nesam_model::{ModelBundle, Normalization};
use nesam_physics::{SOIL_DIM, SOIL_NAMES, SecondCommand, Vehicle};
use nesam_trajectories::{Trajectory, card_to_json};
use serde_json::{Value, json};

use self::kinematic::kinematic_error;
use super::train::Console;
use crate::args::DataArgs;
use crate::bundle_version::derived_from;
use crate::failure::{Failure, OrFail};
use crate::interrupt;
use crate::output::{check_files, or_here, out_dir, provenance, say, write_file, write_json};
use crate::progress::Progress;
use crate::sources::{Drives, bundle_to_change, read_drives};

/// Parts of the drives that are left out in turn: every part costs one more calibration.
const FOLDS: usize = 5;
/// Heading changes over a rollout, as root of the mean square, from which on it is told how much of them the physics makes, rad (chosen: beyond noise).
const TURNS_RAD: f64 = 0.1;
/// A share of the turning that is further from one than this is a warning (chosen).
const TURNING_OFF: f64 = 0.1;
/// Name of the fitted card.
const CARD: &str = "vehicle_calibrated.json";

const OUTCOME: &str = "The fitted card is complete: give it as --vehicle where a data root is read, or copy it into a data root in place of \
its own. `nesam train` fits the same numbers before it trains. A bundle keeps the card that it was trained with for a vehicle of the same name; \
with --bundle DIR its copy in the output folder has the fitted card and the learned parts as trained, without soil filter, regions and reference, \
which were measured with the old card: make them again with `nesam adapt --calibrate`, `nesam evaluate --calibrate-coverage` and \
`nesam diagnose --make-reference`.

What is fitted: how soil and engine act (contact law, rims at an over-speed or hubs under torque), the numbers of the drive line, and over a map the \
rates and dampings of the suspension; of a skid-steer base the servo of its rims, from measured wheel speeds or, \
without any, from the motion. Where no drive has a map, loam and hard ground are tried too; a bundle keeps the better one (`soil` in the JSON), a card does not. Beside its errors are those of a kinematic fit (`kinematic` in the JSON), which knows no soil, no slip and no slopes. \
Where the fitted physics turns less or more than the vehicle by a tenth (`turning`), that is a line of warning: a base on casters is none that it can be. \
A range of commands that the card does not state is widened to the commands of the drives. A number that ends at an end of what is tried is a line of warning (`at_ends` in the JSON): the drives chose the end and not the number.

Examples:
  nesam calibrate --data mine --set first --out mine-calibrated
  nesam diagnose --data mine --set first --vehicle mine-calibrated/vehicle_calibrated.json --reference physics";

/// Options of `nesam calibrate`.
#[derive(Args, Debug)]
#[command(after_help = OUTCOME)]
pub struct CalibrateArgs {
    #[command(flatten)]
    data: DataArgs,
    /// Also write this bundle anew, with the fitted card [default: none, the card alone]
    #[arg(long, value_name = "DIR")]
    bundle: Option<PathBuf>,
    /// Folder for the card, the JSON and the bundle [default: nesam-out/calibrate-<set>]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Write the JSON (schema nesam.calibrate/1) here instead
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// What the physics is off by on a drive, with the card as it came and with the fitted one.
struct Scored {
    trajectory: String,
    before: Errors,
    after: Errors,
    /// Of the kinematic fit; `None` where the drives are too short for one.
    kinematic: Option<Errors>,
}

/// Mean absolute errors over rollouts.
#[derive(Clone, Copy, Default)]
struct Errors {
    position_m: f64,
    yaw_rad: f64,
    /// Roll and pitch together; `None` without a map, where they tell of the ground.
    tilt_rad: Option<f64>,
    /// Turning over a rollout: mean of predicted times measured and of measured squared, rad².
    turning_rad2: [f64; 2],
}

impl Errors {
    /// How much of the measured turning is predicted, by least squares; `None` where the vehicle hardly turns.
    fn turning(&self) -> Option<f64> {
        let [both, measured] = self.turning_rad2;
        (measured >= TURNS_RAD * TURNS_RAD).then(|| both / measured)
    }
}

/// A calibration on a part of the drives says nothing.
struct Silent;

impl Reporter for Silent {
    fn stage(&self, _name: &str, _total: usize) {}
    fn progress(&self, _done: usize, _remark: &str) {}
    fn line(&self, _text: &str) {}
}

/// Runs the command.
pub fn run(args: &CalibrateArgs) -> Result<(), Failure> {
    interrupt::exit_on_ctrl_c("nothing was written");
    let drives = read_drives(&args.data, false)?;
    let card = drives.root.vehicle();
    let bundle = args.bundle.as_deref().map(|dir| bundle_to_change("--bundle", dir, args.data.dt)).transpose()?;
    let out = out_dir(args.out.as_deref(), "calibrate", &drives.set)?;
    if drives.root.card().parent().is_some_and(|root| same_folder(root, &out)) {
        let card = drives.root.card().display();
        return Err(Failure::input(format!(
            "--out {}: two cards in a data root are one too many; give another folder, then put the new card into the place of {card}",
            out.display()
        )));
    }
    let [path, file] = [out.join(CARD), args.json.clone().unwrap_or_else(|| out.join("calibrate.json"))];
    check_files([&path, &file].into_iter())?;
    let measured = load_drives(&drives.root, &drives.drives).or_input()?;
    let usable: Vec<&Drive> = measured.iter().filter(|drive| drive.states.len() > HORIZON + 1).collect();
    if usable.is_empty() {
        let needed_s = (HORIZON + 1) as f64 * args.data.dt;
        return Err(Failure::input(format!("no drive of set `{}` is of {needed_s:.1} s or more, so nothing can be predicted", drives.set)));
    }
    let widened = drives.root.vehicle_of(&drives.drives);
    let fitted = calibrated(widened.clone(), &usable, args.data.dt, &Console::default());
    let scored = if usable.len() > 1 {
        held_out(card, &usable, &drives.drives, args.data.dt)
    } else {
        scored(card, &fitted, [&usable, &usable], &drives.drives)
    };
    let Calibrated { vehicle, scales, ground } = fitted;
    // A card does not hold the ground, a bundle does.
    let soil = ground.map(|_| scales.default_soil());
    let changes = changes(card, &vehicle);
    let seconds = HORIZON as f64 * args.data.dt;
    summary(&scored, &changes, usable.len() > 1, seconds);
    if card.second == SecondCommand::YawRateRadS && usable.iter().all(|d| d.wheel_speed_rad_s.is_none()) {
        say!("no drive has wheel speeds: the servo of the rims was fitted to the motion, together with what the ground makes of it");
    }
    if ground == Some(Ground::Hard) {
        let kept = if bundle.is_some() { "the bundle keeps that" } else { "a card does not hold that, a bundle does (--bundle)" };
        say!("ground: the drives are predicted best on hard ground, like a floor or a paved road; {kept}");
    }
    write_file(&path, (card_to_json(&vehicle) + "\n").as_bytes())?;
    say!("wrote {}", path.display());
    let document = document(args, &drives, &scored, (&changes, &at_ends(&widened, &vehicle)), (soil, &path));
    let saved = bundle.as_ref().map(|base| save_bundle(base, &vehicle, soil, &drives.root.hash(), &out.join("bundle"))).transpose()?;
    let document = with_bundle(document, saved.as_deref(), provenance(bundle.as_ref(), &drives));
    write_json(&file, &document)?;
    say!("wrote {}", file.display());
    Ok(())
}

/// Whether two folders are one that is there.
fn same_folder(a: &Path, b: &Path) -> bool {
    let there = |folder: &Path| or_here(folder).canonicalize().ok();
    there(a).is_some_and(|a| there(b) == Some(a))
}

/// Calibrates to the end: Ctrl-C ends this command as a whole.
fn calibrated(card: Vehicle, drives: &[&Drive], dt_s: f64, reporter: &dyn Reporter) -> Calibrated {
    calibrate_vehicle(card, drives, dt_s, reporter, &|| false).expect("nothing interrupts it; this is a bug")
}

/// Errors of every drive with a card that was fitted on others.
fn held_out(card: &Vehicle, drives: &[&Drive], recorded: &[Trajectory], dt_s: f64) -> Vec<Scored> {
    let folds = FOLDS.min(drives.len());
    let progress = Progress::start("drives left out in turn", folds);
    let mut all: Vec<Scored> = Vec::with_capacity(drives.len());
    for fold in 0..folds {
        let part = |held: bool| -> Vec<&Drive> {
            drives.iter().enumerate().filter(|(i, _)| (i % folds == fold) == held).map(|(_, drive)| *drive).collect()
        };
        let fitted = calibrated(card.clone(), &part(false), dt_s, &Silent);
        all.extend(scored(card, &fitted, [&part(false), &part(true)], recorded));
        progress.set(fold + 1);
    }
    progress.finish();
    all.sort_by(|a, b| a.trajectory.cmp(&b.trajectory));
    all
}

/// Errors of drives with two cards, the second on the ground that was found with it, and of the kinematic fit to the drives that it was fitted on: (fitted on,
/// scored).
fn scored(card: &Vehicle, fitted: &Calibrated, [fitted_on, drives]: [&[&Drive]; 2], recorded: &[Trajectory]) -> Vec<Scored> {
    let assumed = Ground::Middle.under(&fitted.scales);
    let errors = |vehicle: &Vehicle, scales: &Normalization, drive: &Drive| {
        let error = symbolic_error(vehicle, &[drive], scales);
        let tilt_rad = drive.map.is_some().then_some(error.tilt_rad);
        Errors { position_m: error.position_m, yaw_rad: error.yaw_rad, tilt_rad, turning_rad2: error.turning_rad2 }
    };
    let training: Vec<Trajectory> = recorded.iter().filter(|t| fitted_on.iter().any(|drive| drive.id == t.id)).cloned().collect();
    // Drives that are too short for a window of it have none.
    let kinematic = Kinematic::fit(card, &training, HORIZON).ok();
    let one = |drive: &&Drive| Scored {
        trajectory: drive.id.clone(),
        before: errors(card, &assumed, drive),
        after: errors(&fitted.vehicle, &fitted.scales, drive),
        kinematic: kinematic.map(|fit| kinematic_error(&fit, card, drive, fitted.scales.dt_s)),
    };
    drives.iter().map(one).collect()
}

/// Mean over drives; of roll and pitch over those with a map.
fn mean(errors: impl Iterator<Item = Errors>) -> Errors {
    let all: Vec<Errors> = errors.collect();
    let over = |of: fn(&Errors) -> f64| all.iter().map(of).sum::<f64>() / all.len().max(1) as f64;
    let tilts: Vec<f64> = all.iter().filter_map(|e| e.tilt_rad).collect();
    Errors {
        position_m: over(|e| e.position_m),
        yaw_rad: over(|e| e.yaw_rad),
        tilt_rad: (!tilts.is_empty()).then(|| tilts.iter().sum::<f64>() / tilts.len() as f64),
        turning_rad2: [over(|e| e.turning_rad2[0]), over(|e| e.turning_rad2[1])],
    }
}

/// Mean errors of the kinematic fit; `None` where a drive has none.
fn kinematic_mean(scored: &[Scored]) -> Option<Errors> {
    let all: Option<Vec<Errors>> = scored.iter().map(|s| s.kinematic).collect();
    all.map(|all| mean(all.into_iter()))
}

/// Numbers of the card that the fit changed: as the card has them, as fitted; null where one of the two does not have it.
fn changes(card: &Vehicle, fitted: &Vehicle) -> BTreeMap<String, [Value; 2]> {
    let leaves = |vehicle: &Vehicle| {
        let mut found = BTreeMap::new();
        let card: Value = serde_json::from_str(&card_to_json(vehicle)).expect("a card is JSON; this is a bug");
        collect_leaves("", &card, &mut found);
        found
    };
    let (before, after) = (leaves(card), leaves(fitted));
    let of = |held: &BTreeMap<String, Value>, name: &String| held.get(name).cloned().unwrap_or(Value::Null);
    let names = before.keys().chain(after.keys());
    names.map(|name| (name.clone(), [of(&before, name), of(&after, name)])).filter(|(_, [before, after])| before != after).collect()
}

/// Adds what is no object to `found`, under its keys joined by dots; an array is one value.
fn collect_leaves(prefix: &str, value: &Value, found: &mut BTreeMap<String, Value>) {
    let Value::Object(fields) = value else {
        found.insert(prefix.into(), value.clone());
        return;
    };
    for (key, value) in fields {
        let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        collect_leaves(&name, value, found);
    }
}

fn summary(scored: &[Scored], changes: &BTreeMap<String, [Value; 2]>, held_out: bool, seconds: f64) {
    let on = if held_out {
        "each with a card fitted on other drives"
    } else {
        "the drive that the card was fitted on: of another one this says nothing"
    };
    let (before, after) = (mean(scored.iter().map(|s| s.before)), mean(scored.iter().map(|s| s.after)));
    say!("\nerror of the physics alone over {seconds:.1} s, card -> fitted, {} drives, {on}:", scored.len());
    say!("  position {:.3} m -> {:.3} m", before.position_m, after.position_m);
    say!("  yaw {:.3}° -> {:.3}°", before.yaw_rad.to_degrees(), after.yaw_rad.to_degrees());
    if let (Some(before), Some(after)) = (before.tilt_rad, after.tilt_rad) {
        say!("  roll and pitch together {:.3}° -> {:.3}°", before.to_degrees(), after.to_degrees());
    }
    if let Some(kinematic) = kinematic_mean(scored) {
        let (position_m, yaw_deg) = (kinematic.position_m, kinematic.yaw_rad.to_degrees());
        say!("  a kinematic fit, which knows no soil: position {position_m:.3} m, yaw {yaw_deg:.3}°");
    }
    let better = |of: fn(&Errors) -> f64| scored.iter().filter(|s| of(&s.after) < of(&s.before)).count();
    let (position, yaw) = (better(|e| e.position_m), better(|e| e.yaw_rad));
    say!("  position is better on {position} of {} drives, yaw on {yaw}", scored.len());
    for (what, worse) in [("position", after.position_m > before.position_m), ("yaw", after.yaw_rad > before.yaw_rad)] {
        if worse {
            say!("  warning: {what} is worse with the fitted card; see which of its numbers below is not what the vehicle is like");
        }
    }
    if let Some(turning) = after.turning().filter(|turning| (turning - 1.0).abs() > TURNING_OFF) {
        let why = if turning < 0.0 {
            "the second command or the yaw has the opposite sign: left is positive, `nesam check` says which"
        } else {
            "no number that is fitted makes up for that. See track, wheelbase, wheels and centre of gravity of the card; a base on casters, or one that rolls on more than \
             four wheels, is not what the physics can be"
        };
        say!("  warning: with the fitted card the physics turns {turning:.2} times as much as the vehicle: {why}");
    }
    say!("\ncard -> fitted:");
    let shown = |value: &Value| if value.is_null() { "–".into() } else { value.to_string() };
    for (name, [before, after]) in changes {
        say!("  {name}: {} -> {}", shown(before), shown(after));
    }
}

fn document(
    args: &CalibrateArgs,
    drives: &Drives,
    scored: &[Scored],
    (changes, ends): (&BTreeMap<String, [Value; 2]>, &[AtEnd]),
    (soil, card): (Option<[f64; SOIL_DIM]>, &Path),
) -> Value {
    let errors = |e: Errors| {
        let (yaw_deg, tilt_deg) = (e.yaw_rad.to_degrees(), e.tilt_rad.map(f64::to_degrees));
        json!({"position_m": e.position_m, "yaw_deg": yaw_deg, "tilt_deg": tilt_deg, "turning": e.turning()})
    };
    let parameters: Vec<Value> =
        changes.iter().map(|(name, [before, after])| json!({"name": name, "card": before, "fitted": after})).collect();
    let trajectories: Vec<Value> =
        scored.iter().map(|s| json!({"trajectory": s.trajectory, "before": errors(s.before), "after": errors(s.after)})).collect();
    let at_ends: Vec<Value> =
        ends.iter().map(|end| json!({"name": end.name, "value": end.value, "unit": end.unit, "range": end.range})).collect();
    json!({
        "schema": "nesam.calibrate/1",
        "set": drives.set,
        "split": args.data.split.as_str(),
        "dt_s": args.data.dt,
        "horizon_steps": HORIZON,
        "held_out": scored.len() > 1,
        "before": errors(mean(scored.iter().map(|s| s.before))),
        "after": errors(mean(scored.iter().map(|s| s.after))),
        "kinematic": kinematic_mean(scored).map(errors),
        "trajectories": trajectories,
        "parameters": parameters,
        "at_ends": at_ends,
        "soil": soil.map(|soil| SOIL_NAMES.iter().zip(soil).collect::<BTreeMap<_, _>>()),
        "vehicle": card.display().to_string(),
    })
}

/// The document with the bundle that was written, and what all of it was made from.
fn with_bundle(mut document: Value, bundle: Option<&Path>, provenance: nesam_evaluation::Provenance) -> Value {
    document["bundle"] = json!(bundle.map(|path| path.display().to_string()));
    document["provenance"] = json!(provenance);
    document
}

/// Writes a bundle with another card, and the ground under it where no map tells; what was measured with the old card is left out.
fn save_bundle(
    base: &ModelBundle,
    vehicle: &Vehicle,
    soil: Option<[f64; SOIL_DIM]>,
    data_hash: &str,
    to: &Path,
) -> Result<PathBuf, Failure> {
    let mut moved = base.clone();
    moved.move_to(vehicle);
    if let Some(soil) = soil {
        moved.normalization.set_default_soil(&soil);
    }
    let mut bundle = ModelBundle {
        reference_json: None,
        reference_drives: None,
        soil_filter_json: None,
        rollout_noise_json: None,
        provenance: derived_from(base, data_hash),
        ..moved
    };
    let path = bundle.save(to).or_failed()?;
    say!("bundle {} ({}) in {}", bundle.name, &bundle.hash[..12], path.display());
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_changes_of_a_card_are_named_by_their_keys() {
        let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles/hmmwv-nominal/vehicle.json");
        let card = nesam_trajectories::read_vehicle_card(&dir).expect("a shipped card");
        assert!(changes(&card, &card).is_empty());
        let mut fitted = card.clone();
        fitted.driveline.steering_lag_s += 0.25;
        fitted.driveline.torque = None;
        let found = changes(&card, &fitted);
        let lag = found["driveline.steering_lag_s"][1].as_f64().expect("a number");
        assert!((lag - fitted.driveline.steering_lag_s).abs() < 1e-12, "{lag}");
        assert!(found.len() > 1 && found.iter().all(|(name, [_, after])| name.starts_with("driveline.torque.") == after.is_null()));
    }

    #[test]
    fn analytic_means_are_of_what_was_measured() {
        let error = |position_m, tilt_rad| Errors { position_m, yaw_rad: 0.1, tilt_rad, turning_rad2: [0.1, 0.2] };
        let all = mean([error(1.0, None), error(3.0, Some(0.2))].into_iter());
        assert_eq!((all.position_m, all.tilt_rad), (2.0, Some(0.2)));
        assert_eq!(mean([error(1.0, None)].into_iter()).tilt_rad, None);
        assert_eq!((all.turning(), Errors::default().turning()), (Some(0.5), None), "of what hardly turns nothing is said");
    }
}
