//! `nesam evaluate --coverage` and `--calibrate-coverage`: whether predicted covariances are honest.

use nesam_adaptation::{CalibratedFilter, FilterConfig};
use nesam_evaluation::{
    DriveAdaptation, LinearisedWindow, Resamples, SoilKnowledge, StepCoverage, Truth, adapt_all, all_windows, calibrate_regions,
    calibrate_rollout_noise, check_forecasts, coverage, linearise_windows,
};
use nesam_model::rollout_noise::{SoilCovariance, StateCovariance};
use nesam_model::{ModelBundle, Predictor, RolloutNoise};
use nesam_physics::STATE_DIM;

use super::evaluate::EvaluateArgs;
use crate::bundle_path::bundle_dir;
use crate::failure::{Failure, OrFail};
use crate::output::say;
use crate::progress::Progress;
use crate::sources::{Drives, check_own_vehicle, load_bundle, load_bundle_for, predictor_for, read_drives, validation_drives};
use crate::{interrupt, output};

/// Share of windows that the 90 % regions hold, with the soil prior and with what the drive has taught.
pub fn run(args: &EvaluateArgs) -> Result<(), Failure> {
    interrupt::exit_on_ctrl_c("nothing was written");
    let drives = read_drives(&args.data, false)?;
    let [file] = output::result_files(args.out.as_deref(), "coverage", &drives.set, [(&args.json, "coverage.json")], [])?;
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
    let noise = noise_of(predictor.bundle())?;
    let resamples = Resamples::draw(drives.drives.len(), args.resamples, args.seed);
    let filter = CalibratedFilter::config_of(predictor.bundle().soil_filter_json.as_deref()).or_input()?;
    let mut filtered = adapt_all(&predictor, &drives.drives, &drives.maps, &filter, &|_| {}).or_input()?;
    check_forecasts(&predictor, &drives.drives, &drives.maps, &noise, &mut filtered);
    let covered = |filtered: Option<&[DriveAdaptation]>| {
        let windows = windows_of(args, &drives, &predictor, &noise.start_covariance(), &filter, filtered)?;
        Ok(coverage(&windows, &noise, &resamples))
    };
    let [prior, learned]: [Result<_, Failure>; 2] = [covered(None), covered(Some(&filtered))];
    let [prior, learned] = [prior?, learned?];
    say!("{} ({}): share of windows inside the 90 % region, {} drives", drives.set, args.data.split.as_str(), drives.drives.len());
    print_table("soil prior", &prior);
    print_table("soil as learned", &learned);
    let provenance = output::provenance(Some(predictor.bundle()), &drives);
    // `prior`: soil prior as it is, with its covariance; `learned`: what a session knew of the soil and of the model's errors at the start of each window.
    let document = serde_json::json!({
        "schema": "nesam.coverage/1",
        "set": drives.set,
        "split": args.data.split.as_str(),
        "trajectories": drives.drives.len(),
        "prior": prior,
        "learned": learned,
        "provenance": provenance,
    });
    output::write_json(&file, &document)?;
    say!("\nwrote {}", file.display());
    Ok(())
}

/// Estimates what the bundle does not know of itself on validation drives, and puts it into the bundle.
pub fn calibrate(args: &EvaluateArgs) -> Result<(), Failure> {
    interrupt::exit_on_ctrl_c("the bundle is unchanged");
    let dir = bundle_dir(args.bundle.bundle.as_deref())?;
    let start_sd: [f64; STATE_DIM] = args
        .start_sd
        .as_slice()
        .try_into()
        .map_err(|_| Failure::input(format!("--start-sd has {} numbers, {STATE_DIM} are needed", args.start_sd.len())))?;
    let drives = validation_drives(&args.data, "--calibrate-coverage", "the covariance is estimated")?;
    let mut bundle = load_bundle(Some(&dir))?;
    check_own_vehicle(&bundle, &drives.root, "--calibrate-coverage")?;
    let predictor = predictor_for(bundle.clone(), &drives.root, args.data.dt)?;
    let start = RolloutNoise::new(start_sd, &[]).start_covariance();
    let filter = CalibratedFilter::config_of(bundle.soil_filter_json.as_deref()).or_input()?;
    let mut filtered = adapt_all(&predictor, &drives.drives, &drives.maps, &filter, &|_| {}).or_input()?;
    let mut windows = windows_of(args, &drives, &predictor, &start, &filter, Some(&filtered))?;
    let none = || Failure::input("no window of the validation drives could be rolled out".to_string());
    let mut noise = calibrate_rollout_noise(&windows, start_sd).ok_or_else(none)?;
    // Regions are those of a session, which knows how its predictions came true.
    check_forecasts(&predictor, &drives.drives, &drives.maps, &noise, &mut filtered);
    windows.iter_mut().for_each(|w| w.noise_scale = filtered[w.drive].noise_scale_at(w.start));
    calibrate_regions(&windows, &mut noise).ok_or_else(none)?;
    (noise.drives, noise.data_hash) = (drives.drives.len(), drives.root.hash());
    bundle.rollout_noise_json = Some(noise.to_json());
    bundle.save(&dir).or_failed()?;
    say!(
        "bundle {} now carries the covariance of its errors over {} steps from {} windows of {} drives; squared radius of the 90 % region {:.2} (x, y), {} (single); its hash is {}",
        bundle.name,
        noise.steps(),
        noise.windows,
        noise.drives,
        noise.region_90_planar,
        noise.region_90_single.map(|r| format!("{r:.2}")).join(" "),
        &bundle.hash[..12]
    );
    Ok(())
}

fn noise_of(bundle: &ModelBundle) -> Result<RolloutNoise, Failure> {
    let hint = "run `nesam evaluate --calibrate-coverage --split train` on training data of that vehicle, with a bundle of it";
    let json = bundle.rollout_noise_json.as_deref().ok_or_else(|| {
        let (name, vehicle) = (&bundle.name, &bundle.vehicle.name);
        Failure::input(format!("bundle {name} does not know the covariance of its errors with `{vehicle}`; {hint}"))
    })?;
    RolloutNoise::from_json(json).or_input()
}

/// Every window, linearised with the soil prior or with what the soil filter had learned by its start.
fn windows_of(
    args: &EvaluateArgs,
    drives: &Drives,
    predictor: &Predictor,
    start: &StateCovariance,
    filter: &FilterConfig,
    filtered: Option<&[DriveAdaptation]>,
) -> Result<Vec<LinearisedWindow>, Failure> {
    let windows = all_windows(&drives.drives, args.window.horizon_on(&drives.drives), args.window.history, Truth::Measured).or_input()?;
    let prior: SoilCovariance = core::array::from_fn(|r| core::array::from_fn(|c| if r == c { filter.prior_sd[r].powi(2) } else { 0.0 }));
    let soil = filtered.map_or(SoilKnowledge::Prior(&prior), |filtered| SoilKnowledge::Learned(filtered, &prior));
    let progress = Progress::start("windows linearised", windows.len());
    let linearised = linearise_windows(predictor, &windows, &drives.maps, start, soil, &|done| progress.set(done)).or_failed()?;
    progress.finish();
    Ok(linearised)
}

fn print_table(title: &str, steps: &[StepCoverage]) {
    say!(
        "\n{title:<18}{:>8}{:>24}{:>10}{:>9}{:>9}{:>9}{:>9}{:>9}{:>9}",
        "windows",
        "(x, y) [95 %]",
        "radius m",
        "x",
        "y",
        "z",
        "roll",
        "pitch",
        "yaw"
    );
    for step in steps {
        let interval = step.planar.ci95.map_or(String::new(), |[low, high]| format!(" [{low:.3}, {high:.3}]"));
        let single: String = step.single.iter().map(|(_, share)| format!("{:>9.3}", share.inside)).collect();
        let planar = format!("{:.3}{interval}", step.planar.inside);
        say!("{:<18}{:>8}{planar:>24}{:>10.3}{single}", format!("k = {}", step.step), step.windows, step.radius_m_median);
    }
}
