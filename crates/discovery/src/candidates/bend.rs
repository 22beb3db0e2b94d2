//! Whether actuators follow their commands, and sensors what they measure, along a straight line: a steering that turns further to one side, a rim whose servo is deaf to
//! slow commands, or a gyro that reads more in left turns is an offset with another ratio on average and is neither.
//!
//! Each channel of an actuator has columns for parts of its deviations that bend with the command: with the size of the second command (to either side), with its cube (an
//! S about the middle, as of a dead band), or with the square of the commanded speed; each less what a constant and a straight line in the command make of it on the same
//! drive. What compares measurements with one another has such columns too: the turn against the gyro bends with the turning to either side, with its cube and with the
//! speed, the path against the velocity with the square of the speed and by what is there at any speed. Offsets, ratios, gains, biases and scales leave nothing there,
//! whatever their size; how much drives without an effect bend is measured like everything else.

use serde::Serialize;

use crate::observe::channels::{PATH_AT, RIM_AT, STEERING_AT, TURN_AT, name};

/// What a vehicle was commanded and did over a segment, in the mean.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Driven {
    /// Commanded speed, m/s.
    pub commanded_m_s: f64,
    /// Second command, in its unit.
    pub second: f64,
    /// Measured forward velocity, m/s.
    pub forward_m_s: f64,
    /// Measured yaw rate, rad/s.
    pub yaw_rate_rad_s: f64,
}

impl Driven {
    /// The four numbers, in the order of the fields.
    pub fn to_array(self) -> [f64; 4] {
        [self.commanded_m_s, self.second, self.forward_m_s, self.yaw_rate_rad_s]
    }

    /// The reverse of [`Driven::to_array`].
    pub fn from_array([commanded_m_s, second, forward_m_s, yaw_rate_rad_s]: [f64; 4]) -> Self {
        Self { commanded_m_s, second, forward_m_s, yaw_rate_rad_s }
    }
}

/// How a channel goes beside a straight line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// With the size of the second command, or of the turning.
    Side,
    /// With the square of the speed.
    Square,
    /// With the cube of the second command, or of the turning.
    Curve,
    /// With the speed, where it should go with the turning.
    Speed,
    /// By a constant, where it should go with the speed alone.
    Offset,
}

/// A way in which a channel may bend.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bend {
    /// The channel.
    pub channel: usize,
    /// How it bends.
    pub shape: Shape,
}

/// The turn against the gyro about the vertical.
const GYRO: usize = TURN_AT + 2;

/// All bends: of the steering to either side, of the rims, of the steering as a curve, of the gyro, of the velocity ahead.
pub const ALL: [Bend; 2 * (RIM_AT - STEERING_AT) + (PATH_AT - RIM_AT) + 5] = {
    let mut all = [Bend { channel: STEERING_AT, shape: Shape::Side }; 2 * (RIM_AT - STEERING_AT) + (PATH_AT - RIM_AT) + 5];
    let (mut i, mut channel) = (0, STEERING_AT);
    while channel < PATH_AT {
        all[i] = Bend { channel, shape: if channel < RIM_AT { Shape::Side } else { Shape::Square } };
        (i, channel) = (i + 1, channel + 1);
    }
    channel = STEERING_AT;
    while channel < RIM_AT {
        all[i] = Bend { channel, shape: Shape::Curve };
        (i, channel) = (i + 1, channel + 1);
    }
    all[i] = Bend { channel: GYRO, shape: Shape::Side };
    all[i + 1] = Bend { channel: GYRO, shape: Shape::Curve };
    all[i + 2] = Bend { channel: GYRO, shape: Shape::Speed };
    all[i + 3] = Bend { channel: PATH_AT, shape: Shape::Square };
    all[i + 4] = Bend { channel: PATH_AT, shape: Shape::Offset };
    all
};

/// Those of some channels.
pub fn asked_of(channels: &[usize]) -> Vec<Bend> {
    ALL.into_iter().filter(|bend| channels.contains(&bend.channel)).collect()
}

impl Bend {
    /// Its place among all.
    pub fn place(&self) -> usize {
        ALL.iter().position(|bend| bend == self).expect("every bend is one of all; this is a bug")
    }

    /// What it is called.
    pub fn name(&self) -> String {
        let what = match self.shape {
            Shape::Side | Shape::Square => "bend",
            Shape::Curve => "curve",
            Shape::Speed => "part that goes with the speed",
            Shape::Offset => "part that is there at any speed",
        };
        format!("{what} of {}", name(self.channel))
    }

    /// How far its channel would be off in each segment of a drive if it bent by one, in units of what it bends with (square, cube). Nothing where that hardly varies.
    pub fn over(&self, driven: &[Driven]) -> Vec<f64> {
        let turning = |d: &Driven| if self.channel == GYRO { d.yaw_rate_rad_s } else { d.second };
        let speed = |d: &Driven| if self.channel == PATH_AT { d.forward_m_s } else { d.commanded_m_s };
        // What it bends with, and what a straight line would make of it beside a constant.
        let of = |d: &Driven| match self.shape {
            Shape::Side => (turning(d), turning(d).abs()),
            Shape::Curve => (turning(d), turning(d).powi(3)),
            Shape::Square => (speed(d), speed(d).powi(2)),
            Shape::Speed => (turning(d), d.forward_m_s),
            Shape::Offset => (speed(d), 1.0),
        };
        let (line, bent): (Vec<f64>, Vec<f64>) = driven.iter().map(of).unzip();
        let centred = |values: Vec<f64>| {
            let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
            values.iter().map(|v| v - mean).collect::<Vec<f64>>()
        };
        // A velocity that is measured in proportion has no constant of its own.
        let (line, bent) = if self.shape == Shape::Offset { (line, bent) } else { (centred(line), centred(bent)) };
        let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let slope = product(&line, &bent) / product(&line, &line).max(f64::MIN_POSITIVE);
        bent.iter().zip(&line).map(|(bent, line)| bent - slope * line).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: what goes along a straight line bends nothing, and what bends is seen with its size. Method: commands and turns to both sides in 20 segments; deviations
    /// that are constant, in proportion, larger to the left, with a square or a cube, with the speed, and constant beside a proportion.
    #[test]
    fn analytic_a_straight_line_bends_nothing() {
        let driven: Vec<Driven> = (0..20)
            .map(|k| {
                let phase = k as f64;
                Driven {
                    commanded_m_s: 2.0 + phase.cos(),
                    second: (0.7 * phase).sin(),
                    forward_m_s: 1.8 + (1.1 * phase).cos(),
                    yaw_rate_rad_s: 0.4 * (0.6 * phase).sin(),
                }
            })
            .collect();
        for bend in ALL {
            let over = bend.over(&driven);
            let size = |deviation: &dyn Fn(&Driven) -> f64| {
                let product: f64 = over.iter().zip(&driven).map(|(s, d)| s * deviation(d)).sum();
                product / over.iter().map(|s| s * s).sum::<f64>()
            };
            let turning = |d: &Driven| if bend.channel == GYRO { d.yaw_rate_rad_s } else { d.second };
            let speed = |d: &Driven| if bend.channel == PATH_AT { d.forward_m_s } else { d.commanded_m_s };
            let straight: &dyn Fn(&Driven) -> f64 = match bend.shape {
                Shape::Side | Shape::Curve | Shape::Speed => &|d| 0.3 + 0.5 * turning(d),
                Shape::Square => &|d| 0.3 + 0.5 * speed(d),
                Shape::Offset => &|d| 0.5 * speed(d),
            };
            assert!(size(straight).abs() < 1e-12, "{bend:?}");
            let bent = match bend.shape {
                Shape::Side => size(&|d| 0.12 * turning(d).max(0.0)),
                Shape::Square => size(&|d| 0.06 * speed(d).powi(2) - speed(d)),
                Shape::Curve => size(&|d| 0.06 * turning(d).powi(3) + turning(d)),
                Shape::Speed => size(&|d| 0.06 * d.forward_m_s - 0.2 * turning(d) + 1.0),
                Shape::Offset => size(&|d| 0.06 + 0.2 * speed(d)),
            };
            assert!((bent - 0.06).abs() < 1e-12, "{bend:?} {bent}");
        }
    }

    #[test]
    fn analytic_each_bend_has_its_place() {
        assert!(ALL.iter().enumerate().all(|(i, bend)| bend.place() == i));
        let shapes = |channels: &[usize]| asked_of(channels).iter().map(|b| b.shape).collect::<Vec<_>>();
        assert_eq!(shapes(&[STEERING_AT, PATH_AT + 1]), [Shape::Side, Shape::Curve]);
        assert_eq!(shapes(&[GYRO]), [Shape::Side, Shape::Curve, Shape::Speed]);
        assert_eq!(shapes(&[PATH_AT]), [Shape::Square, Shape::Offset]);
    }

    #[test]
    fn analytic_what_does_not_vary_asks_nothing() {
        let steady = Driven { commanded_m_s: 2.0, second: 0.1, forward_m_s: 1.9, yaw_rate_rad_s: 0.2 };
        for bend in ALL {
            let over = bend.over(&[steady; 5]);
            assert!(over.iter().all(|s| s.abs() < 1e-12), "{bend:?}");
            assert!(bend.over(&[]).is_empty());
        }
        assert_eq!(Driven::from_array(steady.to_array()), steady);
    }
}
