//! What may be wrong with the vehicle and is told to nobody.

use crate::error::PlantError;

/// Hidden effects; zero (or false) = absent. Ids and parameters are those of the product's catalogue.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct HiddenEffects {
    /// Mass of a load, kg.
    pub payload_kg: f64,
    /// Its place, Body, relative to the reference point, m.
    pub payload_at_m: [f64; 3],
    /// Friction torque on one wheel, N m.
    pub wheel_drag_n_m: f64,
    /// Which wheel: 0 FL, 1 FR, 2 RL, 3 RR.
    pub wheel_drag_wheel: usize,
    /// Added to the position of the steering in the linkage, behind its stops, normalised, as in the Chrono car of the open set `steer_offset`.
    pub steering_offset: f64,
    /// Relative change of the road-wheel angles.
    pub steering_ratio: f64,
    /// Added to the time constant of the steering actuator, s.
    pub steering_lag_s: f64,
    /// Dead time of the steering command, s.
    pub steering_delay_s: f64,
    /// Dead time of the speed command, s.
    pub speed_delay_s: f64,
    /// Relative change of the speed that the controller aims at.
    pub speed_gain: f64,
    /// Rearward force at the reference point, N.
    pub tow_n: f64,
    /// Resistance against the forward speed, N s/m.
    pub linear_drag_n_s_m: f64,
    /// Resistance against the square of the forward speed, N s^2/m^2.
    pub quadratic_drag_n_s2_m2: f64,
    /// Force of wind, World x and y, N.
    pub wind_n: [f64; 2],
    /// Rolling resistance over weight.
    pub rolling_resistance: f64,
    /// Relative change of the radius of all tyres.
    pub tyre_radius: f64,
    /// The same of the front tyres, in addition.
    pub tyre_radius_front: f64,
    /// The same of the rear tyres, in addition.
    pub tyre_radius_rear: f64,
    /// Share of the engine's torque that is missing.
    pub torque_limit: f64,
    /// Added to the measured yaw rate, rad/s.
    pub gyro_bias_rad_s: f64,
    /// Relative change of the measured angular velocity.
    pub gyro_scale: f64,
    /// Relative change of the measured linear velocity.
    pub velocity_scale: f64,
    /// Added to the measured height, m.
    pub map_offset_m: f64,
    /// Age of the measured position, s.
    pub position_latency_s: f64,
}

/// One effect: its id, which number of [`HiddenEffects`] its magnitude sets, and the range admitted.
pub struct Entry {
    /// Id in the catalogue.
    pub id: &'static str,
    /// Magnitudes admitted.
    pub range: [f64; 2],
    set: fn(&mut HiddenEffects, f64),
}

macro_rules! entry {
    ($id:literal, $low:literal, $high:literal, $field:ident $([$at:literal])?) => {
        Entry { id: $id, range: [$low, $high], set: |effects, value| effects.$field $([$at])? = value }
    };
}

/// Every effect that the plant knows, by id.
pub const EFFECTS: [Entry; 23] = [
    entry!("payload", 0.0, 1500.0, payload_kg),
    entry!("wheel_drag", 0.0, 3000.0, wheel_drag_n_m),
    entry!("steering_offset", -0.5, 0.5, steering_offset),
    entry!("steering_ratio", -0.5, 0.5, steering_ratio),
    entry!("steering_lag", 0.0, 1.0, steering_lag_s),
    entry!("steering_delay", 0.0, 1.0, steering_delay_s),
    entry!("speed_delay", 0.0, 1.0, speed_delay_s),
    entry!("speed_gain", -0.5, 0.5, speed_gain),
    entry!("tow", 0.0, 5000.0, tow_n),
    entry!("linear_drag", 0.0, 2000.0, linear_drag_n_s_m),
    entry!("quadratic_drag", 0.0, 500.0, quadratic_drag_n_s2_m2),
    entry!("wind_x", -5000.0, 5000.0, wind_n[0]),
    entry!("wind_y", -5000.0, 5000.0, wind_n[1]),
    entry!("rolling_resistance", 0.0, 0.2, rolling_resistance),
    entry!("tyre_radius", -0.2, 0.2, tyre_radius),
    entry!("tyre_radius_front", -0.2, 0.2, tyre_radius_front),
    entry!("tyre_radius_rear", -0.2, 0.2, tyre_radius_rear),
    entry!("torque_limit", 0.0, 0.95, torque_limit),
    entry!("gyro_bias", -0.2, 0.2, gyro_bias_rad_s),
    entry!("gyro_scale", -0.5, 0.5, gyro_scale),
    entry!("velocity_scale", -0.5, 0.5, velocity_scale),
    entry!("map_offset", -0.5, 0.5, map_offset_m),
    entry!("position_latency", 0.0, 1.0, position_latency_s),
];

/// Where a payload sits unless told otherwise (1.4 m behind and 0.77 m above the reference point), and which wheel drags.
const PAYLOAD_AT_M: [f64; 3] = [-1.4, 0.0, 0.77];
const DRAGGING_WHEEL: usize = 3;

impl HiddenEffects {
    /// Reads `id=magnitude` pairs.
    ///
    /// # Errors
    /// `PlantError::Effect` naming what was given and what is allowed.
    pub fn parse<'a>(given: impl IntoIterator<Item = &'a str>) -> Result<Self, PlantError> {
        let mut effects = Self { payload_at_m: PAYLOAD_AT_M, wheel_drag_wheel: DRAGGING_WHEEL, ..Self::default() };
        for text in given {
            let wrong = |reason: String| PlantError::Effect { given: text.into(), reason };
            let (id, value) = text.split_once('=').ok_or_else(|| wrong("write it as id=magnitude".into()))?;
            let known = || EFFECTS.iter().map(|e| e.id).collect::<Vec<_>>().join(", ");
            let entry = EFFECTS.iter().find(|e| e.id == id).ok_or_else(|| wrong(format!("is not one of {}", known())))?;
            let [low, high] = entry.range;
            let value = value.parse::<f64>().ok().filter(|v| (low..=high).contains(v));
            (entry.set)(&mut effects, value.ok_or_else(|| wrong(format!("needs a magnitude from {low} to {high}")))?);
        }
        Ok(effects)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn property_every_effect_can_be_set_and_out_of_range_is_refused() {
        for entry in &EFFECTS {
            let half = 0.5 * entry.range[1];
            let text = format!("{}={half}", entry.id);
            assert_ne!(HiddenEffects::parse([text.as_str()]).unwrap(), HiddenEffects::parse([]).unwrap(), "{text}");
            assert!(HiddenEffects::parse([format!("{}={}", entry.id, entry.range[1] * 1.1).as_str()]).is_err());
        }
        for wrong in ["payload", "mass=3", "tow=NaN", "tow=much"] {
            assert!(HiddenEffects::parse([wrong]).unwrap_err().to_string().contains(wrong));
        }
    }
}
