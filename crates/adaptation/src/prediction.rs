//! One-step predictions of the velocities and how they depend on the soil correction.

use nesam_physics::driveline::WheelCommand;
use nesam_physics::scalar::Dual;
use nesam_physics::step::{Ground, StepInput, StepModel};
use nesam_physics::{Real, SOIL_DIM, STATE_DIM, Soil, SoilCoordinates, SoilCorrection, VehicleState};

/// Channels of y = [v, ω].
pub const VELOCITY_DIM: usize = 6;

/// Where the velocities begin in the state vector.
const VELOCITY_AT: usize = STATE_DIM - VELOCITY_DIM;

/// A number and its derivatives with respect to the six entries of Δθ.
type SoilDual = Dual<f64, SOIL_DIM>;

/// One measured transition (x_k, u_k, m_k) → y_{k+1}, with everything the network says of it.
#[derive(Clone, Copy, Debug)]
pub struct BufferedTransition {
    /// Input of the physics: measured state x_k, what the drive line makes of u_k, sinkage ratios, ground, and the *prior* soil θ̄(m_k).
    pub input: StepInput<f64>,
    /// Learned state residual Δx_res of the step.
    pub residual: [f64; STATE_DIM],
    /// Measured y_{k+1} = [v, ω] in Body, m/s and rad/s.
    pub measured_next: [f64; VELOCITY_DIM],
    /// Share of a lasting resistance that the actuators were observed to make up for before x_k ([`StepModel::observed_share`]); 0 where they are what they are.
    pub observed_share: f64,
    /// Class of the ground by its look; 0 = not told. Each class has a correction of its own, see [`crate::FilterConfig::classes`].
    pub ground_class: usize,
}

impl BufferedTransition {
    /// A transition that ended in a measured state.
    pub fn new(input: StepInput<f64>, residual: [f64; STATE_DIM], end: &VehicleState<f64>) -> Self {
        let ([vx, vy, vz], [wx, wy, wz]) = (end.velocity_m_s, end.angular_velocity_rad_s);
        Self { input, residual, measured_next: [vx, vy, vz, wx, wy, wz], observed_share: 0.0, ground_class: 0 }
    }
}

/// Predicted velocities after one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityPrediction {
    /// ŷ_{k+1}, m/s and rad/s.
    pub velocity: [f64; VELOCITY_DIM],
    /// ∂ŷ/∂Δθ, one row per channel; a column is zero where the clip holds the parameter.
    pub jacobian: [[f64; SOIL_DIM]; VELOCITY_DIM],
}

/// ŷ_{k+1} = V(F(x_k, u_k, m_k; clip(θ̄_k ⊕ Δθ))) and its Jacobian, in one pass of the physics over dual numbers: what the filter takes a buffer of this one
/// transition for.
pub fn predict_velocity(model: &StepModel, transition: &BufferedTransition, correction: &SoilCorrection) -> VelocityPrediction {
    predict_along(model, core::slice::from_ref(transition), &|_| *correction, &|_| true)[0]
}

/// The same after every transition of a buffer, each starting where the prediction before it ended; only the first starts from a
/// measurement. Ground, actuators and what the network says stay those of the measured path. The correction may differ from class to class of the ground;
/// derivatives are those with respect to the corrections of the transitions for which `varies` is true, that of k_c by [`with_first_slope`].
///
/// A wrong soil shows as what it does to a rollout, a speed or a turn that is too fast or too slow, and the noise of the measured states
/// enters once instead of at every step, where it looks like slip.
pub(crate) fn predict_along(
    model: &StepModel,
    buffer: &[BufferedTransition],
    correction: &dyn Fn(&BufferedTransition) -> SoilCorrection,
    varies: &dyn Fn(&BufferedTransition) -> bool,
) -> Vec<VelocityPrediction> {
    let Some(first) = buffer.first() else { return Vec::new() };
    let mut state = first.input.state.to_array().map(SoilDual::constant);
    let mut made_up_for = None;
    buffer
        .iter()
        .map(|transition| {
            let correction = correction(transition);
            let delta = if varies(transition) { variables(&correction) } else { correction.delta.map(SoilDual::constant) };
            let mut soil = corrected(transition, &correction, &delta);
            with_first_slope(&mut soil, &transition.input.soil, correction.coordinates);
            let made_up_for = *made_up_for.get_or_insert_with(|| made_up_for_m_s(model, transition, &soil));
            state = next_state(model, transition, &state, soil, made_up_for);
            prediction_of(&state)
        })
        .collect()
}

/// The velocities of [`predict_along`] alone.
pub(crate) fn velocities_along(
    model: &StepModel,
    buffer: &[BufferedTransition],
    correction: &dyn Fn(&BufferedTransition) -> SoilCorrection,
) -> Vec<[f64; VELOCITY_DIM]> {
    let Some(first) = buffer.first() else { return Vec::new() };
    let mut state = first.input.state.to_array();
    let mut made_up_for = None;
    let velocities = buffer.iter().map(|transition| {
        let correction = correction(transition);
        let soil = corrected(transition, &correction, &correction.delta);
        let made_up_for = *made_up_for.get_or_insert_with(|| made_up_for_m_s(model, transition, &soil));
        state = next_state(model, transition, &state, soil, made_up_for);
        core::array::from_fn(|c| state[VELOCITY_AT + c])
    });
    velocities.collect()
}

fn variables(correction: &SoilCorrection) -> [SoilDual; SOIL_DIM] {
    core::array::from_fn(|i| SoilDual::variable(correction.delta[i], i))
}

/// θ of a transition where Δθ is `delta`, in the coordinates of the correction.
fn corrected<T: Real>(transition: &BufferedTransition, correction: &SoilCorrection, delta: &[T; SOIL_DIM]) -> [T; SOIL_DIM] {
    correction.coordinates.correct(&transition.input.soil.to_array(), delta)
}

/// Gives k_c the slope of a first estimate ([`SoilCoordinates::first_slope_of_k_c`]), unless its bound holds it.
fn with_first_slope(soil: &mut [SoilDual; SOIL_DIM], prior: &Soil<f64>, coordinates: SoilCoordinates) {
    let [k_phi, k_c, ..] = soil;
    if let Some(slope) = coordinates.first_slope_of_k_c(prior, k_phi.re)
        && k_c.eps[1] != 0.0
    {
        k_c.eps[1] = slope;
    }
}

/// x̂_{k+1} from x_k on a soil; x, y and yaw are carried along without meaning, as the physics reads none of them.
fn next_state<T: Real>(
    model: &StepModel,
    transition: &BufferedTransition,
    state: &[T; STATE_DIM],
    soil: [T; SOIL_DIM],
    made_up_for_m_s: T,
) -> [T; STATE_DIM] {
    let mut input = StepInput { state: VehicleState::from_array(*state), ..with_soil(&transition.input, Soil::from_array(soil)) };
    input.wheels = input.wheels.demanding_more(made_up_for_m_s);
    let increment = model.step(&input).increment.to_array();
    core::array::from_fn(|i| state[i] + increment[i] + T::lit(transition.residual[i]))
}

/// What the speed control demands beyond what the transition knows because the soil is not its prior: constant over a buffer, as an integral that hardly forgets is.
fn made_up_for_m_s<T: Real<Value = f64>>(model: &StepModel, transition: &BufferedTransition, soil: &[T; SOIL_DIM]) -> T {
    let speed_m_s = T::lit(transition.input.state.velocity_m_s[0]);
    let integral_m = model.compaction_made_up_for_m(&transition.input.soil, &Soil::from_array(*soil), speed_m_s, transition.observed_share);
    integral_m * T::lit(model.vehicle().driveline.speed_integral_gain_per_s)
}

fn prediction_of(state: &[SoilDual; STATE_DIM]) -> VelocityPrediction {
    VelocityPrediction {
        velocity: core::array::from_fn(|c| state[VELOCITY_AT + c].re),
        jacobian: core::array::from_fn(|c| state[VELOCITY_AT + c].eps),
    }
}

/// The input with another soil, in the scalar of that soil; everything else is constant.
fn with_soil<T: Real>(input: &StepInput<f64>, soil: Soil<T>) -> StepInput<T> {
    let wheels = &input.wheels;
    StepInput {
        state: input.state.map(T::lit),
        wheels: WheelCommand {
            angle_rad: wheels.angle_rad.map(T::lit),
            rim_base_m_s: wheels.rim_base_m_s.map(T::lit),
            rim_follow: T::lit(wheels.rim_follow),
            rim_gain: T::lit(wheels.rim_gain),
            overspeed_limit_m_s: T::lit(wheels.overspeed_limit_m_s),
            speed_m_s: T::lit(wheels.speed_m_s),
        },
        sinkage_log_ratio: input.sinkage_log_ratio.map(T::lit),
        soil,
        ground: input.ground.map(|g| Ground {
            height_m: T::lit(g.height_m),
            slope_ahead: T::lit(g.slope_ahead),
            slope_left: T::lit(g.slope_left),
        }),
    }
}
