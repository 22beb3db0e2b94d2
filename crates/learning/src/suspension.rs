//! Calibration of the suspension on measured drives, with the symbolic model alone.
//!
//! A data sheet gives springs and dampers at the shock and at best a word on what the wheel sees of them. How a body leans over ground that is mapped
//! tells it: rates and dampings of both axles are fitted to roll and pitch.

use nesam_model::Normalization;
use nesam_physics::{Vehicle, WHEELS};

use crate::at_end::AtEnd;
use crate::drives::Drive;
use crate::symbolic::{descend, symbolic_error};

/// What is fitted: wheels of an axle share one number.
const NUMBERS: [(&str, fn(&mut Vehicle) -> &mut [f64; WHEELS], [usize; 2]); 4] = [
    ("rate, front", |v| &mut v.suspension_n_m, [0, 1]),
    ("rate, rear", |v| &mut v.suspension_n_m, [2, 3]),
    ("damping, front", |v| &mut v.suspension_n_s_m, [0, 1]),
    ("damping, rear", |v| &mut v.suspension_n_s_m, [2, 3]),
];
/// How often each number has its turn, and the share by which it is first changed then.
const FIRST_REACH: [f64; 3] = [0.5, 0.2, 0.1];
/// A number may be this much larger or smaller than the card has it.
const MOST: f64 = 3.0;

/// Numbers of a fitted suspension that lie at an end of their range about those of the card.
pub(crate) fn at_ends(card: &Vehicle, fitted: &Vehicle) -> Vec<AtEnd> {
    let (mut card, mut fitted) = (card.clone(), fitted.clone());
    let end = |(name, number, [wheel, _]): (&str, fn(&mut Vehicle) -> &mut [f64; WHEELS], [usize; 2])| {
        let (of_card, value) = (number(&mut card)[wheel], number(&mut fitted)[wheel]);
        let (key, unit) = if name.starts_with("rate") { ("suspension_n_m", "N/m") } else { ("suspension_n_s_m", "N s/m") };
        let axle = if wheel < 2 { "front" } else { "rear" };
        AtEnd::of(format!("{key} of the {axle} axle"), unit, value, range(of_card))
    };
    NUMBERS.into_iter().filter_map(end).collect()
}

/// Least and most that is tried of a number.
fn range(of_card: f64) -> [f64; 2] {
    [of_card / MOST, of_card * MOST]
}

/// Steps of progress of a calibration.
pub const TURNS: usize = NUMBERS.len() * FIRST_REACH.len();

/// Fits rates and dampings to the roll and pitch of drives over a map, and returns the error before and after, rad. Drives without a map tell nothing of
/// what tilts a body: without any the vehicle stays as it is. Where it is interrupted, which is asked before each number, the vehicle is as fitted by then.
pub fn calibrate_suspension(
    vehicle: &mut Vehicle,
    drives: &[&Drive],
    scales: &Normalization,
    mut progress: impl FnMut(&str, f64, f64),
    interrupted: &dyn Fn() -> bool,
) -> [f64; 2] {
    let mapped: Vec<&Drive> = drives.iter().copied().filter(|drive| drive.map.is_some()).collect();
    let before = symbolic_error(vehicle, &mapped, scales).tilt_rad;
    let (mut card, mut best) = (vehicle.clone(), before);
    if mapped.is_empty() {
        return [before, best];
    }
    for reach in FIRST_REACH {
        for (name, number, wheels) in NUMBERS {
            if interrupted() {
                return [before, best];
            }
            let of_card = *number(&mut card);
            let trials = |vehicle: &Vehicle, reach: f64| {
                [1.0 + reach, 1.0 / (1.0 + reach)].map(|factor| {
                    let mut trial = vehicle.clone();
                    for wheel in wheels {
                        let value = &mut number(&mut trial)[wheel];
                        let [low, high] = range(of_card[wheel]);
                        *value = (*value * factor).clamp(low, high);
                    }
                    trial
                })
            };
            best = descend(vehicle, best, reach, trials, |trial| symbolic_error(trial, &mapped, scales).tilt_rad);
            progress(name, number(vehicle)[wheels[0]], best);
        }
    }
    [before, best]
}
