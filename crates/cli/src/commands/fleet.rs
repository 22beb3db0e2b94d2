//! `nesam fleet`: what a vehicle gains from the soil map of a fleet in its first seconds.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use nesam_engine::{
    Candidates, Command, Engine, FleetSoilSettings, Limits, Measurement, OpenSession, PredictExtras, PredictQuery, Reply, WheelMeasurement,
};
use nesam_evaluation::{DEFAULT_RESAMPLES, POSE_DIM, PosePath, Resamples, Truth, Window, WindowErrors, pose_of};
use nesam_model::{MAX_HORIZON, Predictor};
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;
use serde::Serialize;
use serde_json::json;

use crate::args::{BundleArgs, DataArgs, check_count};
use crate::failure::{Failure, OrFail};
use crate::interrupt;
use crate::output::{check_file, provenance, say, write_json};
use crate::progress::Progress;
use crate::sources::{load_bundle_for, predictor_for, read_drives};

/// Step of the model, ns.
const STEP_NS: i64 = 100_000_000;

/// Options of `nesam fleet`.
#[derive(Args, Debug)]
pub struct FleetArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    bundle: BundleArgs,
    /// Steps to predict
    #[arg(long, value_name = "STEPS", default_value_t = MAX_HORIZON)]
    horizon: usize,
    /// Part of the second drive that is scored: predictions start in its first so many seconds, one every half second
    #[arg(long, value_name = "SECONDS", default_value_t = 5.0)]
    first_s: f64,
    /// Distance over which evidence loses the factor e, m
    #[arg(long, value_name = "M", default_value_t = FleetSoilSettings::default().reach_m)]
    reach_m: f64,
    /// Process noise, as share of the standard deviations of the filter's prior
    #[arg(long, value_name = "SHARE", default_value_t = FleetSoilSettings::default().process_share)]
    process_share: f64,
    /// Seed of the bootstrap
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write the figures as JSON (schema nesam.fleet/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Two drives of one world: the first teaches, the second is scored.
struct Pair<'a> {
    teacher: &'a Trajectory,
    driver: &'a Trajectory,
    map: &'a Arc<WorldMap>,
}

/// Runs the command.
pub fn run(args: &FleetArgs) -> Result<(), Failure> {
    check_count("--horizon", args.horizon, 1..=MAX_HORIZON)?;
    if !(args.first_s > 0.0 && args.first_s.is_finite()) {
        return Err(Failure::input(format!("--first-s {} is not above 0", args.first_s)));
    }
    args.json.iter().try_for_each(|file| check_file(file))?;
    interrupt::exit_on_ctrl_c("nothing was written");
    let drives = read_drives(&args.data, false)?;
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
    let pairs = pairs_of(&drives.drives, &drives.maps);
    if pairs.is_empty() {
        return Err(Failure::input("no world of the set has two drives; a second vehicle needs one that drove before it"));
    }
    let mut errors = [WindowErrors::empty(args.horizon), WindowErrors::empty(args.horizon)];
    let progress = Progress::start("pairs driven", pairs.len());
    for (index, pair) in pairs.iter().enumerate() {
        for (errors, shared) in errors.iter_mut().zip([false, true]) {
            drive_pair(pair, index, &predictor, args, shared, errors)?;
        }
        progress.set(index + 1);
    }
    progress.finish();
    let gains = gains(&errors, pairs.len(), args);
    print_table(&drives.set, args, pairs.len(), errors[0].windows(), &gains);
    let Some(file) = &args.json else { return Ok(()) };
    let document = json!({
        "schema": "nesam.fleet/1",
        "set": drives.set,
        "split": args.data.split.as_str(),
        "pairs": pairs.iter().map(|p| json!({ "teacher": p.teacher.id, "driver": p.driver.id })).collect::<Vec<_>>(),
        "windows": errors[0].windows(),
        "horizon": args.horizon,
        "first_s": args.first_s,
        "reach_m": args.reach_m,
        "process_share": args.process_share,
        "seed": args.seed,
        "errors": gains.iter().map(|gain| (gain.name, gain)).collect::<BTreeMap<_, _>>(),
        "provenance": provenance(Some(predictor.bundle()), &drives),
    });
    write_json(file, &document)
}

/// Every drive behind the one before it in the same world, the first behind the last: each is scored once.
fn pairs_of<'a>(drives: &'a [Trajectory], maps: &'a [Option<Arc<WorldMap>>]) -> Vec<Pair<'a>> {
    let mut worlds: BTreeMap<&str, Vec<(&Trajectory, &Arc<WorldMap>)>> = BTreeMap::new();
    for (drive, map) in drives.iter().zip(maps) {
        if let (Some(world), Some(map)) = (&drive.world, map) {
            worlds.entry(world).or_default().push((drive, map));
        }
    }
    let several = worlds.values().filter(|drives| drives.len() > 1);
    several
        .flat_map(|drives| {
            let before = drives.iter().cycle().skip(drives.len() - 1);
            before.zip(drives).map(|((teacher, _), (driver, map))| Pair { teacher, driver, map })
        })
        .collect()
}

/// Lets the teacher drive, then the driver, through the engine of the service; scores what the service would have answered to the driver.
fn drive_pair(
    pair: &Pair<'_>,
    index: usize,
    predictor: &Arc<Predictor>,
    args: &FleetArgs,
    shared: bool,
    errors: &mut WindowErrors,
) -> Result<(), Failure> {
    let mut engine = Engine::new(predictor.clone(), Limits::default()).or_input()?;
    let mut now_ns = 0;
    engine.execute(now_ns, &Command::PutMap { map: pair.map.clone(), base: None }).or_failed()?;
    if shared {
        let settings = FleetSoilSettings { reach_m: args.reach_m, process_share: args.process_share, ..FleetSoilSettings::default() };
        engine = engine.with_fleet_soil(settings).or_input()?;
        open(&mut engine, now_ns, "teacher", pair.map)?;
        for sample in 0..pair.teacher.states.len() {
            feed(&mut engine, now_ns, "teacher", pair.teacher, sample)?;
            now_ns += STEP_NS as u64;
        }
    }
    open(&mut engine, now_ns, "driver", pair.map)?;
    let drive = pair.driver;
    let last_start = ((args.first_s * 10.0).round() as usize).min(drive.states.len().saturating_sub(args.horizon + 1));
    for sample in 0..last_start {
        feed(&mut engine, now_ns, "driver", drive, sample)?;
        now_ns += STEP_NS as u64;
        if sample % 5 == 0 {
            let window = Window { trajectory: drive, drive: index, start: sample, first_history: 0, horizon: args.horizon };
            let poses = predict(&mut engine, now_ns, drive, sample, args.horizon)?;
            let path = PosePath { poses, predicts: [true; POSE_DIM] };
            let (truth, path_m) = (window.truth(Truth::Measured), window.path_m(Truth::Measured));
            errors.push(index, &window.start_pose(), &path, &truth, path_m, [true; POSE_DIM]);
        }
    }
    Ok(())
}

fn open(engine: &mut Engine, now_ns: u64, vehicle: &str, map: &WorldMap) -> Result<(), Failure> {
    let open = OpenSession { vehicle: vehicle.into(), map: map.id().into(), ..Default::default() };
    engine.execute(now_ns, &Command::Open(open)).or_failed().map(|_| ())
}

fn feed(engine: &mut Engine, now_ns: u64, vehicle: &str, drive: &Trajectory, sample: usize) -> Result<(), Failure> {
    let measurement = Measurement {
        sequence: Some(sample as u64 + 1),
        boot: None,
        stamp_ns: sample as i64 * STEP_NS,
        state: drive.states[sample],
        command: drive.controls[sample],
        wheels: WheelMeasurement::default(),
    };
    engine.execute(now_ns, &Command::Measure { session: vehicle.into(), vehicle: None, measurement }).or_failed().map(|_| ())
}

/// Poses after steps 1…K from the newest measurement, with the commands of the drive.
fn predict(engine: &mut Engine, now_ns: u64, drive: &Trajectory, sample: usize, horizon: usize) -> Result<Vec<[f64; POSE_DIM]>, Failure> {
    let controls = drive.controls[sample..sample + horizon].iter().flat_map(|control| control.packed()).collect();
    let query = PredictQuery {
        session: "driver".into(),
        start: None,
        instant: None,
        use_history: true,
        samples: 1,
        samples_min: 0,
        horizon,
        extras: PredictExtras::default(),
        controls: Candidates::Given(controls),
        cost: None,
    };
    match engine.execute(now_ns, &Command::Predict(query)).or_failed()? {
        Reply::Predicted(prediction) => Ok((0..horizon).map(|k| pose_of(&prediction.rollout.state_f64(0, k))).collect()),
        _ => Err(Failure::Failed("the engine answered a prediction with another reply; this is a bug".into())),
    }
}

/// A figure with its 95 % interval over pairs of drives.
#[derive(Serialize)]
struct Figure {
    mean: f64,
    ci95: Option<[f64; 2]>,
}

impl Figure {
    fn cell(&self) -> String {
        let interval = self.ci95.map_or(String::new(), |[low, high]| format!(" [{low:.3}, {high:.3}]"));
        format!("{:.3}{interval}", self.mean)
    }
}

/// Mean absolute errors over the horizon of one quantity, without and with the soil map of the vehicle before, and their ratio.
#[derive(Serialize)]
struct Gain {
    #[serde(skip)]
    name: &'static str,
    #[serde(skip)]
    title: &'static str,
    without: Figure,
    with: Figure,
    ratio: Figure,
}

fn gains([without, with]: &[WindowErrors; 2], pairs: usize, args: &FleetArgs) -> Vec<Gain> {
    let resamples = Resamples::draw(pairs, DEFAULT_RESAMPLES, args.seed);
    let quantities = [
        ("position_m", "position m", POSE_DIM),
        ("z_m", "z m", 2),
        ("roll_deg", "roll °", 3),
        ("pitch_deg", "pitch °", 4),
        ("yaw_deg", "yaw °", 5),
    ];
    let gain = |(name, title, column)| {
        let rows = |errors: &WindowErrors| -> Vec<f64> {
            let columns: Vec<Vec<f64>> = (0..args.horizon).map(|k| errors.column(k, column)).collect();
            (0..errors.windows()).map(|w| columns.iter().map(|c| c[w]).sum::<f64>() / args.horizon as f64).collect()
        };
        let mean = |rows: &[f64]| rows.iter().sum::<f64>() / rows.len() as f64;
        let figure = |rows: &[f64]| Figure { mean: mean(rows), ci95: resamples.mean_interval(rows, &without.trajectory) };
        let (a, b) = (rows(without), rows(with));
        let ratio = Figure { mean: mean(&b) / mean(&a), ci95: resamples.ratio_interval(&b, &a, &without.trajectory) };
        Gain { name, title, without: figure(&a), with: figure(&b), ratio }
    };
    quantities.map(gain).into()
}

fn print_table(set: &str, args: &FleetArgs, pairs: usize, windows: usize, gains: &[Gain]) {
    say!(
        "{set}: {windows} windows of {} steps from the first {} s of {pairs} drives, each behind another drive of its world; mean absolute errors over the horizon",
        args.horizon,
        args.first_s,
    );
    say!("\n{:<12}{:>28}{:>28}{:>28}", "", "without the map", "with the map of another", "with / without");
    for Gain { title, without, with, ratio, .. } in gains {
        say!("{title:<12}{:>28}{:>28}{:>28}", without.cell(), with.cell(), ratio.cell());
    }
}
