//! A truck, twin drives, settings without the adaptive parts.

use nesam_adaptation::{BufferedTransition, ChannelNoise, FilterConfig, Innovation, SoilFilter, SoilUpdate, VelocityNoise};
use nesam_physics::driveline::{DrivelineState, command_wheels};
use nesam_physics::step::{Ground, StepInput, StepModel};
use nesam_physics::{Control, DT_S, SOIL_DIM, Soil, SoilCoordinates, VehicleState};
pub use nesam_test_vehicles::truck;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

pub const LOAM: [f64; SOIL_DIM] = [1.5e6, 5.0e3, 0.75, 1.7e3, 0.5, 0.025];
pub const SOFT: [f64; SOIL_DIM] = [0.7e6, 4.0e3, 0.9, 1.1e3, 0.42, 0.033];
pub const NOISE: [f64; 2] = [0.02, 0.005];

/// Transitions of a drive on `true_soil` over waves of ground, as seen by a model that believes in `prior`. The start of each transition is
/// known exactly, the velocities after it are measured with the noise that the filter is told.
pub fn twin(model: &StepModel, true_soil: [f64; SOIL_DIM], prior: [f64; SOIL_DIM], steps: usize, seed: u64) -> Vec<BufferedTransition> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut state = VehicleState::zero();
    state.position_m[2] = 0.6;
    state.velocity_m_s[0] = 2.0;
    let mut actuators = DrivelineState::default();
    let mut transitions = Vec::new();
    for k in 0..steps + 10 {
        let t = k as f64 * DT_S;
        let control = Control { speed_m_s: 2.5 + 1.2 * (1.1 * t).sin(), second: 0.8 * (0.7 * t + seed as f64).sin() };
        let after = actuators.advance(model.vehicle(), &control, state.velocity_m_s[0], DT_S);
        let slope = 0.12 * (0.25 * t).sin();
        let input = StepInput {
            state,
            wheels: command_wheels(model.vehicle(), &actuators, &after, &control),
            sinkage_log_ratio: [0.0; 4],
            soil: Soil::from_array(true_soil),
            // A slope that turns with the vehicle: the ground passes under the reference point.
            ground: model.wheel_offsets_heading(state.attitude_rad[0], state.attitude_rad[1]).map(|offset| Ground {
                height_m: slope * offset[0],
                slope_ahead: slope,
                slope_left: 0.0,
            }),
        };
        let increment = model.step(&input).increment;
        let (x, dx) = (state.to_array(), increment.to_array());
        state = VehicleState::from_array(core::array::from_fn(|i| x[i] + dx[i]));
        actuators = after;
        if k < 10 {
            continue; // settling
        }
        let next = state.to_array();
        let mut noisy = |c: usize| {
            let unit: f64 = StandardNormal.sample(&mut rng);
            next[6 + c] + NOISE[c / 3] * unit
        };
        let measured_next = core::array::from_fn(&mut noisy);
        transitions.push(BufferedTransition {
            input: StepInput { soil: Soil::from_array(prior), ..input },
            residual: [0.0; 12],
            measured_next,
            observed_share: 0.0,
            ground_class: 0,
        });
    }
    transitions
}

/// The same white noise in the three linear and the three angular channels, nothing coloured.
pub fn white(velocity_m_s: f64, angular_velocity_rad_s: f64) -> VelocityNoise {
    let of = |white_sd| ChannelNoise { white_sd, coloured_sd: 0.0, correlation: 0.0 };
    VelocityNoise { channels: core::array::from_fn(|c| of(if c < 3 { velocity_m_s } else { angular_velocity_rad_s })) }
}

pub fn config(coordinates: SoilCoordinates) -> FilterConfig {
    let base = match coordinates {
        SoilCoordinates::Physical => FilterConfig::literal(),
        SoilCoordinates::Logarithmic => FilterConfig::default(),
    };
    let noise = white(NOISE[0], NOISE[1]).into();
    let one_step = Innovation::OneStep;
    let plain = FilterConfig { scale_memory: 0.0, trust_memory: 0.0, shared_buffers: 1.0, classes: 1, class_share: 0.0, ..base };
    FilterConfig { noise, process_sd: [0.0; 6], gate_tail_probability: 0.0, innovation: one_step, block: 1, ..plain }
}

pub fn run(config: FilterConfig, model: &StepModel, transitions: &[BufferedTransition]) -> (SoilFilter, Vec<SoilUpdate>) {
    let mut filter = SoilFilter::new(config).unwrap();
    let updates = transitions.iter().filter_map(|t| filter.push(model, *t).unwrap()).collect();
    (filter, updates)
}

pub fn model() -> StepModel {
    StepModel::new(&truck(), DT_S, 2)
}
