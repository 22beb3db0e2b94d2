//! `nesam inside`: is the physics inside real? Sinkage, loads, forces, slip and soil against a simulator's own values.

use std::path::PathBuf;

use clap::Args;
use nesam_evaluation::{ResidualPart, look_inside, wheel_rates};
use nesam_trajectories::{SoilTruth, Trajectory, read_ground_truth_soil};
use serde_json::{Map, Value, json};

use crate::args::{BundleArgs, DataArgs};
use crate::failure::{Failure, OrFail};
use crate::interrupt::exit_on_ctrl_c;
use crate::output::{check_file, provenance, say, write_json};
use crate::sources::{Drives, load_bundle_for, predictor_for, read_drives};

/// Options of `nesam inside`.
#[derive(Args, Debug)]
pub struct InsideArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    bundle: BundleArgs,
    /// Write the figures as JSON (schema nesam.inside/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

const STATE_NAMES: [&str; 12] = ["x", "y", "z", "roll", "pitch", "yaw", "vx", "vy", "vz", "wx", "wy", "wz"];

/// Runs the command.
pub fn run(args: &InsideArgs) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| check_file(file))?;
    exit_on_ctrl_c("nothing was written");
    let drives = read_drives(&args.data, true)?;
    if drives.drives.iter().all(|d| d.truth.is_none()) {
        return Err(Failure::input(format!("set `{}` has no gt_ columns: there is nothing to compare the physics with", drives.set)));
    }
    let true_soils = true_soils(&drives)?;
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
    let (comparison, residual) = look_inside(&predictor, &drives.drives, &drives.maps, &true_soils);
    say!("{:<28}{:>9}{:>12}{:>12}{:>12}{:>8}{:>8}", "quantity/class", "values", "true mean", "bias", "mean |err|", "corr.", "rank");
    let mut quantities = Map::new();
    for (name, pairs) in &comparison {
        let Some(a) = pairs.agreement() else { continue };
        let number = |v: f64| if v.abs() >= 100.0 { format!("{v:.0}") } else { format!("{v:.4}") };
        let part = |v: Option<f64>| v.map_or("–".into(), |v| format!("{v:.2}"));
        say!(
            "{name:<28}{:>9}{:>12}{:>12}{:>12}{:>8}{:>8}",
            a.count,
            number(a.mean),
            number(a.bias),
            number(a.mae),
            part(a.correlation),
            part(a.rank_correlation)
        );
        quantities.insert(name.clone(), serde_json::to_value(a).expect("numbers serialise; this is a bug"));
    }
    let by_state = || STATE_NAMES.iter().zip(&residual);
    let listed = |text: fn(&ResidualPart) -> String| by_state().map(|(name, part)| format!("{name} {}", text(part))).collect::<Vec<_>>();
    let shares: Map<String, Value> = by_state().map(|(name, part)| ((*name).into(), json!(part.share))).collect();
    let means: Map<String, Value> = by_state().map(|(name, part)| ((*name).into(), json!(part.mean_per_s))).collect();
    say!("\nshare of one step's change that the learned residual carries:");
    say!("{}", listed(|part| format!("{:.0} %", 100.0 * part.share)).join(", "));
    say!("and what it adds on average, per second (m, rad, m/s, rad/s):");
    say!("{}", listed(|part| format!("{:.3}", part.mean_per_s)).join(", "));
    let vehicle = &predictor.bundle().vehicle;
    let believed = [0, 2].map(|w| vehicle.suspension_n_m[w]);
    let seen = wheel_rates(vehicle, drives.drives.iter().filter_map(|d| d.truth.as_ref()));
    if let Some(seen) = seen {
        say!("\nrate of the suspension at a wheel, front and rear: {believed:.0?} N/m in the bundle, {seen:.0?} N/m by force over travel");
    }
    let Some(file) = &args.json else { return Ok(()) };
    let document = json!({
        "schema": "nesam.inside/1",
        "set": drives.set,
        "split": args.data.split.as_str(),
        "quantities": quantities,
        "residual_share": shares,
        "residual_mean_per_s": means,
        "wheel_rate_n_m": { "bundle": believed, "seen": seen },
        "provenance": provenance(Some(predictor.bundle()), &drives),
    });
    write_json(file, &document)
}

/// True soils of each drive's world; `None` where the world states none. A statement that cannot be read is an error.
fn true_soils(drives: &Drives) -> Result<Vec<Option<SoilTruth>>, Failure> {
    let of = |drive: &Trajectory| {
        let world = drive.world.as_deref().map(|world| drives.root.world_dir(world));
        let stated = world.filter(|folder| folder.join("gt_soil.json").exists());
        stated.map(|folder| read_ground_truth_soil(&folder).or_input()).transpose()
    };
    drives.drives.iter().map(of).collect()
}
