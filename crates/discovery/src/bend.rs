//! Whether an actuator follows its command along a straight line: a steering that turns further to one side, or a rim whose servo is deaf to slow commands, is an offset with
//! another ratio on average and is neither.
//!
//! Each channel of an actuator has columns for parts of its deviations that bend with the command: with the size of the second command (to either side), with its cube (an
//! S about the middle, as of a dead band), or with the square of the commanded speed; each less what a constant and a straight line in the command make of it on the same
//! drive. Offsets, ratios and gains leave nothing there, whatever their size; how much drives without an effect bend is measured like everything else.

use serde::Serialize;

use crate::channels::{PATH_AT, RIM_AT, STEERING_AT, name};

/// The mean commands of a segment: speed, m/s, and the second command in its unit.
pub type Commands = [f64; 2];

/// How a channel goes with its command beside a straight line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// With the size of the second command.
    Side,
    /// With the square of the commanded speed.
    Square,
    /// With the cube of the second command.
    Curve,
}

/// A way in which an actuator may bend.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bend {
    /// The channel.
    pub channel: usize,
    /// How it bends.
    pub shape: Shape,
}

/// Number of bends that are asked for.
pub const BENDS: usize = PATH_AT - STEERING_AT + (RIM_AT - STEERING_AT);

/// All bends: one of each channel of an actuator, then the curve of each of the steering.
pub fn all() -> [Bend; BENDS] {
    let first = PATH_AT - STEERING_AT;
    core::array::from_fn(|i| match STEERING_AT + i {
        channel if channel < RIM_AT => Bend { channel, shape: Shape::Side },
        channel if channel < PATH_AT => Bend { channel, shape: Shape::Square },
        _ => Bend { channel: STEERING_AT + i - first, shape: Shape::Curve },
    })
}

/// Those of some channels.
pub fn asked_of(channels: &[usize]) -> Vec<Bend> {
    all().into_iter().filter(|bend| channels.contains(&bend.channel)).collect()
}

impl Bend {
    /// Its place among all.
    pub fn place(&self) -> usize {
        all().iter().position(|bend| bend == self).expect("every bend is one of all; this is a bug")
    }

    /// What it is called.
    pub fn name(&self) -> String {
        let what = if self.shape == Shape::Curve { "curve" } else { "bend" };
        format!("{what} of {}", name(self.channel))
    }

    /// How far its channel would be off in each segment of a drive if it bent by one, in units of the command (square, cube). Nothing where the commands hardly vary.
    pub fn over(&self, commands: &[Commands]) -> Vec<f64> {
        let of = |[speed, second]: &Commands| match self.shape {
            Shape::Side => (*second, second.abs()),
            Shape::Curve => (*second, second.powi(3)),
            Shape::Square => (*speed, speed * speed),
        };
        let (command, bent): (Vec<f64>, Vec<f64>) = commands.iter().map(of).unzip();
        let centred = |values: &[f64]| {
            let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
            values.iter().map(|v| v - mean).collect::<Vec<f64>>()
        };
        let (command, bent) = (centred(&command), centred(&bent));
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let slope = product(&command, &bent) / product(&command, &command).max(f64::MIN_POSITIVE);
        bent.iter().zip(&command).map(|(bent, command)| bent - slope * command).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: offsets and ratios bend nothing, and what bends is seen with its size. Method: commands to both sides in 20 segments; deviations that are constant, in
    /// proportion, larger to the left, and with a cube.
    #[test]
    fn analytic_a_straight_line_bends_nothing() {
        let commands: Vec<Commands> = (0..20).map(|k| [2.0 + (k as f64).cos(), (0.7 * k as f64).sin()]).collect();
        for bend in all() {
            let over = bend.over(&commands);
            let of = usize::from(bend.shape != Shape::Square);
            let size = |deviation: &dyn Fn(f64) -> f64| {
                let product: f64 = over.iter().zip(&commands).map(|(s, c)| s * deviation(c[of])).sum();
                product / over.iter().map(|s| s * s).sum::<f64>()
            };
            assert!(size(&|_| 0.3).abs() < 1e-12 && size(&|command| 0.5 * command).abs() < 1e-12);
            let bent = match bend.shape {
                Shape::Side => size(&|second| 0.12 * second.max(0.0)),
                Shape::Square => size(&|speed| 0.06 * speed * speed - speed),
                Shape::Curve => size(&|second| 0.06 * second.powi(3) + second),
            };
            assert!((bent - 0.06).abs() < 1e-12, "{bend:?} {bent}");
        }
    }

    #[test]
    fn analytic_each_bend_has_its_place() {
        assert!(all().iter().enumerate().all(|(i, bend)| bend.place() == i));
        assert_eq!(asked_of(&[STEERING_AT, PATH_AT]).iter().map(|b| b.shape).collect::<Vec<_>>(), [Shape::Side, Shape::Curve]);
    }

    #[test]
    fn analytic_commands_that_do_not_vary_ask_nothing() {
        for bend in all() {
            let over = bend.over(&[[2.0, if bend.shape == Shape::Square { 0.1 } else { 0.0 }]; 5]);
            assert!(over.iter().all(|s| s.abs() < 1e-12), "{bend:?}");
            assert!(bend.over(&[]).is_empty());
        }
    }
}
