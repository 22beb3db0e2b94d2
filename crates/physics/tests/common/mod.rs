//! Vehicles, soils and ground shared by the tests of this crate.
#![allow(dead_code)]

use nesam_physics::driveline::{DrivelineState, WheelCommand, command_wheels};
use nesam_physics::step::{Ground, StepInput, StepModel, StepOutput};
use nesam_physics::{Control, DT_S, Real, SecondCommand, Soil, Vehicle, VehicleState};

/// Sandy loam, 15 % moisture (Wong's table).
pub fn loam() -> Soil<f64> {
    Soil { k_phi: 1515.04e3, k_c: 5.27e3, n: 0.7, c: 1.72e3, phi: 29f64.to_radians(), k_shear: 0.025 }
}

/// Mud in which the wheels of a car of 2.5 tonnes sink by most of their radius.
pub fn mud() -> Soil<f64> {
    Soil { k_phi: 1.3e5, k_c: 700.0, n: 0.8, c: 1700.0, phi: 8f64.to_radians(), k_shear: 0.043 }
}

/// Ground that is a plane of the given slopes in World, seen from a pose with its reference point at (x, y).
pub fn plane(model: &StepModel, state: &VehicleState<f64>, slope_x: f64, slope_y: f64) -> [Ground<f64>; 4] {
    let [roll, pitch, yaw] = state.attitude_rad;
    let (sin, cos) = yaw.sin_cos();
    model.wheel_offsets_heading(roll, pitch).map(|offset| {
        let x = state.position_m[0] + cos * offset[0] - sin * offset[1];
        let y = state.position_m[1] + sin * offset[0] + cos * offset[1];
        Ground {
            height_m: slope_x * x + slope_y * y,
            slope_ahead: cos * slope_x + sin * slope_y,
            slope_left: -sin * slope_x + cos * slope_y,
        }
    })
}

/// A drive on a plane: the loop that a rollout is, without the network.
pub struct Drive {
    pub model: StepModel,
    pub state: VehicleState<f64>,
    pub actuators: DrivelineState,
    pub soil: Soil<f64>,
    pub slope: [f64; 2],
}

impl Drive {
    /// A vehicle set down on flat ground at a speed.
    pub fn new(vehicle: Vehicle, speed_m_s: f64) -> Self {
        let mut state = VehicleState::zero();
        state.position_m[2] = vehicle.wheel_radius_m - vehicle.wheel_centre_m[0][2];
        state.velocity_m_s[0] = speed_m_s;
        let actuators = DrivelineState::default();
        Self { model: StepModel::new(&vehicle, DT_S, 2), state, actuators, soil: loam(), slope: [0.0; 2] }
    }

    /// Input of the next step under a command, and the actuators after it.
    pub fn input(&self, control: &Control<f64>) -> (StepInput<f64>, DrivelineState) {
        let after = self.actuators.advance(self.model.vehicle(), control, self.state.velocity_m_s[0], DT_S);
        let input = StepInput {
            state: self.state,
            wheels: command_wheels(self.model.vehicle(), &self.actuators, &after, control),
            sinkage_log_ratio: [0.0; 4],
            soil: self.soil,
            ground: plane(&self.model, &self.state, self.slope[0], self.slope[1]),
        };
        (input, after)
    }

    /// One step.
    pub fn step(&mut self, speed_m_s: f64, second: f64) -> StepOutput<f64> {
        let (input, after) = self.input(&Control { speed_m_s, second });
        let output = self.model.step(&input);
        self.state = VehicleState::from_array(self.state.advanced(&output.increment.to_array()));
        self.actuators = after;
        output
    }
}

/// Numbers of a [`StepInput`] in the order of [`unflatten`]: z, roll, pitch, velocities (9), sinkage ratios (4), ln soil (6), then the
/// constants of a step: road-wheel angles (4), rim bases (4), speed command, heights (4), slopes ahead and left (8).
pub const INPUTS: usize = 40;
/// The first of them, in which training and filter differentiate.
pub const VARIABLES: usize = 19;

/// A step's input over any scalar from its numbers; the way in which the drive line works is the vehicle's.
pub fn unflatten<T: Real>(vehicle: &Vehicle, x: &[T; INPUTS]) -> StepInput<T> {
    let zero = T::lit(0.0);
    let four = |at: usize| -> [T; 4] { core::array::from_fn(|i| x[at + i]) };
    let idle = Control { speed_m_s: 0.0, second: 0.0 };
    let wheels = command_wheels::<T>(vehicle, &DrivelineState::settled(&idle), &DrivelineState::settled(&idle), &idle);
    StepInput {
        state: VehicleState::from_array([zero, zero, x[0], x[1], x[2], zero, x[3], x[4], x[5], x[6], x[7], x[8]]),
        wheels: WheelCommand { angle_rad: four(19), rim_base_m_s: four(23), speed_m_s: x[27], ..wheels },
        sinkage_log_ratio: four(9),
        soil: Soil { k_phi: x[13].exp(), k_c: x[14].exp(), n: x[15].exp(), c: x[16].exp(), phi: x[17].exp(), k_shear: x[18].exp() },
        ground: core::array::from_fn(|i| Ground { height_m: x[28 + i], slope_ahead: x[32 + i], slope_left: x[36 + i] }),
    }
}

/// Numbers of a plausible step from as many numbers in [0, 1): on and off the ground, forwards and backwards, dry sand to clay.
pub fn spread(vehicle: &Vehicle, unit: &[f64]) -> [f64; INPUTS] {
    assert_eq!(unit.len(), INPUTS);
    let within = |i: usize, low: f64, high: f64| low + (high - low) * unit[i];
    let about = |i: usize, half: f64| within(i, -half, half);
    let sag = vehicle.static_load_n()[0] / vehicle.suspension_n_m[0];
    let [slowest, fastest] = vehicle.command_range[0];
    let rest = vehicle.wheel_radius_m - vehicle.wheel_centre_m[0][2];
    let mut x = [0.0; INPUTS];
    x[0] = rest + about(0, 0.5 * sag);
    (x[1], x[2]) = (about(1, 0.3 * sag), about(2, 0.3 * sag));
    x[3] = within(3, slowest, fastest);
    (x[4], x[5]) = (about(4, 0.5), about(5, 0.2));
    (x[6], x[7], x[8]) = (about(6, 0.3), about(7, 0.3), about(8, 0.8));
    for i in 9..13 {
        x[i] = about(i, 0.5);
    }
    let soils = [(3e5, 5e6), (1e3, 5e4), (0.5, 1.2), (5e2, 8e3), (0.2, 0.65), (0.008, 0.03)];
    for (i, (low, high)) in (13..).zip(soils) {
        x[i] = within(i, f64::ln(low), f64::ln(high));
    }
    let skid = vehicle.second == SecondCommand::YawRateRadS;
    for i in 0..4 {
        x[19 + i] = if skid || i > 1 { 0.0 } else { about(19 + i, 0.37) };
        x[23 + i] = if skid { x[3] + about(23 + i, 0.5 * fastest) } else { about(23 + i, 0.3) };
        x[28 + i] = about(28 + i, 0.4 * sag);
        (x[32 + i], x[36 + i]) = (about(32 + i, 0.2), about(36 + i, 0.2));
    }
    x[27] = within(27, slowest, fastest);
    x
}
