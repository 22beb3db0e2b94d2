//! Vehicles for the unit tests of this crate.

use nesam_physics::{Driveline, SecondCommand, Vehicle};

/// A car of 2.5 t whose second command is the road-wheel angle.
pub(crate) fn bicycle() -> Vehicle {
    Vehicle {
        name: "test car".into(),
        mass_kg: 2500.0,
        inertia_kg_m2: [[1445.0, 0.0, 0.0], [0.0, 4122.0, 0.0], [0.0, 0.0, 5026.0]],
        inertia_estimated: false,
        wheel_centre_m: [[1.6, 0.91, -0.15], [1.6, -0.91, -0.15], [-1.7, 0.91, -0.15], [-1.7, -0.91, -0.15]],
        wheel_radius_m: 0.467,
        wheel_width_m: 0.254,
        suspension_n_m: [1.5e5; 4],
        suspension_n_s_m: [1.5e4; 4],
        second: SecondCommand::RoadWheelAngleRad,
        command_range: [[-5.0, 10.0], [-0.5, 0.5]],
        steering: None,
        track_m: 1.82,
        wheelbase_m: 3.3,
        driveline: Driveline {
            steering_lag_s: 0.08,
            steering_rate_limit_per_s: 3.0,
            speed_gain: 0.2,
            speed_integral_gain_per_s: 0.1,
            speed_integral_leak_s: 5.0,
            speed_integral_limit_m: 5.0,
            overspeed_limit_m_s: 2.0,
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

/// A 50-kg differential drive.
pub(crate) fn skid() -> Vehicle {
    Vehicle {
        name: "test skid".into(),
        mass_kg: 50.0,
        second: SecondCommand::YawRateRadS,
        wheel_centre_m: [[0.256, 0.28, -0.1], [0.256, -0.28, -0.1], [-0.256, 0.28, -0.1], [-0.256, -0.28, -0.1]],
        track_m: 0.55,
        wheelbase_m: 0.512,
        ..bicycle()
    }
}
