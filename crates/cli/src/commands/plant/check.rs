//! `nesam plant check`: how real the plant is, against the simulator that made the recorded drives.
//!
//! The plant is set down as the recorded vehicle was, gets the recorded commands, and is put back on the recorded motion every 0.1 s, so that ruts, springs and
//! the speed controller are as they were. From every fourth second on a copy runs free for 3.2 s and is compared with the record.

use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use nesam_evaluation::{median, quantile_sorted};
use nesam_physics::wrap_angle;
use nesam_plant::{Command, Ground, HiddenEffects, Plant, PlantVehicle, Truth, WHEELS};
use nesam_trajectories::{GroundTruth, Trajectory};
use serde_json::{Value, json};

use super::BEFORE;
use crate::args::DataArgs;
use crate::failure::{Failure, OrFail};
use crate::interrupt::exit_on_ctrl_c;
use crate::output::{check_file, provenance, say, write_json};
use crate::progress::Progress;
use crate::sources::{open_root, read_drives};

/// Free steps that are compared, steps between comparisons, and the first of them.
const FREE_STEPS: usize = 32;
const EVERY: usize = 40;
const FIRST: usize = 32;
/// Free steps after which errors are reported.
const REPORTED: [usize; 3] = [10, 20, 32];

/// Options of `nesam plant check`.
#[derive(Args, Debug)]
pub struct CheckArgs {
    #[command(flatten)]
    data: DataArgs,
    /// Write the figures as JSON (schema nesam.plant_check/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Plant against record after so many free steps.
struct Compared {
    after: usize,
    /// m, rad, m/s.
    position: f64,
    yaw: f64,
    height: f64,
    roll: f64,
    pitch: f64,
    speed: f64,
    /// Plant and record, mean over the wheels.
    sinkage: [f64; 2],
    slip: [f64; 2],
}

/// Runs the command.
pub fn run(args: &CheckArgs) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| check_file(file))?;
    exit_on_ctrl_c("nothing was written");
    let drives = read_drives(&args.data, true)?;
    let (_, root) = open_root(&args.data)?;
    let vehicle = Arc::new(PlantVehicle::of_root(&root).or_input()?);
    let progress = Progress::start("drives compared", drives.drives.len());
    let mut compared = Vec::new();
    for (done, drive) in drives.drives.iter().enumerate() {
        let world = drive.world.as_deref().ok_or_else(|| Failure::input(format!("drive {} has no world", drive.id)))?;
        let ground = Arc::new(Ground::read(&root.join("worlds").join(world)).or_input()?);
        let truth = drive.truth.as_ref().ok_or_else(|| Failure::input(format!("drive {} has no gt_ columns", drive.id)))?;
        compared.extend(compare(&vehicle, &ground, drive, truth));
        progress.set(done + 1);
    }
    progress.finish();
    print(&compared);
    if let Some(file) = &args.json {
        let rows: Vec<Value> = REPORTED.iter().filter_map(|after| of_step(&compared, *after)).collect();
        let document = json!({ "schema": "nesam.plant_check/1", "set": drives.set, "drives": drives.drives.len(), "after": rows, "provenance": provenance(None, &drives) });
        write_json(file, &document)?;
    }
    Ok(())
}

fn compare(vehicle: &Arc<PlantVehicle>, ground: &Arc<Ground>, drive: &Trajectory, truth: &GroundTruth) -> Vec<Compared> {
    let samples = truth.states.len();
    let command = |k: usize| Command { speed_m_s: drive.controls[k].speed_m_s, steering: drive.controls[k].second };
    let state = |k: usize| truth.states[k].to_array();
    let first = state(0);
    // Straight acceleration to the first speed takes about half of it times its duration.
    let back = 0.5 * 0.1 * BEFORE[1] as f64 * first[6];
    let (sin, cos) = first[5].sin_cos();
    let effects = HiddenEffects::default();
    let mut plant =
        Plant::at_rest(Arc::clone(vehicle), Arc::clone(ground), effects, first[0] - back * cos, first[1] - back * sin, first[5]);
    for (steps, speed_m_s) in BEFORE.into_iter().zip([0.0, command(0).speed_m_s]) {
        (0..steps).for_each(|_| plant.advance(Command { speed_m_s, steering: 0.0 }));
    }
    let mut compared = Vec::new();
    for i in 0..samples.saturating_sub(FREE_STEPS) {
        plant.set_state(&state(i), truth.wheel_speed_rad_s[i], truth.steering_actuator[i]);
        if i >= FIRST && (i - FIRST).is_multiple_of(EVERY) {
            let mut free = plant.clone();
            for k in 1..=FREE_STEPS {
                free.advance(command(i + k - 1));
                if REPORTED.contains(&k) {
                    compared.push(difference(&free.truth(), truth, i + k, k));
                }
            }
        }
        plant.advance(command(i));
    }
    compared
}

fn difference(plant: &Truth, record: &GroundTruth, at: usize, after: usize) -> Compared {
    let (a, b) = (plant.state, record.states[at].to_array());
    let mean = |values: &[f64; WHEELS]| values.iter().sum::<f64>() / WHEELS as f64;
    Compared {
        after,
        position: (a[0] - b[0]).hypot(a[1] - b[1]),
        yaw: wrap_angle(a[5] - b[5]),
        height: a[2] - b[2],
        roll: a[3] - b[3],
        pitch: a[4] - b[4],
        speed: a[6] - b[6],
        sinkage: [mean(&plant.sinkage_max_m), mean(&record.sinkage_max_m[at])],
        slip: [mean(&plant.slip), mean(&record.slip[at])],
    }
}

/// Figures after so many free steps; `None` where nothing was compared.
fn of_step(compared: &[Compared], after: usize) -> Option<Value> {
    let rows: Vec<&Compared> = compared.iter().filter(|c| c.after == after).collect();
    if rows.is_empty() {
        return None;
    }
    let mean = |of: &dyn Fn(&Compared) -> f64| rows.iter().map(|c| of(c)).sum::<f64>() / rows.len() as f64;
    let mut position: Vec<f64> = rows.iter().map(|c| c.position).collect();
    position.sort_by(f64::total_cmp);
    let correlation = |of: fn(&Compared) -> [f64; 2]| {
        let (a, b) = (mean(&|c| of(c)[0]), mean(&|c| of(c)[1]));
        let product = mean(&|c| (of(c)[0] - a) * (of(c)[1] - b));
        product / (mean(&|c| (of(c)[0] - a).powi(2)) * mean(&|c| (of(c)[1] - b).powi(2))).sqrt()
    };
    Some(json!({
        "after_s": 0.1 * after as f64,
        "windows": rows.len(),
        "position_m": { "mean": mean(&|c| c.position), "median": median(&position), "p90": quantile_sorted(&position, 0.9) },
        "yaw_deg": { "mean_abs": mean(&|c| c.yaw.abs()).to_degrees(), "bias": mean(&|c| c.yaw).to_degrees() },
        "z_m": { "mean_abs": mean(&|c| c.height.abs()), "bias": mean(&|c| c.height) },
        "roll_deg": mean(&|c| c.roll.abs()).to_degrees(),
        "pitch_deg": mean(&|c| c.pitch.abs()).to_degrees(),
        "speed_m_s": { "mean_abs": mean(&|c| c.speed.abs()), "bias": mean(&|c| c.speed) },
        "sinkage_m": { "plant": mean(&|c| c.sinkage[0]), "record": mean(&|c| c.sinkage[1]), "correlation": correlation(|c| c.sinkage) },
        "slip": { "plant": mean(&|c| c.slip[0]), "record": mean(&|c| c.slip[1]), "correlation": correlation(|c| c.slip) },
    }))
}

fn print(compared: &[Compared]) {
    say!("plant against record, errors of free runs with the recorded commands");
    say!(
        "after s  windows  position m mean, median, 90 %   yaw °   z m    roll °  pitch °  speed m/s (bias)   sinkage m plant, record (corr.)   slip plant, record (corr.)"
    );
    for row in REPORTED.iter().filter_map(|after| of_step(compared, *after)) {
        let number = |pointer: &str| row.pointer(pointer).and_then(Value::as_f64).unwrap_or(f64::NAN);
        say!(
            "{:>7.1}{:>9.0}{:>12.3}{:>8.3}{:>8.3}{:>12.2}{:>8.3}{:>8.2}{:>8.2}{:>9.3} ({:+.3}){:>13.4}{:>8.4} ({:.2}){:>19.3}{:>8.3} ({:.2})",
            number("/after_s"),
            number("/windows"),
            number("/position_m/mean"),
            number("/position_m/median"),
            number("/position_m/p90"),
            number("/yaw_deg/mean_abs"),
            number("/z_m/mean_abs"),
            number("/roll_deg"),
            number("/pitch_deg"),
            number("/speed_m_s/mean_abs"),
            number("/speed_m_s/bias"),
            number("/sinkage_m/plant"),
            number("/sinkage_m/record"),
            number("/sinkage_m/correlation"),
            number("/slip/plant"),
            number("/slip/record"),
            number("/slip/correlation")
        );
    }
}
