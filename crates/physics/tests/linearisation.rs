//! Goal: the derivatives of a step, which training, filter and predictions rely on, do not grow from step to step.
mod common;

use common::{Drive, loam, mud};
use nesam_physics::driveline::WheelCommand;
use nesam_physics::scalar::Dual;
use nesam_physics::step::{Ground, StepInput};
use nesam_physics::terramechanics::ContactLaw;
use nesam_physics::{Control, Real, Soil, Vehicle, VehicleState};
use nesam_test_vehicles::{robot, torque_truck, truck};

const N: usize = 9;

/// Soil softer than loam.
const SOFT: Soil<f64> = Soil { k_phi: 4e5, k_c: 3000.0, n: 0.9, c: 2000.0, phi: 0.3, k_shear: 0.025 };
/// Soil harder than it.
const FIRM: Soil<f64> = Soil { k_phi: 8e6, k_c: 60e3, n: 1.1, c: 10e3, phi: 33f64.to_radians(), k_shear: 0.01 };

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

/// Goal: errors of a state die out, also of a vehicle that slows down to walking pace and to a stop. Method: how velocities ahead, to the left and of the turn answer
/// after 32 steps to each of them before, by the product of the steps' Jacobians, on soft, sticky and firm ground and in mud, flat and up a slope of 10 %.
#[test]
fn property_steps_do_not_amplify_small_changes() {
    const PLANAR: [usize; 3] = [3, 4, 8];
    let clay = Soil { k_phi: 692.15e3, k_c: 13.19e3, n: 0.5, c: 4.14e3, phi: 13f64.to_radians(), k_shear: 0.006 };
    for (vehicle, soil) in [truck(), torque_truck(), robot()].iter().flat_map(|v| [loam(), clay, FIRM, mud()].map(|soil| (v, soil))) {
        for (slope, speed_m_s) in [0.0, 0.1].into_iter().flat_map(|slope| [0.0, 0.1, 0.3, 0.6, 0.9, 1.2, 1.5, 2.0, 3.0].map(|v| (slope, v)))
        {
            let mut drive = Drive::new(vehicle.clone(), speed_m_s + 0.5);
            drive.soil = soil;
            drive.slope = [slope, 0.0];
            let jacobians: Vec<_> = (0..92)
                .map(|k| {
                    let control = Control { speed_m_s, second: 0.3 * (0.1 * f64::from(k)).sin() };
                    let jacobian = jacobian(&drive, &control);
                    drive.step(control.speed_m_s, control.second);
                    jacobian
                })
                .collect();
            for start in [0, 20, 40, 60] {
                let identity = core::array::from_fn(|r| core::array::from_fn(|c| f64::from(u8::from(r == c))));
                let over_32: [[f64; N]; N] = jacobians[start..start + 32].iter().fold(identity, |product, jacobian| {
                    core::array::from_fn(|r| core::array::from_fn(|c| (0..N).map(|k| jacobian[r][k] * product[k][c]).sum()))
                });
                let largest = PLANAR.iter().flat_map(|r| PLANAR.map(|c| over_32[*r][c].abs())).fold(0.0, f64::max);
                assert!(largest < 1.01, "{} at {speed_m_s} m/s up {slope} from step {start}, {soil:?}: {largest}", vehicle.name);
            }
        }
    }
}

/// Goal: a vehicle that stops or is stuck does not go to and fro, and stands where the ground is level. Method: the smallest of three changes of velocity in a row that
/// turn around each time, in the last six of ten seconds of drives that start at 0.8 m/s, flat and up slopes, some across them, on ground from mud to firm; trucks with
/// wheels that drag, on damped soil and under the other law of contact among them.
#[test]
fn property_a_vehicle_that_stops_does_not_go_to_and_fro() {
    let mut dragging = torque_truck();
    dragging.effects.force.wheel_drag_n_m = [900.0; 4];
    let damped = Vehicle { soil_damping_pa_s_m: 2e4, ..torque_truck() };
    let other_law = Vehicle { contact_law: ContactLaw::WongReece, ..torque_truck() };
    for (at, vehicle) in [truck(), torque_truck(), dragging, damped, other_law, robot()].into_iter().enumerate() {
        for (soil, slope) in [mud(), SOFT, loam(), FIRM].into_iter().flat_map(|soil| [0.0, 0.1, 0.2, 0.3].map(|slope| (soil, slope))) {
            for (speed_m_s, across) in [0.0, 0.3, 1.0].into_iter().flat_map(|v| [0.0, 0.5].map(|across| (v, across))) {
                let mut drive = Drive::new(vehicle.clone(), 0.8);
                drive.soil = soil;
                drive.slope = [slope, across * slope];
                let velocities: Vec<_> = (0..100)
                    .map(|_| {
                        drive.step(speed_m_s, 0.4 * across);
                        drive.state.velocity_m_s
                    })
                    .collect();
                if speed_m_s == 0.0 && slope == 0.0 {
                    let last = velocities[velocities.len() - 1][0];
                    assert!(last.abs() < 0.02, "vehicle {at}, {soil:?}: {last} m/s on level ground");
                }
                for axis in 0..2 {
                    let change: Vec<f64> = velocities[40..].windows(2).map(|v| v[1][axis] - v[0][axis]).collect();
                    let turning = change.windows(3).filter(|c| c[0] * c[1] < 0.0 && c[1] * c[2] < 0.0);
                    let largest = turning.map(|c| c.iter().fold(f64::INFINITY, |least, c| least.min(c.abs()))).fold(0.0, f64::max);
                    assert!(
                        largest < 0.01,
                        "vehicle {at} at {speed_m_s} m/s up {slope}, {across} of it across, axis {axis}, {soil:?}: {largest} m/s"
                    );
                }
            }
        }
    }
}

/// Goal: what resists the rolling of a wheel does not push a vehicle that is stuck. Method: forward speed after ten seconds under a command ahead, on flat ground.
#[test]
fn property_wheels_that_spin_on_the_spot_push_nobody_back() {
    for (vehicle, soil) in [truck(), torque_truck(), robot()].iter().flat_map(|v| [mud(), SOFT, loam()].map(|soil| (v, soil))) {
        for speed_m_s in [0.3, 1.0, 2.0] {
            let mut drive = Drive::new(vehicle.clone(), 0.5);
            drive.soil = soil;
            (0..100).for_each(|_| _ = drive.step(speed_m_s, 0.0));
            let forward_m_s = drive.state.velocity_m_s[0];
            assert!(forward_m_s > -0.01, "{} at {speed_m_s} m/s, {soil:?}: {forward_m_s} m/s", vehicle.name);
        }
    }
}
