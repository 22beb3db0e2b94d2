//! How near a step is to a limit: load transfer towards a roll-over, traction left before the vehicle is stuck.

use crate::scalar::Real;
use crate::step::{StepInput, StepModel, WheelContact};
use crate::terramechanics::{ContactMotion, Support, balance_sinkage, wheel_wrench};
use crate::vec3::Tilt;
use crate::vehicle::WHEELS;

/// Slip at which the traction that is left is counted (chosen: beyond it a wheel digs more than it pulls).
pub const RESERVE_SLIP: f64 = 0.8;
/// Speed command below which the motion tells the direction of travel, and speed around which it changes its sign then, m/s (chosen, as for slip).
const DIRECTION_SPEED_M_S: f64 = 0.05;

/// Lateral load-transfer ratio |ΣF_left - ΣF_right| / ΣF of the wheel loads FL, FR, RL, RR in N: 0 = even, 1 = one side carries nothing.
///
/// Source: the static and quasi-static rollover indices of road vehicles (e.g. Rajamani, *Vehicle Dynamics and Control*, ch. 15). Loads are those of the
/// contacts, so suspension, slope and the vehicle's motion are in it; compliance of the tyres and a second axle's own limit are not.
pub fn load_transfer_ratio<T: Real>(load_n: &[T; WHEELS]) -> T {
    let [front_left, front_right, rear_left, rear_right] = *load_n;
    let difference = front_left + rear_left - front_right - rear_right;
    T::select_ge0(difference, difference, -difference) / (front_left + front_right + rear_left + rear_right)
}

impl StepModel {
    /// Traction reserve ρ = Σ DP_i(s*) / (M g) - d sin γ: drawbar pull that all wheels could give at their present loads, less what the slope asks
    /// for, over the weight. Below 0 the vehicle cannot go where it is told to at any slip: it slows down until it is stuck, or does not start (an
    /// immobilisation margin).
    ///
    /// DP_i(s*) = thrust - compaction resistance of wheel i (Wong, *Theory of Ground Vehicles*, ch. 2) at slip s* = [`RESERVE_SLIP`], at the sinkage that
    /// carries the wheel's load with this slip, times the learned ratio; γ is the climb of the body's x axis, d the direction of travel: that of
    /// the speed command, 1 or -1, or of the motion in (-1, 1) where none is told. Drawbar pull over weight equals the tangent of the steepest slope that
    /// a vehicle climbs, hence the unit. Effects act on wheel, soil and pull as in a step, and a force that they put on the body counts like the slope.
    /// Neglects side forces, the torque limit of the drive, friction at hubs (which torque overcomes) and obstacles. `contacts` are those of the step
    /// with this input.
    pub fn traction_reserve<T: Real>(&self, input: &StepInput<T>, contacts: &[WheelContact<T>; WHEELS]) -> T {
        let motion = ContactMotion::<T>::from_slip(RESERVE_SLIP, 0.0);
        let speed = input.state.velocity_m_s[0];
        let of_motion = speed / speed.abs_smooth(DIRECTION_SPEED_M_S);
        let (told, threshold) = (input.wheels.speed_m_s, T::lit(DIRECTION_SPEED_M_S));
        let backwards_or_none = T::select_ge0(-told - threshold, T::lit(-1.0), of_motion);
        let direction = T::select_ge0(told - threshold, T::lit(1.0), backwards_or_none);
        let mut pull_n = T::lit(0.0);
        for (i, (contact, log_ratio)) in contacts.iter().zip(input.sinkage_log_ratio).enumerate() {
            let (wheel, support) = (self.wheel_at(i), Support { preload_n: contact.normal_n, rate_n_m: T::lit(0.0) });
            let (mut soil, mut ratio) = (input.soil, log_ratio.exp());
            if self.altered.on_wheels {
                ratio = ratio * self.digging(motion.slip);
                soil = self.soil_under(i, direction, &support, ratio, &motion, &soil);
            }
            let sinkage = balance_sinkage(wheel, &support, &motion, &soil) * ratio;
            let wrench = wheel_wrench(wheel, sinkage, &motion, &soil);
            let mut pulled = wrench.drawbar_n() * contact.normal_n / wrench.normal_n.relu_smooth(1.0);
            if self.altered.on_wheels {
                pulled = self.altered_pull_n(i, direction, contact.normal_n, sinkage, pulled, &soil);
            }
            pull_n = pull_n + pulled;
        }
        // Pitch is positive nose down, so the body climbs by -pitch.
        let climb = -input.state.attitude_rad[1].sin_cos().0;
        let weight_n = T::lit(self.body.mass_kg * self.vehicle().gravity_m_s2);
        let reserve = pull_n / weight_n - direction * climb;
        if self.altered.on_body { reserve + direction * self.pushed_ahead_n(input) / weight_n } else { reserve }
    }

    /// Force that effects put on the body along its x axis, N.
    fn pushed_ahead_n<T: Real>(&self, input: &StepInput<T>) -> T {
        // The heading is that of the input: a step counts its own from there.
        let mut state = input.state;
        state.attitude_rad[2] = T::lit(0.0);
        let mut on_body = [T::lit(0.0); 6];
        self.add_body_forces(&state, input, &Tilt::new(state.attitude_rad[0], state.attitude_rad[1]), &mut on_body);
        on_body[0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_load_transfer_of_even_and_one_sided_loads() {
        assert_eq!(load_transfer_ratio(&[5.0, 5.0, 7.0, 7.0]), 0.0);
        assert_eq!(load_transfer_ratio(&[0.0, 5.0, 0.0, 7.0]), 1.0);
        assert_eq!(load_transfer_ratio(&[3.0, 1.0, 3.0, 1.0]), 0.5);
    }
}
