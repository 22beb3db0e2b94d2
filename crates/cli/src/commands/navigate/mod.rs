//! `nesam navigate`: laps of a closed path on a simulated vehicle, with predictions from the service and without.

mod laps;
mod stage;

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use nesam_model::ModelBundle;
use nesam_model::bundle::sha256_hex;
use nesam_navigation::{
    CautionSettings, MppiSettings, NavigationReport, ReferencePath, Run, SoilKind, Stretch, TrackingCost, lap_file_name,
};
use nesam_physics::{SecondCommand, Vehicle, driveline::road_wheel_angles};
use nesam_plant::HiddenEffects;
use nesam_terrain::WorldMap;
use nesam_trajectories::{DataRoot, read_ground_truth_soil};
use serde_json::{Value, json};

use crate::args::{BundleArgs, DataArgs};
use crate::failure::{Failure, OrFail};
use crate::interrupt::note_ctrl_c;
use crate::output::{self, say};
use crate::sources::{check_model_step, load_bundle_for, on_vehicle_of, open_root};

use laps::{Driven, Identity, Kept, drive_all};
use stage::{Bundles, Stage, kinematic_of};

/// Correlation of the planner's noise from step to step, its standard deviation (m/s; share of full steering) and the temperature of its weights.
const NOISE_CORRELATION: f64 = 0.8;
const NOISE_SD: [f64; 2] = [0.4, 0.16];
const TEMPERATURE: f64 = 0.1;
/// Radius of the turn at the wanted speed that counts as full steering for a vehicle that is told its yaw rate, m.
const SHARPEST_TURN_M: f64 = 2.5;
/// Admitted speed commands: what the training drives cover, m/s.
const SPEED_LIMITS_M_S: [f64; 2] = [0.5, 4.0];
/// Weights of progress and tilt against the squared distance from the path.
const LAG_WEIGHT: f64 = 0.1;
const TILT_WEIGHT: f64 = 2.0;
/// What the planner does about ground further ahead that will not hold the vehicle on the path (ADR 0061, 0078).
const CAUTION: CautionSettings = CautionSettings {
    ahead_m: [6.0, 10.0, 14.0, 18.0],
    every_steps: 10,
    trial_speed_m_s: 2.5,
    slowed_by_m: [-0.8, -0.5],
    slow_m_s: 2.2,
    slow_limits_m_s: [2.0, 2.6],
    slowed_over: Stretch { lead_m: 12.0, ramp_m: 6.0, behind_m: 3.0 },
    moved_by_m: [-0.7, -0.2],
    inside_m: 1.8,
    moved_over: Stretch { lead_m: 8.0, ramp_m: 8.0, behind_m: 0.0 },
};
/// Worlds of the scenario, where the data root has them.
const SCENARIO: [&str; 5] = ["w35", "w36", "w37", "w38", "w39"];
/// Files that tell the true soil of a world.
const TRUE_SOIL: [&str; 2] = ["gt_soil.json", "gt_region.png"];
/// Largest seed.
const SEED_MAX: u64 = 1 << 53;
/// Steps of a candidate at most: one of the 32 positions of the model is the step whose command is already on its way.
const HORIZON_MAX: usize = 31;

/// Options of `nesam navigate`.
#[derive(Args, Debug)]
pub struct NavigateArgs {
    /// Data root with the vehicle's data sheet and worlds with true soil [default: the sample shipped with the repository]
    #[arg(long, value_name = "ROOT")]
    data: Option<PathBuf>,
    #[command(flatten)]
    bundle: BundleArgs,
    /// Worlds to drive in [default: those of w35 to w39 with true soil, else every world with true soil; with --plant true soil is not needed]
    #[arg(long, value_name = "ID,…", value_delimiter = ',')]
    worlds: Option<Vec<String>>,
    /// Where predictions come from [default: fixed, adapted, oracle, kinematic, and diagnosed where --diagnosed is given]
    #[arg(long, value_enum, value_name = "NAME,…", value_delimiter = ',')]
    configurations: Option<Vec<Configuration>>,
    /// Bundle with the effects that a diagnosis found (`nesam diagnose` writes it), for the configuration `diagnosed`
    #[arg(long, value_name = "DIR")]
    diagnosed: Option<PathBuf>,
    /// Laps per configuration: worlds and both starts in turn, then the next seed
    #[arg(long, default_value_t = 30)]
    runs: usize,
    /// First seed of sensors and planner; all configurations drive the same seeds
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Candidate sequences of a plan
    #[arg(long, value_name = "N", default_value_t = 128)]
    candidates: usize,
    /// Steps of a candidate, 1 to 31
    #[arg(long, value_name = "STEPS", default_value_t = 30)]
    horizon: usize,
    /// Steps of 0.1 s from plan to plan
    #[arg(long, value_name = "STEPS", default_value_t = 2)]
    plan_every: usize,
    /// Look no further ahead than candidates reach: without it the planner tries places of the path up to 18 m ahead and comes slower and further inside to those
    /// that will not hold the vehicle
    #[arg(long)]
    no_caution: bool,
    /// Wanted speed, m/s
    #[arg(long, value_name = "M/S", default_value_t = 3.0)]
    speed: f64,
    /// Hidden effect of the vehicle, told to the plant only; may be given several times (`nesam plant effects` lists them)
    #[arg(long, value_name = "ID=MAGNITUDE")]
    effect: Vec<String>,
    /// Drive another simulator that speaks the plant protocol over UDP (docs/plant-adapter.md)
    #[arg(long, value_name = "HOST:PORT", conflicts_with = "effect")]
    plant: Option<String>,
    /// How long another simulator may take for an answer before it counts as gone [default: 1800]
    #[arg(long, value_name = "SECONDS", requires = "plant")]
    plant_timeout: Option<u64>,
    /// Take laps that are there already of a simulator that does not say which it is: it is the one that drove them
    #[arg(long, requires = "plant")]
    resume: bool,
    /// Folder for one file per lap; laps that are there already, with the same settings on the same plant, are not driven again [default: nesam-out/navigate-laps]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Write the results as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write a report with the paths as HTML
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
}

/// Where predictions come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Configuration {
    /// The service, soil prior as it is.
    Fixed,
    /// The service, learning the soil while driving.
    Adapted,
    /// The service, told the true soil.
    Oracle,
    /// A fitted bicycle on the map, no service.
    Kinematic,
    /// The service, learning the soil while driving, with the bundle of --diagnosed.
    Diagnosed,
}

impl Configuration {
    const USUAL: [Self; 4] = [Self::Fixed, Self::Adapted, Self::Oracle, Self::Kinematic];

    /// As in the JSON.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Fixed => "fixed",
            Self::Adapted => "adapted",
            Self::Oracle => "oracle",
            Self::Kinematic => "kinematic",
            Self::Diagnosed => "diagnosed",
        }
    }
}

/// One lap to drive.
pub struct Task {
    pub configuration: Configuration,
    pub world: String,
    pub soil: SoilKind,
    /// Half turns from phi = 0.
    pub start: usize,
    pub seed: u64,
}

impl Task {
    fn file_name(&self) -> String {
        lap_file_name(self.configuration.as_str(), &self.world, self.start, self.seed)
    }

    fn is_of(&self, run: &Run) -> bool {
        (self.configuration.as_str(), &self.world, self.soil, self.start, self.seed)
            == (run.configuration.as_str(), &run.world, run.soil, run.start, run.seed)
    }
}

/// Runs the command.
pub fn run(args: &NavigateArgs) -> Result<(), Failure> {
    check(args)?;
    output::check_files(args.json.iter().chain(&args.html))?;
    note_ctrl_c(
        "stopping: the laps that are done are kept and reported; Ctrl-C again to stop at once",
        "stopped at once: the laps that are done are kept",
    );
    let effects = HiddenEffects::parse(args.effect.iter().map(String::as_str)).or_input()?;
    let data = DataArgs::of(args.data.clone());
    let (root, path) = open_root(&data)?;
    let load = |dir: Option<&Path>| {
        let bundle = load_bundle_for(dir, &root)?;
        check_model_step(&bundle, data.dt)?;
        Ok::<_, Failure>(on_vehicle_of(bundle, &root))
    };
    let bundle = load(args.bundle.bundle.as_deref())?;
    let diagnosed = args.diagnosed.as_deref().map(|dir| load(Some(dir))).transpose()?;
    check_speed(args.speed, &bundle.vehicle)?;
    let worlds = worlds_of(args, &root)?;
    let configurations = configurations(args, &bundle, &root, &worlds)?;
    let tasks = tasks_of(args, &worlds, &configurations);
    let mut settings = settings_of(args, &bundle, diagnosed.as_ref());
    let of_worlds = worlds.iter().map(|(world, _)| Ok((world.clone(), settings_of_lap(&settings, &root, world)?)));
    let mut of_worlds: HashMap<String, Value> = of_worlds.collect::<Result<_, Failure>>()?;
    let out = output::out_dir(args.out.as_deref(), "navigate", "laps")?;
    crate::logging::log_to_stderr("error");
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().or_failed()?;
    let mut provenance = vec![
        ("command".to_string(), output::command_line()),
        ("version".to_string(), format!("nesam {}", env!("CARGO_PKG_VERSION"))),
        ("bundle".to_string(), format!("{} {}", bundle.name, bundle.hash)),
    ];
    let mut stage = Stage::new(args, root, path, Bundles { shipped: bundle, diagnosed }, effects)?;
    let plant = stage.identity(&tasks[0])?;
    provenance.push(("plant".to_string(), plant_text(args, &plant)));
    of_worlds.values_mut().chain([&mut settings]).for_each(|settings| settings["plant"] = plant.in_settings());
    let kept = Kept { out: out.clone(), settings: of_worlds, plant, resume: args.resume };
    let Driven { runs, mut warnings, ended } = drive_all(&mut stage, &runtime, &tasks, &kept);
    if ended.is_ok() {
        runtime.block_on(stage.stop());
    } else {
        provenance.push(("ended early".to_string(), format!("{} of {} laps", runs.len(), tasks.len())));
    }
    if runs.is_empty() {
        return ended;
    }
    for name in nesam_navigation::lost(&runs) {
        let warning =
            format!("warning: every lap of {name} is lost: a number of `state` or `truth` is none, or beyond what a vehicle does");
        output::note!("{warning}");
        warnings.push(warning);
    }
    ended.and(report(args, &NavigationReport { runs, settings, folder: out, warnings, provenance }))
}

/// The plant as it is told of in reports.
fn plant_text(args: &NavigateArgs, plant: &Identity) -> String {
    let address = args.plant.as_deref().unwrap_or_default();
    match plant {
        Identity::BuiltIn => "built in".into(),
        Identity::Named(name) => format!("{address}: {name}"),
        Identity::Unnamed => format!("{address}, which does not say what it is"),
    }
}

fn check(args: &NavigateArgs) -> Result<(), Failure> {
    let counts = [("--runs", args.runs, 1, 10_000), ("--candidates", args.candidates, 2, 2048), ("--plan-every", args.plan_every, 1, 20)];
    let wrong = counts.iter().find(|(_, value, low, high)| !(low..=high).contains(&value));
    if let Some((option, value, low, high)) = wrong {
        return Err(Failure::input(format!("{option} {value} is not {low} to {high}")));
    }
    if args.horizon == 0 || args.horizon > HORIZON_MAX || args.plan_every > args.horizon {
        return Err(Failure::input(format!("--horizon {} is not 1 to {HORIZON_MAX}, or shorter than --plan-every", args.horizon)));
    }
    // A lap that counts twice is no more evidence than once.
    let twice = |option: &str, names: &[String]| {
        let name = names.iter().enumerate().find(|(i, name)| names[..*i].contains(name)).map(|(_, name)| name);
        name.map_or(Ok(()), |name| Err(Failure::input(format!("{option} has `{name}` twice; give each once"))))
    };
    twice("--worlds", args.worlds.as_deref().unwrap_or_default())?;
    twice("--configurations", &args.configurations.iter().flatten().map(|c| c.as_str().to_string()).collect::<Vec<_>>())?;
    // Plants written in other languages count to 2^53.
    if args.seed.saturating_add(args.runs as u64) > SEED_MAX {
        return Err(Failure::input(format!("--seed {} and the seeds after it are not below 2^53", args.seed)));
    }
    if args.plant_timeout == Some(0) {
        return Err(Failure::input("--plant-timeout 0 leaves no time to answer; give a second or more"));
    }
    if args.configurations.iter().flatten().any(|c| *c == Configuration::Diagnosed) && args.diagnosed.is_none() {
        return Err(Failure::input("the configuration `diagnosed` needs --diagnosed, a bundle that a diagnosis has written"));
    }
    Ok(())
}

/// Speed commands that training covers and the card admits, m/s.
fn speed_limits_m_s(vehicle: &Vehicle) -> [f64; 2] {
    let ([low, high], [least, most]) = (SPEED_LIMITS_M_S, vehicle.command_range[0]);
    [low.max(least), high.min(most)]
}

fn check_speed(speed_m_s: f64, vehicle: &Vehicle) -> Result<(), Failure> {
    let [low, high] = speed_limits_m_s(vehicle);
    if (low..=high).contains(&speed_m_s) {
        return Ok(());
    }
    Err(Failure::input(format!(
        "--speed {speed_m_s} is not {low} to {high} m/s, what training covers and the card of `{}` admits",
        vehicle.name
    )))
}

/// Where predictions come from: what is told, else the usual that the bundle and the worlds allow.
fn configurations(
    args: &NavigateArgs,
    bundle: &ModelBundle,
    root: &DataRoot,
    worlds: &[(String, SoilKind)],
) -> Result<Vec<Configuration>, Failure> {
    let usual = || Configuration::USUAL.into_iter().chain(args.diagnosed.is_some().then_some(Configuration::Diagnosed)).collect();
    let mut chosen: Vec<Configuration> = args.configurations.clone().unwrap_or_else(usual);
    let untold = worlds.iter().find(|(world, _)| !has_true_soil(root, world));
    let oracle = untold.map_or(Ok(()), |(world, _)| {
        let lacks = "the data root does not have the true soil (gt_soil.json, gt_region.png)";
        Err(Failure::input(format!("{lacks} of {world}, which the oracle is told")))
    });
    let possible = [(Configuration::Kinematic, kinematic_of(bundle).map(|_| ())), (Configuration::Oracle, oracle)];
    for (configuration, possible) in possible {
        if let Err(failure) = possible
            && chosen.contains(&configuration)
        {
            if args.configurations.is_some() {
                let others: Vec<_> = chosen.iter().filter(|c| **c != configuration).map(|c| c.as_str()).collect();
                let without = if others.is_empty() { "fixed,adapted".into() } else { others.join(",") };
                return Err(Failure::input(format!("{failure}; use --configurations {without}")));
            }
            crate::output::note!("note: {} is left out: {failure}", configuration.as_str());
            chosen.retain(|c| *c != configuration);
        }
    }
    Ok(chosen)
}

/// The worlds to drive in, with the kind of their soil.
fn worlds_of(args: &NavigateArgs, root: &DataRoot) -> Result<Vec<(String, SoilKind)>, Failure> {
    let there = root.world_ids();
    // Another simulator knows its soil itself.
    let drivable = |world: &str| args.plant.is_some() || has_true_soil(root, world);
    let advice = format!("true soil ({}), which the simulated vehicle drives on; --plant drives another simulator", TRUE_SOIL.join(", "));
    let chosen = args.worlds.clone().unwrap_or_else(|| default_worlds(&there, &drivable, &|world| has_true_soil(root, world)));
    if chosen.is_empty() {
        return Err(Failure::input(format!("the data root has no world with {advice}")));
    }
    let kind_of = |world: String| {
        let map = root.world(&world).or_input()?;
        if !drivable(&world) {
            return Err(Failure::input(format!("--worlds {world}: the data root does not have its {advice}")));
        }
        let kind = soil_kind(&root.world_dir(&world), &map)?;
        Ok((world, kind))
    };
    chosen.into_iter().map(kind_of).collect()
}

/// The worlds of the scenario that can be driven in; else those with true soil; else those that can be driven in.
fn default_worlds(there: &[String], drivable: &dyn Fn(&str) -> bool, has_truth: &dyn Fn(&str) -> bool) -> Vec<String> {
    let of = |wanted: &dyn Fn(&str) -> bool| there.iter().filter(|world| wanted(world)).cloned().collect::<Vec<_>>();
    let choices = [of(&|world| SCENARIO.contains(&world) && drivable(world)), of(has_truth), of(drivable)];
    choices.into_iter().find(|worlds| !worlds.is_empty()).unwrap_or_default()
}

/// Whether a root tells the true soil of a world.
fn has_true_soil(root: &DataRoot, world: &str) -> bool {
    TRUE_SOIL.iter().all(|file| root.world_dir(world).join(file).exists())
}

/// Compares the true sinkage modulus of every region with what its class promises.
fn soil_kind(world_dir: &Path, map: &WorldMap) -> Result<SoilKind, Failure> {
    if !world_dir.join("gt_soil.json").exists() {
        return Ok(SoilKind::Unknown);
    }
    let truth = read_ground_truth_soil(world_dir).or_input()?;
    let (mut softer, mut firmer) = (false, false);
    for region in &truth.regions {
        let Some(class) = map.soil_classes().iter().find(|c| c.name == region.class) else { continue };
        softer |= region.soil.k_phi < class.low[0];
        firmer |= region.soil.k_phi > class.high[0];
    }
    Ok(match (softer, firmer) {
        (true, false) => SoilKind::Soft,
        (false, true) => SoilKind::Firm,
        (true, true) => SoilKind::Mixed,
        (false, false) => SoilKind::Nominal,
    })
}

/// Laps in the order in which they are driven: an interrupted command has about as many of each configuration.
fn tasks_of(args: &NavigateArgs, worlds: &[(String, SoilKind)], configurations: &[Configuration]) -> Vec<Task> {
    let places = 2 * worlds.len();
    (0..args.runs)
        .flat_map(|i| {
            let (world, soil) = &worlds[i % worlds.len()];
            let (start, seed) = ((i % places) / worlds.len(), args.seed + (i / places) as u64);
            configurations.iter().map(move |c| Task { configuration: *c, world: world.clone(), soil: *soil, start, seed })
        })
        .collect()
}

fn settings_of(args: &NavigateArgs, bundle: &ModelBundle, diagnosed: Option<&ModelBundle>) -> Value {
    json!({
        "version": env!("CARGO_PKG_VERSION"),
        "bundle_hash": bundle.hash,
        "diagnosed_hash": diagnosed.map(|bundle| &bundle.hash),
        "candidates": args.candidates,
        "horizon": args.horizon,
        "plan_every": args.plan_every,
        "cost": cost_of(args),
        "noise_sd": mppi_of(args, &bundle.vehicle).noise_sd,
        "noise_correlation": NOISE_CORRELATION,
        "temperature": TEMPERATURE,
        "speed_limits_m_s": speed_limits_m_s(&bundle.vehicle),
        "caution": caution_of(args),
        "effect": args.effect,
    })
}

/// The settings with the vehicle and the ground of a lap: what the planner knows of them, and the truth of the built-in plant.
fn settings_of_lap(settings: &Value, root: &DataRoot, world: &str) -> Result<Value, Failure> {
    let hash = |file: &Path| std::fs::read(file).ok().map(|content| sha256_hex(&content));
    let truth = |name: &str| hash(&root.world_dir(world).join(name));
    let mut settings = settings.clone();
    settings["card_hash"] = json!(hash(root.card()));
    settings["map_hash"] = json!(root.world(world).or_input()?.hash());
    settings["true_soil_hash"] = json!([truth("gt_soil.json"), truth("gt_region.png")]);
    Ok(settings)
}

fn cost_of(args: &NavigateArgs) -> TrackingCost {
    TrackingCost { speed_m_s: args.speed, lag: LAG_WEIGHT, tilt: TILT_WEIGHT }
}

fn caution_of(args: &NavigateArgs) -> Option<CautionSettings> {
    (!args.no_caution).then_some(CAUTION)
}

fn mppi_of(args: &NavigateArgs, vehicle: &Vehicle) -> MppiSettings {
    let [low, high] = vehicle.command_range[1];
    let range = 0.5 * (high - low);
    // A base that can turn on the spot is not to try that at every step.
    let half = if vehicle.second == SecondCommand::YawRateRadS { range.min(args.speed / SHARPEST_TURN_M) } else { range };
    MppiSettings {
        candidates: args.candidates,
        limits: [speed_limits_m_s(vehicle), [low, high]],
        noise_sd: [NOISE_SD[0], NOISE_SD[1] * half],
        noise_correlation: NOISE_CORRELATION,
        temperature: TEMPERATURE,
    }
}

/// Second command that follows the mean curvature of the path at a speed, on ground that does not give.
fn steering_guess(vehicle: &Vehicle, path: &ReferencePath, speed_m_s: f64) -> f64 {
    let full = vehicle.command_range[1][1];
    if vehicle.second == SecondCommand::YawRateRadS {
        return (speed_m_s * std::f64::consts::TAU / path.length_m()).min(full);
    }
    let [left, right, ..] = road_wheel_angles(vehicle, full);
    let angle = (vehicle.wheelbase_m * std::f64::consts::TAU / path.length_m()).atan();
    (full * 2.0 * angle / (left + right)).min(full)
}

fn report(args: &NavigateArgs, report: &NavigationReport) -> Result<(), Failure> {
    let rows: Vec<[String; 12]> = std::iter::once(NavigationReport::HEAD.map(String::from)).chain(report.rows()).collect();
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: [usize; 12] = std::array::from_fn(width);
    for row in &rows {
        let padded = row.iter().zip(widths).enumerate().map(|(i, (c, w))| if i < 2 { format!("{c:<w$}") } else { format!("{c:>w$}") });
        say!("{}", padded.collect::<Vec<_>>().join("  "));
    }
    report.ends().iter().for_each(|ends| say!("not completed by {ends}"));
    if let Some(file) = &args.json {
        output::write_json(file, &report.to_json())?;
    }
    if let Some(file) = &args.html {
        output::write_file(file, report.page().render().as_bytes())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: worlds are left to choose from where those of the scenario tell no true soil. Method: with and without it, and another simulator, which needs none.
    #[test]
    fn analytic_worlds_of_the_scenario_come_first_where_they_can_be_driven_in() {
        let there: Vec<String> = ["w01", "w02", "w35", "w36"].map(String::from).to_vec();
        let chosen = |with_truth: &[&str], plant: bool| {
            let has_truth = |world: &str| with_truth.contains(&world);
            default_worlds(&there, &|world| plant || has_truth(world), &has_truth)
        };
        assert_eq!(chosen(&["w01", "w35"], false), ["w35"]);
        assert_eq!(chosen(&["w01", "w02"], false), ["w01", "w02"]);
        assert!(chosen(&[], false).is_empty());
        assert_eq!(chosen(&["w01"], true), ["w35", "w36"]);
        let own = &there[..2];
        assert_eq!(default_worlds(own, &|_| true, &|world| world == "w02"), ["w02"]);
        assert_eq!(default_worlds(own, &|_| true, &|_| false), ["w01", "w02"]);
    }

    const HUSKY: &str = include_str!("../../../../../deploy/bundles/clearpath-husky/vehicle.json");

    #[test]
    fn analytic_a_vehicle_that_is_told_its_yaw_rate_is_told_that_of_the_path() {
        let (husky, path) = (nesam_trajectories::card_from_json(HUSKY).expect("a card"), ReferencePath::of_ood_soil());
        // 2 m/s once round a path of about 150 m.
        let (guess, lap_s) = (steering_guess(&husky, &path, 2.0), path.length_m() / 2.0);
        assert!((guess * lap_s - std::f64::consts::TAU).abs() < 1e-9, "{guess}");
        assert_eq!(speed_limits_m_s(&husky), [0.5, 3.0], "not the 4 m/s of the training drives");
        assert!(check_speed(3.0, &husky).is_ok());
        let refused = check_speed(3.5, &husky).expect_err("too fast").to_string();
        assert!(refused.contains("--speed 3.5 is not 0.5 to 3 m/s") && refused.contains("Clearpath Husky"), "{refused}");
    }
}
