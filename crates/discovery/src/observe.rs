//! Measured drives as segments of the frozen reference: what the physics predicts there, with or without an effect.
//!
//! The network is asked once, at every measured sample ([`Predictor::transition`]); its sinkage ratios and residuals are then constants, so
//! an effect or another soil changes the prediction through the physics alone. A segment starts at a measured state and runs a few steps: long
//! enough for forces to rise above the noise of one sample, short enough to stay near the measured path.

use std::sync::Arc;

use nesam_evaluation::{DriveMaps, history_steps};
use nesam_model::{GroundSource, Predictor, Transition};
use nesam_physics::driveline::command_wheels;
use nesam_physics::step::{StepInput, StepModel};
use nesam_physics::{STATE_DIM, Soil, SoilCorrection, VehicleState, WHEELS, wrap_angle};
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use crate::channels::{BINS, CHANNELS, RIM_AT, Row, SEGMENT_STEPS, STATE_CHANNELS, STEERING_AT, available};
use crate::error::DiscoveryError;

/// First sample of the first segment, so that the actuators are known from the commands before it.
const FIRST_START: usize = 16;
/// Smallest change of tractive force per rim over-speed that is believed, N per m/s (a wheel in the air has none).
const TRACTION_SLOPE_FLOOR: f64 = 2000.0;

/// A measured drive, prepared: nothing of it depends on an effect or a soil correction.
#[derive(Clone, Debug)]
pub struct ObservedDrive {
    /// Trajectory id.
    pub id: String,
    /// Measured channels.
    pub available: [bool; CHANNELS],
    /// First sample of each segment, ascending.
    pub starts: Vec<usize>,
    map: Option<Arc<WorldMap>>,
    states: Vec<VehicleState<f64>>,
    transitions: Vec<Transition>,
    wheel_speed_rad_s: Option<Vec<[f64; WHEELS]>>,
    road_wheel_angle_rad: Option<Vec<[f64; 2]>>,
    /// ∂(tractive force)/∂(rim over-speed) of each wheel at each sample, N per m/s.
    traction_slope: Vec<[f64; WHEELS]>,
}

/// Prepares drives, world by world, because a predictor keeps terrain features of a few maps only; `done` is called after each drive.
///
/// # Errors
/// `DiscoveryError::NoSegments` for a drive without a usable segment.
pub fn observe_all(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &DriveMaps,
    done: &(dyn Fn(usize) + Sync),
) -> Result<Vec<ObservedDrive>, DiscoveryError> {
    let mut order: Vec<usize> = (0..drives.len()).collect();
    order.sort_by_key(|&d| maps[d].as_ref().map(|m| m.hash().to_string()));
    let mut observed = Vec::with_capacity(drives.len());
    for (count, d) in order.into_iter().enumerate() {
        observed.push((d, observe(predictor, &drives[d], maps[d].as_ref())?));
        done(count + 1);
    }
    observed.sort_by_key(|(d, _)| *d);
    Ok(observed.into_iter().map(|(_, o)| o).collect())
}

/// Prepares one drive.
///
/// # Errors
/// `DiscoveryError::NoSegments` when no segment fits on known ground.
pub fn observe(predictor: &Predictor, drive: &Trajectory, map: Option<&Arc<WorldMap>>) -> Result<ObservedDrive, DiscoveryError> {
    let steps = history_steps(drive);
    let transitions: Vec<Transition> = (0..steps.len().saturating_sub(1))
        .into_par_iter()
        .map(|k| predictor.transition(&steps[..k], &steps[k].state, &steps[k].control, map))
        .collect();
    let last = drive.states.len().saturating_sub(SEGMENT_STEPS + 1);
    let first = FIRST_START.min(last);
    let finite = |k: usize| drive.states[k].to_array().iter().all(|v| v.is_finite());
    let usable = |&k: &usize| {
        k + SEGMENT_STEPS < drive.states.len()
            && (k..=k + SEGMENT_STEPS).all(finite)
            && transitions[k..k + SEGMENT_STEPS].iter().all(|t| t.ground_known)
    };
    let starts: Vec<usize> = (first..=last).step_by(SEGMENT_STEPS).filter(usable).collect();
    if starts.is_empty() {
        return Err(DiscoveryError::NoSegments { trajectory: drive.id.clone(), steps: SEGMENT_STEPS });
    }
    let model = predictor.step_model();
    let traction_slope = transitions.par_iter().map(|t| traction_slopes(model, t)).collect();
    Ok(ObservedDrive {
        id: drive.id.clone(),
        available: available(&drive.measured),
        starts,
        map: map.cloned(),
        states: drive.states.clone(),
        transitions,
        wheel_speed_rad_s: drive.wheel_speed_rad_s.clone(),
        road_wheel_angle_rad: drive.road_wheel_angle_rad.clone(),
        traction_slope,
    })
}

/// How much more each wheel pulls per rim over-speed, by central differences of the contact forces.
fn traction_slopes(model: &StepModel, transition: &Transition) -> [f64; WHEELS] {
    const STEP_M_S: f64 = 0.05;
    let forces = |step: f64| {
        let mut input = transition.input;
        input.wheels.rim_base_m_s = input.wheels.rim_base_m_s.map(|v| v + step);
        model.step(&input).contacts.map(|c| c.forward_n)
    };
    let (more, less) = (forces(STEP_M_S), forces(-STEP_M_S));
    core::array::from_fn(|i| ((more[i] - less[i]) / (2.0 * STEP_M_S)).max(TRACTION_SLOPE_FLOOR))
}

impl ObservedDrive {
    /// Measured minus predicted for every segment, with the vehicle of `model` and a soil correction.
    pub fn deviations(&self, model: &StepModel, soil: &SoilCorrection) -> Vec<Row> {
        self.starts.par_iter().map(|&start| self.segment(model, soil, start)).collect()
    }

    fn segment(&self, model: &StepModel, soil: &SoilCorrection, start: usize) -> Row {
        let mut row = [0.0; CHANNELS];
        let mut state = self.states[start];
        let ground = GroundSource::new(self.map.as_deref(), model, &state);
        for (j, transition) in self.transitions[start..start + SEGMENT_STEPS].iter().enumerate() {
            self.actuators(model, transition, start + j, &mut row);
            let input = StepInput {
                state,
                wheels: command_wheels(model.vehicle(), &transition.actuators[0], &transition.actuators[1], &transition.control),
                soil: Soil::from_array(soil.apply(&transition.input.soil.to_array())),
                ground: ground.under_wheels(model, &state, 0.0).0,
                ..transition.input
            };
            let increment = model.step(&input).increment.to_array();
            let total: [f64; STATE_DIM] = core::array::from_fn(|i| increment[i] + transition.residual[i]);
            state = VehicleState::from_array(state.advanced(&total));
            for (b, [from, to]) in BINS.iter().enumerate() {
                if (*from..=*to).contains(&(j + 1)) {
                    let share = 1.0 / (to - from + 1) as f64;
                    let deviation = deviation(&self.states[start + j + 1], &state);
                    for c in 0..STATE_CHANNELS {
                        row[b * STATE_CHANNELS + c] += share * deviation[c];
                    }
                }
            }
        }
        row
    }

    /// Adds the actuator layer of one sample: road-wheel angle, and rim over-speeds with what a drag at the wheel takes from them.
    ///
    /// A drag torque τ lowers the rim speed until the tread makes up for what the coupling of the axle does not:
    /// Δ(over-speed) = -(τ at the tread / r) / (∂F/∂over-speed), see `StepModel`.
    fn actuators(&self, model: &StepModel, transition: &Transition, sample: usize, row: &mut Row) {
        let vehicle = model.vehicle();
        let share = 1.0 / SEGMENT_STEPS as f64;
        let mut angles = transition.actuators[0].road_wheel_angles(vehicle);
        if let Some(measured) = self.road_wheel_angle_rad.as_ref().map(|m| m[sample]) {
            row[STEERING_AT] += share * 0.5 * (measured[0] + measured[1] - angles[0] - angles[1]);
            angles[..2].copy_from_slice(&measured);
        }
        let Some(wheel_speed) = self.wheel_speed_rad_s.as_ref().map(|m| m[sample]) else { return };
        let state = &self.states[sample];
        let (v, w) = (state.velocity_m_s, state.angular_velocity_rad_s);
        for i in 0..WHEELS {
            let at = vehicle.wheel_centre_m[i];
            let centre = [v[0] + w[1] * at[2] - w[2] * at[1], v[1] + w[2] * at[0] - w[0] * at[2]];
            let (sin, cos) = angles[i].sin_cos();
            let forward = cos * centre[0] + sin * centre[1];
            let slope = self.traction_slope[sample][i];
            let drag = vehicle.drag_at_tread_n_m(i, slope) / vehicle.wheel_radius_m / slope;
            let predicted = transition.input.wheels.rim_speed_m_s(i, forward, v[0]) - drag * forward.signum();
            row[RIM_AT + i] += share * (wheel_speed[i] * vehicle.wheel_radius_m - predicted);
        }
    }
}

/// Measured minus predicted, positions in the measured heading frame, angles wrapped.
fn deviation(measured: &VehicleState<f64>, predicted: &VehicleState<f64>) -> [f64; STATE_CHANNELS] {
    let (m, p) = (measured.to_array(), predicted.to_array());
    let (sin, cos) = m[5].sin_cos();
    let (dx, dy) = (m[0] - p[0], m[1] - p[1]);
    core::array::from_fn(|c| match c {
        0 => cos * dx + sin * dy,
        1 => cos * dy - sin * dx,
        3..=5 => wrap_angle(m[c] - p[c]),
        _ => m[c] - p[c],
    })
}
