//! Goal: the derivatives of a step, which training and filter rely on, are those of the step, and a step does not amplify them.
mod common;

use common::Drive;
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

/// Goal: errors of a state die out. Method: eigenvalues of the step's Jacobian along drives at 1.5 m/s; at walking pace they do not (ADR 0003).
#[test]
fn property_a_step_does_not_amplify_small_changes() {
    for vehicle in [truck(), torque_truck(), robot()] {
        let mut drive = Drive::new(vehicle, 1.0);
        for k in 0..60 {
            let control = Control { speed_m_s: 1.5, second: 0.5 * (0.1 * k as f64).sin() };
            let j = jacobian(&drive, &control);
            // Power iteration on J^8.
            let mut v = [1.0; N];
            let mut growth = 1.0;
            for _ in 0..40 {
                let mut n = [0.0; N];
                for r in 0..N {
                    for c in 0..N {
                        n[r] += j[r][c] * v[c];
                    }
                }
                let norm = n.iter().map(|x| x * x).sum::<f64>().sqrt();
                growth = norm / v.iter().map(|x| x * x).sum::<f64>().sqrt();
                v = n.map(|x| x / norm);
            }
            assert!(growth < 1.0, "{} step {k}: {growth} along {v:.2?}", drive.model.vehicle().name);
            drive.step(control.speed_m_s, control.second);
        }
    }
}
