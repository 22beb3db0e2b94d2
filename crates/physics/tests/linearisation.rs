//! Goal: the derivatives of a step, which training and filter rely on, are those of the step, and a step does not amplify them.
mod common;

use common::{Drive, loam};
use nalgebra::SMatrix;
use nesam_physics::driveline::WheelCommand;
use nesam_physics::scalar::Dual;
use nesam_physics::step::{Ground, StepInput};
use nesam_physics::{Control, Real, Soil, VehicleState};
use nesam_test_vehicles::{robot, torque_truck, truck};

const N: usize = 9;

/// z, roll, pitch, velocities after a step as duals of the same before it.
fn jacobian(drive: &Drive, control: &Control<f64>) -> [[f64; N]; N] {
    let (input, _) = drive.input(control);
    type D = Dual<f64, N>;
    let c = |x: f64| D::lit(x);
    let x = input.state.to_array();
    let index = [2, 3, 4, 6, 7, 8, 9, 10, 11];
    let mut state = [D::lit(0.0); 12];
    for i in 0..12 {
        state[i] = c(x[i]);
    }
    for (k, &i) in index.iter().enumerate() {
        state[i] = D::variable(x[i], k);
    }
    let w = input.wheels;
    let dual = StepInput {
        state: VehicleState::from_array(state),
        wheels: WheelCommand {
            angle_rad: w.angle_rad.map(c),
            rim_base_m_s: w.rim_base_m_s.map(c),
            rim_follow: c(w.rim_follow),
            rim_gain: c(w.rim_gain),
            overspeed_limit_m_s: c(w.overspeed_limit_m_s),
            speed_m_s: c(w.speed_m_s),
        },
        sinkage_log_ratio: [c(0.0); 4],
        soil: Soil::from_array(input.soil.to_array().map(c)),
        ground: input.ground.map(|g| Ground { height_m: c(g.height_m), slope_ahead: c(g.slope_ahead), slope_left: c(g.slope_left) }),
    };
    let inc = drive.model.step(&dual).increment.to_array();
    core::array::from_fn(|r| core::array::from_fn(|k| inc[index[r]].eps[k] + if r == k { 1.0 } else { 0.0 }))
}

/// Largest eigenvalue by size, by power iteration.
fn spectral_radius(j: &[[f64; N]; N]) -> f64 {
    let matrix = SMatrix::<f64, N, N>::from_fn(|r, c| j[r][c]);
    matrix.complex_eigenvalues().iter().map(|value| value.norm()).fold(0.0, f64::max)
}

/// Goal: errors of a state die out, at walking pace too, so that covariances and Jacobians of a rollout mean something. Method: eigenvalues of the step's Jacobian along drives
/// that slow down and steer, on four soils, for vehicles of three kinds; where the force aside of a wheel is near zero its slope is steepest. A single step may grow a little.
#[test]
fn property_a_step_does_not_amplify_small_changes() {
    let dense = Soil { phi: 0.58, c: 2.0e3, k_shear: 0.01, ..loam() };
    let firm = Soil { k_phi: 4.0e6, n: 0.5, k_shear: 0.008, ..loam() };
    let loose = Soil { k_shear: 0.04, phi: 0.35, ..loam() };
    for vehicle in [truck(), torque_truck(), robot()] {
        for soil in [loam(), dense, firm, loose] {
            for turn in [0.0, 0.3] {
                let mut drive = Drive::new(vehicle.clone(), 1.5);
                drive.soil = soil;
                let radii: Vec<f64> = (0..80)
                    .map(|k| {
                        let speed_m_s = 1.5 - 1.3 * f64::from(k) / 80.0;
                        let control = Control { speed_m_s, second: turn * (0.2 * f64::from(k)).sin() };
                        let radius = spectral_radius(&jacobian(&drive, &control));
                        drive.step(control.speed_m_s, control.second);
                        radius
                    })
                    .collect();
                let (growing, worst) = (radii.iter().filter(|r| **r > 1.0 + 1e-6).count(), radii.iter().copied().fold(0.0, f64::max));
                assert!(growing < 5 && worst < 1.5, "{} with K = {} m, turn {turn}: {growing} steps, {worst}", vehicle.name, soil.k_shear);
            }
        }
    }
}
