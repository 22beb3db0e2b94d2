//! A twin world: drives of the physics itself on hills, with soil that differs from drive to drive, sensor noise, and a known effect.
#![allow(dead_code, clippy::unwrap_used)]

use std::sync::{Arc, OnceLock};

use nesam_discovery::{
    Against, Bench, Diagnosis, Options, Reference, ReferenceDrives, Scoring, Segmented, catalogue, diagnose, observe_all,
};
use nesam_learning::{Drive, initial::initial_weights, scales};
use nesam_model::{GroundSource, ModelBundle, Predictor, Provenance, Variant, effects_from_toml};
use nesam_physics::driveline::{DrivelineState, command_wheels};
use nesam_physics::effects::{Effect, ScheduledEffect, Written};
use nesam_physics::step::{StepInput, StepModel};
use nesam_physics::{Control, Driveline, RimServo, SOIL_DIM, SecondCommand, Soil, SoilCorrection, Vehicle, VehicleState};
use nesam_terrain::{GridGeometry, WorldMap};
use nesam_trajectories::{MeasuredChannels, Trajectory};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Samples of a drive.
const SAMPLES: usize = 200;
/// Noise of the sensors: position, height, attitude, velocity, angular velocity, road-wheel angle.
const NOISE: [f64; 6] = [0.015, 0.02, 0.0017, 0.025, 0.002, 0.001];
/// Standard deviation of the logarithm (or value) of a drive's soil.
const SOIL_SCATTER: [f64; 6] = [0.15, 0.15, 0.02, 0.15, 0.02, 0.1];

/// The car with a firm speed controller.
pub fn truck() -> Vehicle {
    let car = nesam_test_vehicles::truck();
    let driveline = Driveline {
        speed_gain: 0.25,
        speed_integral_gain_per_s: 0.05,
        speed_integral_leak_s: 5.0,
        speed_integral_limit_m: 5.0,
        overspeed_limit_m_s: 1.5,
        ..car.driveline
    };
    Vehicle { driveline, ..car }
}

/// Hills of a decimetre to half a metre over 140 m.
pub fn world() -> Arc<WorldMap> {
    static WORLD: OnceLock<Arc<WorldMap>> = OnceLock::new();
    WORLD.get_or_init(|| world_lower_by(0.0)).clone()
}

/// The same on a map that is too low, m.
pub fn world_lower_by(lower_m: f64) -> Arc<WorldMap> {
    let (size, resolution) = (281, 0.5);
    let geometry = GridGeometry { origin_m: [-70.0, -70.0], resolution_m: resolution, width: size, height: size };
    let height = |i: usize| {
        let (x, y) = ((i % size) as f64 * resolution, (i / size) as f64 * resolution);
        (0.5 * (x / 6.0).sin() * (y / 7.0).cos() + 0.15 * (x / 2.5 + y / 3.1).sin() - lower_m) as f32
    };
    Arc::new(WorldMap::from_layers("twin", 1, geometry, (0..size * size).map(height).collect(), None).unwrap())
}

/// A drive of the vehicle with effects; every number follows from the seed.
pub fn drive(id: &str, seed: u64, effects: &[Effect], soil: &[f64; 6]) -> Trajectory {
    drive_from(id, seed, effects, 0.0, soil)
}

/// The same with effects that begin `onset_s` after the start.
pub fn drive_from(id: &str, seed: u64, effects: &[Effect], onset_s: f64, soil: &[f64; 6]) -> Trajectory {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
    let (plain, changed) = (truck(), truck().with_effects(effects));
    let models = [StepModel::new(&plain, 0.1, 2), StepModel::new(&changed, 0.1, 2)];
    let world = world();
    let mut correction = SoilCorrection::NONE;
    correction.delta = core::array::from_fn(|i| SOIL_SCATTER[i] * normal());
    let soil = Soil::from_array(correction.apply(soil));
    let angle = normal() * 3.0;
    let (sin, cos) = angle.sin_cos();
    let mut state = VehicleState {
        position_m: [-20.0 * cos, -20.0 * sin, 0.0],
        attitude_rad: [0.0, 0.0, angle],
        velocity_m_s: [2.0, 0.0, 0.0],
        angular_velocity_rad_s: [0.0; 3],
    };
    state.position_m[2] = world.height_m(state.position_m[0], state.position_m[1]).unwrap() + 0.6;
    let (turn, gain, swell) = (0.25 + 0.1 * normal().abs(), 0.5 + 0.2 * normal().abs(), 0.5 + 0.2 * normal().abs());
    let command = |k: usize| {
        let t = 0.1 * k as f64;
        Control { speed_m_s: 2.4 + 0.7 * (swell * t).sin(), second: (gain * (turn * t + angle).sin()).clamp(-0.9, 0.9) }
    };
    let mut actuators = DrivelineState::settled(&command(0));
    let (mut states, mut controls, mut steering) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..SAMPLES + 10 {
        let model = &models[usize::from(k as f64 * 0.1 - 1.0 >= onset_s - 1e-9 || onset_s == 0.0)];
        let vehicle = model.vehicle();
        let control = command(k);
        if k >= 10 {
            let x = state.to_array();
            let sd = |i: usize| NOISE[[0, 0, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4][i]];
            states.push(VehicleState::from_array(core::array::from_fn(|i| x[i] + sd(i) * normal())));
            controls.push(control);
            let angles = actuators.road_wheel_angles(vehicle);
            steering.push([angles[0] + NOISE[5] * normal(), angles[1] + NOISE[5] * normal()]);
        }
        let after = actuators.advance(vehicle, &control, state.velocity_m_s[0], 0.1);
        let ground = GroundSource::new(Some(&world), model, &state).under_wheels(model, &state, 0.0).0;
        let wheels = command_wheels(vehicle, &actuators, &after, &control);
        let step = model.step(&StepInput { state, wheels, sinkage_log_ratio: [0.0; 4], soil, ground }).increment.to_array();
        let x = state.to_array();
        let (sin, cos) = x[5].sin_cos();
        let mut next: [f64; 12] = core::array::from_fn(|i| x[i] + step[i]);
        next[0] = x[0] + cos * step[0] - sin * step[1];
        next[1] = x[1] + sin * step[0] + cos * step[1];
        (state, actuators) = (VehicleState::from_array(next), after);
    }
    Trajectory {
        id: id.into(),
        set: "twin".into(),
        world: Some("twin".into()),
        split: None,
        dt_s: 0.1,
        time_s: (0..SAMPLES).map(|k| 0.1 * k as f64).collect(),
        states,
        controls,
        wheel_speed_rad_s: None,
        road_wheel_angle_rad: Some(steering),
        measured: MeasuredChannels { road_wheel_angle: true, ..MeasuredChannels::POSE_AND_TWIST },
        truth: None,
    }
}

/// A plough in front that leans to the left: it pushes more the faster the vehicle goes, and turns it.
pub fn plough() -> Written {
    let text = r#"
[[written]]
id = "snow_plough"
force_x = "-(push + per_speed * abs(v_ahead)) * tanh(v_ahead / fade)"
moment_z = "arm * (push + per_speed * abs(v_ahead)) * tanh(v_ahead / fade)"
parameters.push = { value = 300.0, unit = "N", range = [0.0, 2000.0] }
parameters.per_speed = { value = 80.0, unit = "N s/m", range = [0.0, 500.0] }
parameters.fade = { value = 0.2, unit = "m/s", range = [0.05, 1.0] }
parameters.arm = { value = 2.0, unit = "m", range = [-3.0, 3.0] }
"#;
    effects_from_toml(text).unwrap()[0].effect.written().unwrap()
}

/// A bundle of the physics alone, whose default soil is that of the twin, with the reference of 24 null drives; it knows the plough as a hypothesis.
pub fn bundle() -> ModelBundle {
    static BUNDLE: OnceLock<ModelBundle> = OnceLock::new();
    BUNDLE
        .get_or_init(|| {
            let soil = [1.3e6, 8.0e3, 0.8, 3.0e3, 0.42, 0.015];
            let sample = drive("scales", 1, &[], &soil);
            let scales = scales::measure(&[&Drive::new(sample.id, Some(world()), sample.states, sample.controls)], &truck(), 0.1);
            // A twin differs from the model by its effect, soil and noise alone: the network says nothing.
            let mut weights = initial_weights(7, &scales);
            for head in ["sinkage.weight", "residual.weight"] {
                weights.values_mut(head).unwrap().fill(0.0);
            }
            let mut bundle = ModelBundle {
                name: "twin".into(),
                hash: "0".repeat(64),
                vehicle: truck(),
                effects: Vec::new(),
                parameters: 0,
                form: Variant::Full,
                weights,
                normalization: scales,
                baselines_json: None,
                reference_json: None,
                reference_drives: None,
                soil_filter_json: None,
                rollout_noise_json: None,
                provenance: Provenance::default(),
            };
            let (drives, maps) = null_drives(&bundle);
            let predictor = Predictor::new(Arc::new(bundle.clone())).unwrap();
            let observed = observe_all(&predictor, &drives, &maps, &|_| {}).unwrap();
            let catalogue = catalogue(&[plough()]);
            let bench = Bench::new(&bundle, &catalogue);
            let reference = Reference::measure(&bench, &observed, "twin", &|_| {}).unwrap();
            bundle.reference_json = Some(reference.to_json().into());
            bundle
        })
        .clone()
}

/// Drives without an effect, with their maps.
fn null_drives(bundle: &ModelBundle) -> (Vec<Trajectory>, Vec<Option<Arc<WorldMap>>>) {
    let drives: Vec<Trajectory> = (0..24).map(|i| drive(&format!("null{i:02}"), 100 + i, &[], &bundle.default_soil())).collect();
    let maps = vec![Some(world()); drives.len()];
    (drives, maps)
}

/// The same bundle with what it takes to judge drives that lack something.
pub fn bundle_with_drives() -> ModelBundle {
    static BUNDLE: OnceLock<ModelBundle> = OnceLock::new();
    BUNDLE
        .get_or_init(|| {
            let mut bundle = bundle();
            let (drives, maps) = null_drives(&bundle);
            let predictor = Predictor::new(Arc::new(bundle.clone())).unwrap();
            let reference = Reference::from_json(bundle.reference_json.as_ref().unwrap()).unwrap();
            let catalogue = reference.catalogue().unwrap();
            let bench = Bench::new(&bundle, &catalogue);
            let segmented = Segmented::of(&bench, &observe_all(&predictor, &drives, &maps, &|_| {}).unwrap(), &|_| {});
            let behind = ReferenceDrives::measure(&predictor, &bench, (&drives, &maps), (&reference, &segmented), &|_, _| {}).unwrap();
            bundle.reference_drives = Some(behind.to_bytes().into());
            bundle
        })
        .clone()
}

/// Options of a quick diagnosis.
pub fn options() -> Options {
    Options::of(Scoring { horizon: 16, history: 16, resamples: 1000, seed: 1 })
}

/// Diagnoses eight twin drives with effects.
pub fn diagnose_twin(effects: &[Effect], seed: u64, options: &Options) -> Diagnosis {
    diagnose_from(effects, 0.0, seed, options)
}

/// The same with effects that begin `onset_s` after the start.
pub fn diagnose_from(effects: &[Effect], onset_s: f64, seed: u64, options: &Options) -> Diagnosis {
    let soil = bundle().default_soil();
    let drives: Vec<Trajectory> = (0..8).map(|i| drive_from(&format!("d{i}"), seed + i, effects, onset_s, &soil)).collect();
    diagnose_drives(&drives, options)
}

/// Diagnoses drives of the twin.
pub fn diagnose_drives(drives: &[Trajectory], options: &Options) -> Diagnosis {
    let predictor = Predictor::new(Arc::new(bundle())).unwrap();
    diagnose(&predictor, drives, &vec![Some(world()); drives.len()], options, &|_, _, _| {}).unwrap()
}

/// A skid-steer base of the same size, its rims servoed.
pub fn rover() -> Vehicle {
    let car = truck();
    let rims = RimServo { speed_lag_s: 0.1, yaw_lag_s: 0.1, ..RimServo::default() };
    Vehicle {
        name: "rover".into(),
        second: SecondCommand::YawRateRadS,
        steering: None,
        command_range: [[-3.0, 3.0], [-1.5, 1.5]],
        driveline: Driveline { rims, ..car.driveline },
        ..car
    }
}

/// Logs of a rover with effects, as short ones of real robots are: two seconds after a step of the commands, on ground without a map, poses, wheel speeds and
/// the yaw rate measured, velocities not (what stands for them is noise about the truth).
pub fn rover_logs(count: u64, seed: u64, effects: &[Effect], soil: &[f64; SOIL_DIM]) -> Vec<Trajectory> {
    (0..count).map(|i| rover_log(&format!("r{i:02}"), seed + i, effects, soil)).collect()
}

fn rover_log(id: &str, seed: u64, effects: &[Effect], soil: &[f64; SOIL_DIM]) -> Trajectory {
    const STEPS: usize = 21;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
    let vehicle = rover().with_effects(effects);
    let model = StepModel::new(&vehicle, 0.1, 2);
    let soil = Soil::from_array(*soil);
    let mut command = || Control { speed_m_s: (1.2 * normal()).clamp(-2.0, 2.0), second: (0.5 * normal()).clamp(-1.0, 1.0) };
    let told = [command(), command()];
    let mut state = VehicleState::from_array([0.0, 0.0, 0.6, 0.0, 0.0, 0.0, told[0].speed_m_s, 0.0, 0.0, 0.0, 0.0, 0.0]);
    let mut actuators = DrivelineState::settled(&told[0]);
    let (mut states, mut controls, mut wheels) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..20 + STEPS {
        let control = told[usize::from(k >= 20)];
        if k >= 20 {
            let seen = vehicle.effects.sensor.to_measured(&state).to_array();
            let sd = |i: usize| [0.004, 0.004, 0.004, 0.002, 0.002, 0.004, 0.05, 0.05, 0.05, 0.02, 0.02, 0.005][i];
            states.push(VehicleState::from_array(core::array::from_fn(|i| seen[i] + sd(i) * normal())));
            controls.push(control);
            let now = command_wheels::<f64>(&vehicle, &actuators, &actuators, &control);
            wheels.push(core::array::from_fn(|i| now.servo_m_s(i) / vehicle.wheel_radius_m + 0.02 * normal()));
        }
        let after = actuators.advance(&vehicle, &control, state.velocity_m_s[0], 0.1);
        let ground = GroundSource::new(None, &model, &state).under_wheels(&model, &state, 0.0).0;
        let told = command_wheels(&vehicle, &actuators, &after, &control);
        let step = model.step(&StepInput { state, wheels: told, sinkage_log_ratio: [0.0; 4], soil, ground });
        (state, actuators) = (VehicleState::from_array(state.advanced(&step.increment.to_array())), after);
    }
    let measured = MeasuredChannels {
        linear_velocity: false,
        angular_velocity: [false, false, true],
        wheel_speed: true,
        ..MeasuredChannels::POSE_AND_TWIST
    };
    Trajectory {
        id: id.into(),
        set: "rover".into(),
        world: None,
        split: None,
        dt_s: 0.1,
        time_s: (0..STEPS).map(|k| 0.1 * k as f64).collect(),
        states,
        controls,
        wheel_speed_rad_s: Some(wheels),
        road_wheel_angle_rad: None,
        measured,
        truth: None,
    }
}

/// The model of a rover on trial by logs of one with effects.
pub fn diagnose_rover(effects: &[Effect]) -> Diagnosis {
    diagnose_rover_on(&bundle().default_soil(), effects)
}

/// The same of one that drove on another soil than the model assumes.
pub fn diagnose_rover_on(soil: &[f64; SOIL_DIM], effects: &[Effect]) -> Diagnosis {
    diagnose_rover_beside(&[], &rover_logs(60, 300, effects, soil))
}

/// Logs of a rover against a model that has some effects.
pub fn diagnose_rover_beside(known: &[ScheduledEffect], logs: &[Trajectory]) -> Diagnosis {
    let bundle = ModelBundle { vehicle: rover(), reference_json: None, ..bundle() }.with_effects(known);
    let options = Options { against: Against::Physics, scoring: Scoring { horizon: 19, history: 1, ..options().scoring }, ..options() };
    let predictor = Predictor::new(Arc::new(bundle)).unwrap();
    diagnose(&predictor, logs, &vec![None; logs.len()], &options, &|_, _, _| {}).unwrap()
}
