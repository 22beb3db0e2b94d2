//! Normalisation measured on the training drives.

use nesam_model::dims::STATE_CONTROL;
use nesam_model::soil_coordinates::to_raw;
use nesam_model::token::token_entries;
use nesam_model::{GroundSource, Normalization};
use nesam_physics::step::StepModel;
use nesam_physics::{STATE_DIM, Vehicle, wrap_angle};
use nesam_terrain::PatchScale;

use crate::drives::Drive;

/// A soil in the middle of what vehicles meet, used where nothing is known: between firm dirt and loose sand of Wong's tables.
pub const MIDDLE_SOIL: [f64; 6] = [1.3e6, 8.0e3, 0.8, 3.0e3, 0.42, 0.015];

/// Errors that count as one in the loss: x, y, z (m), attitude (rad), velocity (m/s), angular velocity (rad/s), near the targets of the evaluation.
const LOSS_SCALE: [f32; STATE_DIM] = [0.15, 0.15, 0.04, 0.012, 0.012, 0.02, 0.15, 0.15, 0.15, 0.15, 0.15, 0.05];

/// Raw residual of one, per step: what the symbolic step is typically off by.
const RESIDUAL_SCALE: [f32; STATE_DIM] = [0.02, 0.02, 0.02, 0.01, 0.01, 0.01, 0.1, 0.1, 0.1, 0.1, 0.1, 0.05];

/// Mean and standard deviation of what one step changes: displacement in the heading frame, attitude, velocities; for a form without symbolic half.
pub fn measure_increments(drives: &[&Drive]) -> [[f32; STATE_DIM]; 2] {
    let (mut sum, mut squares, mut count) = ([0.0; STATE_DIM], [0.0; STATE_DIM], 0.0);
    for pair in drives.iter().flat_map(|drive| drive.states.windows(2)) {
        let (x, next) = (pair[0].to_array(), pair[1].to_array());
        let mut change: [f64; STATE_DIM] = core::array::from_fn(|i| next[i] - x[i]);
        let (sin, cos) = x[5].sin_cos();
        (change[0], change[1]) = (cos * change[0] + sin * change[1], cos * change[1] - sin * change[0]);
        change[5] = wrap_angle(change[5]);
        for i in 0..STATE_DIM {
            sum[i] += change[i];
            squares[i] += change[i].powi(2);
        }
        count += 1.0;
    }
    let mean = sum.map(|s| s / count);
    let sd: [f64; STATE_DIM] = core::array::from_fn(|i| (squares[i] / count - mean[i].powi(2)).max(0.0).sqrt().max(1e-4));
    [mean, sd].map(|values| values.map(|v| v as f32))
}

/// Scales of tokens, ranges and losses from the training drives (measured channels only).
pub fn measure(drives: &[&Drive], vehicle: &Vehicle, dt_s: f64) -> Normalization {
    let model = StepModel::new(vehicle, dt_s, 2);
    let (mut sum, mut squares, mut count) = ([0.0; STATE_CONTROL], [0.0; STATE_CONTROL], 0.0);
    let (mut speed, mut second, mut tilt) = ([f64::INFINITY, f64::NEG_INFINITY], [f64::INFINITY, f64::NEG_INFINITY], 0f64);
    for drive in drives {
        let ground = GroundSource::new(drive.map.as_deref(), &model, &drive.states[0]);
        for i in 1..drive.states.len() {
            let (state, control) = (&drive.states[i], &drive.controls[i]);
            let (height, _, _) = ground.at(&vehicle.effects.map, state.position_m[0], state.position_m[1]);
            let entries = token_entries(state, Some(&drive.states[i - 1]), [control.speed_m_s, control.second], height, dt_s);
            for (k, e) in entries.iter().enumerate() {
                sum[k] += f64::from(*e);
                squares[k] += f64::from(*e).powi(2);
            }
            count += 1.0;
            speed = [speed[0].min(control.speed_m_s), speed[1].max(control.speed_m_s)];
            second = [second[0].min(control.second), second[1].max(control.second)];
            tilt = tilt.max(state.attitude_rad[0].abs()).max(state.attitude_rad[1].abs());
        }
    }
    let mean: [f64; STATE_CONTROL] = sum.map(|s| s / count);
    let scale: [f64; STATE_CONTROL] = core::array::from_fn(|k| (squares[k] / count - mean[k].powi(2)).max(0.0).sqrt().max(1e-3));
    let patch = PatchScale::default();
    Normalization {
        dt_s,
        substeps: 2,
        elevation_half_range_m: patch.elevation_half_range_m,
        semantic_mean: patch.semantic_mean,
        semantic_half_range: patch.semantic_half_range,
        smooth_semantics: true,
        token_mean: mean.map(|v| v as f32),
        token_scale: scale.map(|v| v as f32),
        residual_scale: RESIDUAL_SCALE,
        sinkage_log_ratio_max: 1.5,
        loss_scale: LOSS_SCALE,
        default_soil_raw: to_raw(&MIDDLE_SOIL),
        trained_speed_m_s: speed,
        trained_second: second,
        trained_tilt_rad: tilt,
        stand_in: None,
    }
}
