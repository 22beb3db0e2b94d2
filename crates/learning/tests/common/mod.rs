//! A hilly map, a vehicle, untrained weights and a drive made by the symbolic model, shared by the tests of this crate.
#![allow(dead_code)]

use std::sync::Arc;

use nesam_learning::initial::initial_weights;
use nesam_learning::{Drive, Pooling, encode_drives, scales};
use nesam_model::encoder::TerrainEncoders;
use nesam_model::{GroundSource, HistoryStep, ModelBundle, Normalization, Predictor, Provenance, RolloutQuery, Variant, Weights};
use nesam_physics::driveline::{DrivelineState, command_wheels};
use nesam_physics::step::{StepInput, StepModel};
use nesam_physics::{Control, Driveline, Soil, SoilCorrection, Vehicle, VehicleState};
use nesam_terrain::{GridGeometry, WorldMap};

/// The car with a speed controller that integrates, and with sides that are alike to the digit.
pub fn truck() -> Vehicle {
    let mut car = nesam_test_vehicles::truck();
    car.wheel_centre_m[1][2] = car.wheel_centre_m[0][2];
    Vehicle { driveline: Driveline { speed_integral_gain_per_s: 0.05, ..car.driveline }, ..car }
}

/// 60 m × 60 m of hills with coloured stripes.
pub fn hills() -> Arc<WorldMap> {
    striped(1.0)
}

/// Coloured stripes on hills of a relative height.
pub fn striped(relief: f64) -> Arc<WorldMap> {
    let side = 601;
    let geometry = GridGeometry { origin_m: [-30.0, -30.0], resolution_m: 0.1, width: side, height: side };
    let at = |i: usize| (-30.0 + 0.1 * (i % side) as f64, -30.0 + 0.1 * (i / side) as f64);
    let height = |i: usize| (relief * (0.8 * (0.2 * at(i).0).sin() * (0.17 * at(i).1 + 0.4).cos() + 0.05 * (1.3 * at(i).0).sin())) as f32;
    let colour = |i: usize| {
        let (x, y) = at(i);
        if (0.3 * x + 0.2 * y).sin() > 0.0 { [90, 122, 52] } else { [214, 190, (140.0 + 20.0 * x.sin()) as u8] }
    };
    let cells = side * side;
    let map = WorldMap::from_layers("hills", 1, geometry, (0..cells).map(height).collect(), Some((0..cells).map(colour).collect()));
    Arc::new(map.expect("a valid map"))
}

/// A drive of `n` samples by the symbolic model on the hills.
pub fn drive(map: Option<&Arc<WorldMap>>, n: usize) -> Drive {
    drive_on_side(map, n, 1.0)
}

/// The same with start and steering on the other side for `side` = -1.
pub fn drive_on_side(map: Option<&Arc<WorldMap>>, n: usize, side: f64) -> Drive {
    let model = StepModel::new(&truck(), 0.1, 4);
    let soil = Soil { k_phi: 1.5e6, k_c: 5e3, n: 0.7, c: 1.7e3, phi: 0.5, k_shear: 0.02 };
    let mut state = VehicleState::zero();
    state.position_m = [-12.0, -6.0 * side, 0.6 + map.map_or(0.0, |m| m.nearest_height_m(-12.0, -6.0 * side))];
    state.velocity_m_s[0] = 2.0;
    let flat = VehicleState { position_m: [0.0, 0.0, 0.6], ..VehicleState::zero() };
    let mut actuators = DrivelineState::default();
    let (mut states, mut controls) = (Vec::new(), Vec::new());
    for k in 0..n {
        let t = 0.1 * k as f64;
        let control = Control { speed_m_s: 2.5 + (0.6 * t).sin(), second: side * 0.6 * (0.5 * t).sin() };
        states.push(state);
        controls.push(control);
        let ground = GroundSource::new(map.map(Arc::as_ref), &model, &flat);
        let after = actuators.advance(model.vehicle(), &control, state.velocity_m_s[0], 0.1);
        let input = StepInput {
            state,
            wheels: command_wheels(model.vehicle(), &actuators, &after, &control),
            sinkage_log_ratio: [0.0; 4],
            soil,
            ground: ground.under_wheels(&model, &state, 0.0).0,
        };
        let d = model.step(&input).increment.to_array();
        let (sin, cos) = state.attitude_rad[2].sin_cos();
        let x = state.to_array();
        let mut next: [f64; 12] = core::array::from_fn(|i| x[i] + d[i]);
        next[0] = x[0] + cos * d[0] - sin * d[1];
        next[1] = x[1] + sin * d[0] + cos * d[1];
        state = VehicleState::from_array(next);
        actuators = after;
    }
    Drive::new("made".into(), map.cloned(), states, controls)
}

/// Untrained weights with heads large enough to matter.
pub fn lively_weights(scales: &Normalization) -> Weights {
    let mut weights = initial_weights(7, scales);
    for name in ["sinkage.weight", "residual.weight", "soil.out.weight"] {
        let array = weights.iter().find(|(n, _)| *n == name).map(|(_, a)| a.clone()).expect("listed");
        weights.insert(name, &array.shape, array.values.iter().map(|v| v * 4.0).collect());
    }
    weights
}

/// Scales of a drive.
pub fn measured_scales(drive: &Drive) -> Normalization {
    scales::measure(&[drive], &truck(), 0.1)
}

/// A predictor of untrained weights.
pub fn predictor(scales: &Normalization, weights: Weights) -> Predictor {
    predictor_of(truck(), scales, weights)
}

/// The same for another vehicle.
pub fn predictor_of(vehicle: Vehicle, scales: &Normalization, weights: Weights) -> Predictor {
    let bundle = ModelBundle {
        name: "untrained".into(),
        hash: String::new(),
        form: Variant::Full,
        vehicle,
        parameters: 0,
        normalization: scales.clone(),
        weights,
        baselines_json: None,
        reference_json: None,
        reference_drives: None,
        soil_filter_json: None,
        rollout_noise_json: None,
        effects: Vec::new(),
        provenance: Provenance::default(),
    };
    Predictor::new(Arc::new(bundle)).expect("all arrays are there")
}

/// No sharing of the terrain projection.
pub fn single_cells() -> Pooling {
    Pooling::new(1).expect("single cells tile everything")
}

/// The drive with its contexts.
pub fn encoded(mut drive: Drive, weights: &Weights, scales: &Normalization) -> Drive {
    let encoders = TerrainEncoders::new(weights).expect("all arrays are there");
    encode_drives(core::slice::from_mut(&mut drive), &encoders, &scales.patch_scale(), &single_cells(), |_| {}, &|| false);
    drive
}

/// A query of all candidates from the 33rd sample of a drive on.
pub fn from_sample_33<'a>(
    drive: &Drive,
    past: &'a [HistoryStep],
    controls: &'a [f32],
    samples: usize,
    map: &'a Arc<WorldMap>,
) -> RolloutQuery<'a> {
    RolloutQuery {
        history: past,
        start: drive.states[33],
        controls,
        samples,
        horizon: controls.len() / (2 * samples),
        map: Some(map),
        soil_correction: SoilCorrection::NONE,
        variant: Variant::Full,
        start_time_s: None,
        wheels: None,
    }
}
