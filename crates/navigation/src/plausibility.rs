//! What readings have to be for a lap to go on, whether their velocities are those of their positions, and whether the vehicle turns where it is told to.

use std::f64::consts::{FRAC_PI_2, PI};

use nesam_physics::vec3::Tilt;
use nesam_physics::{Control, DT_S};

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
/// One factor between positions and velocities is what they differ by where it leaves no more than this share of the difference.
const LEFT_BY_FACTOR: f64 = 0.5;
/// Whether a vehicle turns as it is told is seen above this speed, m/s, over so many steps, where it turns faster than noise (rms), rad/s.
const TURNING_ABOVE_M_S: f64 = 1.0;
const TURNING_STEPS_MIN: usize = 15;
const TURNING_MIN_RAD_S: f64 = 0.03;
/// A vehicle that moves sideways by more than this share of its speed slides, wherever its wheels point (the reference point of a car in a sharp turn: a fifth).
const SLIDES: f64 = 0.25;
/// How a lap ends beyond 90 degrees of roll or pitch.
pub(crate) const OVERTURNED: &str = "overturned";

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
    if roll.abs().max(pitch.abs()) > FRAC_PI_2 { Err(OVERTURNED.into()) } else { Ok(reading) }
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
        self.left_m_s(1.0)
    }

    /// How many times as far as velocities say positions move (least squares), where this factor is most of what they differ by.
    pub(crate) fn moved_over_told(&self) -> Option<f64> {
        let (both, squares) =
            self.speeds_m_s().fold((0.0, 0.0), |(both, squares), [moved, told]| (both + moved * told, squares + told * told));
        let factor = both / squares;
        let (all, left) = (self.left_m_s(1.0)?, self.left_m_s(factor)?);
        // Velocities that point backwards are those of another frame.
        (factor > 0.0 && left <= LEFT_BY_FACTOR * all).then_some(factor)
    }

    /// What is left of the difference where velocities are multiplied by a factor: root mean square, m/s.
    fn left_m_s(&self, factor: f64) -> Option<f64> {
        let stretches = self.read.len().checked_sub(COMPARED_STEPS).filter(|count| *count > 0)?;
        let squares: f64 = self.speeds_m_s().map(|[moved, told]| (moved - factor * told).powi(2)).sum();
        Some((squares / stretches as f64).sqrt())
    }

    /// Speeds along both axes of every stretch: by its ends, and the mean of the velocities on it (trapezoids), m/s.
    fn speeds_m_s(&self) -> impl Iterator<Item = [f64; 2]> {
        self.read.windows(COMPARED_STEPS + 1).flat_map(|stretch| [0, 1].map(|axis| speeds_m_s(stretch, axis)))
    }
}

fn speeds_m_s(stretch: &[[[f64; 2]; 2]], axis: usize) -> [f64; 2] {
    let steps = (stretch.len() - 1) as f64;
    let moved = (stretch[stretch.len() - 1][0][axis] - stretch[0][0][axis]) / (steps * DT_S);
    let told: f64 = stretch.windows(2).map(|pair| 0.5 * (pair[0][1][axis] + pair[1][1][axis])).sum();
    [moved, told / steps]
}

/// Holds the turning of the vehicle against what it was told: to the left is positive in either.
#[derive(Default)]
pub(crate) struct TurnCheck {
    steps: usize,
    /// Sums of command times yaw rate, and of the squares of either.
    products: [f64; 3],
}

impl TurnCheck {
    /// A command, and what was measured at the end of its step.
    pub(crate) fn add(&mut self, command: Control<f64>, measured: &[f64; 12]) {
        let (speed_m_s, sideways_m_s, rate_rad_s) = (measured[6], measured[7], measured[11]);
        if speed_m_s < TURNING_ABOVE_M_S || sideways_m_s.abs() > SLIDES * speed_m_s {
            return;
        }
        self.steps += 1;
        let products = [command.second * rate_rad_s, command.second.powi(2), rate_rad_s.powi(2)];
        self.products.iter_mut().zip(products).for_each(|(sum, product)| *sum += product);
    }

    /// Correlation about zero, -1 to 1; `None` where the vehicle hardly turned.
    pub(crate) fn correlation(&self) -> Option<f64> {
        let [both, commands, rates] = self.products;
        let turned = self.steps >= TURNING_STEPS_MIN && (rates / self.steps as f64).sqrt() >= TURNING_MIN_RAD_S;
        (turned && commands > 0.0).then(|| both / (commands * rates).sqrt())
    }
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
        assert_eq!(world.moved_over_told(), None, "no factor turns a frame");
        let (body, world) = (body.mismatch_m_s().unwrap(), world.mismatch_m_s().unwrap());
        assert!(body < 1e-4 && world > 1.0, "{body} {world}");
    }

    /// Goal: a plant whose step takes another time than 0.1 s is told from one whose velocities are in another frame. Method: the same circle in steps of 0.05 s,
    /// 0.09 s and 0.2 s; with steps of 0.1 s and a position that jumps by 5 cm, no factor is seen.
    #[test]
    fn regress_a_step_of_another_length_is_a_factor() {
        let (speed_m_s, rate_rad_s) = (2.0, 0.2);
        let circle = |step_s: f64, jump_m: f64| {
            let mut check = VelocityCheck::default();
            for k in 0..300 {
                let (yaw, jump_m) = (rate_rad_s * step_s * f64::from(k), if k % 2 == 0 { jump_m } else { -jump_m });
                let at = [speed_m_s / rate_rad_s * yaw.sin() + jump_m * f64::from(k % 3), -speed_m_s / rate_rad_s * yaw.cos()];
                check.add(&[at[0], at[1], 0.6, 0.0, 0.0, yaw, speed_m_s, 0.0, 0.0, 0.0, 0.0, rate_rad_s]);
            }
            check.moved_over_told()
        };
        for step_s in [0.05, 0.09, 0.2] {
            let factor = circle(step_s, 0.0).unwrap();
            // The chord of a second is shorter than its arc by 0.2 % at most.
            assert!((factor / (step_s / DT_S) - 1.0).abs() < 0.005, "{step_s}: {factor}");
        }
        assert_eq!(circle(DT_S, 0.05), None);
        assert_eq!(VelocityCheck::default().moved_over_told(), None);
        let mut standing = VelocityCheck::default();
        (0..30).for_each(|_| standing.add(&[0.0; 12]));
        assert_eq!(standing.moved_over_told(), None, "nothing moves and nothing is told to");
    }

    /// Goal: a vehicle that turns right where it is told to turn left is seen, one that answers late, slides or stands is not. Method: commands of a sinusoid, yaw
    /// rates that follow them 0.3 s later, with either sign, without any, at little speed and sliding down a slope.
    #[test]
    fn regress_reversed_steering_is_seen() {
        let sliding = |gain: f64, speed_m_s: f64, sideways_m_s: f64, steps: u32| {
            let command = |k: u32| 0.3 + 0.4 * (0.1 * f64::from(k)).sin();
            let mut check = TurnCheck::default();
            for k in 3..3 + steps {
                let mut measured = [0.0; 12];
                (measured[6], measured[7], measured[11]) = (speed_m_s, sideways_m_s, gain * command(k - 3));
                check.add(Control { speed_m_s, second: command(k) }, &measured);
            }
            check.correlation()
        };
        let driven = |gain: f64, speed_m_s: f64, steps: u32| sliding(gain, speed_m_s, 0.15 * speed_m_s, steps);
        assert_eq!(sliding(-0.3, 3.0, -1.0, 40), None);
        assert!(driven(0.3, 3.0, 40).is_some_and(|r| r > 0.8));
        assert!(driven(-0.3, 3.0, 40).is_some_and(|r| r < -0.8));
        assert_eq!([driven(0.0, 3.0, 40), driven(-0.3, 0.9, 40), driven(-0.3, 3.0, 14)], [None; 3]);
    }
}
