//! `nesam adapt`: what learning the soil while driving gains on recorded drives.

mod alternatives;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use nesam_adaptation::{CalibratedFilter, FilterConfig, FilterSettings};
use nesam_evaluation::report::{Short, adaptation_page};
use nesam_evaluation::{
    Adaptation, Consistency, DEFAULT_RESAMPLES, DriveAdaptation, ErrorSummary, ErrorTree, Inputs, KnownSoil, ModelName, Resamples, Row,
    Truth, WindowPredictor, adapt_all, all_windows, calibrate_noise, path_median_m, predict_all, score, write_predictions,
};
use nesam_learning::stand_in;
use nesam_model::{ModelBundle, Predictor, Variant};
use nesam_physics::SOIL_NAMES;
use nesam_terrain::{Disguise, WorldMap};
use nesam_trajectories::Trajectory;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use self::alternatives::{Scene, read_true_soils};
use crate::args::{BundleArgs, CommandsArgs, DataArgs, SplitArg, TruthArg, WindowArgs};
use crate::bundle_path::bundle_dir;
use crate::failure::{Failure, OrFail};
use crate::output::{error_heads, note, say};
use crate::progress::Progress;
use crate::sources::{
    Drives, check_model_step, check_own_vehicle, load_bundle, load_bundle_for, parted_drives, predictor_for, read_drives,
};
use crate::{interrupt, output};

/// Options of `nesam adapt`.
#[derive(Args, Debug)]
pub struct AdaptArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    bundle: BundleArgs,
    #[command(flatten)]
    window: WindowArgs,
    #[command(flatten)]
    inputs: CommandsArgs,
    /// Settings of the soil filter, JSON as in the `filter` block of a report; what is absent stays as the bundle has it (docs/soil-filter.md)
    #[arg(long, value_name = "FILE.json")]
    filter: Option<PathBuf>,
    /// Algorithm 1 of the paper to the letter: physical units, one linearisation, nothing held at a bound
    #[arg(long)]
    literal: bool,
    /// Estimate the noise of the soil filter on the drives of the train split that training left for validation, and on the others what stands in where
    /// a map has no colours, and put both into the bundle; run once for every new bundle
    #[arg(long, conflicts_with = "literal")]
    calibrate: bool,
    /// With --calibrate: follow errors that carry on from buffer to buffer as a state, instead of counting repeated evidence less
    #[arg(long, requires = "calibrate")]
    follow_errors: bool,
    /// Repaint the map so that the ground is not what it looks like: judges adaptation on drives of the train split, where settings may be chosen
    #[arg(long, value_enum, value_name = "LOOK", conflicts_with = "calibrate")]
    disguise: Option<DisguiseArg>,
    /// Further predictors in the same table
    #[arg(long, value_enum, value_name = "NAME,…", value_delimiter = ',', conflicts_with = "calibrate")]
    also: Vec<AlsoArg>,
    /// Drives to score apart from the rest, e.g. those that no setting was chosen on
    #[arg(long, value_name = "ID,…", value_delimiter = ',', conflicts_with = "calibrate")]
    apart: Vec<String>,
    /// A set on ground that is what it looks like: prints how much of the gap to it is closed
    #[arg(long, value_name = "SET", conflicts_with = "calibrate")]
    reference: Option<String>,
    /// Score against the noise-free channels, where a set has them
    #[arg(long, value_name = "CHANNELS", value_enum, default_value_t = TruthArg::Measured)]
    truth: TruthArg,
    /// Seed of the bootstrap and of what --disguise draws
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for adapt.json and adapt.html [default: nesam-out/adapt-<set>, or none where --json or --html says what to write]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Write the JSON here; `-` is standard output
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the HTML report here
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Write every predicted pose of every row of the table as Parquet: model, trajectory, t0, k, x, y, z, roll, pitch, yaw
    #[arg(long, value_name = "FILE.parquet", conflicts_with = "calibrate")]
    predictions: Option<PathBuf>,
}

/// Degrees of freedom of Student's t that a calibrated filter has (chosen on validation drives and o01-o06 of `ood_soil`).
const TAIL_DOF: f64 = 4.0;
/// What it makes of heave, roll and pitch, order vx, vy, vz, ωx, ωy, ωz (chosen on the same, ADR 0048).
const CAUTION: [f64; 6] = [1.0, 1.0, 3.0, 3.0, 3.0, 1.0];

/// How likely it thinks that the ground has changed before each buffer of a second: one change in ten seconds (chosen on the same and on twins, ADR 0059).
const CHANGE_PROBABILITY: f64 = 0.1;
/// How much the ground varies about the prior where it is what it looks like, of what the filter allows for (chosen on the same, ADR 0068).
const LOOKS_SHARE: f64 = 0.65;
/// Buffers over which it scales R_B to the drive, and its log odds that a correction helps before any evidence (chosen with that).
const SCALE_MEMORY: f64 = 3.0;
const TRUST_LOG_ODDS: f64 = -4.0;
/// Standard deviation of the soil prior that it begins with, in the coordinates of a correction: half as wide again as the default (chosen on the same, ADR 0050).
const PRIOR_SD: [f64; 6] = [1.05, 1.05, 0.225, 0.75, 0.12, 0.6];

/// What else is scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum AlsoArg {
    /// Algorithm 1 of the paper to the letter.
    Literal,
    /// The simulator's own soil in place of the prior (`oracle_soil`); only where a world states it.
    OracleSoil,
    /// The one correction of each drive that predicts the very windows best that it is scored on: a ceiling, takes a minute for ten drives.
    BestConstant,
    /// The same with a correction for each class of ground; takes minutes.
    BestByClass,
    /// One correction for each fifth of a drive, fitted to those windows of the rest of the drive that do not overlap it, before and after: what a correction that does
    /// not change could carry over; takes minutes.
    ConstantElsewhere,
}

impl AlsoArg {
    /// Whether the simulator's own soil, or its classes, must be read for it.
    fn needs_true_soil(self) -> bool {
        matches!(self, Self::OracleSoil | Self::BestByClass)
    }
}

/// How the ground is made to look.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum DisguiseArg {
    /// Like the next firmer class.
    Firmer,
    /// Like the next softer class.
    Softer,
    /// Some classes firmer, some softer, some as they are, in each world by the seed.
    Mixed,
    /// Like nothing: a map of heights alone.
    Bare,
}

/// Runs the command.
pub fn run(args: &AdaptArgs) -> Result<(), Failure> {
    args.window.check_horizon()?;
    args.inputs.check("what the soil is learned for is predictions under commands")?;
    if args.calibrate {
        return calibrate(args);
    }
    interrupt::exit_on_ctrl_c("nothing was written");
    let truth = Truth::from(args.truth);
    let mut drives = read_drives(&args.data, truth == Truth::Gt)?;
    if let Some(look) = args.disguise {
        disguise(&mut drives, look, args.seed)?;
    }
    let apart = apart(&drives.drives, &args.apart)?;
    let reference_drives = args.reference.as_deref().map(|set| reference_drives(args, set)).transpose()?;
    let true_soils = if args.also.iter().any(|also| also.needs_true_soil()) { read_true_soils(&drives)? } else { Vec::new() };
    let names = [(&args.json, "adapt.json"), (&args.html, "adapt.html")];
    let [json, html] = output::asked_files(args.out.as_deref(), "adapt", &drives.set, names, [&args.predictions])?;
    let horizon = args.window.horizon_on(&drives.drives);
    let windows = all_windows(&drives.drives, horizon, args.window.history, truth).or_input()?;
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
    let filter = filter_in_force(&settings_file(args.filter.as_deref())?, args.literal, predictor.bundle())?;
    warn_about_velocities(&drives);

    let progress = Progress::start("drives filtered", drives.drives.len());
    let filtered = adapt_all(&predictor, &drives.drives, &drives.maps, &filter, &|done| progress.set(done)).or_input()?;
    progress.finish();
    let filtered = Arc::new(filtered);
    let models = [
        (ModelName::Nesam, WindowPredictor::Nesam { predictor: Arc::clone(&predictor), variant: Variant::Full, inputs: Inputs::Commands }),
        (ModelName::Nesam, WindowPredictor::Adapted { predictor: Arc::clone(&predictor), filtered: Arc::clone(&filtered) }),
    ];
    let progress = Progress::start("windows predicted", windows.len());
    let paths = predict_all(&models, &windows, &drives.maps, &|done| progress.set(done)).or_failed()?;
    progress.finish();
    let resamples = Resamples::draw(drives.drives.len(), DEFAULT_RESAMPLES, args.seed);
    let [fixed, adapted] = [0, 1].map(|i| score(&paths[i], &windows, truth, &resamples));
    let scene = Scene { predictor: &predictor, drives: &drives, windows: &windows, truth, true_soils: &true_soils };
    let known_soil =
        if args.also.contains(&AlsoArg::OracleSoil) { KnownSoil::of(&drives.drives, &filtered, &true_soils, &resamples) } else { None };
    let alternatives = args.also.iter().map(|also| scene.paths(*also, &filter)).collect::<Result<Vec<_>, _>>()?;
    let others: Vec<Row> = alternatives.iter().map(|(key, paths)| Row { key, score: score(paths, &windows, truth, &resamples) }).collect();
    let reference = reference_drives.map(|drives| Ok((drives.set.clone(), reference(args, &drives, horizon, &predictor)?))).transpose()?;
    let provenance = output::provenance(Some(predictor.bundle()), &drives);
    let adaptation = Adaptation {
        set: &drives.set,
        split: args.data.split.as_str(),
        horizon_steps: horizon,
        dt_s: args.data.dt,
        path_m_median: path_median_m(&windows, truth),
        truth,
        starts_s: &windows.iter().map(nesam_evaluation::Window::since_log_start_s).collect::<Vec<_>>(),
        maps: &drives.maps,
        drives: &drives.drives,
        fixed: &fixed,
        adapted: &adapted,
        others: &others,
        apart: &apart,
        reference: reference.as_ref().map(|(set, summary)| (set.as_str(), summary)),
        filtered: &filtered,
        known_soil: known_soil.as_ref(),
        filter: &filter,
        seed: args.seed,
        resamples: &resamples,
        provenance: &provenance,
    };
    print_table(&adaptation);
    say!("");
    if let Some(file) = &json {
        output::write_file(file, adaptation.to_json().as_bytes())?;
        say!("wrote {}", file.display());
    }
    if let Some(file) = &html {
        output::write_file(file, adaptation_page(&adaptation).as_bytes())?;
        say!("wrote {}", file.display());
    }
    if let Some(file) = &args.predictions {
        let own = [("fixed", &paths[0]), ("adapted", &paths[1])].into_iter();
        let named: Vec<_> = own.chain(alternatives.iter().map(|(key, paths)| (*key, paths))).collect();
        output::write_with(file, |draft| write_predictions(draft, &named, &windows).or_failed())?;
        say!("wrote {}", file.display());
    }
    Ok(())
}

/// Indices of the drives that are to be scored apart.
fn apart(drives: &[Trajectory], ids: &[String]) -> Result<Vec<usize>, Failure> {
    let place = |id: &String| {
        drives.iter().position(|d| d.id == *id).ok_or_else(|| Failure::input(format!("--apart {id}: not among the drives that are scored")))
    };
    ids.iter().map(place).collect()
}

/// Drives of another set, whole.
fn reference_drives(args: &AdaptArgs, set: &str) -> Result<Drives, Failure> {
    let data = DataArgs { set: Some(set.into()), trajectories: None, split: SplitArg::All, ..args.data.clone() };
    read_drives(&data, args.truth == TruthArg::Gt)
}

/// What the model scores with its soil prior on them.
fn reference(args: &AdaptArgs, drives: &Drives, horizon: usize, predictor: &Arc<Predictor>) -> Result<ErrorSummary, Failure> {
    let truth = Truth::from(args.truth);
    let windows = all_windows(&drives.drives, horizon, args.window.history, truth).or_input()?;
    let none = Arc::new(vec![DriveAdaptation::default(); drives.drives.len()]);
    let model = [(ModelName::Nesam, WindowPredictor::Adapted { predictor: Arc::clone(predictor), filtered: none })];
    let paths = predict_all(&model, &windows, &drives.maps, &|_| {}).or_failed()?;
    Ok(score(&paths[0], &windows, truth, &Resamples::draw(drives.drives.len(), DEFAULT_RESAMPLES, args.seed)).summary)
}

/// Settings in force: those given, over those that the bundle carries, over the defaults. `--literal` takes nothing from the bundle.
pub(super) fn filter_in_force(given: &FilterSettings, literal: bool, bundle: &ModelBundle) -> Result<FilterConfig, Failure> {
    if literal {
        return Ok(given.over_defaults(true));
    }
    match &bundle.soil_filter_json {
        None => {
            note!(
                "note: bundle {} carries no noise of the soil filter for `{}`; defaults stand in (see `nesam adapt --calibrate`, with a bundle of that vehicle)",
                bundle.name,
                bundle.vehicle.name
            );
            Ok(given.over_defaults(false))
        }
        Some(json) => Ok(given.over(CalibratedFilter::from_json(json).or_input()?.config())),
    }
}

/// Repaints the map of every drive, each world once.
fn disguise(drives: &mut Drives, look: DisguiseArg, seed: u64) -> Result<(), Failure> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut painted: BTreeMap<String, Arc<WorldMap>> = BTreeMap::new();
    for map in drives.maps.iter_mut().flatten() {
        if !painted.contains_key(map.hash()) {
            let other = match look {
                DisguiseArg::Firmer => Disguise::Firmer.of(map),
                DisguiseArg::Softer => Disguise::Softer.of(map),
                DisguiseArg::Mixed => Disguise::Mixed(rng.random()).of(map),
                DisguiseArg::Bare => Some(map.without_colours()),
            };
            let other = other.ok_or_else(|| Failure::input(format!("map {} states no colours of soil classes to repaint", map.id())))?;
            painted.insert(map.hash().into(), Arc::new(other));
        }
        *map = Arc::clone(&painted[map.hash()]);
    }
    Ok(())
}

fn calibrate(args: &AdaptArgs) -> Result<(), Failure> {
    interrupt::exit_on_ctrl_c("the bundle is unchanged");
    let dir = bundle_dir(args.bundle.bundle.as_deref())?;
    let mut given = settings_file(args.filter.as_deref())?;
    let (drives, training) = parted_drives(&args.data, "--calibrate", "the noise is estimated")?;
    let mut bundle = load_bundle(Some(&dir))?;
    check_own_vehicle(&bundle, &drives.root, "--calibrate")?;
    check_model_step(&bundle, args.data.dt)?;
    if let Some(measured) = stand_in::measure_on(&bundle, &drives.root, &training).or_input()? {
        bundle.normalization.stand_in = Some(measured);
    }
    let predictor = predictor_for(bundle.clone(), &drives.root, args.data.dt)?;
    given.tail_dof.get_or_insert(TAIL_DOF);
    let prior_sd = *given.prior_sd.get_or_insert(PRIOR_SD);
    given.process_sd.get_or_insert(FilterConfig::process_sd_of(&prior_sd));
    given.caution.get_or_insert(CAUTION);
    given.change_probability.get_or_insert(CHANGE_PROBABILITY);
    given.looks_share.get_or_insert(LOOKS_SHARE);
    given.scale_memory.get_or_insert(SCALE_MEMORY);
    given.trust_log_odds.get_or_insert(TRUST_LOG_ODDS);
    if !args.follow_errors {
        given.shared_error_covariance = Some(Vec::new());
    }
    let config = given.over_defaults(false);
    let found = calibrate_noise(&predictor, &drives.drives, &drives.maps, &config, true).or_input()?;
    let calibrated = CalibratedFilter::new(&found, &given, drives.drives.len(), &drives.root.hash());
    bundle.soil_filter_json = Some(calibrated.to_json());
    bundle.save(&dir).or_failed()?;
    say!(
        "bundle {} now carries the noise of {} buffers of {} drives, {:.1} of which say no more than one (or: correlated by {:.2}); its hash is {}",
        bundle.name,
        found.buffers,
        drives.drives.len(),
        found.shared_buffers,
        found.shared_error.correlation,
        &bundle.hash[..12]
    );
    Ok(())
}

/// Settings of a file, or none.
pub(super) fn settings_file(file: Option<&Path>) -> Result<FilterSettings, Failure> {
    let Some(file) = file else { return Ok(FilterSettings::default()) };
    let text = std::fs::read_to_string(file).map_err(|e| Failure::input(format!("{}: {e}", file.display())))?;
    FilterSettings::from_json(&text).map_err(|e| Failure::input(format!("{}: {e}", file.display())))
}

fn warn_about_velocities(drives: &Drives) {
    let estimated = drives.drives.iter().filter(|d| !d.measured.linear_velocity || d.measured.angular_velocity.contains(&false)).count();
    if estimated > 0 {
        note!(
            "note: {estimated} drives do not measure all velocities; estimates from positions and attitudes stand in, and the filter trusts them as if measured"
        );
    }
}

fn print_table(a: &Adaptation<'_>) {
    say!(
        "{} ({}): {} windows of {} steps from {} drives, median path {:.2} m; mean absolute errors against {} channels",
        a.set,
        a.split,
        a.fixed.summary.windows,
        a.horizon_steps,
        a.drives.len(),
        a.path_m_median,
        a.truth.as_str()
    );
    let scored = a.models().map(|(key, score)| (key.to_string(), score.summary.tree, Some(score.summary.ci95)));
    let mut rows: Vec<_> = scored.chain([("adapted / fixed".to_string(), a.ratio(), Some(a.ratio_ci95()))]).collect();
    if let Some((set, _)) = a.reference {
        let closed = a.models().skip(1).filter_map(|(key, score)| Some((format!("gap closed, {key}"), a.closed(score)?, None)));
        rows.extend(closed);
        say!("gap = fixed here minus fixed on {set}");
    }
    for last in [false, true] {
        say!("");
        print_errors(if last { "at the last step" } else { "mean over the horizon" }, &rows, last);
    }
    for part in a.parts() {
        let scored = a.models().map(|(key, _)| (key.to_string(), part.models[key].tree, Some(part.models[key].ci95)));
        let rows: Vec<_> = scored.chain([("adapted / fixed".to_string(), part.ratio, Some(part.ratio_ci95))]).collect();
        say!("\nonly {}", part.trajectories.join(", "));
        print_errors("mean over the horizon", &rows, false);
    }
    say!("\n{}", updates_line(&a.consistency(), a.maps.iter().any(Option::is_some)));
    if let Some(known) = a.known_soil {
        say!("{}", known.sentence());
        say!("{:<22}{}", "", SOIL_NAMES.map(|n| format!("{n:>11}")).concat());
        for (name, values) in known.by_parameter() {
            say!("{name:<22}{}", values.map(|v| format!("{v:>11.2}")).concat());
        }
    }
    print_soil(a);
}

/// What the filter did; `mapped`: whether any drive has a map.
fn updates_line(c: &Consistency, mapped: bool) -> String {
    if c.updates + c.rejected + c.failed == 0 && !mapped {
        return "0 updates: no map, and without one the soil is not learned".into();
    }
    let number = |v: Option<f64>| v.map_or("–".into(), |v| format!("{v:.2}"));
    format!(
        "{} updates, {} rejected, {} given up; NIS/dof mean {} median {}; inside 95 %: {}",
        c.updates,
        c.rejected,
        c.failed,
        number(c.nis_mean_over_dof),
        number(c.nis_median_over_dof),
        number(c.inside_95)
    )
}

/// A predictor, its errors and their intervals.
type ErrorRow = (String, ErrorTree<f64>, Option<ErrorTree<[f64; 2]>>);

fn print_errors(title: &str, rows: &[ErrorRow], last: bool) {
    let head = error_heads(15);
    say!("{title:<32}{head}");
    for (name, value, interval) in rows {
        let values = value.row(last).map(|v| v.map_or(format!("{:>15}", "–"), |v| format!("{v:>15.3}"))).concat();
        say!("{name:<32}{values}");
        let Some(interval) = interval else { continue };
        let between = |[low, high]: [f64; 2]| format!("{:>15}", format!("{low:.3}…{high:.3}"));
        let intervals = interval.row(last).map(|ci| ci.map_or(format!("{:>15}", ""), between)).concat();
        say!("{:<32}{intervals}", "  95 %");
    }
}

/// Soil at the end of each drive; what was not learned has no number.
fn print_soil(a: &Adaptation<'_>) {
    say!("\n{:<22}{}", "soil at the end", SOIL_NAMES.map(|n| format!("{n:>11}")).concat());
    for (drive, filtered) in a.drives.iter().zip(a.filtered) {
        let Some(last) = filtered.updates.last() else { continue };
        let cells = |value: &dyn Fn(usize) -> String| (0..SOIL_NAMES.len()).map(|i| format!("{:>11}", value(i))).collect::<String>();
        let soil = last.soil();
        let shown = |i: usize| if last.update.posterior.learned[i] { Short(soil[i]).to_string() } else { "·".into() };
        say!("{:<22}{}", drive.id, cells(&shown));
        if a.drives.len() <= 4 {
            say!("{:<22}{}", "  prior there", cells(&|i| Short(last.prior[i]).to_string()));
        }
    }
    say!("(· = not learned: the drive did not halve the variance of the prior, or the prior fits as well)");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regress_no_updates_without_a_map_are_explained() {
        // Goal: who has no map reads why nothing was learned. Method: nothing without and with a map, and one update.
        let nothing = Consistency::default();
        assert!(updates_line(&nothing, false).starts_with("0 updates: no map"));
        assert!(updates_line(&nothing, true).starts_with("0 updates, 0 rejected"));
        assert!(updates_line(&Consistency { updates: 1, ..nothing }, false).starts_with("1 updates, 0 rejected"));
    }
}
