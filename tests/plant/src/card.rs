//! The vehicle's data sheet.

use std::path::Path;

use serde_json::Value;

use crate::error::PlantError;
use crate::math::Vec3;
use crate::plant::WHEELS;

/// What the plant needs to know of a vehicle: four sprung wheels, steered in front, all driven.
#[derive(Clone, Debug, PartialEq)]
pub struct PlantVehicle {
    pub(crate) mass_kg: f64,
    pub(crate) unsprung_kg: f64,
    pub(crate) inertia_kg_m2: [Vec3; 3],
    /// Wheel centres at rest on level ground, Body, relative to the reference point, m.
    pub(crate) wheel_centre_m: [Vec3; WHEELS],
    pub(crate) radius_m: f64,
    pub(crate) width_m: f64,
    pub(crate) spin_inertia_kg_m2: f64,
    /// At the wheel.
    pub(crate) spring_n_m: [f64; WHEELS],
    pub(crate) damper_n_s_m: [f64; WHEELS],
    /// Command, left angle, right angle.
    pub(crate) steering: Vec<[f64; 3]>,
    pub(crate) steering_lag_s: f64,
    pub(crate) steering_rate_per_s: f64,
    pub(crate) coupling_n_m_s: f64,
    pub(crate) coupling_max_n_m: f64,
    /// Gear ratios, engine speed over wheel speed.
    pub(crate) ratios: Vec<f64>,
    pub(crate) brake_max_n_m: f64,
    pub(crate) brake_pedal_max: f64,
    pub(crate) kp: f64,
    pub(crate) ki: f64,
    pub(crate) gravity_m_s2: f64,
}

/// Wheel rate over spring rate: the data sheet says "roughly 0.6" of an inclined shock with motion ratio 0.8, which is 0.8^2 for the damper too.
const MOTION_RATIO_SQUARED: f64 = 0.6;
const DAMPER_RATIO_SQUARED: f64 = 0.64;

impl PlantVehicle {
    /// Reads the one `vehicle_*.json` of a data root.
    ///
    /// # Errors
    /// `PlantError` naming the file and the key that is missing or of another form.
    pub fn of_root(root: &Path) -> Result<Self, PlantError> {
        let entries = std::fs::read_dir(root).map_err(|source| PlantError::File { path: root.into(), source })?;
        let is_card = |name: &str| name.starts_with("vehicle_") && name.ends_with(".json");
        let cards =
            entries.filter_map(Result::ok).map(|e| e.path()).filter(|p| p.file_name().and_then(|n| n.to_str()).is_some_and(is_card));
        let card = cards.min().ok_or_else(|| PlantError::content(root, "has no vehicle_*.json"))?;
        Self::read(&card)
    }

    /// Reads a data sheet.
    ///
    /// # Errors
    /// As [`PlantVehicle::of_root`].
    pub fn read(path: &Path) -> Result<Self, PlantError> {
        let text = std::fs::read(path).map_err(|source| PlantError::File { path: path.into(), source })?;
        let json: Value = serde_json::from_slice(&text).map_err(|e| PlantError::content(path, e.to_string()))?;
        Self::from_json(&json).map_err(|key| PlantError::content(path, format!("`{key}` is missing or not of the expected form")))
    }

    fn from_json(json: &Value) -> Result<Self, &'static str> {
        let number = |pointer: &'static str| json.pointer(pointer).and_then(Value::as_f64).filter(|v| v.is_finite()).ok_or(pointer);
        let numbers = |pointer: &'static str| -> Result<Vec<f64>, &'static str> {
            let list = json.pointer(pointer).and_then(Value::as_array).ok_or(pointer)?;
            list.iter().map(|v| v.as_f64().ok_or(pointer)).collect()
        };
        let vectors = |pointer: &'static str| -> Result<Vec<Vec3>, &'static str> {
            let list = json.pointer(pointer).and_then(Value::as_array).ok_or(pointer)?;
            let vector = |v: &Value| -> Option<Vec3> {
                let entries: Vec<f64> = v.as_array()?.iter().map(Value::as_f64).collect::<Option<_>>()?;
                entries.try_into().ok()
            };
            list.iter().map(|v| vector(v).ok_or(pointer)).collect()
        };
        let table = json
            .pointer("/steering/command_to_road_wheel_table")
            .and_then(Value::as_array)
            .ok_or("/steering/command_to_road_wheel_table")?;
        let angle = |row: &Value, key: &str| row.get(key).and_then(Value::as_f64).ok_or("/steering/command_to_road_wheel_table");
        let steering = table.iter().map(|row| Ok([angle(row, "cmd")?, angle(row, "fl_rad")?, angle(row, "fr_rad")?]));
        let (front, rear) = ("/suspension/front/spring_N_per_m", "/suspension/rear/spring_N_per_m");
        let (front_damper, rear_damper) = ("/suspension/front/damper_Ns_per_m", "/suspension/rear/damper_Ns_per_m");
        let axles = |front: f64, rear: f64, share: f64| [front * share, front * share, rear * share, rear * share];
        let last_ratio = number("/driveline/final_drive_ratio")?;
        Ok(Self {
            mass_kg: number("/mass_total")?,
            unsprung_kg: number("/unsprung_mass_per_wheel")?,
            inertia_kg_m2: vectors("/inertia_about_cg/matrix")?.try_into().map_err(|_| "/inertia_about_cg/matrix")?,
            wheel_centre_m: vectors("/wheel_centres_rel_P_static")?.try_into().map_err(|_| "/wheel_centres_rel_P_static")?,
            radius_m: number("/tyre/radius")?,
            width_m: number("/tyre/width")?,
            spin_inertia_kg_m2: number("/wheel_spin_inertia")?,
            spring_n_m: axles(number(front)?, number(rear)?, MOTION_RATIO_SQUARED),
            damper_n_s_m: axles(number(front_damper)?, number(rear_damper)?, DAMPER_RATIO_SQUARED),
            steering: steering.collect::<Result<_, &'static str>>()?,
            steering_lag_s: number("/steering/actuator/time_constant_s")?,
            steering_rate_per_s: number("/steering/actuator/rate_limit_per_s")?,
            coupling_n_m_s: number("/driveline/lsd_Nm_per_rad_s")?,
            coupling_max_n_m: number("/driveline/lsd_max_Nm")?,
            ratios: numbers("/driveline/gear_ratios_engine_to_shaft")?.iter().map(|shaft| last_ratio / shaft).collect(),
            brake_max_n_m: number("/brakes/max_torque_per_wheel_Nm")?,
            brake_pedal_max: numbers("/speed_controller/brake_range")?.get(1).copied().ok_or("/speed_controller/brake_range")?,
            kp: number("/speed_controller/kp")?,
            ki: number("/speed_controller/ki")?,
            gravity_m_s2: number("/gravity")?,
        })
    }

    /// Road-wheel angles of the front wheels (left, right) for an actuator position: linear in the table and on with the slope at its ends, rad.
    pub(crate) fn road_wheel_angles(&self, position: f64) -> [f64; 2] {
        let table = &self.steering;
        let (Some(first), Some(last)) = (table.first(), table.last()) else { return [0.0; 2] };
        let within = position.clamp(first[0], last[0]);
        let above = table.iter().position(|row| row[0] >= within).unwrap_or(table.len() - 1).max(1);
        let (low, high) = (table[above - 1], table[above]);
        let share = (position - low[0]) / (high[0] - low[0]);
        [low[1] + share * (high[1] - low[1]), low[2] + share * (high[2] - low[2])]
    }
}
