//! `nesam train`: trains a bundle on the train split of a set.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use clap::Args;
use nesam_evaluation::Baselines;
use nesam_learning::origin::Origin;
use nesam_learning::recipe::{Recipe, Reporter, run as train};
use nesam_learning::{Objective, Pooling, TrainingError, TrainingPlan};
use nesam_model::bundle::MANIFEST;
use nesam_model::reference::ComputeDevice;
use nesam_model::{MAX_HORIZON, ModelBundle, Variant};

use crate::args::{DataArgs, SplitArg, check_count, horizon_of};
use crate::cli::command_without_paths;
use crate::environment::{PURGE_DELAY, restart_with};
use crate::failure::{Failure, OrFail};
use crate::interrupt::{is_noted, note_ctrl_c};
use crate::output::{hold, note, out_place};
use crate::progress::Progress;
use crate::sources::{bundle_to_change, read_drives};

/// Options of `nesam train`.
#[derive(Args, Debug)]
pub struct TrainArgs {
    #[command(flatten)]
    data: DataArgs,
    /// Folder of the new bundle and its checkpoints, which must hold none, or with --resume those of the same command [default: nesam-out/train-<set>, for another model than nesam nesam-out/train-<set>-<model>]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Name of the new bundle [default: <vehicle's first word>-<set>]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// What to train: nesam; an ablation, nesam_no_residual or nesam_zero_sinkage; a baseline on the same tokens, transformer,
    /// kinematic_residual or rigid_residual; or one that attends to the terrain, tal_elev_sem, tal_elev or tal_sem
    #[arg(long, value_name = "MODEL", default_value = "nesam")]
    model: String,
    /// Optimiser steps of the encoders' pre-training
    #[arg(long, value_name = "STEPS", default_value_t = 600)]
    encoder_steps: usize,
    /// Peak learning rate of the encoders' pre-training
    #[arg(long, value_name = "RATE", default_value_t = 2e-3)]
    encoder_lr: f64,
    /// Epochs: after each, the model is validated and a checkpoint written; 0 with --from: only what else is asked for is changed
    #[arg(long, default_value_t = 40)]
    epochs: usize,
    /// Batches per epoch
    #[arg(long, default_value_t = 250)]
    batches: usize,
    /// Windows per batch
    #[arg(long, default_value_t = 32)]
    batch_size: usize,
    /// Steps of each training rollout, at most 32 [default: 32, fewer where every drive is shorter]
    #[arg(long, value_name = "STEPS")]
    horizon: Option<usize>,
    /// Peak learning rate
    #[arg(long, default_value_t = 5e-4)]
    lr: f64,
    /// Share of the terrain features that each window is trained without
    #[arg(long, value_name = "SHARE", default_value_t = 0.1)]
    dropout: f32,
    /// Cells of the 16 × 16 terrain features, per side, that share one weight: 1, 2, 4, 8 or 16; more of them learn fewer places by heart
    #[arg(long, value_name = "CELLS", default_value_t = 1)]
    pool: usize,
    /// Let the encoders see borders between colours as the map has them, or smoothed over about 0.4 m, so that terrain can be interpolated between poses
    /// [default: smooth, with --from as the bundle has it]
    #[arg(long, value_name = "hard|smooth", value_parser = ["hard", "smooth"])]
    borders: Option<String>,
    /// Decay of the weights, per unit of learning rate
    #[arg(long, value_name = "RATE", default_value_t = 0.0)]
    decay: f32,
    /// Weight in the loss of what the residual carries on average over a window: more of it leaves lasting forces to the wheels
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.0)]
    sustained: f64,
    /// Weight in the loss of soils that lie off the ranges that the map states for their class: more of it keeps the soil what the map says
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.0)]
    soil_prior: f64,
    /// Start from the weights, scales and vehicle of this bundle (same model, no effects) instead of from nothing
    #[arg(long, value_name = "BUNDLE")]
    from: Option<PathBuf>,
    /// Fit drive line and suspension anew on these drives instead of taking the bundle's vehicle: after the physics or the card has changed
    #[arg(long, requires = "from")]
    recalibrate: bool,
    /// Pressure by which fresh soil resists being pressed down, over the speed of that, Pa s/m; a few thousand to tens of thousands, 0 for soil that yields
    /// however fast it is pressed. Part of the soil contact model, the only contact law that is then calibrated [default: as the card or, with --from, the
    /// bundle has it]
    #[arg(long, value_name = "PA_S_M")]
    soil_damping: Option<f64>,
    /// Do not train on the mirror images of the drives; for a vehicle whose left differs from its right
    #[arg(long)]
    no_mirror: bool,
    /// Seed of weights and batches
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Where to train: cpu, or cuda or cuda:1 in a program built with the feature `cuda`; the physics stays on the processor
    #[arg(long, value_name = "DEVICE", default_value_t = ComputeDevice::Cpu)]
    device: ComputeDevice,
    /// Threads that share each batch; the sum runs in a fixed order, so a number of threads has its own bytes [default: 2, on a GPU 1]
    #[arg(long)]
    threads: Option<usize>,
    /// Go on where an interrupted run of the same command stopped
    #[arg(long)]
    resume: bool,
}

/// Shows the stages of a run as progress bars or lines.
#[derive(Default)]
pub struct Console {
    stage: Mutex<Option<Progress>>,
}

impl Reporter for Console {
    fn stage(&self, name: &str, total: usize) {
        if let Ok(mut stage) = self.stage.lock()
            && let Some(done) = stage.replace(Progress::start(name, total))
        {
            done.finish();
        }
    }

    fn progress(&self, done: usize, remark: &str) {
        if let Ok(stage) = self.stage.lock()
            && let Some(progress) = stage.as_ref()
        {
            progress.set_with(done, remark);
        }
    }

    fn line(&self, text: &str) {
        note!("{text}");
    }
}

/// Runs the command.
pub fn run(args: &TrainArgs) -> Result<(), Failure> {
    if args.data.split == SplitArg::Test {
        return Err(Failure::input("--split test: training reads the train split alone, so that the test split can score it"));
    }
    let variant = Variant::from_name(&args.model)
        .ok_or_else(|| Failure::input(format!("no model `{}`; one of {}", args.model, Variant::ALL.map(Variant::as_str).join(", "))))?;
    let shards = args.threads.unwrap_or(if args.device == ComputeDevice::Cpu { 2 } else { 1 });
    check_numbers(args, shards)?;
    let pooling = Pooling::new(args.pool).ok_or_else(|| Failure::input(format!("--pool {} is none of 1, 2, 4, 8, 16", args.pool)))?;
    check_form(args, variant)?;
    let start = args.from.as_deref().map(|dir| start_of(dir, variant, args.data.dt)).transpose()?;
    // Each thread of `--threads` works on its own share of a batch, so candle's own element-wise threads would only get in their way (0.67 s against 0.42 s per
    // step, measured), and without a set number candle reads the processor list at every matrix product. What a step gives back the next one takes again.
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get()).to_string();
    restart_with(&[("CANDLE_NUM_THREADS", "1"), ("RAYON_NUM_THREADS", &threads), (PURGE_DELAY, "-1")])?;
    args.device.open().or_input()?;
    let drives = read_drives(&DataArgs { split: SplitArg::Train, ..args.data.clone() }, false)?;
    if let Some(bundle) = start.as_ref().filter(|bundle| !bundle.is_of(drives.root.vehicle())) {
        let (own, given) = (&bundle.vehicle.name, &drives.root.vehicle().name);
        return Err(Failure::input(format!("--from: bundle {} is of `{own}`, the data of `{given}`", bundle.name)));
    }
    let hash = drives.root.hash();
    let horizon = horizon_of(args.horizon, &drives.drives, "trained on");
    let baselines = Baselines::fit(drives.root.vehicle(), &drives.drives, horizon).or_input()?;
    let form = if variant == Variant::Full { String::new() } else { format!("-{}", variant.as_str().replace('_', "-")) };
    let out = out_place(args.out.as_deref(), "train", &format!("{}{form}", drives.set))?;
    check_unused(&out, args.resume)?;
    let name = args.name.clone().unwrap_or_else(|| {
        let vehicle = drives.root.vehicle().name.split_whitespace().next().unwrap_or("vehicle").to_lowercase();
        format!("{vehicle}-{}{form}", drives.set.replace('/', "-"))
    });
    let recipe = Recipe {
        name,
        dt_s: args.data.dt,
        encoder_steps: args.encoder_steps,
        encoder_batch: 64,
        encoder_rate: args.encoder_lr,
        mirror: !args.no_mirror,
        pooling,
        plan: TrainingPlan {
            steps: args.epochs * args.batches,
            batch: args.batch_size,
            rate: args.lr,
            horizon,
            seed: args.seed,
            epoch: args.batches,
            device: args.device,
            shards,
            dropout: args.dropout,
            decay: args.decay,
            objective: Objective { variant, sustained: args.sustained, soil_prior: args.soil_prior },
            folder: out.join("checkpoint"),
            origin: Origin::new(),
        },
        start,
        recalibrate: args.recalibrate,
        soil_damping_pa_s_m: args.soil_damping,
        smooth_borders: args.borders.as_ref().map(|borders| borders == "smooth"),
        out: out.clone(),
        resume: args.resume,
        // However often it was interrupted, it is the same bundle.
        command: command_without_paths().replace(" --resume", ""),
    };
    let _held = hold(&out)?;
    // Another run may have ended since.
    check_unused(&out, args.resume)?;
    // A checkpoint after the step in work, or before the first step an end after what is in work.
    note_ctrl_c(
        "stopping after this step; Ctrl-C again to stop at once",
        "stopped at once: what was done since the last checkpoint is lost",
    );
    let console = Console::default();
    let bundle = train(&drives.root, &drives.drives, &hash, &recipe, Some(baselines.to_json()), &console, &is_noted);
    let bundle = match bundle {
        Err(error @ (TrainingError::Drives(_) | TrainingError::Foreign { .. })) => return Err(Failure::input(error.to_string())),
        other => other.or_failed()?,
    };
    note!("bundle {} ({}) in {}", bundle.name, &bundle.hash[..12], out.join("bundle").display());
    Ok(())
}

/// Refuses numbers out of range, and a name that is none.
fn check_numbers(args: &TrainArgs, shards: usize) -> Result<(), Failure> {
    if args.batches * args.batch_size * shards == 0 || (args.epochs == 0 && args.from.is_none()) {
        return Err(Failure::input("--batches, --batch-size and --threads must be at least 1, and so must --epochs without --from"));
    }
    args.horizon.map_or(Ok(()), |horizon| check_count("--horizon", horizon, 1..=MAX_HORIZON))?;
    for (option, rate) in [("--lr", args.lr), ("--encoder-lr", args.encoder_lr)] {
        if !(rate > 0.0 && rate <= 1.0) {
            return Err(Failure::input(format!("{option} {rate} is not above 0 and at most 1")));
        }
    }
    if !(0.0..0.9).contains(&args.dropout) {
        return Err(Failure::input(format!("--dropout {} is not in 0..0.9", args.dropout)));
    }
    if !(0.0..100.0).contains(&args.decay) {
        return Err(Failure::input(format!("--decay {} is not in 0..100", args.decay)));
    }
    for (option, weight) in [("--sustained", args.sustained), ("--soil-prior", args.soil_prior)] {
        if !(0.0..100.0).contains(&weight) {
            return Err(Failure::input(format!("{option} {weight} is not in 0..100")));
        }
    }
    if let Some(damping) = args.soil_damping.filter(|d| !(0.0..=1e6).contains(d)) {
        return Err(Failure::input(format!("--soil-damping {damping} is not in 0..1e6 Pa s/m")));
    }
    if let Some(name) = args.name.as_ref().filter(|name| !is_name(name)) {
        return Err(Failure::input(format!("--name `{name}` has other than letters, digits, `-`, `_` and `.`")));
    }
    Ok(())
}

/// Refuses losses of what a model does not have.
fn check_form(args: &TrainArgs, variant: Variant) -> Result<(), Failure> {
    if args.sustained > 0.0 && variant.is_end_to_end() {
        return Err(Failure::input(format!("--sustained is for models whose physics carries what lasts; {} has none", args.model)));
    }
    if args.soil_prior > 0.0 && !variant.has_soil() {
        return Err(Failure::input(format!("--soil-prior is for models that read a soil off the map; {} does not", args.model)));
    }
    Ok(())
}

/// Refuses a folder that holds the results of another run, which this one would take the place of.
fn check_unused(out: &Path, resume: bool) -> Result<(), Failure> {
    let checkpoint = out.join("checkpoint/state.json").exists();
    let refused = |why: &str| Err(Failure::input(format!("--out {} {why}", out.display())));
    if checkpoint && !resume {
        return refused(
            "holds the checkpoint of another run; go on with --resume if it was the same command, choose another --out, or remove it",
        );
    }
    if !checkpoint && out.join("bundle").join(MANIFEST).exists() {
        return refused("holds a bundle and no checkpoint to go on from; choose another --out or remove it");
    }
    Ok(())
}

/// Whether a bundle can be called so wherever it is named: in paths, tables and pages.
fn is_name(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_alphanumeric() || "-_.".contains(c))
}

/// The bundle that a run starts from.
fn start_of(dir: &Path, variant: Variant, dt_s: f64) -> Result<ModelBundle, Failure> {
    let bundle = bundle_to_change("--from", dir, dt_s)?;
    if bundle.form != variant {
        return Err(Failure::input(format!("--from {}: it is a {}, not a {}", dir.display(), bundle.form.as_str(), variant.as_str())));
    }
    Ok(bundle)
}
