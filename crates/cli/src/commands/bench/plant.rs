//! `nesam bench plant`: effects of several sizes in drives of a vehicle that shares no code with the model, and what a diagnosis makes of them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;
use nesam_discovery::{Diagnosis, Options, Scoring, diagnose};
use nesam_model::Predictor;
use nesam_plant::HiddenEffects;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use serde_json::json;

use crate::args::{BundleArgs, DataArgs, check_count};
use crate::commands::plant::write::{Asked, copy_vehicle_and_worlds, write_drives};
use crate::failure::{Failure, OrFail};
use crate::interrupt::exit_on_ctrl_c;
use crate::output::{self, say, write_json};
use crate::progress::Progress;
use crate::sources::{load_bundle_for, open_root, predictor_for, read_drives};

/// Id of an effect, the parameter that its size is, and its usual size.
type Dose = (&'static str, &'static str, f64);
const DOSES: [Dose; 16] = [
    ("payload", "mass_kg", 600.0),
    ("wheel_drag", "torque_nm", 900.0),
    ("steering_offset", "second", 0.08),
    ("steering_ratio", "relative", 0.12),
    ("steering_lag", "seconds", 0.2),
    ("steering_delay", "seconds", 0.2),
    ("speed_delay", "seconds", 0.3),
    ("speed_gain", "relative", -0.12),
    ("tow", "force_n", 2000.0),
    ("tyre_radius_rear", "relative", 0.04),
    ("gyro_bias", "rad_s", 0.015),
    ("gyro_scale", "relative", 0.04),
    ("velocity_scale", "relative", 0.03),
    ("map_offset", "z_m", 0.05),
    ("position_latency", "seconds", 0.12),
    ("tyre_radius", "relative", 0.04),
];
/// The effect whose sign is drawn too.
const EITHER_SIDE: &str = "steering_offset";
/// Sizes are drawn within this share of what was asked for.
const JITTER: f64 = 0.1;
/// Length of a drive, s.
const SECONDS: f64 = 25.0;
/// Rollouts of the proof.
const SCORING: Scoring = Scoring { horizon: 32, history: 32, resamples: 200, seed: 1 };
/// Student's t at 97.5 % by degrees of freedom, 1 to 5; more are taken as 5.
const STUDENT: [f64; 5] = [12.706, 4.303, 3.182, 2.776, 2.571];

/// Options of `nesam bench plant`.
#[derive(Args, Debug)]
pub(super) struct PlantBench {
    /// Data root with the vehicle's data sheet and worlds with true soil [default: the sample shipped with the repository]
    #[arg(long, value_name = "ROOT")]
    data: Option<PathBuf>,
    #[command(flatten)]
    bundle: BundleArgs,
    /// Worlds, one drive after the other
    #[arg(long, value_name = "ID,…", value_delimiter = ',', required = true)]
    worlds: Vec<String>,
    /// Effects to hide, one at a time [default: the sixteen that have a usual size, of `nesam plant effects`]
    #[arg(long, value_name = "ID,…", value_delimiter = ',')]
    effects: Vec<String>,
    /// Sizes, as multiples of the usual one of each effect
    #[arg(long, value_name = "FACTOR,…", value_delimiter = ',', default_values_t = [0.5, 1.0, 1.5])]
    doses: Vec<f64>,
    /// Sets without an effect
    #[arg(long, value_name = "N", default_value_t = 5)]
    nulls: usize,
    /// Drives of 25 s in each set
    #[arg(long, default_value_t = 8)]
    drives: usize,
    /// Seed of sizes, order, commands and sensor noise
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..1 << 32))]
    seed: u64,
    /// Folder for the drives [default: nesam-out/bench-plant]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Write the figures as JSON (schema nesam.bench.plant/1)
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// What is hidden in a set of drives, `None` = nothing, and the vehicle that has it.
type Label = (Option<(Dose, f64)>, HiddenEffects);

/// What a diagnosis said of a set, and what was in it.
#[derive(Debug, Serialize)]
struct Run {
    set: String,
    hidden: &'static str,
    size: f64,
    verdict: &'static str,
    /// Claimed effects, each with its rivals after it.
    named: Vec<Vec<String>>,
    /// Size of the hidden effect, where it was claimed, and its 95 % interval.
    estimate: Option<f64>,
    ci95: Option<[f64; 2]>,
    reason: String,
}

/// Runs the command.
pub(super) fn run(args: &PlantBench) -> Result<(), Failure> {
    args.json.iter().try_for_each(|file| output::check_file(file))?;
    let doses = chosen(args)?;
    let labels = drawn(args, &doses)?;
    exit_on_ctrl_c("drives that were written are in the folder, figures were not");
    let data = DataArgs::of(args.data.clone());
    let (root, path) = open_root(&data)?;
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &root)?, &root, data.dt)?;
    let out = output::out_dir(args.out.as_deref(), "bench", "plant")?;
    copy_vehicle_and_worlds(&path, &out, &args.worlds)?;
    write_sets(args, &labels, &path, &out)?;
    let runs = judge(&predictor, &out, labels)?;
    for run in &runs {
        let estimate = run.estimate.zip(run.ci95).map_or(String::new(), |(e, [low, high])| format!("  {e:.4} [{low:.4}, {high:.4}]"));
        let named: Vec<String> = run.named.iter().map(|set| set.join(" or ")).collect();
        say!("{:<18}{:>10.4}  {:<12}{}{estimate}", run.hidden, run.size, run.verdict, named.join("; "));
    }
    let lines: BTreeMap<&str, Line> = doses.iter().map(|dose| (dose.0, Line::of(dose.0, &runs))).collect();
    say!("\n{:<18}{:>6}{:>12}{:>10}{:>9}  slope", "effect", "sets", "named first", "in class", "other");
    for (id, line) in &lines {
        let slope = line.slope.map_or("–".into(), |[slope, low, high]| format!("{slope:.3} [{low:.3}, {high:.3}]"));
        say!("{id:<18}{:>6}{:>12}{:>10}{:>9}  {slope}", line.sets, line.first, line.in_class, line.other);
    }
    let nulls: Vec<&Run> = runs.iter().filter(|run| run.hidden.is_empty()).collect();
    say!("without an effect: {} sets, {} with a claim", nulls.len(), nulls.iter().filter(|run| !run.named.is_empty()).count());
    let Some(file) = &args.json else { return Ok(()) };
    let provenance = output::provenance_of(Some(predictor.bundle()), &root.hash(), "");
    let document = json!({ "schema": "nesam.bench.plant/1", "effects": lines, "runs": runs, "seed": args.seed, "provenance": provenance });
    write_json(file, &document)
}

fn chosen(args: &PlantBench) -> Result<Vec<Dose>, Failure> {
    asked(args, 0).check()?;
    check_count("--drives", args.drives, 2..=usize::MAX)?;
    if let Some(wrong) = args.doses.iter().find(|factor| !(factor.is_finite() && **factor > 0.0)) {
        return Err(Failure::input(format!("--doses must be above 0, not {wrong}")));
    }
    if let Some(unknown) = args.effects.iter().find(|id| !DOSES.iter().any(|dose| dose.0 == id.as_str())) {
        let known: Vec<&str> = DOSES.iter().map(|dose| dose.0).collect();
        return Err(Failure::input(format!("--effects {unknown}: known are {}", known.join(", "))));
    }
    Ok(DOSES.into_iter().filter(|dose| args.effects.is_empty() || args.effects.iter().any(|id| id == dose.0)).collect())
}

/// What is hidden in each set, in an order drawn by the seed.
fn drawn(args: &PlantBench, doses: &[Dose]) -> Result<Vec<Label>, Failure> {
    let mut random = ChaCha8Rng::seed_from_u64(args.seed);
    let mut hidden: Vec<Option<(Dose, f64)>> = Vec::new();
    for dose in doses {
        for factor in &args.doses {
            let share = random.random_range(1.0 - JITTER..1.0 + JITTER);
            let sign = if dose.0 == EITHER_SIDE && random.random::<bool>() { -1.0 } else { 1.0 };
            hidden.push(Some((*dose, sign * share * factor * dose.2)));
        }
    }
    hidden.extend((0..args.nulls).map(|_| None));
    hidden.shuffle(&mut random);
    let label = |hidden: Option<(Dose, f64)>| {
        let told = hidden.map(|((id, ..), size)| format!("{id}={size}"));
        HiddenEffects::parse(told.as_deref()).or_input().map(|effects| (hidden, effects))
    };
    hidden.into_iter().map(label).collect()
}

/// What is asked of the plant for set number `i`.
fn asked(args: &PlantBench, i: usize) -> Asked<'_> {
    let seed = 1 + (args.seed << 16) + (i * args.drives) as u64;
    Asked { worlds: &args.worlds, drives: args.drives, seconds: SECONDS, seed }
}

/// Writes the sets under names that say nothing.
fn write_sets(args: &PlantBench, labels: &[Label], root: &Path, out: &Path) -> Result<(), Failure> {
    let progress = Progress::start("drives written", labels.len() * args.drives);
    for (i, (_, effects)) in labels.iter().enumerate() {
        write_drives(root, &out.join(name(i)), effects, &asked(args, i), &|done| progress.set(i * args.drives + done))?;
    }
    progress.finish();
    Ok(())
}

fn name(i: usize) -> String {
    format!("set{i:03}")
}

/// Diagnoses every set and only then looks what was in it.
fn judge(predictor: &Predictor, out: &Path, labels: Vec<Label>) -> Result<Vec<Run>, Failure> {
    let progress = Progress::start("diagnoses", labels.len());
    let mut found = Vec::new();
    for i in 0..labels.len() {
        found.push(diagnosis(predictor, out, i)?);
        progress.set(i + 1);
    }
    progress.finish();
    let mut runs: Vec<Run> = found.iter().zip(labels).enumerate().map(|(i, (found, (hidden, _)))| scored(i, found, hidden)).collect();
    runs.sort_by(|a, b| a.hidden.cmp(b.hidden).then(a.size.abs().total_cmp(&b.size.abs())));
    Ok(runs)
}

fn diagnosis(predictor: &Predictor, out: &Path, i: usize) -> Result<Diagnosis, Failure> {
    let drives = read_drives(&DataArgs { set: Some(name(i)), ..DataArgs::of(Some(out.into())) }, false)?;
    let options = Options::of(SCORING);
    diagnose(predictor, &drives.drives, &drives.maps, &options, &|_, _, _| ()).or_input()
}

fn scored(i: usize, found: &Diagnosis, hidden: Option<(Dose, f64)>) -> Run {
    let (hidden, parameter, size) = hidden.map_or(("", "", 0.0), |((id, parameter, _), size)| (id, parameter, size));
    let named = found.claims().map(|finding| {
        let rivals = finding.rivals.iter().map(|rival| rival.candidate.id().to_string());
        std::iter::once(finding.candidate.id().to_string()).chain(rivals).collect()
    });
    let own = found.claims().find(|finding| finding.candidate.id() == hidden);
    let estimate = own.and_then(|finding| finding.estimates.iter().find(|estimate| estimate.name == parameter));
    Run {
        set: name(i),
        hidden,
        size,
        verdict: found.verdict.as_str(),
        named: named.collect(),
        estimate: estimate.map(|estimate| estimate.value),
        ci95: estimate.and_then(|estimate| estimate.ci95),
        reason: found.reason.clone(),
    }
}

/// Sizes that were found over sizes that were hidden.
#[derive(Debug, Serialize)]
struct Line {
    sets: usize,
    /// Sets in which it was claimed.
    first: usize,
    /// Sets in which it was claimed, or at least a rival of what was.
    in_class: usize,
    /// Sets in which something else was named, and not this.
    other: usize,
    /// Slope of the line through zero, with its 95 % interval, where it was claimed at least twice.
    slope: Option<[f64; 3]>,
}

impl Line {
    fn of(id: &str, runs: &[Run]) -> Self {
        let runs: Vec<&Run> = runs.iter().filter(|run| run.hidden == id).collect();
        let has = |run: &Run| run.named.iter().any(|set| set.iter().any(|named| named == id));
        let points: Vec<(f64, f64)> = runs.iter().filter_map(|run| run.estimate.map(|estimate| (run.size, estimate))).collect();
        Self {
            sets: runs.len(),
            first: runs.iter().filter(|run| run.named.iter().any(|set| set[0] == id)).count(),
            in_class: runs.iter().filter(|run| has(run)).count(),
            other: runs.iter().filter(|run| !run.named.is_empty() && !has(run)).count(),
            slope: slope(&points),
        }
    }
}

/// Least squares of y = slope x, and the interval by Student's t.
fn slope(points: &[(f64, f64)]) -> Option<[f64; 3]> {
    let freedom = points.len().checked_sub(1).filter(|freedom| *freedom > 0)?;
    let square: f64 = points.iter().map(|(x, _)| x * x).sum();
    let slope = points.iter().map(|(x, y)| x * y).sum::<f64>() / square;
    let residual: f64 = points.iter().map(|(x, y)| (y - slope * x).powi(2)).sum();
    let half = STUDENT[(freedom - 1).min(4)] * (residual / freedom as f64 / square).sqrt();
    Some([slope, slope - half, slope + half])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_slope_through_zero() {
        let [value, low, high] = slope(&[(1.0, 2.1), (2.0, 3.9), (3.0, 6.0)]).unwrap();
        // 28.0 - 0.1 over 14; the residuals are 0.107, -0.086 and 0.021.
        assert!((value - 27.9 / 14.0).abs() < 1e-12, "{value}");
        let spread = 4.303 * ((0.107_f64.powi(2) + 0.086_f64.powi(2) + 0.021_f64.powi(2)) / 2.0 / 14.0).sqrt();
        assert!((high - value - spread).abs() < 1e-3 && (value - low - spread).abs() < 1e-3, "{low} {high}");
        assert!(slope(&[(1.0, 1.0)]).is_none());
    }
}
