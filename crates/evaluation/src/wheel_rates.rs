//! What the springs of a simulated vehicle are at the wheel: force of the soil against the place of the wheel in the body; for evaluation only.

use nesam_physics::vec3::{Tilt, dot};
use nesam_physics::{Vehicle, WHEELS};
use nesam_trajectories::GroundTruth;

/// Samples that are averaged, so that dampers and the inertia of the wheel, which do not last, drop out: 2 s at 10 Hz.
const TOGETHER: usize = 20;

/// Rate at the wheel that the simulator's own values show for the front and the rear axle, N/m: slope of the force along the body's up over how far the wheel
/// is pressed up, between means over 2 s, least squares. Scatter of the places, which the force does not tell, makes it a little too small. `None` where
/// nothing moves.
pub fn wheel_rates<'a>(vehicle: &Vehicle, truths: impl IntoIterator<Item = &'a GroundTruth>) -> Option<[f64; 2]> {
    let mut axles = [Line::default(); 2];
    for truth in truths {
        let samples: Vec<[(f64, f64); WHEELS]> = (0..truth.states.len()).map(|k| pressed_up(vehicle, truth, k)).collect();
        for block in samples.chunks_exact(TOGETHER) {
            for w in 0..WHEELS {
                let mean = |of: fn((f64, f64)) -> f64| block.iter().map(|s| of(s[w])).sum::<f64>() / TOGETHER as f64;
                axles[w / 2].push(mean(|s| s.0), mean(|s| s.1));
            }
        }
    }
    let [front, rear] = axles.map(|line| line.slope());
    Some([front?, rear?])
}

/// How far each wheel is above its place at rest in the body (m) and the force of the soil (N), both along the body's up.
fn pressed_up(vehicle: &Vehicle, truth: &GroundTruth, k: usize) -> [(f64, f64); WHEELS] {
    let state = &truth.states[k];
    let [roll, pitch, yaw] = state.attitude_rad;
    let tilt = Tilt::new(roll, pitch);
    let [ahead, left, up] = tilt.to_heading([0.0, 0.0, 1.0]);
    let (sin, cos) = yaw.sin_cos();
    let up_w = [cos * ahead - sin * left, sin * ahead + cos * left, up];
    core::array::from_fn(|w| {
        let at_rest_m = state.position_m[2] + tilt.to_heading(vehicle.wheel_centre_m[w])[2];
        ((truth.wheel_height_m[k][w] - at_rest_m) / up, dot(truth.wheel_force_n[k][w], up_w))
    })
}

/// Sums of a straight line through points.
#[derive(Clone, Copy, Default)]
struct Line {
    n: f64,
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
}

impl Line {
    fn push(&mut self, x: f64, y: f64) {
        self.n += 1.0;
        self.x += x;
        self.y += y;
        self.xx += x * x;
        self.xy += x * y;
    }

    fn slope(&self) -> Option<f64> {
        let spread = self.n * self.xx - self.x * self.x;
        (spread > 0.0).then(|| (self.n * self.xy - self.x * self.y) / spread)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_vehicle::bicycle;
    use nesam_physics::VehicleState;

    #[test]
    fn analytic_springs_of_a_tilted_body_are_read_off() {
        let vehicle = bicycle();
        let rates = [150e3, 150e3, 280e3, 280e3];
        let n = 10 * TOGETHER;
        let mut truth = GroundTruth::default();
        for k in 0..n {
            // The attitude holds within a mean, in which a product would not be that of the means.
            let t = (k / TOGETHER) as f64;
            let [roll, pitch, yaw] = [0.2 * (1.3 * t).sin(), 0.2 * (0.7 * t).cos(), 0.9 * t];
            let mut state = VehicleState::zero();
            (state.position_m, state.attitude_rad) = ([3.0 * t, -t, 0.1 * t], [roll, pitch, yaw]);
            // Axes of a body turned by yaw, then pitch, then roll, written out.
            let ([sr, cr], [sp, cp], [sy, cy]) = ([roll.sin(), roll.cos()], [pitch.sin(), pitch.cos()], [yaw.sin(), yaw.cos()]);
            let (ahead, up) = ([cy * cp, sy * cp, -sp], [cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr]);
            let height_of = |at: [f64; 3]| 0.1 * t - sp * at[0] + cp * sr * at[1] + cp * cr * at[2];
            let pressed_m = |w: usize| 0.02 * (2.1 * t + w as f64).sin();
            truth.wheel_height_m.push(core::array::from_fn(|w| height_of(vehicle.wheel_centre_m[w]) + pressed_m(w) * up[2]));
            truth.wheel_force_n.push(core::array::from_fn(|w| {
                let along = 6000.0 + rates[w] * pressed_m(w);
                core::array::from_fn(|axis| along * up[axis] + 900.0 * ahead[axis])
            }));
            truth.states.push(state);
        }
        let [front, rear] = wheel_rates(&vehicle, [&truth]).expect("the wheels move");
        assert!((front / 150e3 - 1.0).abs() < 1e-9 && (rear / 280e3 - 1.0).abs() < 1e-9, "{front} {rear} N/m");
        truth.wheel_height_m.truncate(0);
        truth.states.truncate(0);
        assert!(wheel_rates(&vehicle, [&truth]).is_none());
    }
}
