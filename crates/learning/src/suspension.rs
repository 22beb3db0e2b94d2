//! Calibration of the suspension on measured drives, with the symbolic model alone.
//!
//! A data sheet gives springs and dampers at the shock and at best a word on what the wheel sees of them. How a body leans over ground that is mapped
//! tells it: rates and dampings of both axles are fitted to roll and pitch.

use nesam_model::Normalization;
use nesam_physics::{Vehicle, WHEELS};

use crate::drives::Drive;
use crate::symbolic::symbolic_error;

/// What is fitted: wheels of an axle share one number.
const NUMBERS: [(&str, fn(&mut Vehicle) -> &mut [f64; WHEELS], [usize; 2]); 4] = [
    ("rate, front", |v| &mut v.suspension_n_m, [0, 1]),
    ("rate, rear", |v| &mut v.suspension_n_m, [2, 3]),
    ("damping, front", |v| &mut v.suspension_n_s_m, [0, 1]),
    ("damping, rear", |v| &mut v.suspension_n_s_m, [2, 3]),
];
/// How often each number has its turn, and shares by which it is changed then: halved until nothing is better.
const FIRST_REACH: [f64; 3] = [0.5, 0.2, 0.1];
/// Smallest share.
const LAST_REACH: f64 = 0.02;
/// A number may be this much larger or smaller than the card has it.
const MOST: f64 = 3.0;

/// Steps of progress of a calibration.
pub const TURNS: usize = NUMBERS.len() * FIRST_REACH.len();

/// Fits rates and dampings to the roll and pitch of drives over a map, and returns the error before and after, rad. Drives without a map tell nothing of
/// what tilts a body: without any the vehicle stays as it is.
pub fn calibrate_suspension(
    vehicle: &mut Vehicle,
    drives: &[&Drive],
    scales: &Normalization,
    mut progress: impl FnMut(&str, f64, f64),
) -> [f64; 2] {
    let mapped: Vec<&Drive> = drives.iter().copied().filter(|drive| drive.map.is_some()).collect();
    let before = symbolic_error(vehicle, &mapped, scales).tilt_rad;
    let (card, mut best) = (vehicle.clone(), before);
    if mapped.is_empty() {
        return [before, best];
    }
    for first_reach in FIRST_REACH {
        for (name, number, wheels) in NUMBERS {
            let mut reach = first_reach;
            while reach > LAST_REACH {
                let mut improved = false;
                for factor in [1.0 + reach, 1.0 / (1.0 + reach)] {
                    let mut candidate = vehicle.clone();
                    for wheel in wheels {
                        let at_first = number(&mut card.clone())[wheel];
                        let trial = number(&mut candidate)[wheel] * factor;
                        number(&mut candidate)[wheel] = trial.clamp(at_first / MOST, at_first * MOST);
                    }
                    let error = symbolic_error(&candidate, &mapped, scales).tilt_rad;
                    if error < best {
                        best = error;
                        *vehicle = candidate;
                        improved = true;
                    }
                }
                if !improved {
                    reach *= 0.5;
                }
            }
            progress(name, number(vehicle)[wheels[0]], best);
        }
    }
    [before, best]
}
