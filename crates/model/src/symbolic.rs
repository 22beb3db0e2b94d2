//! The half of a form that is not learned: what moves the vehicle before the learned residual is added, and how much of that is.

use nesam_physics::step::{StepInput, StepModel, StepOutput, WheelContact};
use nesam_physics::terramechanics::WheelGeometry;
use nesam_physics::{Real, Rolling, Soil, Sunk, VehicleState, WHEELS, Wheels};

use crate::rollout::Variant;

/// A floor: a wheel of six kilonewtons sinks by less than a millimetre and grips by Coulomb friction (chosen: as concrete, tan φ = 0.7).
const FLOOR: Soil<f64> = Soil { k_phi: 5.0e8, k_c: 0.0, n: 1.0, c: 100.0, phi: 0.61, k_shear: 0.005 };
/// Time in which the bicycle takes up a commanded speed, s (chosen; the residual learns the rest).
const SPEED_LAG_S: f64 = 0.5;

/// Increment Δx of the symbolic half and the contacts of the wheels; all zero where a form has no soil.
#[inline(always)]
pub fn symbolic_step<T: Real>(variant: Variant, model: &StepModel, input: &StepInput<T>) -> StepOutput<T> {
    symbolic_step_by(variant, model, input, Rolling::sink_each)
}

/// The same with somebody else who works the contacts out ([`StepModel::step_by`]).
#[inline(always)]
pub fn symbolic_step_by<T: Real>(
    variant: Variant,
    model: &StepModel,
    input: &StepInput<T>,
    sink: impl Fn(Wheels<'_, Rolling<T>>, Wheels<'_, WheelGeometry>) -> [Sunk<T>; WHEELS],
) -> StepOutput<T> {
    let zero = T::lit(0.0);
    let none = WheelContact { sinkage_m: zero, normal_n: zero, forward_n: zero, left_n: zero, slip: zero, overspeed_m_s: zero };
    let without_soil = |increment| StepOutput { increment, contacts: [none; WHEELS] };
    let input = match variant {
        Variant::Full | Variant::NoResidual | Variant::ZeroSinkage => *input,
        Variant::RigidResidual => {
            let soil = Soil::from_array(FLOOR.to_array().map(T::lit));
            StepInput { soil, sinkage_log_ratio: [zero; WHEELS], ..*input }
        }
        Variant::KinematicResidual => return without_soil(bicycle(model, input)),
        Variant::Transformer | Variant::TalElevSem | Variant::TalElev | Variant::TalSem => {
            return without_soil(VehicleState::from_array([zero; 12]));
        }
    };
    // One call for all forms: the step is inlined here, and it is long.
    let output = model.step_by(&input, sink);
    if variant == Variant::RigidResidual { without_soil(output.increment) } else { output }
}

/// Share of the learned residual that is added in a step, 0 to 1: all of it where the vehicle is told to be as fast as the slowest command of training or faster, in
/// proportion below, none of it backwards. What the network says there it has learned nowhere: a car that stands and is told to was predicted to creep. All of it where
/// training held standing and both directions, and in a form that has nothing else.
#[inline(always)]
pub fn residual_share<T: Real>(variant: Variant, slowest_m_s: f64, commanded_m_s: T) -> T {
    let (none, all) = (T::lit(0.0), T::lit(1.0));
    match variant {
        Variant::NoResidual => none,
        _ if variant.is_end_to_end() || slowest_m_s <= 0.0 => all,
        _ => (commanded_m_s / T::lit(slowest_m_s)).max(none).min(all),
    }
}

/// A bicycle (or a differential drive) that rolls without slip: speed follows the command with a lag, the turn follows from road-wheel angle and rim
/// speeds, position and attitude from the velocities. Side speed, vertical speed, roll and pitch rate stay as they are.
#[inline(always)]
fn bicycle<T: Real>(model: &StepModel, input: &StepInput<T>) -> VehicleState<T> {
    let vehicle = model.vehicle();
    let (dt, zero) = (T::lit(model.dt_s()), T::lit(0.0));
    let [vx, vy, vz] = input.state.velocity_m_s;
    let [wx, wy, wz] = input.state.angular_velocity_rad_s;
    let wheels = &input.wheels;
    let share = T::lit(1.0 - (-model.dt_s() / SPEED_LAG_S).exp());
    let faster = (wheels.speed_m_s - vx) * share;
    let half = T::lit(0.5);
    let angle = (wheels.angle_rad[0] + wheels.angle_rad[1]) * half;
    let side = |i: usize, j: usize| (wheels.rim_base_m_s[i] + wheels.rim_base_m_s[j]) * half * (T::lit(1.0) - wheels.rim_follow);
    let speed = vx + faster * half;
    let turn = speed * angle.tan() / T::lit(vehicle.wheelbase_m) + (side(1, 3) - side(0, 2)) / T::lit(vehicle.track_m);
    let turned = (wz + turn) * half * dt;
    let pitch = input.state.attitude_rad[1];
    VehicleState {
        position_m: [speed * dt, vy * dt, (vz - speed * pitch) * dt],
        attitude_rad: [wx * dt, wy * dt, turned],
        velocity_m_s: [faster, zero, zero],
        angular_velocity_rad_s: [zero, zero, turn - wz],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: the network is silent where it learned nothing, and nowhere else. Method: commands around the slowest one of training, 1 m/s; a base that was trained in both
    /// directions, and forms without and with nothing but the network.
    #[test]
    fn analytic_the_residual_fades_below_the_slowest_command_of_training() {
        let share = |commanded: f64| residual_share(Variant::Full, 1.0, commanded);
        assert_eq!([-2.0, 0.0, 0.25, 1.0, 3.0, 9.0].map(share), [0.0, 0.0, 0.25, 1.0, 1.0, 1.0]);
        assert_eq!([-1.0, 0.0, 0.1].map(|v| residual_share(Variant::Full, -1.0, v)), [1.0; 3]);
        assert_eq!(residual_share(Variant::NoResidual, 1.0, 3.0), 0.0);
        assert_eq!(residual_share(Variant::Transformer, 1.0, 0.0), 1.0);
    }
}
