//! Opens what the shared options name: data roots, drives with their maps, bundles.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nesam_learning::recipe::{VALIDATED_FROM, is_validation};
use nesam_model::{ModelBundle, Precision, Predictor};
use nesam_physics::{SecondCommand, Vehicle};
use nesam_server::recording::RecordingHeader;
use nesam_terrain::WorldMap;
use nesam_trajectories::{BeyondRange, DataRoot, SetQuery, Trajectory};

use crate::args::{DataArgs, SplitArg};
use crate::bundle_path::{bundle_dir, bundle_of_hash, bundle_of_vehicle, sample_root};
use crate::failure::{Failure, OrFail};
use crate::on_map;
use crate::output::note;

/// The drives of one set, with the map of each.
pub struct Drives {
    /// The root they come from.
    pub root: DataRoot,
    /// Name of the set.
    pub set: String,
    /// Drives in the order of the index.
    pub drives: Vec<Trajectory>,
    /// Map of each drive; `None` where it has none.
    pub maps: Vec<Option<Arc<WorldMap>>>,
}

/// Opens the data root: `--data`, else the shipped sample.
pub fn open_root(args: &DataArgs) -> Result<(DataRoot, PathBuf), Failure> {
    let path = match &args.data {
        Some(path) => path.clone(),
        None => {
            let sample = sample_root()
                .ok_or_else(|| Failure::input("no --data given and no shipped sample found; give a data root with --data ROOT"))?;
            note!("no --data given: reading the shipped sample {}", sample.display());
            sample
        }
    };
    if !path.is_dir() {
        return Err(Failure::input(format!("data root {} is not a folder", path.display())));
    }
    Ok((DataRoot::open(&path, args.vehicle.as_deref()).or_input()?, path))
}

/// The set that the options name, or the one that is meant when they name none.
pub fn chosen_set(root: &DataRoot, args: &DataArgs) -> Result<String, Failure> {
    let sets = root.sets();
    let listed = || if sets.is_empty() { "none".into() } else { sets.join(", ") };
    match &args.set {
        Some(set) if sets.contains(set) => Ok(set.clone()),
        Some(set) => Err(Failure::input(format!("no set `{set}` in the data root; its sets: {}", listed()))),
        None if sets.iter().any(|s| s == "nominal") => Ok("nominal".into()),
        None if sets.len() == 1 => Ok(sets[0].clone()),
        None => Err(Failure::input(format!("which set? give --set; the data root has: {}", listed()))),
    }
}

/// Reads the drives that the options name, and their maps.
pub fn read_drives(args: &DataArgs, ground_truth: bool) -> Result<Drives, Failure> {
    check_step(args.dt)?;
    let (root, _) = open_root(args)?;
    let set = chosen_set(&root, args)?;
    let drives = root.load_set(&query(args, &set, args.split, ground_truth)).or_input()?;
    if drives.is_empty() {
        return Err(Failure::input(format!("set `{set}` has no drive in split `{}`", args.split.as_str())));
    }
    for note in root.contradictions().iter().chain(&root.notes()) {
        crate::output::note!("note: {note}");
    }
    for beyond in root.beyond_range(&drives) {
        crate::output::note!("note: set `{set}`: {}", beyond_range_note(&beyond));
    }
    let maps = maps_of(&root, &drives)?;
    let worlds: BTreeMap<&str, &Arc<WorldMap>> =
        drives.iter().zip(&maps).filter_map(|(drive, map)| Some((drive.world.as_deref()?, map.as_ref()?))).collect();
    for doubt in worlds.into_iter().flat_map(|(world, map)| on_map::doubts(&drives, world, map, root.vehicle())) {
        note!("note: set `{set}`: {doubt}");
    }
    Ok(Drives { root, set, drives, maps })
}

/// What commands beyond the range of a card come to: they were recorded, so that the drives are read, and no service would take them.
pub fn beyond_range_note(beyond: &BeyondRange) -> String {
    let of = if beyond.implied { "a range that the card does not state" } else { "the range that the card states" };
    format!(
        "{} drives command beyond {of}, and no service would take that: {beyond}; if its units are right, let `command_range` of the card admit it (`nesam calibrate` and \
         `nesam train` widen a range that is not stated)",
        beyond.drives
    )
}

/// The drives that training left for validation, for `option`, which does `what` with them; only the train split has any.
pub fn validation_drives(args: &DataArgs, option: &str, what: &str) -> Result<Drives, Failure> {
    parted_drives(args, option, what).map(|(validating, _)| validating)
}

/// The same and the drives that train.
pub fn parted_drives(args: &DataArgs, option: &str, what: &str) -> Result<(Drives, Vec<Trajectory>), Failure> {
    if args.split != SplitArg::Train {
        return Err(Failure::input(format!("{option} needs --split train: {what} on validation drives of the train split")));
    }
    let mut all = read_drives(args, false)?;
    let mut sorted: Vec<(Trajectory, Option<Arc<WorldMap>>)> = all.drives.into_iter().zip(all.maps).collect();
    sorted.sort_by(|(a, _), (b, _)| a.id.cmp(&b.id));
    let count = sorted.len();
    let (validating, training): (Vec<_>, Vec<_>) = sorted.into_iter().enumerate().partition(|(i, _)| is_validation(*i, count));
    (all.drives, all.maps) = validating.into_iter().map(|(_, drive)| drive).unzip();
    if all.drives.is_empty() {
        return Err(Failure::input(format!(
            "{option}: training leaves every tenth drive for validation where there are {VALIDATED_FROM} or more; with the {count} of set `{}` all train, and \
             {what} on drives that no weight has seen: record more, or leave out --trajectories",
            all.set
        )));
    }
    Ok((all, training.into_iter().map(|(_, (drive, _))| drive).collect()))
}

/// Training drives to fit baselines on: of the same set, else of the first set of the root that has a train split; `None` when none has.
pub fn training_drives(drives: &Drives, args: &DataArgs) -> Option<Vec<Trajectory>> {
    let all = DataArgs { trajectories: None, ..args.clone() };
    let train = |set: &str| drives.root.load_set(&query(&all, set, SplitArg::Train, false)).ok().filter(|d| !d.is_empty());
    train(&drives.set).or_else(|| drives.root.sets().iter().filter(|s| **s != drives.set).find_map(|s| train(s)))
}

/// One hash over the maps under the drives; empty without maps.
pub fn maps_hash(maps: &[Option<Arc<WorldMap>>]) -> String {
    let mut hashes: Vec<&str> = maps.iter().flatten().map(|m| m.hash()).collect();
    hashes.sort_unstable();
    hashes.dedup();
    if hashes.is_empty() { String::new() } else { nesam_model::bundle::sha256_hex(hashes.concat().as_bytes()) }
}

/// Worlds of the train split, as far as the root knows them.
pub fn worlds_of(drives: &[Trajectory]) -> BTreeSet<String> {
    drives.iter().filter_map(|d| d.world.clone()).collect()
}

/// The query behind the options.
pub fn query(args: &DataArgs, set: &str, split: SplitArg, ground_truth: bool) -> SetQuery {
    SetQuery {
        set: set.into(),
        split: split.into(),
        trajectories: args.trajectories.clone(),
        dt_s: args.dt,
        ground_truth,
        may_lack_drives: args.may_lack_drives,
    }
}

/// The map of each drive. A drive without a world has none; a world that is there and cannot be read is an error.
pub fn maps_of(root: &DataRoot, drives: &[Trajectory]) -> Result<Vec<Option<Arc<WorldMap>>>, Failure> {
    drives.iter().map(|d| d.world.as_deref().map(|world| root.world(world).or_input()).transpose()).collect()
}

/// Loads and verifies a bundle.
pub fn load_bundle(given: Option<&Path>) -> Result<ModelBundle, Failure> {
    ModelBundle::load(&bundle_dir(given)?).or_input()
}

/// The bundle that is given, else the shipped one for the vehicle of the data root, else the shipped one.
pub fn load_bundle_for(given: Option<&Path>, root: &DataRoot) -> Result<ModelBundle, Failure> {
    let own = if given.is_none() { bundle_of_vehicle(&root.vehicle().name) } else { None };
    load_bundle(given.or(own.as_deref()))
}

/// The bundle that a server was recorded with: the given one, else the shipped one of the recorded hash.
pub fn load_recorded_bundle(given: Option<&Path>, header: &RecordingHeader) -> Result<ModelBundle, Failure> {
    let found = if given.is_none() { bundle_of_hash(&header.bundle_hash) } else { None };
    if given.is_none() && found.is_none() {
        return Err(Failure::input(format!(
            "the recording was made with bundle {} {}, which is not in deploy/bundles; give it with --bundle DIR",
            header.bundle, header.bundle_hash
        )));
    }
    load_bundle(given.or(found.as_deref()))
}

/// The bundle as a predictor of the vehicle of a data root, see [`on_vehicle_of`], for drives in steps of `dt_s` seconds.
pub fn predictor_for(bundle: ModelBundle, root: &DataRoot, dt_s: f64) -> Result<Arc<Predictor>, Failure> {
    check_model_step(&bundle, dt_s)?;
    Ok(Arc::new(Predictor::new(Arc::new(on_vehicle_of(bundle, root))).or_input()?))
}

/// The bundle on the vehicle of a data root. The bundle's own card is the calibrated one; only where the data root is of another vehicle does the physics take
/// the new card, while the learned parts stay and what was measured of the bundle's vehicle is dropped ([`ModelBundle::move_to`]). This is said on stderr,
/// and so is what a card of the same name says otherwise.
pub fn on_vehicle_of(mut bundle: ModelBundle, root: &DataRoot) -> ModelBundle {
    let (own, given) = (&bundle.vehicle, root.vehicle());
    let otherwise = uncalibrated_differences(own, given);
    if !bundle.is_of(given) {
        // Cards of one name may be told in different ways where to go.
        let [of_own, of_given] = [own, given].map(|card| {
            let second =
                if own.name == given.name { format!(" with the second command `{}`", second_as_str(card.second)) } else { String::new() };
            format!("`{}`{second}", card.name)
        });
        note!(
            "note: bundle {} was trained for {of_own}; its physics now uses the card of {of_given}, its learned parts are as trained, and what it knows of its errors \
             (reference, soil filter, covariance) and its kinematic model are left out",
            bundle.name
        );
        bundle.move_to(given);
    } else if !otherwise.is_empty() {
        note!(
            "note: {} has another {} than the card of bundle {}, which counts; a card under another vehicle name is used as it is",
            root.card().display(),
            otherwise.join(", "),
            bundle.name
        );
    }
    bundle
}

/// As on a card.
pub fn second_as_str(second: SecondCommand) -> &'static str {
    match second {
        SecondCommand::SteeringNormalised => "steering_normalised",
        SecondCommand::RoadWheelAngleRad => "road_wheel_angle_rad",
        SecondCommand::YawRateRadS => "yaw_rate_rad_s",
    }
}

/// Refuses to write into a bundle, as `option` does, what was measured on the drives of another vehicle: a bundle drops it there.
pub fn check_own_vehicle(bundle: &ModelBundle, root: &DataRoot, option: &str) -> Result<(), Failure> {
    let vehicle = root.vehicle();
    if bundle.is_of(vehicle) {
        return Ok(());
    }
    Err(Failure::input(format!(
        "{option}: bundle {} is of `{}`, the data root of `{}`; make a bundle of that vehicle first, with `nesam calibrate --bundle DIR` or `nesam train`",
        bundle.name, bundle.vehicle.name, vehicle.name
    )))
}

/// Relative difference up to which two numbers of cards are the same: digits that a text drops.
const SAME_SHARE: f64 = 1e-6;

/// What calibration leaves alone and two cards say differently.
fn uncalibrated_differences(a: &Vehicle, b: &Vehicle) -> Vec<&'static str> {
    let steering = |v: &Vehicle| match &v.steering {
        Some(table) => [table.command.as_slice(), table.front_left_rad.as_slice(), table.front_right_rad.as_slice()].concat(),
        None => Vec::new(),
    };
    let of = |v: &Vehicle| {
        [
            ("mass", vec![v.mass_kg]),
            ("inertia", v.inertia_kg_m2.as_flattened().to_vec()),
            ("wheel centre", v.wheel_centre_m.as_flattened().to_vec()),
            ("wheel radius", vec![v.wheel_radius_m]),
            ("wheel width", vec![v.wheel_width_m]),
            ("steering table", steering(v)),
            ("command range", v.command_range.as_flattened().to_vec()),
        ]
    };
    let differ = |a: &[f64], b: &[f64]| {
        let largest = a.iter().chain(b).fold(0.0, |largest: f64, value| largest.max(value.abs()));
        a.len() != b.len() || a.iter().zip(b).any(|(a, b)| (a - b).abs() > SAME_SHARE * largest)
    };
    of(a).into_iter().zip(of(b)).filter(|((_, a), (_, b))| differ(a, b)).map(|((name, _), _)| name).collect()
}

/// The predictor as it is, or with the network's products in rollouts rounded to bf16. `key` is the option that asks for it.
pub fn rounded(predictor: Arc<Predictor>, bf16: bool, key: &str) -> Result<Arc<Predictor>, Failure> {
    if !bf16 {
        return Ok(predictor);
    }
    let none = "this processor has no instructions for products of bf16 (AMX or AVX-512 BF16), where f32 is faster; leave it out";
    let precision = Precision::bf16_here().ok_or_else(|| Failure::input(format!("{key}: {none}")))?;
    Ok(Arc::new(predictor.in_precision(precision)))
}

fn check_step(dt_s: f64) -> Result<(), Failure> {
    if dt_s.is_finite() && (0.01..=1.0).contains(&dt_s) {
        return Ok(());
    }
    Err(Failure::input(format!("--dt {dt_s} is outside 0.01…1 s")))
}

/// Whether a bundle was trained with drives in this step.
fn has_step(bundle: &ModelBundle, dt_s: f64) -> bool {
    (dt_s - bundle.normalization.dt_s).abs() < 1e-9
}

/// A bundle of which another is made: in the step of the drives, and without effects, which were found beside what is changed now. `option` names it.
pub fn bundle_to_change(option: &str, dir: &Path, dt_s: f64) -> Result<ModelBundle, Failure> {
    let bundle = load_bundle(Some(dir))?;
    let refused = |why: String| Err(Failure::input(format!("{option} {}: {why}", dir.display())));
    if !bundle.effects.is_empty() {
        return refused("it carries effects; give the bundle that they were added to".into());
    }
    if !has_step(&bundle, dt_s) {
        return refused(format!("it steps by {} s, --dt is {dt_s} s", bundle.normalization.dt_s));
    }
    Ok(bundle)
}

/// Refuses drives in another step than the one that the bundle was trained with: its network would take them for drives at another speed.
pub fn check_model_step(bundle: &ModelBundle, dt_s: f64) -> Result<(), Failure> {
    if has_step(bundle, dt_s) {
        return Ok(());
    }
    let own_s = bundle.normalization.dt_s;
    Err(Failure::input(format!(
        "bundle {} predicts in steps of {own_s} s, the drives are read in steps of {dt_s} s (--dt {dt_s}); without a bundle, `nesam evaluate --models \
         kinematic,constant_velocity` takes any step",
        bundle.name
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: no bundle is given what was measured on another vehicle. Method: the shipped bundles of car and robot, on the car's drives.
    #[test]
    fn regress_what_another_vehicle_measured_is_not_written_into_a_bundle() {
        let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let bundle = |name: &str| ModelBundle::load(&repository.join("deploy/bundles").join(name)).expect("a shipped bundle");
        let root = DataRoot::open(&repository.join("tests/data/chrono_sample"), None).expect("the shipped sample");
        assert!(check_own_vehicle(&bundle("hmmwv-nominal"), &root, "--make-reference").is_ok());
        assert!(check_own_vehicle(&bundle("clearpath-husky"), &root, "--make-reference").is_err());
    }

    /// Goal: nothing is calibrated on drives that a model was trained on. Method: the shipped sample, of which training leaves none out.
    #[test]
    fn regress_few_drives_leave_none_for_validation() {
        let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/chrono_sample");
        let args = DataArgs { set: Some("nominal".into()), split: SplitArg::Train, ..DataArgs::of(Some(sample)) };
        let count = read_drives(&args, false).expect("the shipped sample").drives.len();
        assert!(count > 0 && count < VALIDATED_FROM, "{count} drives");
        let failure = validation_drives(&args, "--calibrate", "the noise is estimated").err().map(|failure| failure.to_string());
        let failure = failure.unwrap_or_default();
        assert!(failure.contains("--calibrate") && failure.contains(&format!("the {count} of set `nominal`")), "{failure}");
    }

    /// Goal: drives are read in the step of the bundle that predicts them, whatever that is. Method: the shipped bundle, as it is and as one of 0.05 s.
    #[test]
    fn regress_drives_in_another_step_than_the_bundle_are_refused() {
        let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let mut bundle = ModelBundle::load(&repository.join("deploy/bundles/hmmwv-nominal")).expect("a shipped bundle");
        let root = DataRoot::open(&repository.join("tests/data/chrono_sample"), None).expect("the shipped sample");
        for (own_s, other_s) in [(0.1, 0.05), (0.05, 0.1)] {
            bundle.normalization.dt_s = own_s;
            assert!(predictor_for(bundle.clone(), &root, own_s).is_ok(), "{own_s}");
            let failure = predictor_for(bundle.clone(), &root, other_s).err().map(|failure| failure.to_string()).unwrap_or_default();
            assert!(failure.contains(&format!("steps of {own_s} s")) && failure.contains(&format!("--dt {other_s}")), "{own_s}: {failure}");
        }
    }
}
