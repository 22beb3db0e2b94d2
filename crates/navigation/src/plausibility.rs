//! What readings have to be for a lap to go on, and whether their velocities are those of their positions.

use std::f64::consts::{FRAC_PI_2, PI};

use nesam_physics::DT_S;
use nesam_physics::vec3::Tilt;

use crate::link::{Answer, Reading};

/// Largest magnitude of each number of a state: what the service takes of a measurement. m, rad (the yaw may be unwrapped), m/s, rad/s.
const LIMITS: [f64; 12] = {
    let (position_m, attitude_rad, yaw_rad, speed_m_s, rate_rad_s) = (1e6, PI + 1e-6, 1e4, 100.0, 50.0);
    [
        position_m,
        position_m,
        position_m,
        attitude_rad,
        attitude_rad,
        yaw_rad,
        speed_m_s,
        speed_m_s,
        speed_m_s,
        rate_rad_s,
        rate_rad_s,
        rate_rad_s,
    ]
};
/// Steps over which positions are compared with velocities: over one second, noise of 2 cm makes 0.03 m/s.
const COMPARED_STEPS: usize = 10;

/// The reading of an answer that a lap can go on with; else how the lap ends: `plant_lost` where a number is none or beyond what a vehicle does, `overturned`
/// beyond 90 degrees of roll or pitch, or what the plant says.
pub(crate) fn usable(answer: &Answer) -> Result<Reading, String> {
    let reading = match answer {
        Answer::Reading(reading) => *reading,
        Answer::Ended(reason) => return Err(reason.clone()),
    };
    if !std::iter::once(&reading.measured).chain(&reading.truth).all(is_plausible) {
        return Err("plant_lost".into());
    }
    let [_, _, _, roll, pitch, ..] = *reading.scored();
    if roll.abs().max(pitch.abs()) > FRAC_PI_2 { Err("overturned".into()) } else { Ok(reading) }
}

/// False of a number that is none, too.
fn is_plausible(state: &[f64; 12]) -> bool {
    state.iter().zip(LIMITS).all(|(value, limit)| value.abs() <= limit)
}

/// Holds the way that positions tell against the way that velocities tell: another frame or another point makes them differ.
#[derive(Default)]
pub(crate) struct VelocityCheck {
    /// x, y (m) and their rates (m/s) in World of every reading.
    read: Vec<[[f64; 2]; 2]>,
}

impl VelocityCheck {
    pub(crate) fn add(&mut self, state: &[f64; 12]) {
        let [x, y, _, roll, pitch, yaw, vx, vy, vz, ..] = *state;
        let [ahead, left, _] = Tilt::new(roll, pitch).to_heading([vx, vy, vz]);
        let (sin, cos) = yaw.sin_cos();
        self.read.push([[x, y], [cos * ahead - sin * left, sin * ahead + cos * left]]);
    }

    /// Root mean square over the stretches of a second, m/s; `None` where there is none.
    pub(crate) fn mismatch_m_s(&self) -> Option<f64> {
        let squares: Vec<f64> =
            self.read.windows(COMPARED_STEPS + 1).map(|stretch| (0..2).map(|i| mismatch(stretch, i).powi(2)).sum()).collect();
        (!squares.is_empty()).then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
    }
}

/// Speed along one axis by the ends of a stretch, less the mean of the velocities on it (trapezoids), m/s.
fn mismatch(stretch: &[[[f64; 2]; 2]], axis: usize) -> f64 {
    let steps = (stretch.len() - 1) as f64;
    let moved = (stretch[stretch.len() - 1][0][axis] - stretch[0][0][axis]) / (steps * DT_S);
    let told: f64 = stretch.windows(2).map(|pair| 0.5 * (pair[0][1][axis] + pair[1][1][axis])).sum();
    moved - told / steps
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reading(measured: [f64; 12], truth: Option<[f64; 12]>) -> Answer {
        Answer::Reading(Reading { measured, truth })
    }

    /// Goal: each limit ends a lap just beyond it and not at it. Method: every channel in turn, in what is measured and in what is true.
    #[test]
    fn property_a_reading_beyond_a_limit_ends_the_lap() {
        let with = |channel: usize, value: f64| std::array::from_fn(|i| if i == channel { value } else { 0.0 });
        for (channel, limit) in LIMITS.into_iter().enumerate() {
            for value in [f64::NAN, f64::INFINITY, -1.001 * limit] {
                for answer in [reading(with(channel, value), None), reading([0.0; 12], Some(with(channel, value)))] {
                    assert_eq!(usable(&answer).unwrap_err(), "plant_lost", "{channel} {value}");
                }
            }
            if !(3..5).contains(&channel) {
                assert!(usable(&reading(with(channel, -limit), None)).is_ok(), "{channel}");
            }
        }
        for channel in [3, 4] {
            assert!(usable(&reading(with(channel, -1.57), None)).is_ok());
            assert_eq!(usable(&reading(with(channel, -1.58), None)).unwrap_err(), "overturned");
        }
        assert_eq!(usable(&Answer::Ended("in a ditch".into())).unwrap_err(), "in a ditch");
    }

    /// Goal: right velocities agree with positions, velocities in another frame do not. Method: a steady circle of 2 m/s and 0.2 rad/s, whose chords are those of
    /// trapezoids but for 0.07 mm/s; the same with its velocities in World.
    #[test]
    fn analytic_velocities_in_body_agree_with_positions() {
        let (speed_m_s, rate_rad_s) = (2.0, 0.2);
        let (mut body, mut world) = (VelocityCheck::default(), VelocityCheck::default());
        for k in 0..300 {
            let yaw = rate_rad_s * DT_S * f64::from(k);
            let (sin, cos) = yaw.sin_cos();
            let at = [speed_m_s / rate_rad_s * sin, -speed_m_s / rate_rad_s * cos];
            let state = |v: [f64; 2]| [at[0], at[1], 0.6, 0.0, 0.0, yaw, v[0], v[1], 0.0, 0.0, 0.0, rate_rad_s];
            body.add(&state([speed_m_s, 0.0]));
            world.add(&state([speed_m_s * cos, speed_m_s * sin]));
            if k == 9 {
                assert!(body.mismatch_m_s().is_none(), "no second has passed");
            }
        }
        let (body, world) = (body.mismatch_m_s().unwrap(), world.mismatch_m_s().unwrap());
        assert!(body < 1e-4 && world > 1.0, "{body} {world}");
    }
}
