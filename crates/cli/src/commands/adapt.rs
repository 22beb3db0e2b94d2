//! `nesam adapt`: what learning the soil while driving gains on recorded drives.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use nesam_adaptation::{CalibratedFilter, FilterConfig, FilterSettings};
use nesam_evaluation::{
    Adaptation, DEFAULT_RESAMPLES, Disguise, Inputs, ModelName, Resamples, Truth, WindowPredictor, adapt_all, all_windows, calibrate_noise,
    path_median_m, predict_all, report, score,
};
use nesam_model::{MAX_HORIZON, ModelBundle};
use nesam_physics::SOIL_NAMES;
use nesam_terrain::WorldMap;

use crate::args::{BundleArgs, DataArgs, WindowArgs};
use crate::bundle_path::bundle_dir;
use crate::failure::{Failure, OrFail};
use crate::output::say;
use crate::progress::Progress;
use crate::sources::{Drives, check_model_step, load_bundle, load_bundle_for, predictor_for, read_drives, validation_drives};
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
    /// Settings of the soil filter, JSON as in the `filter` block of a report; what is absent stays as by default
    #[arg(long, value_name = "FILE.json")]
    filter: Option<PathBuf>,
    /// Algorithm 1 of the paper to the letter: physical units, one linearisation, nothing held at a bound
    #[arg(long)]
    literal: bool,
    /// Estimate the noise of the soil filter on the drives of the train split that training left for validation, and put it into the bundle; run once
    /// for every new bundle
    #[arg(long, conflicts_with = "literal")]
    calibrate: bool,
    /// Repaint the map so that the ground is not what it looks like: judges adaptation on drives of the train split, where settings may be chosen
    #[arg(long, value_enum, value_name = "LOOK", conflicts_with = "calibrate")]
    disguise: Option<DisguiseArg>,
    /// Score against the noise-free channels, where a set has them
    #[arg(long, value_name = "CHANNELS", value_parser = ["measured", "gt"], default_value = "measured")]
    truth: String,
    /// Seed of the bootstrap
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for adapt.json and adapt.html [default: nesam-out/adapt-<set>]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Write the JSON here instead
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the HTML report here instead
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
}

/// How the ground is made to look.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum DisguiseArg {
    /// Like the next firmer class.
    Firmer,
    /// Like the next softer class.
    Softer,
}

/// Runs the command.
pub fn run(args: &AdaptArgs) -> Result<(), Failure> {
    check_model_step(args.data.dt)?;
    if args.window.horizon > MAX_HORIZON {
        return Err(Failure::input(format!("--horizon {} exceeds the model's {MAX_HORIZON} steps", args.window.horizon)));
    }
    if args.calibrate {
        return calibrate(args);
    }
    interrupt::exit_on_ctrl_c("nothing was written");
    let truth = if args.truth == "gt" { Truth::Gt } else { Truth::Measured };
    let mut drives = read_drives(&args.data, truth == Truth::Gt)?;
    if let Some(look) = args.disguise {
        disguise(&mut drives, look)?;
    }
    let out = output::out_dir(args.out.as_deref(), "adapt", &drives.set)?;
    let windows = all_windows(&drives.drives, args.window.horizon, args.window.history, truth).or_input()?;
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root)?;
    let filter = filter_of(args, predictor.bundle())?;
    warn_about_velocities(&drives);

    let progress = Progress::start("drives filtered", drives.drives.len());
    let filtered = adapt_all(&predictor, &drives.drives, &drives.maps, &filter, &|done| progress.set(done)).or_input()?;
    progress.finish();
    let filtered = Arc::new(filtered);
    let models = [
        (
            ModelName::Nesam,
            WindowPredictor::new(ModelName::Nesam, Some(&predictor), &Arc::new(drives.root.vehicle().clone()), None, Inputs::Commands)
                .or_input()?,
        ),
        (ModelName::Nesam, WindowPredictor::Adapted { predictor: Arc::clone(&predictor), filtered: Arc::clone(&filtered) }),
    ];
    let progress = Progress::start("windows predicted", windows.len());
    let paths = predict_all(&models, &windows, &drives.maps, &|done| progress.set(done)).or_failed()?;
    progress.finish();
    let resamples = Resamples::draw(drives.drives.len(), DEFAULT_RESAMPLES, args.seed);
    let [fixed, adapted] = [0, 1].map(|i| score(&paths[i], &windows, truth, &resamples));
    let provenance = output::provenance(Some(predictor.bundle()), &drives);
    let adaptation = Adaptation {
        set: &drives.set,
        split: args.data.split.as_str(),
        horizon_steps: args.window.horizon,
        dt_s: args.data.dt,
        path_m_median: path_median_m(&windows, truth),
        truth,
        drives: &drives.drives,
        fixed: &fixed,
        adapted: &adapted,
        filtered: &filtered,
        filter: &filter,
        seed: args.seed,
        resamples: &resamples,
        provenance: &provenance,
    };
    print_table(&adaptation);
    let (json, html) =
        (args.json.clone().unwrap_or_else(|| out.join("adapt.json")), args.html.clone().unwrap_or_else(|| out.join("adapt.html")));
    output::write_file(&json, adaptation.to_json().as_bytes())?;
    output::write_file(&html, report::adaptation_page(&adaptation).as_bytes())?;
    say!("\nwrote {} and {}", json.display(), html.display());
    Ok(())
}

/// Settings in force: those given, over those that the bundle carries, over the defaults. `--literal` takes nothing from the bundle.
fn filter_of(args: &AdaptArgs, bundle: &ModelBundle) -> Result<FilterConfig, Failure> {
    let given = settings(args)?;
    if args.literal {
        return Ok(given.over_defaults(true));
    }
    match &bundle.soil_filter_json {
        None => {
            eprintln!(
                "note: bundle {} carries no noise of the soil filter; defaults stand in (see `nesam adapt --calibrate`)",
                bundle.name
            );
            Ok(given.over_defaults(false))
        }
        Some(json) => Ok(given.over(CalibratedFilter::from_json(json).or_input()?.config())),
    }
}

/// Repaints the map of every drive, each world once.
fn disguise(drives: &mut Drives, look: DisguiseArg) -> Result<(), Failure> {
    let disguise = match look {
        DisguiseArg::Firmer => Disguise::Firmer,
        DisguiseArg::Softer => Disguise::Softer,
    };
    let mut painted: BTreeMap<String, Arc<WorldMap>> = BTreeMap::new();
    for map in drives.maps.iter_mut().flatten() {
        if !painted.contains_key(map.hash()) {
            let other =
                disguise.of(map).ok_or_else(|| Failure::input(format!("map {} states no colours of soil classes to repaint", map.id())))?;
            painted.insert(map.hash().into(), Arc::new(other));
        }
        *map = Arc::clone(&painted[map.hash()]);
    }
    Ok(())
}

fn calibrate(args: &AdaptArgs) -> Result<(), Failure> {
    interrupt::exit_on_ctrl_c("the bundle is unchanged");
    let dir = bundle_dir(args.bundle.bundle.as_deref())?;
    let drives = validation_drives(&args.data, "--calibrate", "the noise is estimated")?;
    let mut bundle = load_bundle(Some(&dir))?;
    let predictor = predictor_for(bundle.clone(), &drives.root)?;
    let config = settings(args)?.over_defaults(false);
    let found = calibrate_noise(&predictor, &drives.drives, &drives.maps, &config).or_input()?;
    let calibrated = CalibratedFilter::new(&found, &config, drives.drives.len(), &drives.root.hash());
    bundle.soil_filter_json = Some(calibrated.to_json());
    bundle.save(&dir).or_failed()?;
    say!(
        "bundle {} now carries the noise of {} buffers of {} drives, {:.1} of which say no more than one; its hash is {}",
        bundle.name,
        found.buffers,
        drives.drives.len(),
        found.shared_buffers,
        &bundle.hash[..12]
    );
    Ok(())
}

fn settings(args: &AdaptArgs) -> Result<FilterSettings, Failure> {
    let Some(file) = &args.filter else { return Ok(FilterSettings::default()) };
    let text = std::fs::read_to_string(file).map_err(|e| Failure::input(format!("{}: {e}", file.display())))?;
    FilterSettings::from_json(&text).map_err(|e| Failure::input(format!("{}: {e}", file.display())))
}

fn warn_about_velocities(drives: &Drives) {
    let estimated = drives.drives.iter().filter(|d| !d.measured.linear_velocity || d.measured.angular_velocity.contains(&false)).count();
    if estimated > 0 {
        eprintln!(
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
    let rows = [
        ("fixed", a.fixed.summary.tree, a.fixed.summary.ci95),
        ("adapted", a.adapted.summary.tree, a.adapted.summary.ci95),
        ("adapted / fixed", a.ratio(), a.ratio_ci95()),
    ];
    for (title, last) in [("mean over the horizon", false), ("at the last step", true)] {
        let head: String = ["x m", "y m", "z m", "roll °", "pitch °", "yaw °", "pos. m"].map(|name| format!("{name:>15}")).concat();
        say!("\n{title:<22}{head}");
        for (name, value, interval) in &rows {
            let values = value.row(last).map(|v| v.map_or(format!("{:>15}", "–"), |v| format!("{v:>15.3}"))).concat();
            let between = |[low, high]: [f64; 2]| format!("{:>15}", format!("{low:.3}…{high:.3}"));
            let intervals = interval.row(last).map(|ci| ci.map_or(format!("{:>15}", ""), between)).concat();
            say!("{name:<22}{values}\n{:<22}{intervals}", "  95 %");
        }
    }
    let c = a.consistency();
    let number = |v: Option<f64>| v.map_or("–".into(), |v| format!("{v:.2}"));
    say!(
        "\n{} updates, {} rejected, {} given up; NIS/dof mean {} median {}; inside 95 %: {}",
        c.updates,
        c.rejected,
        c.failed,
        number(c.nis_mean_over_dof),
        number(c.nis_median_over_dof),
        number(c.inside_95)
    );
    print_soil(a);
}

/// Soil at the end of each drive; what was not learned has no number.
fn print_soil(a: &Adaptation<'_>) {
    say!("\n{:<22}{}", "soil at the end", SOIL_NAMES.map(|n| format!("{n:>11}")).concat());
    for (drive, filtered) in a.drives.iter().zip(a.filtered) {
        let Some(last) = filtered.updates.last() else { continue };
        let cells = |value: &dyn Fn(usize) -> String| (0..SOIL_NAMES.len()).map(|i| format!("{:>11}", value(i))).collect::<String>();
        let soil = last.soil();
        let shown = |i: usize| if last.update.posterior.learned[i] { format!("{}", Short(soil[i])) } else { "·".into() };
        say!("{:<22}{}", drive.id, cells(&shown));
        if a.drives.len() <= 4 {
            say!("{:<22}{}", "  prior there", cells(&|i| format!("{}", Short(last.prior[i]))));
        }
    }
    say!("(· = not learned: the drive did not tell)");
}

/// A number in as few characters as it needs: exponents for large ones.
struct Short(f64);

impl std::fmt::Display for Short {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.0.abs() >= 1e4 {
            write!(f, "{:.2e}", self.0)
        } else if self.0.abs() >= 10.0 {
            write!(f, "{:.0}", self.0)
        } else {
            write!(f, "{:.3}", self.0)
        }
    }
}
