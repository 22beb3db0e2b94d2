//! Goal: training follows the true gradient of the loss, through heads, soil prior, terramechanics and Newton-Euler.
//! Method: central differences of the loss in single weights against candle's backward pass, end to end over a rollout.

mod common;

use std::sync::Arc;

use candle_core::{Device, Tensor};
use common::{drive, encoded, measured_scales, single_cells, striped, truck};
use nesam_learning::batch::Window;
use nesam_learning::initial::initial_weights;
use nesam_learning::{Drive, Objective, TrainingSet};
use nesam_model::Variant;
use nesam_model::reference::Network;
use nesam_physics::step::StepModel;
use nesam_terrain::SoilClassRange;

/// Compares single entries of the gradient with central differences of half-width `h`.
fn check(mut made: Drive, entries: &[(&str, usize)], soil_prior: f64, tolerance: f64) {
    // Errors to learn from: the same drive, measured on a slower vehicle.
    for (k, state) in made.states.iter_mut().enumerate() {
        state.velocity_m_s[0] *= 0.9;
        state.position_m[2] += 0.01 * (k as f64).sin();
    }
    let scales = measured_scales(&made);
    let weights = initial_weights(7, &scales);
    let made = encoded(made, &weights, &scales);
    // No gradient flows through the integral of the drive line: leave it out here.
    let mut vehicle = truck();
    vehicle.driveline.speed_integral_gain_per_s = 0.0;
    let model = Arc::new(StepModel::new(&vehicle, scales.dt_s, scales.substeps));
    let set = TrainingSet { train: vec![&made], validation: vec![], scales: &scales, model, pooling: single_cells() };
    let network = Network::from_weights(&weights, &Device::Cpu).expect("all arrays are there");
    let windows = [12, 30].map(|start| Window { drive: &made, start, dropout: None });
    let objective = Objective { variant: Variant::Full, sustained: 0.0, soil_prior };
    let gradients = || set.gradients(&network, &windows, 8, 6, objective).expect("the loss is differentiable");
    let (_, backward) = gradients();
    for &(name, index) in entries {
        let (_, var) = network.variables.iter().find(|(n, _)| n == name).expect("a variable");
        let values: Vec<f32> = var.flatten_all().and_then(|v| v.to_vec1()).expect("readable");
        let at = |shift: f32| {
            let mut moved = values.clone();
            moved[index] += shift;
            var.set(&Tensor::from_vec(moved, var.dims(), var.device()).expect("a tensor")).expect("set");
            f64::from(gradients().0)
        };
        let h = 2e-2;
        let numeric = (at(h) - at(-h)) / (2.0 * f64::from(h));
        at(0.0);
        let analytic = f64::from(backward[name][index]);
        let allowed = tolerance * analytic.abs().max(numeric.abs()) + 3e-4;
        assert!((numeric - analytic).abs() < allowed, "{name}[{index}]: backward {analytic}, differences {numeric}");
    }
}

#[test]
fn analytic_gradient_of_the_heads_equals_central_differences() {
    // Level ground: nothing that is detached by design (look-ups of terrain at the predicted pose) takes part.
    let entries = [
        ("residual.bias", 0),
        ("residual.bias", 3),
        ("residual.bias", 5),
        ("residual.bias", 8),
        ("residual.weight", 700),
        ("sinkage.bias", 0),
        ("sinkage.bias", 3),
        ("block1.down.bias", 11),
        ("token.bias", 40),
    ];
    check(drive(None, 60), &entries, 0.0, 0.02);
}

#[test]
fn analytic_gradient_of_the_soil_prior_equals_central_differences() {
    // Level but coloured: the only detached look-up is that of the token, which the soil moves little within six steps.
    let entries = ["soil.out.bias"; 4].into_iter().zip([0, 2, 4, 5]).collect::<Vec<_>>();
    check(drive(Some(&striped(0.0)), 60), &entries, 0.0, 0.05);
}

#[test]
fn analytic_gradient_towards_the_soil_of_the_map_equals_central_differences() {
    // A weight that makes the term larger than the error of the states.
    let class = |name: &str, colour, k_phi: f64, phi: f64| SoilClassRange {
        name: name.into(),
        colour: Some(colour),
        low: [0.5 * k_phi, 5e3, 0.8, 1e3, phi - 0.05, 0.01],
        high: [2.0 * k_phi, 5e4, 1.0, 4e3, phi + 0.05, 0.03],
    };
    let map = Arc::into_inner(striped(0.0))
        .expect("nobody else has it")
        .with_soil_classes(vec![class("grass", [90, 122, 52], 3e6, 0.55), class("sand", [214, 190, 140], 1e6, 0.5)]);
    let entries = ["soil.out.bias"; 6].into_iter().zip(0..6).collect::<Vec<_>>();
    check(drive(Some(&Arc::new(map)), 60), &entries, 0.5, 0.02);
}
