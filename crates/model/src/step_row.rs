//! Layout of one row of the physics step as packed floats: the only place that knows the columns.

use nesam_physics::driveline::WheelCommand;
use nesam_physics::step::{Ground, StepInput};
use nesam_physics::{Real, Soil, VehicleState, WHEELS};

/// Columns through which gradients flow: z, roll, pitch, v, ω (9), sinkage log-ratio (4), soil (6).
pub const DIFFERENTIABLE: usize = 19;
/// Columns of the state part.
pub const STATE_COLUMNS: usize = 9;
/// First column of the sinkage log-ratios.
pub const SINKAGE_AT: usize = STATE_COLUMNS;
/// First column of the soil.
pub const SOIL_AT: usize = SINKAGE_AT + WHEELS;
/// Constant columns: wheel angles (4), rim base (4), follow, gain, limit, speed, ground height and two slopes per wheel (12), yaw.
pub const CONSTANT: usize = 25;
/// All columns of a row.
pub const COLUMNS: usize = DIFFERENTIABLE + CONSTANT;
/// Outputs: the twelve entries of the increment.
pub const OUTPUTS: usize = 12;

/// Packs the constant columns.
pub fn pack_constants(wheels: &WheelCommand<f64>, ground: &[Ground<f64>; WHEELS], yaw_rad: f64) -> [f32; CONSTANT] {
    let mut row = [0.0; CONSTANT];
    for i in 0..WHEELS {
        row[i] = wheels.angle_rad[i] as f32;
        row[4 + i] = wheels.rim_base_m_s[i] as f32;
        row[12 + i] = ground[i].height_m as f32;
        row[16 + i] = ground[i].slope_ahead as f32;
        row[20 + i] = ground[i].slope_left as f32;
    }
    row[8] = wheels.rim_follow as f32;
    row[9] = wheels.rim_gain as f32;
    row[10] = wheels.overspeed_limit_m_s as f32;
    row[11] = wheels.speed_m_s as f32;
    row[24] = yaw_rad as f32;
    row
}

/// Builds the input of the step from the columns of a row, whatever the scalar.
#[inline(always)]
pub fn step_input<T: Real>(varying: [T; DIFFERENTIABLE], constant: [T; CONSTANT]) -> StepInput<T> {
    let zero = T::lit(0.0);
    let x = varying;
    StepInput {
        state: VehicleState {
            position_m: [zero, zero, x[0]],
            attitude_rad: [x[1], x[2], constant[24]],
            velocity_m_s: [x[3], x[4], x[5]],
            angular_velocity_rad_s: [x[6], x[7], x[8]],
        },
        sinkage_log_ratio: core::array::from_fn(|i| x[SINKAGE_AT + i]),
        soil: Soil::from_array(core::array::from_fn(|i| x[SOIL_AT + i])),
        wheels: WheelCommand {
            angle_rad: core::array::from_fn(|i| constant[i]),
            rim_base_m_s: core::array::from_fn(|i| constant[4 + i]),
            rim_follow: constant[8],
            rim_gain: constant[9],
            overspeed_limit_m_s: constant[10],
            speed_m_s: constant[11],
        },
        ground: core::array::from_fn(|i| Ground {
            height_m: constant[12 + i],
            slope_ahead: constant[16 + i],
            slope_left: constant[20 + i],
        }),
    }
}
