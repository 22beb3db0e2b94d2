//! Whether an actuator follows its command along a straight line: a steering that turns further to one side, or a rim whose servo is deaf to slow commands, is an offset with
//! another ratio on average and is neither.
//!
//! Each actuator channel has a column for the part of its deviations that bends with the command: it goes with the size of the second command (to either side) or with the
//! square of the commanded speed, less what a constant and a straight line in the command make of that on the same drive. Offsets, ratios and gains leave nothing there,
//! whatever their size; how much drives without an effect bend is measured like everything else.

use std::ops::Range;

use crate::channels::{PATH_AT, RIM_AT, STEERING_AT};

/// Channels of actuators, of which it is asked.
pub const ASKED: Range<usize> = STEERING_AT..PATH_AT;

/// The mean commands of a segment: speed, m/s, and the second command in its unit.
pub type Commands = [f64; 2];

/// Those of some channels of which it is asked.
pub fn asked_of(channels: &[usize]) -> Vec<usize> {
    channels.iter().copied().filter(|channel| ASKED.contains(channel)).collect()
}

/// How far an actuator channel would be off in each segment of a drive if it bent by one, in units of the command (speed: its square). Nothing where the commands hardly vary.
pub fn shape(commands: &[Commands], channel: usize) -> Vec<f64> {
    let (command, bent): (Vec<f64>, Vec<f64>) = match channel {
        c if c < RIM_AT => commands.iter().map(|[_, second]| (*second, second.abs())).unzip(),
        _ => commands.iter().map(|[speed, _]| (*speed, speed * speed)).unzip(),
    };
    let centred = |values: &[f64]| {
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        values.iter().map(|v| v - mean).collect::<Vec<f64>>()
    };
    let (command, bent) = (centred(&command), centred(&bent));
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let slope = product(&command, &bent) / product(&command, &command).max(f64::MIN_POSITIVE);
    bent.iter().zip(&command).map(|(bent, command)| bent - slope * command).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: offsets and ratios bend nothing, and what bends is seen with its size. Method: commands to both sides in 20 segments; deviations that are constant, in
    /// proportion, and larger to the left.
    #[test]
    fn analytic_a_straight_line_bends_nothing() {
        let commands: Vec<Commands> = (0..20).map(|k| [2.0 + (k as f64).cos(), (0.7 * k as f64).sin()]).collect();
        for (channel, of) in [(STEERING_AT, 1), (RIM_AT + 2, 0)] {
            let shape = shape(&commands, channel);
            let size = |deviation: &dyn Fn(f64) -> f64| {
                let product: f64 = shape.iter().zip(&commands).map(|(s, c)| s * deviation(c[of])).sum();
                product / shape.iter().map(|s| s * s).sum::<f64>()
            };
            assert!(size(&|_| 0.3).abs() < 1e-12 && size(&|command| 0.5 * command).abs() < 1e-12);
            let bent = if of == 1 { size(&|second| 0.12 * second.max(0.0)) } else { size(&|speed| 0.06 * speed * speed - speed) };
            assert!((bent - 0.06).abs() < 1e-12, "{bent}");
        }
    }

    #[test]
    fn analytic_commands_that_do_not_vary_ask_nothing() {
        assert!(shape(&[[2.0, 0.0]; 5], STEERING_AT).iter().all(|s| *s == 0.0));
        assert!(shape(&[[2.0, 0.1]; 5], RIM_AT).iter().all(|s| s.abs() < 1e-12));
        assert!(shape(&[], RIM_AT).is_empty());
    }
}
