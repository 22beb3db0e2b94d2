//! From a data root to a bundle: the stages of a training run in their order, each resumable.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use nesam_model::bundle::{sha256_hex, trained_parameters};
use nesam_model::dims::CONTEXT;
use nesam_model::encoder::{ENCODERS, TerrainEncoders};
use nesam_model::{ModelBundle, ModelError, Normalization, Provenance, Variant, Weights};
use nesam_physics::step::StepModel;
use nesam_physics::{STATE_DIM, Vehicle};
use nesam_terrain::{PatchScale, WorldMap};
use nesam_trajectories::{DataRoot, Trajectory};

use crate::autoencoder::{Places, PretrainPlan, pretrain};
use crate::calibrate::{Calibrated, calibrate_vehicle};
use crate::drives::{Drive, encode_drives};
use crate::initial::initial_weights;
use crate::origin::{self, Origin, digest};
use crate::pooling::Pooling;
use crate::scales::measure_increments;
use crate::stand_in;
use crate::trainer::{EpochReport, TrainingError, TrainingPlan, TrainingSet, train};

/// What a run is told; the defaults of the command line are in `nesam train --help`.
#[derive(Clone, Debug)]
pub struct Recipe {
    /// Name of the bundle.
    pub name: String,
    /// Step of the model, s.
    pub dt_s: f64,
    /// Steps of encoder pre-training.
    pub encoder_steps: usize,
    /// Patches per step of encoder pre-training.
    pub encoder_batch: usize,
    /// Learning rate of encoder pre-training.
    pub encoder_rate: f64,
    /// Trains on the mirror image of each drive too; for vehicles whose two sides are alike.
    pub mirror: bool,
    /// Cells that share a weight of the terrain projection.
    pub pooling: Pooling,
    /// Training plan; its folder is `out/checkpoint`, its origin what this recipe and the data say.
    pub plan: TrainingPlan,
    /// Starts from the weights, scales and vehicle of this bundle instead of from nothing.
    pub start: Option<ModelBundle>,
    /// With `start`: takes the data's vehicle and fits its drive line anew, instead of the bundle's vehicle.
    pub recalibrate: bool,
    /// Viscous part of the pressure of fresh soil, Pa s/m; `None` = as the card, or with `start` its bundle, has it.
    pub soil_damping_pa_s_m: Option<f64>,
    /// Whether the encoders see borders between colours smoothed; `None` = smoothed, or with `start` as its bundle has it.
    pub smooth_borders: Option<bool>,
    /// Output folder.
    pub out: PathBuf,
    /// Goes on where an interrupted run of the same command stopped.
    pub resume: bool,
    /// The command line, for the bundle.
    pub command: String,
}

/// Told how a run goes.
pub trait Reporter: Sync {
    /// A stage begins that counts to `total`.
    fn stage(&self, name: &str, total: usize);
    /// Progress within the stage, with a short remark.
    fn progress(&self, done: usize, remark: &str);
    /// A line worth keeping.
    fn line(&self, text: &str);
}

/// Drives that a training needs to leave some out; of fewer, all train.
pub const VALIDATED_FROM: usize = 10;

/// Every tenth of `count` drives sorted by id validates; the rest trains, and all do where there are fewer than [`VALIDATED_FROM`]. What is calibrated for a
/// bundle afterwards uses the same drives, which no weight has seen.
pub fn is_validation(index: usize, count: usize) -> bool {
    count >= VALIDATED_FROM && index % 10 == 7
}

/// Trains a bundle on the drives of the train split and writes it to `out/bundle`.
///
/// # Errors
/// `TrainingError`; an interruption keeps what is needed to resume.
pub fn run(
    root: &DataRoot,
    trajectories: &[Trajectory],
    data_hash: &str,
    recipe: &Recipe,
    baselines_json: Option<String>,
    reporter: &dyn Reporter,
    interrupted: &(dyn Fn() -> bool + Sync),
) -> Result<ModelBundle, TrainingError> {
    let mut drives = load_drives(root, trajectories)?;
    let plan = TrainingPlan {
        folder: recipe.out.join("checkpoint"),
        origin: origin_of(recipe, root.vehicle(), data_hash, &drives),
        ..recipe.plan.clone()
    };
    if recipe.resume {
        // Before the work that comes first: minutes.
        origin::check(&plan)?;
    }
    let stages = Stages { recipe, reporter, interrupted };
    let (validation_at, mut train_at): (Vec<usize>, Vec<usize>) = (0..drives.len()).partition(|&i| is_validation(i, drives.len()));
    let (vehicle, mut scales) = stages.card(root, trajectories, &at(&drives, &train_at))?;
    scales.smooth_semantics = recipe.smooth_borders.unwrap_or(scales.smooth_semantics);

    let learned_from = train_at.len();
    if recipe.mirror {
        let images = mirrored(&drives, &train_at);
        train_at.extend(drives.len()..drives.len() + images.len());
        drives.extend(images);
    }
    let weights = stages.first_weights(&drives, &train_at, &mut scales)?;
    // Of encoders that were trained on nothing no drive is shown anything.
    if recipe.start.is_some() || any_mapped(&drives, &train_at) {
        stages.show_terrain(&mut drives, &weights, &scales)?;
    }
    if interrupted() {
        return Err(TrainingError::Unprepared("the terrain contexts were computed"));
    }

    let set = TrainingSet {
        train: at(&drives, &train_at),
        validation: at(&drives, &validation_at),
        scales: &scales,
        model: Arc::new(StepModel::new(&vehicle, scales.dt_s, scales.substeps)),
        pooling: recipe.pooling.clone(),
    };
    let validating = set.validating(plan.horizon);
    let parameters = trained_parameters(&weights, recipe.plan.objective.variant);
    reporter.line(&format!("{}, {parameters} parameters", who_trains(learned_from, recipe.mirror, validating)));
    reporter.stage("training", recipe.plan.steps);
    let trained = train(
        &set,
        &weights,
        &plan,
        recipe.resume,
        interrupted,
        |step, loss, norm| reporter.progress(step, &format!("loss {loss:.3}, gradient {norm:.2}")),
        |line| reporter.line(&describe(line, validating > 0)),
    )?;
    reporter.line(&format!("{} steps in {:.0} s", trained.steps, optimisation_s(&trained.curve)));
    let curve = serde_json::to_string_pretty(&trained.curve).expect("numbers serialise; this is a bug");
    write(&recipe.out.join("loss_curve.json"), curve.as_bytes())?;
    let mut bundle = ModelBundle {
        name: recipe.name.clone(),
        hash: String::new(),
        form: recipe.plan.objective.variant,
        parameters: trained_parameters(&trained.weights, recipe.plan.objective.variant),
        vehicle,
        normalization: scales,
        weights: trained.weights,
        baselines_json,
        reference_json: None,
        reference_drives: None,
        soil_filter_json: None,
        rollout_noise_json: None,
        effects: Vec::new(),
        provenance: Provenance {
            command: recipe.command.clone(),
            seed: plan.seed,
            data_hash: data_hash.into(),
            steps: trained.steps as u64,
            training_s: None,
            program: format!("nesam {}", env!("CARGO_PKG_VERSION")),
            parent: recipe.start.as_ref().map(|bundle| bundle.hash.clone()),
        },
    };
    let measured = stand_in::measure(&bundle, &at(&drives, &train_at[..learned_from]))?;
    // Trained further without colours, a network has seen what it is to lack them.
    if measured.is_some() || plan.steps > 0 {
        bundle.normalization.stand_in = measured;
    }
    bundle.save(&recipe.out.join("bundle"))?;
    Ok(bundle)
}

/// Some of the drives.
fn at<'a>(drives: &'a [Drive], places: &[usize]) -> Vec<&'a Drive> {
    places.iter().map(|&i| &drives[i]).collect()
}

/// What comes before the optimiser.
struct Stages<'a> {
    recipe: &'a Recipe,
    reporter: &'a dyn Reporter,
    interrupted: &'a (dyn Fn() -> bool + Sync),
}

impl Stages<'_> {
    /// The vehicle and the scales of its quantities: of the bundle that training starts from, or calibrated on the drives that train.
    fn card(&self, root: &DataRoot, trajectories: &[Trajectory], training: &[&Drive]) -> Result<(Vehicle, Normalization), TrainingError> {
        let damped = |vehicle: &Vehicle| Vehicle {
            soil_damping_pa_s_m: self.recipe.soil_damping_pa_s_m.unwrap_or(vehicle.soil_damping_pa_s_m),
            ..vehicle.clone()
        };
        let fitted = || {
            let vehicle = root.vehicle_of(trajectories);
            if vehicle.command_range != root.vehicle().command_range {
                let [speed_m_s, second] = vehicle.command_range;
                let ranges = format!("with that of the drives speed {speed_m_s:?} m/s, second {second:?}");
                self.reporter.line(&format!("the card states no range of commands; {ranges}"));
            }
            calibrate_vehicle(damped(&vehicle), training, self.recipe.dt_s, self.reporter, self.interrupted)
                .ok_or(TrainingError::Unprepared("the vehicle's card was calibrated"))
        };
        match &self.recipe.start {
            Some(bundle) if self.recipe.recalibrate => {
                let Calibrated { vehicle, scales, ground } = fitted()?;
                let mut kept = bundle.normalization.clone();
                if let Some(ground) = ground {
                    // What stood in for it may go with the training, which reads the other.
                    kept.default_soil_raw = scales.default_soil_raw;
                    kept = ground.under(&kept);
                }
                Ok((vehicle, kept))
            }
            Some(bundle) => Ok((damped(&bundle.vehicle), bundle.normalization.clone())),
            None => fitted().map(|fitted| (fitted.vehicle, fitted.scales)),
        }
    }

    /// The weights that training begins from: those of a bundle, or drawn, with encoders that were trained on the maps of the drives. What predicts end to
    /// end begins from the drives' mean increment, and its scale is theirs.
    fn first_weights(&self, drives: &[Drive], train_at: &[usize], scales: &mut Normalization) -> Result<Weights, TrainingError> {
        let Recipe { plan, pooling, start, .. } = self.recipe;
        let mut weights = start.as_ref().map_or_else(|| initial_weights(plan.seed, scales), |bundle| bundle.weights.clone());
        prepare_projection(&mut weights, pooling, plan.objective.variant);
        if start.is_some() {
            return Ok(weights);
        }
        if plan.objective.variant.is_end_to_end() {
            let [mean, sd] = measure_increments(&at(drives, train_at));
            scales.residual_scale = sd;
            weights.insert("residual.bias", &[STATE_DIM], mean.iter().zip(sd).map(|(m, s)| m / s).collect());
        }
        if any_mapped(drives, train_at) {
            for (name, array) in encoders(drives, train_at, scales, self.recipe, self.reporter, self.interrupted)?.iter() {
                weights.get(name, &array.shape)?;
                weights.insert(name, &array.shape, array.values.clone());
            }
        }
        Ok(weights)
    }

    /// Encodes the terrain along drives over maps, if there are any and they are to be trained on.
    fn show_terrain(&self, drives: &mut [Drive], weights: &Weights, scales: &Normalization) -> Result<(), TrainingError> {
        if self.recipe.plan.steps == 0 || drives.iter().all(|d| d.map.is_none()) {
            return Ok(());
        }
        self.reporter.stage("terrain contexts", drives.iter().map(|d| d.states.len()).sum());
        let done = AtomicUsize::new(0);
        let told = |n| self.reporter.progress(done.fetch_add(n, Ordering::Relaxed) + n, "");
        let encoders = TerrainEncoders::new(weights)?;
        encode_drives(drives, &encoders, &scales.patch_scale(), &self.recipe.pooling, told, self.interrupted);
        Ok(())
    }
}

/// Makes W_c equal within the blocks that share a weight, and zero for what the form does not see: training on nothing leaves that so, and the
/// trained bundle ignores it.
fn prepare_projection(weights: &mut Weights, pooling: &Pooling, variant: Variant) {
    let projection = weights.values_mut("token.context.weight").expect("the projection is part of every network; this is a bug");
    for row in projection.chunks_exact_mut(CONTEXT) {
        let means = pooling.mean(row);
        row.iter_mut().zip(pooling.spread(&means)).for_each(|(weight, mean)| *weight = mean);
        row[variant.unseen()].fill(0.0);
    }
}

/// Seconds that the optimiser's steps took, over all the runs that a resumed training was made of.
fn optimisation_s(curve: &[EpochReport]) -> f64 {
    // The sum of nothing is -0.
    0.0 + curve.iter().scan(0, |before, line| Some((line.step - std::mem::replace(before, line.step)) as f64 * line.step_s)).sum::<f64>()
}

/// All that a run hangs on beside its plan.
fn origin_of(recipe: &Recipe, card: &Vehicle, data_hash: &str, drives: &[Drive]) -> Origin {
    let list = |of: &dyn Fn(&Drive) -> String| digest(&drives.iter().map(of).collect::<Vec<_>>().join("\n"));
    let stated = |value: Option<String>| value.unwrap_or_else(|| "as given".into());
    let settings = [
        ("data", data_hash.get(..12).unwrap_or(data_hash).to_string()),
        ("drives", list(&|drive| drive.id.clone())),
        ("maps", list(&|drive| drive.map.as_ref().map_or(String::new(), |map| map.hash().into()))),
        ("vehicle card", digest(&format!("{card:?}"))),
        ("--dt", recipe.dt_s.to_string()),
        ("--encoder-steps", recipe.encoder_steps.to_string()),
        ("--encoder-lr", recipe.encoder_rate.to_string()),
        ("mirror images", recipe.mirror.to_string()),
        ("--pool", recipe.pooling.cells().to_string()),
        ("--from", recipe.start.as_ref().map_or("nothing", |bundle| bundle.hash.get(..12).unwrap_or(&bundle.hash)).to_string()),
        ("--recalibrate", recipe.recalibrate.to_string()),
        ("--soil-damping", stated(recipe.soil_damping_pa_s_m.map(|damping| damping.to_string()))),
        ("smooth --borders", stated(recipe.smooth_borders.map(|smooth| smooth.to_string()))),
    ];
    settings.into_iter().map(|(name, value)| (name.to_string(), value)).collect()
}

/// How many drives train and validate, for people: mirror images are no drives of their own.
fn who_trains(train: usize, mirrored: bool, validate: usize) -> String {
    let images = if mirrored { ", each with its mirror image" } else { "" };
    let validation = match validate {
        0 => "none validates (the choice among epochs is made on those that train)".into(),
        some => format!("{some} validate"),
    };
    format!("{train} drives train{images}; {validation}")
}

/// One line of the loss curve for people; `held_out` = the drives that validate do not train.
fn describe(line: &EpochReport, held_out: bool) -> String {
    let on = if held_out { "validation" } else { "on the drives that train" };
    let [position, z, roll, pitch, yaw] = line.validation;
    let diverged = match line.diverged {
        0 => String::new(),
        windows => format!(", windows left out because they diverged: {windows}"),
    };
    format!(
        "step {}: loss {:.3}; {on}, mean over the horizon: position {position:.3} m, z {z:.3} m, roll {:.2}°, pitch {:.2}°, yaw {:.2}°{diverged}; {:.2} s per step",
        line.step,
        line.loss,
        roll.to_degrees(),
        pitch.to_degrees(),
        yaw.to_degrees(),
        line.step_s
    )
}

/// Measured channels of the trajectories with their maps, in the order of their ids.
///
/// # Errors
/// `TrainingError::Drives` when the map of one cannot be read.
pub fn load_drives(root: &DataRoot, trajectories: &[Trajectory]) -> Result<Vec<Drive>, TrainingError> {
    let mut sorted: Vec<&Trajectory> = trajectories.iter().collect();
    sorted.sort_by(|a, b| a.id.cmp(&b.id));
    sorted
        .into_iter()
        .map(|t| {
            let map = t.world.as_ref().map(|id| root.world(id)).transpose().map_err(|e| TrainingError::Drives(e.to_string()))?;
            let mut drive = Drive::new(t.id.clone(), map, t.states.clone(), t.controls.clone());
            drive.wheel_speed_rad_s.clone_from(&t.wheel_speed_rad_s);
            Ok(drive)
        })
        .collect()
}

/// Whether any of some drives has a map.
fn any_mapped(drives: &[Drive], at: &[usize]) -> bool {
    at.iter().any(|&i| drives[i].map.is_some())
}

/// Mirror images of some drives; drives over one map share its image.
fn mirrored(drives: &[Drive], at: &[usize]) -> Vec<Drive> {
    let mut maps: HashMap<String, Arc<WorldMap>> = HashMap::new();
    at.iter()
        .map(|&i| {
            let map = drives[i].map.as_ref().map(|map| maps.entry(map.hash().into()).or_insert_with(|| Arc::new(map.mirrored())).clone());
            drives[i].mirrored(map)
        })
        .collect()
}

/// Name of the file with encoders, by all that they are trained on: the plan, the places, and how much of them the pixels show.
fn encoders_file(plan: &PretrainPlan, pixels: &PatchScale, places: &Places) -> String {
    let places: Vec<String> = places.iter().map(|(map, x_m, y_m)| format!("{} {x_m} {y_m}", map.hash())).collect();
    let key = sha256_hex(format!("{plan:?} {pixels:?} {}", places.join(" ")).as_bytes());
    format!("encoders-{}.safetensors", &key[..12])
}

/// Pre-trained encoders, from the output folder if this run was made before. Only both whole are kept.
fn encoders(
    drives: &[Drive],
    train_at: &[usize],
    scales: &Normalization,
    recipe: &Recipe,
    reporter: &dyn Reporter,
    interrupted: &(dyn Fn() -> bool + Sync),
) -> Result<Weights, TrainingError> {
    let plan = PretrainPlan { steps: recipe.encoder_steps, batch: recipe.encoder_batch, rate: recipe.encoder_rate, seed: recipe.plan.seed };
    let places: Places = train_at
        .iter()
        .filter_map(|&i| drives[i].map.as_ref().map(|map| (map, &drives[i])))
        .flat_map(|(map, drive)| drive.states.iter().step_by(3).map(move |s| (map.clone(), s.position_m[0], s.position_m[1])))
        .collect();
    let path = recipe.out.join(encoders_file(&plan, &scales.patch_scale(), &places));
    if let Ok(bytes) = std::fs::read(&path) {
        reporter.line(&format!("encoders taken from {}", path.display()));
        return Ok(Weights::from_bytes(&bytes, &path)?);
    }
    reporter.stage("encoders", 2 * plan.steps);
    let done = AtomicUsize::new(0);
    let device = recipe.plan.device.open()?;
    let results: Vec<_> = std::thread::scope(|scope| {
        let (places, plan, done, device) = (&places, &plan, &done, &device);
        let running: Vec<_> = ENCODERS
            .iter()
            .map(|(name, _)| {
                scope.spawn(move || {
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread can be started; this is a bug");
                    pool.install(|| {
                        let told = |_, loss| {
                            reporter.progress(done.fetch_add(1, Ordering::Relaxed) + 1, &format!("{name} loss {loss:.5}"));
                        };
                        pretrain(name, places, &scales.patch_scale(), plan, device, told, interrupted)
                    })
                })
            })
            .collect();
        running.into_iter().map(|r| r.join().expect("pre-training does not panic; this is a bug")).collect()
    });
    let mut weights = Weights::default();
    for ((name, _), result) in ENCODERS.iter().zip(results) {
        let pretrained = result?.ok_or(TrainingError::Unprepared("the encoders were pre-trained"))?;
        let lost = pretrained.unexplained.map_or("not measured".into(), |share| format!("{:.1} %", 100.0 * share));
        reporter.line(&format!("{name} encoder: variance that is lost in the features: {lost}"));
        for (array_name, array) in pretrained.weights.iter() {
            weights.insert(array_name, &array.shape, array.values.clone());
        }
    }
    write(&path, &weights.to_bytes())?;
    Ok(weights)
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), TrainingError> {
    let fail = |reason: String| TrainingError::Model(ModelError::Bundle { path: path.to_path_buf(), reason });
    if let Some(parent) = path.parent() {
        std::fs::create_dir_all(parent).map_err(|e| fail(e.to_string()))?;
    }
    // A run that is killed meanwhile leaves no part under the name that the next run reads.
    let unfinished = path.with_extension("new");
    std::fs::write(&unfinished, bytes).and_then(|()| std::fs::rename(&unfinished, path)).map_err(|e| fail(e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nesam_terrain::GridGeometry;

    /// Goal: encoders are trained where there is something to train them on. Method: of two drives the one that validates has a map, the other has none.
    #[test]
    fn regress_maps_of_validation_drives_alone_train_no_encoder() {
        let geometry = GridGeometry { origin_m: [0.0; 2], resolution_m: 0.1, width: 2, height: 2 };
        let map = Arc::new(WorldMap::from_layers("plain", 1, geometry, vec![0.0; 4], None).unwrap());
        let drives = [None, Some(map)].map(|map| Drive::new("made".into(), map, Vec::new(), Vec::new()));
        assert!(!any_mapped(&drives, &[0]) && any_mapped(&drives, &[1]) && any_mapped(&drives, &[0, 1]));
    }

    /// Goal: nobody takes the error on drives that train for one on drives that do not, nor mirror images for drives.
    #[test]
    fn regress_who_trains_and_what_was_scored_is_told_as_it_is() {
        let few = who_trains(6, true, 0);
        assert!(few.starts_with("6 drives train, each with its mirror image; none validates"), "{few}");
        assert_eq!(who_trains(9, false, 1), "9 drives train; 1 validate");
        let line = EpochReport { step: 2, loss: 1.0, validation: [0.5, 0.1, 0.0, 0.0, 0.0], diverged: 0, step_s: 0.1 };
        let [held_out, own] = [true, false].map(|held_out| describe(&line, held_out));
        assert!(held_out.contains("; validation, mean over") && own.contains("; on the drives that train, mean over"), "{held_out} {own}");
        assert!(!own.contains("validation"), "{own}");
    }

    #[test]
    fn regress_few_drives_all_train_and_none_of_them_validates() {
        for count in [0, 1, 8, 9] {
            assert!((0..count).all(|index| !is_validation(index, count)), "{count}");
        }
        for (count, held_out) in [(10, vec![7]), (17, vec![7]), (18, vec![7, 17]), (300, (0..30).map(|tenth| 10 * tenth + 7).collect())] {
            assert_eq!((0..count).filter(|index| is_validation(*index, count)).collect::<Vec<_>>(), held_out, "{count}");
        }
    }

    #[test]
    fn property_encoders_are_taken_for_the_same_pixels_of_the_same_places_alone() {
        let map = |height_m: f32| {
            let geometry = GridGeometry { origin_m: [0.0; 2], resolution_m: 0.1, width: 2, height: 2 };
            Arc::new(WorldMap::from_layers("plain", 1, geometry, vec![height_m; 4], None).unwrap())
        };
        let plan = PretrainPlan { steps: 3, batch: 4, rate: 1e-3, seed: 1 };
        let hard = PatchScale::default();
        let smooth = PatchScale { smooth_semantics: true, ..hard };
        let [here, again, there, higher] =
            [(0.0, 0.2), (0.0, 0.2), (0.0, 0.3), (0.1, 0.2)].map(|(height_m, y)| vec![(map(height_m), 0.1, y)]);
        let name = encoders_file(&plan, &hard, &here);
        assert_eq!(encoders_file(&plan, &hard, &again), name);
        for (pixels, places) in [(&smooth, &here), (&hard, &there), (&hard, &higher)] {
            assert_ne!(encoders_file(&plan, pixels, places), name, "{pixels:?} {places:?}");
        }
        assert_ne!(encoders_file(&PretrainPlan { seed: 2, ..plan }, &hard, &here), name);
    }
}
