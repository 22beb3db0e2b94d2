//! How often a diagnosis is right on drives that training never saw: groups of validation drives as pseudo-vehicles, each judged by the reference
//! without its own drives, as recorded (false alarms) and with a change injected into what was recorded (power, wrong claims).
//!
//! `cargo run --release -p nesam-discovery --example pseudo_vehicles -- DATA_ROOT BUNDLE GROUPS [CHANGE…]`
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::sync::Arc;

use nesam_discovery::{Options, Reference, Scoring, diagnose};
use nesam_model::{ModelBundle, Predictor};
use nesam_trajectories::{DataRoot, SetQuery, SplitFilter, Trajectory};

/// Drives of a pseudo-vehicle.
const DRIVES: usize = 5;
/// Changes by name: what they do to a recording and how large.
const CHANGES: [(&str, f64); 17] = [
    ("none", 0.0),
    ("steering_offset", 0.03),
    ("steering_offset", -0.06),
    ("steering_offset", 0.12),
    ("steering_ratio", 0.1),
    ("steering_ratio", -0.2),
    ("steering_delay", 2.0),
    ("speed_gain", 0.05),
    ("speed_gain", -0.1),
    ("speed_delay", 2.0),
    ("gyro_bias", 0.01),
    ("gyro_scale", 0.05),
    ("position_latency", 1.0),
    ("map_offset", 0.03),
    ("map_tilt", 0.01),
    ("velocity_scale", 0.03),
    ("roll_mount", 0.01),
];

fn change(drive: &mut Trajectory, name: &str, size: f64) {
    let steps = size as usize;
    let (controls, states) = (drive.controls.clone(), drive.states.clone());
    let last = controls.len() - 1;
    for k in 0..controls.len() {
        let (c, s) = (&mut drive.controls[k], &mut drive.states[k]);
        match name {
            "none" => {}
            // The vehicle did what was commanded; a vehicle with the effect would have done it at this command.
            "steering_offset" => c.second -= size,
            "steering_ratio" => c.second /= 1.0 + size,
            "steering_delay" => c.second = controls[(k + steps).min(last)].second,
            "speed_gain" => c.speed_m_s /= 1.0 + size,
            "speed_delay" => c.speed_m_s = controls[(k + steps).min(last)].speed_m_s,
            "gyro_bias" => s.angular_velocity_rad_s[2] += size,
            "gyro_scale" => s.angular_velocity_rad_s[2] *= 1.0 + size,
            "position_latency" => s.position_m = states[k.saturating_sub(steps)].position_m,
            "map_offset" => s.position_m[2] += size,
            "map_tilt" => s.attitude_rad[1] += size,
            "roll_mount" => s.attitude_rad[0] += size,
            "velocity_scale" => s.velocity_m_s = s.velocity_m_s.map(|v| v * (1.0 + size)),
            other => panic!("no change `{other}`"),
        }
    }
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [root, bundle, groups, only @ ..] = args.as_slice() else { panic!("DATA_ROOT BUNDLE GROUPS [CHANGE…]") };
    let root = DataRoot::open(Path::new(root), None).unwrap();
    let bundle = ModelBundle::load(Path::new(bundle)).unwrap();
    let reference = Reference::from_json(bundle.reference_json.as_deref().unwrap()).unwrap();
    let mut query = SetQuery::all("nominal");
    query.split = SplitFilter::Train;
    let drives = root.load_set(&query).unwrap();
    let validation: Vec<&Trajectory> = reference.drives.iter().map(|d| drives.iter().find(|t| t.id == d.trajectory).unwrap()).collect();
    let scoring = Scoring { horizon: 32, history: 32, resamples: 1000, seed: 1 };
    let options = Options { fit_on: None, without: Vec::new(), scoring };
    for (name, size) in CHANGES.iter().filter(|(name, _)| only.is_empty() || only.iter().any(|o| o == name)) {
        for group in 0..groups.parse::<usize>().unwrap() {
            // Every sixth drive, so that a group mixes worlds.
            let count = validation.len() / DRIVES;
            let mut chosen: Vec<Trajectory> = (0..DRIVES).map(|i| validation[i * count + group].clone()).collect();
            let mut others = reference.clone();
            others.drives.retain(|d| chosen.iter().all(|t| t.id != d.trajectory));
            let mut judge = bundle.clone();
            judge.reference_json = Some(others.to_json());
            chosen.iter_mut().for_each(|d| change(d, name, *size));
            let maps: Vec<_> = chosen.iter().map(|d| d.world.as_deref().map(|w| root.world(w).unwrap())).collect();
            let predictor = Predictor::new(Arc::new(judge)).unwrap();
            let start = std::time::Instant::now();
            match diagnose(&predictor, &chosen, &maps, &options, &|_, _, _| {}) {
                Ok(found) => {
                    let s = &found.selection;
                    let z: Vec<String> = s.z.iter().flatten().map(|z| format!("{z:.1}")).collect();
                    let size_found: Vec<String> =
                        found.estimates.iter().map(|e| format!("{} {:.3} {:.3?}", e.name, e.value, e.ci95)).collect();
                    println!(
                        "{name} {size} group {group}: {} {} | z {} of {:.1} | distance {:.1} of {:.1} | {} | {:.0} s",
                        found.verdict.as_str().to_uppercase(),
                        found.reason,
                        z.join(" "),
                        s.threshold,
                        s.distance[0],
                        s.distance[1],
                        size_found.join(", "),
                        start.elapsed().as_secs_f64()
                    );
                }
                Err(error) => println!("{name} {size} group {group}: {error}"),
            }
        }
    }
}
