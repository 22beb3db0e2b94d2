//! Numbers of a card that a calibration left at an end of what it tries: there the drives chose the end and not the number.

use core::fmt;

use nesam_physics::{SecondCommand, Vehicle};

use crate::{calibrate, rims, suspension};

/// A number at an end of its range, or beyond it where the card has it there.
#[derive(Clone, Debug, PartialEq)]
pub struct AtEnd {
    /// Its key in the card.
    pub name: String,
    /// Its unit; empty for a plain number.
    pub unit: &'static str,
    /// Where it ended.
    pub value: f64,
    /// Least and most that is tried.
    pub range: [f64; 2],
}

/// All numbers of a card that was fitted, from what it was before, that lie at an end of their range. What a fit did not take up, such as a dead time where the motion
/// asks for none, is none of them.
pub fn at_ends(card: &Vehicle, fitted: &Vehicle) -> Vec<AtEnd> {
    let driveline = if card.second == SecondCommand::YawRateRadS {
        rims::at_ends(&card.driveline.rims, &fitted.driveline.rims)
    } else {
        calibrate::at_ends(fitted)
    };
    driveline.into_iter().chain(suspension::at_ends(card, fitted)).collect()
}

impl AtEnd {
    /// The number if it lies at an end of a range that leaves a choice.
    pub(crate) fn of(name: impl Into<String>, unit: &'static str, value: f64, range: [f64; 2]) -> Option<Self> {
        (range[0] < range[1] && (value <= range[0] || value >= range[1])).then(|| Self { name: name.into(), unit, value, range })
    }
}

impl fmt::Display for AtEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, unit, value, range: [low, high] } = self;
        let beyond = if value >= high {
            "it may be more"
        } else if *low == 0.0 {
            "there may be none of it"
        } else {
            "it may be less"
        };
        let [value, low, high] = [*value, *low, *high].map(short);
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        write!(
            f,
            "{name} ends at {value}{unit}, an end of its range of {low} to {high}{unit}: {beyond}, the data do not tell it, or the card is wrong about something else"
        )
    }
}

/// To four digits behind the point, and none from a thousand on.
fn short(value: f64) -> f64 {
    let digits = if value.abs() < 1e3 { 1e4 } else { 1.0 };
    (value * digits).round() / digits
}

#[cfg(test)]
mod tests {
    use nesam_physics::RimServo;
    use nesam_test_vehicles::{robot, truck};

    use super::*;

    fn names(card: &Vehicle, fitted: &Vehicle) -> Vec<String> {
        at_ends(card, fitted).into_iter().map(|end| end.name).collect()
    }

    /// Goal: only what was fitted and lies at an end is told, and on which side. Method: cards by hand, of a car and of a skid-steer base.
    #[test]
    fn analytic_what_lies_at_an_end_is_named_with_its_unit_and_range() {
        let card = truck();
        let mut fitted = card.clone();
        (fitted.driveline.torque, fitted.driveline.overspeed_limit_m_s, fitted.driveline.speed_gain) = (None, 1.5, 0.25);
        (fitted.driveline.steering_lag_s, fitted.driveline.speed_integral_gain_per_s) = (0.1, 0.05);
        assert_eq!(at_ends(&card, &fitted), []);
        (fitted.driveline.overspeed_limit_m_s, fitted.driveline.steering_lag_s) = (3.0, 0.0);
        fitted.suspension_n_m[2..].iter_mut().for_each(|rate| *rate *= 3.0);
        let told: Vec<String> = at_ends(&card, &fitted).iter().map(ToString::to_string).collect();
        let most = "driveline.overspeed_limit_m_s ends at 3 m/s, an end of its range of 0.05 to 3 m/s: it may be more, the data do not tell it, or ";
        assert!(told.len() == 3 && told[0].starts_with(most), "{told:#?}");
        assert!(told[1].starts_with("driveline.steering_lag_s ends at 0 s, an end of its range of 0 to 0.5 s: there may be none of it"));
        assert!(told[2].starts_with("suspension_n_m of the rear axle ends at") && told[2].contains("N/m: it may be more"), "{}", told[2]);

        let base = Vehicle { second: SecondCommand::YawRateRadS, ..robot() };
        let mut servo = base.clone();
        assert_eq!(names(&base, &servo), [""; 0], "nothing was fitted");
        let found = RimServo { speed_gain: 5.0, speed_lag_s: 0.01, yaw_limit_rad_s: 2.0, rim_limit_m_s: 1.0, ..RimServo::default() };
        servo.driveline.rims = found;
        let ends = ["driveline.rims.speed_gain", "driveline.rims.speed_lag_s"];
        assert_eq!(names(&base, &servo), ends, "no dead time and no ramp are no ends");
        servo.driveline.rims = RimServo { dead_time_s: [0.0, 0.6], acceleration_limit: [0.05, RimServo::NO_LIMIT], ..found };
        assert_eq!(names(&base, &servo)[2..], ["driveline.rims.dead_time_s[1]", "driveline.rims.acceleration_limit[0]"]);
    }
}
