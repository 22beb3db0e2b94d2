//! `nesam inspect`: what a bundle or a data root holds.

use std::path::{Path, PathBuf};

use clap::Args;
use nesam_model::ModelBundle;
use nesam_model::bundle::MANIFEST;
use nesam_physics::effects::ScheduledEffect;
use nesam_physics::{DT_S, SOIL_NAMES, Vehicle};
use nesam_trajectories::{DataRoot, SetQuery, Split};
use serde_json::{Map, Value, json};

use crate::bundle_path::bundle_dir;
use crate::failure::{Failure, OrFail};
use crate::output;
use crate::output::say;
use crate::sources::second_as_str;

/// Options of `nesam inspect`.
#[derive(Args, Debug)]
pub struct InspectArgs {
    /// A bundle or a data root [default: the shipped bundle]
    #[arg(value_name = "PATH")]
    path: Option<PathBuf>,
    /// Vehicle card, when a data root has none of its own
    #[arg(long, value_name = "FILE")]
    vehicle: Option<PathBuf>,
    /// Also write the summary as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &InspectArgs) -> Result<(), Failure> {
    let path = match &args.path {
        Some(path) => path.clone(),
        None => bundle_dir(None)?,
    };
    if !path.is_dir() {
        return Err(Failure::input(format!("{} is not a folder; give a bundle or a data root", path.display())));
    }
    args.json.iter().try_for_each(|file| output::check_file(file))?;
    let is_bundle = path.join(MANIFEST).is_file();
    if is_bundle && args.vehicle.is_some() {
        return Err(Failure::input(format!("--vehicle is for data roots; {} is a bundle and has a card of its own", path.display())));
    }
    let summary = if is_bundle { bundle(&path)? } else { data_root(&path, args.vehicle.as_deref())? };
    print_tree(&summary, 0);
    if let Some(file) = &args.json {
        output::write_json(file, &summary)?;
    }
    Ok(())
}

fn bundle(path: &Path) -> Result<Value, Failure> {
    let bundle = ModelBundle::load(path).or_input()?;
    let soil: Map<String, Value> = SOIL_NAMES.iter().zip(bundle.default_soil()).map(|(k, v)| ((*k).into(), json!(v))).collect();
    let p = &bundle.provenance;
    Ok(json!({
        "schema": "nesam.inspect/1",
        "kind": "bundle",
        "name": bundle.name,
        "hash": bundle.hash,
        "parameters": bundle.parameters,
        "vehicle": vehicle(&bundle.vehicle),
        "default_soil": soil,
        "fitted_baselines": bundle.baselines_json.is_some(),
        "effects": bundle.effects.iter().map(effect).collect::<Vec<_>>(),
        "made_by": {
            "command": p.command, "seed": p.seed, "data_hash": p.data_hash, "steps": p.steps, "training_s": p.training_s,
            "program": p.program, "derived_from": p.parent,
        },
    }))
}

/// An effect that a bundle has beside its card; an onset of 0 = it acts always.
fn effect(scheduled: &ScheduledEffect) -> Value {
    let parameters = scheduled.effect.parameters();
    let parameters: Vec<Value> = parameters.iter().map(|p| json!({"name": p.name, "unit": p.unit, "value": p.value})).collect();
    json!({"id": scheduled.effect.id(), "layer": scheduled.effect.layer().as_str(), "onset_s": scheduled.onset_s, "parameters": parameters})
}

fn data_root(path: &Path, card: Option<&Path>) -> Result<Value, Failure> {
    let root = DataRoot::open(path, card).or_input()?;
    let sets: Vec<Value> = root.sets().iter().map(|set| set_summary(&root, set)).collect::<Result<_, _>>()?;
    Ok(json!({"schema": "nesam.inspect/1", "kind": "data root", "vehicle": vehicle(root.vehicle()), "sets": sets}))
}

fn set_summary(root: &DataRoot, set: &str) -> Result<Value, Failure> {
    let drives = root.load_set(&SetQuery::all(set)).or_input()?;
    let in_split = |split| drives.iter().filter(|d| d.split == split).count();
    let mut worlds: Vec<&str> = drives.iter().filter_map(|d| d.world.as_deref()).collect();
    worlds.sort_unstable();
    worlds.dedup();
    let samples: usize = drives.iter().map(|d| d.states.len()).sum();
    Ok(json!({
        "set": set,
        "drives": drives.len(),
        "train": in_split(Some(Split::Train)),
        "test": in_split(Some(Split::Test)),
        "minutes": (samples as f64 * DT_S / 6.0).round() / 10.0,
        "linear_velocity": if drives.iter().all(|d| d.measured.linear_velocity) { "measured" } else { "estimated" },
        "worlds": worlds.join(" "),
    }))
}

fn vehicle(v: &Vehicle) -> Value {
    json!({
        "name": v.name,
        "mass_kg": v.mass_kg,
        "inertia": if v.inertia_estimated { "estimated from a box" } else { "from the card" },
        "wheelbase_m": v.wheelbase_m,
        "track_m": v.track_m,
        "wheel_radius_m": v.wheel_radius_m,
        "second": second_as_str(v.second),
        "speed_range_m_s": v.command_range[0],
        "second_range": v.command_range[1],
    })
}

/// Prints an object as indented `name: value` lines.
fn print_tree(value: &Value, depth: usize) {
    let indent = "  ".repeat(depth);
    match value {
        Value::Object(fields) => {
            for (name, field) in fields.iter().filter(|(name, _)| *name != "schema") {
                match field {
                    Value::Object(_) => {
                        say!("{indent}{name}:");
                        print_tree(field, depth + 1);
                    }
                    Value::Array(items) if items.iter().any(Value::is_object) => {
                        say!("{indent}{name}:");
                        for item in items {
                            print_row(item, depth + 1);
                        }
                    }
                    other => say!("{indent}{name}: {}", plain(other)),
                }
            }
        }
        other => say!("{indent}{}", plain(other)),
    }
}

/// Prints an object on one line.
fn print_row(value: &Value, depth: usize) {
    let Value::Object(fields) = value else { return };
    // The row's own name comes first; the rest keeps the order of the object.
    let own = |name: &str| ["set", "id"].contains(&name);
    let rest = fields.iter().filter(|(name, _)| !own(name));
    let named = fields.iter().find(|(name, _)| own(name));
    let cells: Vec<String> = named.map(|(_, v)| plain(v)).into_iter().chain(rest.map(|(name, v)| format!("{name} {}", plain(v)))).collect();
    say!("{}{}", "  ".repeat(depth), cells.join(" · "));
}

fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Array(items) if items.iter().any(|item| item["name"].is_string()) => {
            items.iter().map(parameter).collect::<Vec<_>>().join(", ")
        }
        other => other.to_string(),
    }
}

/// Name, value and unit of a parameter.
fn parameter(p: &Value) -> String {
    let unit = p["unit"].as_str().filter(|unit| *unit != "-").map_or(String::new(), |unit| format!(" {unit}"));
    format!("{} {}{unit}", plain(&p["name"]), p["value"])
}
