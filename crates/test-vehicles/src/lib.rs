//! Vehicles that the tests of several crates drive; figures from the given vehicle cards.
#![forbid(unsafe_code)]

use nesam_physics::terramechanics::ContactLaw;
use nesam_physics::{Driveline, SecondCommand, SteeringTable, TorqueDrive, Vehicle};

/// The 2.5-tonne car of the Chrono drives.
pub fn truck() -> Vehicle {
    Vehicle {
        name: "truck".into(),
        mass_kg: 2493.56,
        inertia_kg_m2: [[1445.1, 0.0, -23.6], [0.0, 4121.7, 0.0], [-23.6, 0.0, 5026.4]],
        inertia_estimated: false,
        wheel_centre_m: [[1.5949, 0.9176, -0.1154], [1.5949, -0.9176, -0.1155], [-1.7028, 0.91, -0.1818], [-1.7028, -0.91, -0.1818]],
        wheel_radius_m: 0.467,
        wheel_width_m: 0.254,
        suspension_n_m: [107e3, 107e3, 236e3, 236e3],
        suspension_n_s_m: [14.4e3, 14.4e3, 22.4e3, 22.4e3],
        second: SecondCommand::SteeringNormalised,
        command_range: [[-2.0, 12.0], [-1.0, 1.0]],
        steering: Some(SteeringTable { command: vec![-1.0, 1.0], front_left_rad: vec![-0.37, 0.37], front_right_rad: vec![-0.37, 0.37] }),
        track_m: 1.83,
        wheelbase_m: 3.2977,
        driveline: Driveline {
            steering_lag_s: 0.08,
            steering_rate_limit_per_s: 3.0,
            speed_gain: 0.15,
            speed_integral_gain_per_s: 0.0,
            speed_integral_leak_s: 2.0,
            speed_integral_limit_m: 2.0,
            overspeed_limit_m_s: 0.8,
            rims: Default::default(),
            side_coupling_n_m_s: 0.0,
            torque: None,
        },
        gravity_m_s2: 9.81,
        contact_law: Default::default(),
        soil_damping_pa_s_m: 0.0,
        effects: Default::default(),
    }
}

/// The same car, its hubs under torque, with the figures that its training drives chose, rounded.
pub fn torque_truck() -> Vehicle {
    let torque = TorqueDrive {
        per_demand_n_m_s_m: 4570.0,
        holding_demand_m_s: 0.5,
        integral_observer_per_s: 0.0,
        closed_n_m: 85.0,
        brake_ratio: 0.64,
        curve_speed_m_s: [1.1, 1.9, 2.5, 3.2, 3.8],
        curve: [1.0, 1.3, 1.0, 0.95, 1.0],
    };
    let driveline = Driveline {
        speed_gain: 1.9,
        speed_integral_gain_per_s: 0.6,
        speed_integral_leak_s: 2.6,
        overspeed_limit_m_s: 3.0,
        side_coupling_n_m_s: 220.0,
        torque: Some(torque),
        ..truck().driveline
    };
    Vehicle { name: "torque truck".into(), driveline, contact_law: ContactLaw::SoilContactModel, ..truck() }
}

/// A 50-kg skid-steer robot.
pub fn robot() -> Vehicle {
    let (x, y) = (0.256, 0.2775);
    Vehicle {
        name: "robot".into(),
        mass_kg: 50.0,
        inertia_kg_m2: [[1.9, 0.0, 0.0], [0.0, 2.5, 0.0], [0.0, 0.0, 3.6]],
        wheel_centre_m: [[x, y, -0.05], [x, -y, -0.05], [-x, y, -0.05], [-x, -y, -0.05]],
        wheel_radius_m: 0.165,
        wheel_width_m: 0.125,
        suspension_n_m: [12e3; 4],
        suspension_n_s_m: [550.0; 4],
        second: SecondCommand::YawRateRadS,
        command_range: [[-2.0, 2.0], [-4.0, 4.0]],
        steering: None,
        track_m: 0.55,
        wheelbase_m: 0.512,
        driveline: Driveline { steering_lag_s: 0.0, steering_rate_limit_per_s: 1e3, speed_gain: 1.0, ..truck().driveline },
        ..truck()
    }
}
