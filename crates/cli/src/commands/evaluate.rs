//! `nesam evaluate`: errors of the models on recorded drives.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use nesam_evaluation::{
    Baselines, DEFAULT_RESAMPLES, Evaluation, Inputs, Kinematic, ModelName, ModelPaths, ModelScore, Resamples, Truth, Window,
    WindowPredictor, all_windows, path_median_m, predict_all, report, score, slices, write_predictions,
};
use nesam_model::Predictor;
use nesam_trajectories::Trajectory;

use super::coverage;
use crate::args::{BundleArgs, DataArgs, InputsArg, SplitArg, TruthArg, WindowArgs};
use crate::bundle_path::{baseline_bundles, bundles_in};
use crate::failure::{Failure, OrFail};
use crate::output::{error_heads, note, say};
use crate::progress::Progress;
use crate::sources::{Drives, load_bundle, load_bundle_for, predictor_for, read_drives, rounded, training_drives, worlds_of};
use crate::{interrupt, output};

/// Options of `nesam evaluate`.
#[derive(Args, Debug)]
pub struct EvaluateArgs {
    #[command(flatten)]
    pub(super) data: DataArgs,
    #[command(flatten)]
    pub(super) bundle: BundleArgs,
    #[command(flatten)]
    pub(super) window: WindowArgs,
    /// Instead of errors, the share of windows that the 90 % regions of the predicted covariance hold
    #[arg(long)]
    coverage: bool,
    /// Estimate the covariance of the model's errors on the drives of the train split that training left for validation, and put it into the bundle; run
    /// once for every new bundle, after `nesam adapt --calibrate`
    #[arg(long, conflicts_with = "coverage")]
    calibrate_coverage: bool,
    /// Standard deviations of a measured state for --calibrate-coverage: x y z m, roll pitch yaw rad, vx vy vz m/s, wx wy wz rad/s [default: those of the
    /// Chrono data]
    #[arg(
        long,
        value_name = "SD,…",
        value_delimiter = ',',
        requires = "calibrate_coverage",
        default_value = "0.015,0.015,0.02,0.001745,0.001745,0.001745,0.025,0.025,0.025,0.002,0.002,0.002",
        hide_default_value = true
    )]
    pub(super) start_sd: Vec<f64>,
    /// What drives the prediction over the horizon
    #[arg(long, value_enum, default_value_t = InputsArg::Commands)]
    inputs: InputsArg,
    /// What errors are measured against
    #[arg(long, value_enum, default_value_t = TruthArg::Measured, conflicts_with_all = ["coverage", "calibrate_coverage"])]
    truth: TruthArg,
    /// What start and history are taken from; `gt` is for an error budget (how much the noise of the start costs) and implies `--truth gt`
    #[arg(long, value_enum, default_value_t = TruthArg::Measured, conflicts_with_all = ["coverage", "calibrate_coverage"])]
    start: TruthArg,
    /// Round the network's products to bf16, as `nesam serve --bf16` does: of nesam and of trained baselines
    #[arg(long, conflicts_with_all = ["coverage", "calibrate_coverage"])]
    bf16: bool,
    /// Models to compare [default: all that bundle and data allow]
    #[arg(long, value_name = "NAME,…", value_delimiter = ',', conflicts_with_all = ["coverage", "calibrate_coverage"])]
    models: Option<Vec<String>>,
    /// Folder of baselines trained with `nesam train --model …` [default: deploy/baselines, found from the executable]
    #[arg(long, value_name = "DIR", conflicts_with_all = ["coverage", "calibrate_coverage"])]
    baselines: Option<PathBuf>,
    /// Seed of the bootstrap
    #[arg(long, default_value_t = 1)]
    pub(super) seed: u64,
    /// Bootstrap draws
    #[arg(long, default_value_t = DEFAULT_RESAMPLES, value_parser = at_least_1000)]
    pub(super) resamples: usize,
    /// Folder for evaluate.json and evaluate.html [default: nesam-out/evaluate-<set>, or none where --json or --html says what to write]
    #[arg(long, value_name = "DIR")]
    pub(super) out: Option<PathBuf>,
    /// Write the JSON here; `-` is standard output
    #[arg(long, value_name = "FILE")]
    pub(super) json: Option<PathBuf>,
    /// Write the HTML report here
    #[arg(long, value_name = "FILE", conflicts_with_all = ["coverage", "calibrate_coverage"])]
    html: Option<PathBuf>,
    /// Also write the tables as Markdown
    #[arg(long, value_name = "FILE.md", conflicts_with_all = ["coverage", "calibrate_coverage"])]
    markdown: Option<PathBuf>,
    /// Also write every predicted pose: model, trajectory, t0, k, x, y, z, roll, pitch, yaw
    #[arg(long, value_name = "FILE.parquet", conflicts_with_all = ["coverage", "calibrate_coverage"])]
    predictions: Option<PathBuf>,
}

fn at_least_1000(text: &str) -> Result<usize, String> {
    match text.parse::<usize>() {
        Ok(n) if (1000..=1_000_000).contains(&n) => Ok(n),
        _ => Err("must be a whole number from 1000 to 1000000".into()),
    }
}

/// Runs the command.
pub fn run(args: &EvaluateArgs) -> Result<(), Failure> {
    if args.coverage || args.calibrate_coverage {
        args.window.check_horizon()?;
        if args.inputs == InputsArg::Wheels {
            return Err(Failure::input("--inputs wheels: the covariance of a prediction is that of one under commands"));
        }
        return if args.coverage { coverage::run(args) } else { coverage::calibrate(args) };
    }
    let names = model_names(args)?;
    if let Some(missing) = args.baselines.as_ref().filter(|folder| !folder.is_dir()) {
        return Err(Failure::input(format!("--baselines {} is not a folder", missing.display())));
    }
    interrupt::exit_on_ctrl_c("nothing was written");
    let noise_free = args.start == TruthArg::Gt;
    let truth = if noise_free { Truth::Gt } else { args.truth.into() };
    let mut drives = read_drives(&args.data, truth == Truth::Gt)?;
    if noise_free {
        start_noise_free(&mut drives)?;
    }
    let names_of_files = [(&args.json, "evaluate.json"), (&args.html, "evaluate.html")];
    let files = output::asked_files(args.out.as_deref(), "evaluate", &drives.set, names_of_files, [&args.markdown, &args.predictions])?;
    let horizon = args.window.horizon_on(&drives.drives);
    let windows = all_windows(&drives.drives, horizon, args.window.history, truth).or_input()?;
    warn_about_training_drives(args, &drives);

    let training = training_drives(&drives, &args.data);
    let models = Models::prepare(args, &names, &drives, training.as_deref(), horizon)?;
    models.check_inputs(&windows)?;
    let progress = Progress::start("windows predicted", windows.len());
    let paths = predict_all(&models.ready, &windows, &drives.maps, &|done| progress.set(done)).or_failed()?;
    progress.finish();
    let resamples = Resamples::draw(drives.drives.len(), args.resamples, args.seed);
    let scores: Vec<ModelScore> = paths.iter().map(|p| score(p, &windows, truth, &resamples)).collect();
    let worlds = training.as_deref().map(worlds_of).unwrap_or_default();
    let slices = slices(&windows, &drives.maps, drives.root.vehicle().wheel_radius_m, &worlds);
    let provenance = output::provenance(models.predictor.as_ref().map(|p| p.bundle()), &drives);
    let evaluation = Evaluation {
        set: &drives.set,
        split: args.data.split.as_str(),
        horizon_steps: horizon,
        history_steps: args.window.history,
        dt_s: args.data.dt,
        windows: windows.len(),
        trajectories: windows.iter().map(|window| window.drive).collect::<BTreeSet<_>>().len(),
        path_m_median: path_median_m(&windows, truth),
        truth,
        inputs: Inputs::from(args.inputs).as_str(),
        seed: args.seed,
        resamples: &resamples,
        models: &scores,
        slices: &slices,
        provenance: &provenance,
    };
    print_table(&evaluation);
    write_results(args, &files, &evaluation, &paths, &windows)
}

/// Puts the noise-free states in the place of the measured ones.
fn start_noise_free(drives: &mut Drives) -> Result<(), Failure> {
    for drive in &mut drives.drives {
        let truth = drive.truth.as_ref().ok_or_else(|| {
            Failure::input(format!("--start gt: drive `{}` has no ground-truth channels; use --start measured", drive.id))
        })?;
        drive.states.clone_from(&truth.states);
    }
    Ok(())
}

fn write_results(
    args: &EvaluateArgs,
    [json, html]: &[Option<PathBuf>; 2],
    evaluation: &Evaluation<'_>,
    paths: &[ModelPaths],
    windows: &[Window<'_>],
) -> Result<(), Failure> {
    say!("");
    if let Some(file) = json {
        output::write_file(file, evaluation.to_json().as_bytes())?;
        say!("wrote {}", file.display());
    }
    if let Some(file) = html {
        output::write_file(file, report::evaluation_page(evaluation, paths, windows).as_bytes())?;
        say!("wrote {}", file.display());
    }
    if let Some(file) = &args.markdown {
        output::write_file(file, report::evaluation_markdown(evaluation).as_bytes())?;
        say!("wrote {}", file.display());
    }
    if let Some(file) = &args.predictions {
        let named: Vec<_> = paths.iter().map(|model| (model.name.as_str(), model)).collect();
        output::write_with(file, |draft| write_predictions(draft, &named, windows).or_failed())?;
        say!("wrote {}", file.display());
    }
    Ok(())
}

fn model_names(args: &EvaluateArgs) -> Result<Vec<ModelName>, Failure> {
    let Some(given) = &args.models else { return Ok(ModelName::ALL.to_vec()) };
    let mut names: Vec<ModelName> = Vec::new();
    for text in given {
        let name = text.parse().or_input()?;
        if !names.contains(&name) {
            names.push(name);
        }
    }
    Ok(names)
}

fn warn_about_training_drives(args: &EvaluateArgs, drives: &Drives) {
    let trained_on = drives.drives.iter().filter(|d| d.split == Some(nesam_trajectories::Split::Train)).count();
    if trained_on > 0 && args.data.split == SplitArg::All {
        note!("note: {trained_on} of {} drives belong to the train split; --split test scores unseen drives only", drives.drives.len());
    }
}

/// The models, ready to run.
struct Models {
    predictor: Option<Arc<Predictor>>,
    ready: Vec<(ModelName, WindowPredictor)>,
}

impl Models {
    /// A baseline that is fitted here is fitted over `horizon` steps.
    fn prepare(
        args: &EvaluateArgs,
        names: &[ModelName],
        drives: &Drives,
        training: Option<&[Trajectory]>,
        horizon: usize,
    ) -> Result<Self, Failure> {
        let predictor = if names.iter().any(|n| n.is_nesam()) {
            args.window.check_horizon()?;
            let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
            Some(rounded(predictor, args.bf16, "--bf16")?)
        } else {
            None
        };
        let kinematic = match names.contains(&ModelName::Kinematic) {
            true => kinematic(args, predictor.as_deref(), drives, training, horizon)?,
            false => None,
        };
        // One card for all models: the bundle's where there is one, which is said to count.
        let vehicle = Arc::new(predictor.as_ref().map_or_else(|| drives.root.vehicle(), |predictor| &predictor.bundle().vehicle).clone());
        let trained = trained_baselines(args, names, drives)?;
        let mut ready = Vec::new();
        let own_bundle = |name: ModelName| {
            let mut own = trained.iter().filter(|_| name.is_ablation() || name.is_trained_baseline());
            own.find(|p| p.bundle().form.as_str() == name.as_str())
        };
        let retrained = names.iter().any(|n| n.is_ablation() && own_bundle(*n).is_some());
        for &name in names {
            if name.is_switch() && args.models.is_none() && !retrained {
                continue; // the ablations are the switches then
            }
            if let Some(own) = own_bundle(name) {
                ready.push((name, WindowPredictor::new(name, Some(own), &vehicle, None, args.inputs.into()).or_input()?));
                continue;
            }
            if name.is_ablation() {
                note!("note: {name} is the switch at inference: no bundle of that form for this vehicle in the folder of baselines");
            }
            if name.is_trained_baseline() {
                if args.models.is_some() {
                    let hint = "train one with `nesam train --model`, and give its folder with --baselines";
                    return Err(Failure::input(format!("no bundle of the form {name} for this vehicle; {hint}")));
                }
                note!("note: {name} is left out: no bundle of that form for this vehicle in the folder of baselines");
                continue;
            }
            if name == ModelName::Kinematic && kinematic.is_none() && args.models.is_none() {
                note!(
                    "note: kinematic is left out: the bundle carries no fit for this vehicle and no set of the data root has a train split"
                );
                continue;
            }
            ready.push((name, WindowPredictor::new(name, predictor.as_ref(), &vehicle, kinematic, args.inputs.into()).or_input()?));
        }
        Ok(Self { predictor, ready })
    }

    /// Refuses windows of drives that do not measure what a model reads.
    fn check_inputs(&self, windows: &[Window<'_>]) -> Result<(), Failure> {
        let read = self.ready.iter().flat_map(|(_, model)| windows.iter().map(move |window| model.check_inputs(window)));
        read.collect::<Result<(), _>>().or_input()
    }
}

/// Bundles of baselines for the vehicle of the data.
fn trained_baselines(args: &EvaluateArgs, names: &[ModelName], drives: &Drives) -> Result<Vec<Arc<Predictor>>, Failure> {
    if !names.iter().any(|n| n.is_trained_baseline() || n.is_ablation()) {
        return Ok(Vec::new());
    }
    let folders = args.baselines.as_deref().map_or_else(baseline_bundles, bundles_in);
    let mut predictors = Vec::new();
    for folder in folders {
        let bundle = load_bundle(Some(&folder))?;
        if bundle.is_of(drives.root.vehicle()) {
            predictors.push(rounded(predictor_for(bundle, &drives.root, args.data.dt)?, args.bf16, "--bf16")?);
        }
    }
    Ok(predictors)
}

/// The kinematic fit: the bundle's where it is for this vehicle, else a new one on the train split.
fn kinematic(
    args: &EvaluateArgs,
    predictor: Option<&Predictor>,
    drives: &Drives,
    training: Option<&[Trajectory]>,
    horizon: usize,
) -> Result<Option<Kinematic>, Failure> {
    let bundled = match predictor {
        Some(p) => p.bundle().baselines_json.clone(),
        None => load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)
            .ok()
            .filter(|b| b.is_of(drives.root.vehicle()))
            .and_then(|b| b.baselines_json),
    };
    if let Some(json) = bundled {
        let baselines = Baselines::from_json(&json).or_input()?;
        if baselines.vehicle == drives.root.vehicle().name {
            return Ok(Some(baselines.kinematic));
        }
    }
    let Some(training) = training else { return Ok(None) };
    note!("fitting the kinematic baseline on {} training drives", training.len());
    Ok(Some(Baselines::fit(drives.root.vehicle(), training, horizon).or_failed()?.kinematic))
}

fn print_table(e: &Evaluation<'_>) {
    say!(
        "{} ({}): {} windows of {} steps from {} drives, median path {:.2} m; mean absolute errors against {} channels",
        e.set,
        e.split,
        e.windows,
        e.horizon_steps,
        e.trajectories,
        e.path_m_median,
        e.truth.as_str()
    );
    for (title, last) in [("mean over the horizon", false), ("at the last step", true)] {
        say!("\n{title:<22}{}  95 % interval", error_heads(9));
        for model in e.models {
            let (t, c) = (&model.summary.tree, &model.summary.ci95);
            let cells: String = t.row(last).map(|v| v.map_or("        –".into(), |v| format!("{v:9.3}"))).concat();
            let [.., interval] = c.row(last);
            let interval = interval.map_or(String::new(), |[lo, hi]| format!("  [{lo:.3}, {hi:.3}]"));
            say!("{:<22}{cells}{interval}", model.name.as_str());
        }
    }
    for model in e.models.iter().filter(|m| m.errors.not_finite() > 0) {
        say!("{}: {} windows gave a number that is not finite and count as standing still", model.name, model.errors.not_finite());
    }
}
