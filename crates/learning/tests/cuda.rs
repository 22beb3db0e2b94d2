//! Goal: a GPU trains and predicts what the processor does.
//! Method: the same weights, windows and queries on both, and twice on the GPU; single precision, so sums in another order may differ in the last digits.
//!
//! Needs an NVIDIA GPU: `cargo test --release --features nesam-learning/cuda -p nesam-learning --test cuda`.
#![cfg(feature = "cuda")]

mod common;

use std::collections::HashMap;
use std::sync::Arc;

use common::{drive, encoded, from_sample_33, hills, lively_weights, measured_scales, predictor, single_cells, truck};
use nesam_learning::batch::{Dropout, Window};
use nesam_learning::{Objective, TrainingSet};
use nesam_model::reference::{ComputeDevice, Network, ReferencePredictor};
use nesam_model::{RolloutQuery, Variant};
use nesam_physics::step::StepModel;

const GPU: ComputeDevice = ComputeDevice::Cuda(0);

#[test]
fn property_rollouts_on_a_gpu_equal_those_on_the_processor() {
    let (map, samples, horizon) = (hills(), 64, 32);
    let drive = drive(Some(&map), 80);
    let scales = measured_scales(&drive);
    let predictor = predictor(&scales, lively_weights(&scales));
    let past = drive.history(2, 33);
    // The recorded commands, a little more or less of each: a vehicle that comes to a stand starts again sooner or later for a digit more or less.
    let command = |n: usize, k: usize| (&drive.controls[33 + k], 0.2 * (n as f64 / samples as f64 - 0.5));
    let controls: Vec<f32> = (0..samples * horizon)
        .map(|i| command(i / horizon, i % horizon))
        .flat_map(|(control, off)| [(control.speed_m_s + off) as f32, (control.second + off) as f32])
        .collect();
    for variant in Variant::ALL {
        let query = RolloutQuery { variant, ..from_sample_33(&drive, &past, &controls, samples, &map) };
        let on = |device| ReferencePredictor::new(&predictor, device).and_then(|reference| reference.rollout(&query)).expect("it runs");
        let (gpu, cpu) = (on(GPU), on(ComputeDevice::Cpu));
        let apart = gpu.iter().zip(&cpu).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        println!("{variant:?}: {apart:.2e}");
        // As the fast path: 32 steps of f32 with two orders of summation.
        assert!(apart < 1.5e-3, "{variant:?}: {apart}");
        assert!(gpu == on(GPU), "{variant:?}: the same query gives other bytes");
    }
}

#[test]
fn property_gradients_on_a_gpu_equal_those_on_the_processor() {
    let map = hills();
    let made = drive(Some(&map), 120);
    let scales = measured_scales(&made);
    let weights = lively_weights(&scales);
    let made = encoded(made, &weights, &scales);
    let model = Arc::new(StepModel::new(&truck(), scales.dt_s, scales.substeps));
    let set = TrainingSet { train: vec![&made], validation: vec![], scales: &scales, model, pooling: single_cells() };
    let windows = [31, 40, 52, 60].map(|start| Window { drive: &made, start, dropout: Some(Dropout { share: 0.1, seed: start as u64 }) });
    for variant in Variant::ALL {
        let sustained = if variant.is_end_to_end() { 0.0 } else { 0.2 };
        let objective = Objective { variant, sustained, soil_prior: 0.0 };
        let on = |device: ComputeDevice| -> (f32, HashMap<String, Vec<f32>>) {
            let network = Network::from_weights(&weights, &device.open().expect("there is one")).expect("all arrays are there");
            set.gradients(&network, &windows, 31, 12, objective).expect("the loss is differentiable")
        };
        let ((gpu_loss, gpu), (cpu_loss, cpu)) = (on(GPU), on(ComputeDevice::Cpu));
        assert!((gpu_loss - cpu_loss).abs() < 1e-3 * cpu_loss.abs(), "{variant:?}: loss {gpu_loss}, {cpu_loss}");
        let norm = |values: &mut dyn Iterator<Item = f32>| values.map(|v| f64::from(v).powi(2)).sum::<f64>().sqrt();
        let all = norm(&mut cpu.values().flatten().copied());
        for (name, own) in &cpu {
            let apart = norm(&mut gpu[name].iter().zip(own).map(|(a, b)| a - b));
            println!("{variant:?} {name}: {apart:.2e} of {:.2e}", norm(&mut own.iter().copied()));
            assert!(apart < 2e-3 * norm(&mut own.iter().copied()) + 1e-5 * all, "{variant:?} {name}: {apart} apart");
        }
        assert!(on(GPU).1 == gpu, "{variant:?}: the same batch gives other bytes");
    }
}
