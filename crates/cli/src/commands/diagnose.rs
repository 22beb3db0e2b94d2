//! `nesam diagnose`: from a measured residual to the physical effect that the model lacks.

mod fitted;
mod hypotheses;
mod recording;
mod summary;

use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use clap::Args;
use nesam_discovery::observe::channels::CHANNELS;
use nesam_discovery::report::Report;
use nesam_discovery::{
    Against, Bench, DRIVES_MIN, Judge, Options, Reference, ReferenceDrives, SEGMENT_STEPS, Scoring, Segmented, catalogue, diagnose,
    observe_all,
};
use nesam_evaluation::{DEFAULT_RESAMPLES, Provenance as ReportProvenance};
use nesam_import::doubts;
use nesam_model::{ModelBundle, Predictor};
use nesam_physics::Vehicle;
use nesam_physics::effects::ScheduledEffect;
use nesam_terrain::WorldMap;
use nesam_trajectories::{Split, Trajectory};

use self::recording::RecordingArgs;
use self::summary::{bundles, summary};
use crate::args::{BundleArgs, CommandsArgs, DataArgs, WindowArgs};
use crate::bundle_path::bundle_dir;
use crate::bundle_version::{save_with_effects, set_aside};
use crate::failure::{Failure, OrFail};
use crate::output::say;
use crate::progress::Progress;
use crate::sources::{check_own_vehicle, load_bundle, load_bundle_for, predictor_for, read_drives, validation_drives};
use crate::{interrupt, output};

/// Options of `nesam diagnose`.
#[derive(Args, Debug)]
pub struct DiagnoseArgs {
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    bundle: BundleArgs,
    #[command(flatten)]
    window: WindowArgs,
    #[command(flatten)]
    inputs: CommandsArgs,
    #[command(flatten)]
    recording: RecordingArgs,
    /// Find, prove and claim by these drives only, each left out once, and score the others. `train` stands for those of the train split [default: leave each drive out
    /// once]
    #[arg(long, value_name = "ID,…", value_delimiter = ',')]
    fit_on: Option<Vec<String>>,
    /// Effects that are not considered
    #[arg(long, value_name = "ID,…", value_delimiter = ',')]
    without: Vec<String>,
    /// Effects written as formulas that are considered beside the catalogue, each at a share of its size (docs/your-own-effect.md); a bundle's reference must
    /// have been measured for them, with --make-reference, and then knows them without this
    #[arg(long, value_name = "FILE")]
    hypotheses: Option<PathBuf>,
    /// What the change is measured against [default: bundle; physics where the bundle carries no reference for the vehicle, which is said]
    #[arg(long, value_enum)]
    reference: Option<ReferenceArg>,
    /// Measure the reference on the drives of the train split that training left for validation, and put it into the bundle
    #[arg(long, conflicts_with_all = ["fit_on", "without", "recording"])]
    make_reference: bool,
    /// Leave out the controls: rivals refitted, a black box, a free form of what is left
    #[arg(long)]
    no_controls: bool,
    /// Seed of the bootstrap
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for the reports and the patched bundle [default: nesam-out/diagnose-<set>]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Write the JSON here instead
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the HTML report here instead
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum ReferenceArg {
    /// The change against the frozen bundle.
    Bundle,
    /// The symbolic model itself, the network silent but for its soil prior; of fewer than 8 drives no effect is claimed.
    Physics,
}

impl From<ReferenceArg> for Against {
    fn from(reference: ReferenceArg) -> Self {
        match reference {
            ReferenceArg::Bundle => Self::Bundle,
            ReferenceArg::Physics => Self::Physics,
        }
    }
}

/// What is asked for, else what the bundle can do: a bundle without a reference knows of no drives without an effect, and then the model itself is on trial.
fn reference(asked: Option<ReferenceArg>, bundle: &ModelBundle) -> ReferenceArg {
    asked.unwrap_or(if bundle.reference_json.is_some() { ReferenceArg::Bundle } else { ReferenceArg::Physics })
}

/// What is diagnosed.
struct Input {
    set: String,
    drives: Vec<Trajectory>,
    maps: Vec<Option<Arc<WorldMap>>>,
    data_hash: String,
    predictor: Arc<Predictor>,
    provenance: ReportProvenance,
    /// Drives of the set that are too short to be judged beside the others, with their samples.
    short: Vec<(String, usize)>,
    /// What else to know of them.
    notes: Vec<String>,
}

/// The drives of a set in a data root.
fn of_set(args: &DiagnoseArgs) -> Result<Input, Failure> {
    // With --fit-on others only say what comes of a claim, as far as they are there.
    let mut drives = read_drives(&DataArgs { may_lack_drives: args.fit_on.is_some(), ..args.data.clone() }, false)?;
    let long_enough = |drive: &Trajectory| drive.states.len() > SEGMENT_STEPS;
    let all = drives.drives.len();
    let mut short: Vec<(String, usize)> =
        drives.drives.iter().filter(|drive| !long_enough(drive)).map(|drive| (drive.id.clone(), drive.states.len())).collect();
    if short.len() == all {
        // The diagnosis says that none has a segment.
        short.clear();
    }
    if let Some((id, _)) = short.first() {
        let driven = core::mem::take(&mut drives.drives).into_iter().zip(core::mem::take(&mut drives.maps));
        (drives.drives, drives.maps) = driven.filter(|(drive, _)| long_enough(drive)).unzip();
        output::note!(
            "note: left out as too short to judge, with fewer than {SEGMENT_STEPS} steps: {} of {all} drives, the first is `{id}`",
            short.len()
        );
    }
    let predictor = predictor_for(load_bundle_for(args.bundle.bundle.as_deref(), &drives.root)?, &drives.root, args.data.dt)?;
    let provenance = output::provenance(Some(predictor.bundle()), &drives);
    let data_hash = drives.root.hash();
    Ok(Input { set: drives.set, drives: drives.drives, maps: drives.maps, data_hash, predictor, provenance, short, notes: Vec::new() })
}

/// Runs the command.
pub fn run(args: &DiagnoseArgs) -> Result<(), Failure> {
    args.window.check_horizon()?;
    args.inputs.check("what is diagnosed are predictions under commands")?;
    if args.make_reference { make_reference(args) } else { diagnose_set(args) }
}

fn make_reference(args: &DiagnoseArgs) -> Result<(), Failure> {
    interrupt::exit_on_ctrl_c("the bundle is unchanged");
    let hypotheses = hypotheses::read(args.hypotheses.as_deref())?;
    let dir = bundle_dir(args.bundle.bundle.as_deref())?;
    let drives = validation_drives(&args.data, "--make-reference", "the reference is measured")?;
    let left = drives.drives.len();
    if left < DRIVES_MIN {
        return Err(Failure::input(format!(
            "--make-reference: training left {left} drives for validation, every tenth of set `{}`, and a reference takes {DRIVES_MIN}, so about {} drives in the train \
             split. Without one `nesam diagnose` tests the model itself (--reference physics)",
            drives.set,
            10 * DRIVES_MIN
        )));
    }
    let mut bundle = load_bundle(Some(&dir))?;
    check_own_vehicle(&bundle, &drives.root, "--make-reference")?;
    take_coupling(&mut bundle, drives.root.vehicle());
    let predictor = predictor_for(bundle.clone(), &drives.root, args.data.dt)?;
    let progress = Progress::start("validation drives, as the model sees them", drives.drives.len());
    let seen: Vec<Trajectory> = drives.drives.iter().map(Trajectory::in_hindsight).collect();
    let observed = observe_all(&predictor, &seen, &drives.maps, &|done| progress.set(done)).or_input()?;
    progress.finish();
    let catalogue = catalogue(&hypotheses);
    let bench = Bench::new(predictor.bundle(), &catalogue);
    let progress = Progress::start("validation drives against every effect", observed.len());
    let segmented = Segmented::of(&bench, &observed, &|done| progress.set(done));
    progress.finish();
    let reference = Reference::of(&bench, &observed, &segmented, &drives.root.hash()).or_input()?;
    let looks = Console::default();
    let behind = ReferenceDrives::measure(&predictor, &bench, (&drives.drives, &drives.maps), (&reference, &segmented), &|done, total| {
        looks.show("validation drives as if they lacked channels or maps", done, total);
    });
    looks.end();
    let behind = behind.or_input()?.to_bytes();
    let text = reference.to_json();
    let judge = Judge::new(reference).or_input()?;
    let channels: Vec<usize> = (0..CHANNELS).filter(|c| observed.iter().all(|d| d.available[*c])).collect();
    let yardstick = judge.yardstick(&channels, 5, &[]).or_input()?;
    if let Some(groups) = &yardstick.groups {
        say!("null groups of 5 drives: threshold z = {:.2}", groups.threshold);
        for (candidate, spread) in yardstick.catalogue.iter().zip(&groups.spread) {
            let column = candidate.columns()[0];
            say!(
                "  {:<24} null spread {spread:.2}, dispersion {:.2}, usual share {:+.3}",
                candidate.label(),
                yardstick.nulls.dispersion(column),
                yardstick.nulls.share[column]
            );
        }
    }
    bundle.reference_json = Some(text.into());
    bundle.reference_drives = Some(behind.into());
    bundle.save(&dir).or_failed()?;
    say!("bundle {} now carries the reference of {} drives; its hash is {}", bundle.name, observed.len(), &bundle.hash[..12]);
    Ok(())
}

/// A bundle trained before cards told of couplings between wheels learns of it from the data sheet of the same vehicle; without a wheel drag it has no
/// influence on any prediction.
fn take_coupling(bundle: &mut ModelBundle, sheet: &Vehicle) {
    let coupling = sheet.driveline.side_coupling_n_m_s;
    if bundle.vehicle.driveline.side_coupling_n_m_s == 0.0 && coupling > 0.0 {
        bundle.vehicle.driveline.side_coupling_n_m_s = coupling;
        say!("the card of the bundle now has the coupling of the data sheet, {coupling} N m s/rad between the wheels of an axle");
    }
}

/// The shorter half of some drives: as many steps as the longest of them has, every second drive has.
fn shorter_half<'a, 'd>(drives: &'a mut [&'d Trajectory]) -> &'a [&'d Trajectory] {
    drives.sort_by_key(|drive| drive.states.len());
    &drives[..drives.len().div_ceil(2)]
}

/// Ids of the drives to fit on; `train` stands for those of the train split.
fn fit_on(ids: &[String], Input { drives, short, .. }: &Input, dt_s: f64) -> Result<Vec<String>, Failure> {
    if let Some((id, samples)) = short.iter().find(|(id, _)| ids.contains(id)) {
        let least = SEGMENT_STEPS + 1;
        return Err(Failure::input(format!(
            "--fit-on {id}: the drive is too short to be judged, {:.1} s ({samples} samples of {dt_s} s); it must be of {:.1} s ({least} samples) or more",
            samples.saturating_sub(1) as f64 * dt_s,
            SEGMENT_STEPS as f64 * dt_s
        )));
    }
    if ids != ["train"] || drives.iter().any(|d| d.id == "train") {
        return Ok(ids.to_vec());
    }
    let train: Vec<String> = drives.iter().filter(|d| d.split == Some(Split::Train)).map(|d| d.id.clone()).collect();
    if train.is_empty() || train.len() == drives.len() {
        let split = |split| drives.iter().filter(|d| d.split == Some(split)).count();
        return Err(Failure::input(format!(
            "--fit-on train: needs drives whose index says `split` = train and others; of {} drives {} are train, {} test and {} say nothing. Mend the index, name the \
             drives to fit on (--fit-on ID,ID), or leave --fit-on out: each drive is then judged by the others",
            drives.len(),
            split(Split::Train),
            split(Split::Test),
            drives.len() - split(Split::Train) - split(Split::Test)
        )));
    }
    Ok(train)
}

fn diagnose_set(args: &DiagnoseArgs) -> Result<(), Failure> {
    interrupt::exit_on_ctrl_c("nothing was written");
    let hypotheses = hypotheses::read(args.hypotheses.as_deref())?;
    args.recording.check()?;
    let drives = if args.recording.recording.is_empty() { of_set(args)? } else { args.recording.input(&args.bundle, args.reference)? };
    // A bundle may go beside them, so that the folder is made in any case.
    let out = output::out_dir(args.out.as_deref(), "diagnose", &drives.set)?;
    let names = [(&args.json, "diagnose.json"), (&args.html, "diagnose.html")];
    let [json, html] = output::result_files(Some(&out), "diagnose", &drives.set, names, [])?;
    let predictor = Arc::clone(&drives.predictor);
    let reference = reference(args.reference, predictor.bundle());
    if args.reference.is_none() && reference == ReferenceArg::Physics {
        output::note!(
            "note: bundle {} carries no reference for `{}`, so the model itself is tested, as with --reference physics; --make-reference \
             measures one, with a bundle of that vehicle",
            predictor.bundle().name,
            predictor.bundle().vehicle.name
        );
    }
    let fit_on = args.fit_on.as_deref().map(|ids| fit_on(ids, &drives, predictor.bundle().normalization.dt_s)).transpose()?;
    // What is claimed does not hang on other drives, nor does how far they are predicted.
    let mut fitted: Vec<&Trajectory> = drives.drives.iter().filter(|d| fit_on.as_ref().is_none_or(|ids| ids.contains(&d.id))).collect();
    if fitted.is_empty() {
        // Nothing is of that name, which the diagnosis refuses.
        fitted.extend(&drives.drives);
    }
    let options = Options {
        fit_on,
        without: args.without.clone(),
        hypotheses,
        against: reference.into(),
        scoring: Scoring {
            horizon: args.window.horizon_on(shorter_half(&mut fitted)),
            history: args.window.history,
            resamples: DEFAULT_RESAMPLES,
            seed: args.seed,
        },
        controls: !args.no_controls,
    };
    let console = Console::default();
    let found =
        diagnose(&predictor, &drives.drives, &drives.maps, &options, &|stage, done, total| console.show(stage, done, total)).or_input()?;
    console.end();
    set_aside(&out)?;
    let data_hash = if args.fit_on.is_some() { fitted::hash(&drives.drives, &found.fit_on) } else { drives.data_hash.clone() };
    let bundle = match found.claimed.as_slice() {
        [] => None,
        claimed => {
            let bundle = predictor.bundle();
            let on_soil = found.soils.map(|soils| bundle.on_soil(&soils.beside));
            Some(save_with_effects(on_soil.as_ref().unwrap_or(bundle), claimed, &data_hash, &out.join("bundle"))?)
        }
    };
    let with_free_form: Vec<ScheduledEffect> = found.claimed.iter().copied().chain(found.free_form.map(Into::into)).collect();
    // What silences the network finds is no addition to a network that speaks.
    let free_form_bundle = match found.free_form.filter(|_| reference == ReferenceArg::Bundle) {
        None => None,
        Some(_) => Some(save_with_effects(predictor.bundle(), &with_free_form, &data_hash, &out.join("bundle-free-form"))?),
    };
    let [shown, free_form_bundle] = [bundle, free_form_bundle].map(|b| b.map(|p| p.display().to_string()));
    let doubts: Vec<String> =
        doubts(&drives.drives, &predictor.bundle().vehicle).iter().map(|d| format!("{}. {}", d.what, d.advice)).collect();
    let report = Report {
        set: &drives.set,
        diagnosis: &found,
        bundle: shown.as_deref(),
        free_form_bundle: free_form_bundle.as_deref(),
        provenance: &drives.provenance,
        dt_s: predictor.bundle().normalization.dt_s,
        against: reference.into(),
        doubts: &doubts,
        notes: &drives.notes,
    };
    summary(&report, &found);
    bundles(&report);
    output::write_file(&json, report.to_json().as_bytes())?;
    output::write_file(&html, report.to_html().as_bytes())?;
    say!("\nwrote {} and {}", json.display(), html.display());
    Ok(())
}

/// One progress bar after the other.
#[derive(Default)]
struct Console {
    stage: Mutex<Option<(String, Progress)>>,
}

impl Console {
    fn show(&self, stage: &str, done: usize, total: usize) {
        let Ok(mut now) = self.stage.lock() else { return };
        if now.as_ref().is_none_or(|(name, _)| name != stage)
            && let Some((_, ended)) = now.replace((stage.to_string(), Progress::start(stage, total)))
        {
            ended.finish();
        }
        if let Some((_, progress)) = now.as_ref() {
            progress.set_total(total);
            progress.set(done);
        }
    }

    fn end(&self) {
        if let Some((_, ended)) = self.stage.lock().ok().and_then(|mut now| now.take()) {
            ended.finish();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn regress_a_bundle_without_a_reference_is_held_against_itself_unless_asked() {
        let shipped = |name: &str| {
            let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles").join(name);
            ModelBundle::load(&dir).expect("a shipped bundle")
        };
        let (with, without) = (shipped("hmmwv-nominal"), shipped("clearpath-husky"));
        assert!(with.reference_json.is_some() && without.reference_json.is_none());
        let mut moved = with.clone();
        moved.move_to(&without.vehicle);
        assert_eq!(reference(None, &moved), ReferenceArg::Physics, "the reference of another vehicle is none");
        assert_eq!((reference(None, &with), reference(None, &without)), (ReferenceArg::Bundle, ReferenceArg::Physics));
        for asked in [ReferenceArg::Bundle, ReferenceArg::Physics] {
            assert_eq!([&with, &without].map(|bundle| reference(Some(asked), bundle)), [asked; 2], "what is asked for counts");
        }
    }
}
