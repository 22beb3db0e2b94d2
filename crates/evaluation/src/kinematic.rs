//! Baseline `kinematic`: a best-fit bicycle (or differential-drive) model that rides on the map.
//!
//! This is what a planner uses when it has no terramechanics, made as strong as its form allows: every parameter is fitted on the
//! training drives. It knows no soil, no slope force and no slip other than a constant share.

use nesam_physics::driveline::road_wheel_angles;
use nesam_physics::{Control, SecondCommand, Vehicle, VehicleState, WHEELS, wrap_angle};
use nesam_terrain::WorldMap;
use serde::{Deserialize, Serialize};

use crate::dimension::Pose;

/// Fitted parameters of the kinematic baseline.
///
/// Speed: v' = (g_v u_v - v) / τ_v. Turning: with s the lagged second command (s' = (u_s - s) / τ_s),
/// Ackermann ω = g_s v tan(δ(s)) / (L (1 + k v²)), differential drive ω = g_s s / (1 + k v²). Lateral velocity of the reference
/// point: v_y = ℓ ω (its distance to the axis about which the vehicle turns).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Kinematic {
    /// g_v: steady speed over commanded speed, -.
    pub speed_gain: f64,
    /// τ_v, s.
    pub speed_lag_s: f64,
    /// g_s: yaw rate over that of the ideal geometry, -.
    pub steering_gain: f64,
    /// τ_s, s.
    pub steering_lag_s: f64,
    /// k: understeer, s²/m².
    pub understeer_s2_m2: f64,
    /// ℓ: reference point ahead of the turning axis, m.
    pub turning_lever_m: f64,
}

/// Number of fitted parameters.
pub const KINEMATIC_PARAMETERS: usize = 6;

impl Kinematic {
    /// The unfitted model: ideal geometry, quick actuators, turning about the rear axle (skid-steer: about the reference point).
    pub fn ideal(vehicle: &Vehicle) -> Self {
        let lever = if is_skid(vehicle) { 0.0 } else { -vehicle.wheel_centre_m[2][0] };
        Self { speed_gain: 1.0, speed_lag_s: 0.5, steering_gain: 1.0, steering_lag_s: 0.1, understeer_s2_m2: 0.0, turning_lever_m: lever }
    }

    /// In the order of the fields.
    pub fn to_array(&self) -> [f64; KINEMATIC_PARAMETERS] {
        [self.speed_gain, self.speed_lag_s, self.steering_gain, self.steering_lag_s, self.understeer_s2_m2, self.turning_lever_m]
    }

    /// Inverse of [`Kinematic::to_array`].
    pub fn from_array(p: [f64; KINEMATIC_PARAMETERS]) -> Self {
        Self {
            speed_gain: p[0],
            speed_lag_s: p[1],
            steering_gain: p[2],
            steering_lag_s: p[3],
            understeer_s2_m2: p[4],
            turning_lever_m: p[5],
        }
    }

    /// x, y (m) and yaw (rad) after each of the `future` commands. `past` are the commands before the start, oldest first; they
    /// settle the steering actuator.
    pub fn plane_path(
        &self,
        vehicle: &Vehicle,
        start: &VehicleState<f64>,
        past: &[Control<f64>],
        future: &[Control<f64>],
        dt_s: f64,
    ) -> Vec<[f64; 3]> {
        let skid = is_skid(vehicle);
        let keep = |lag_s: f64| (-dt_s / lag_s.max(1e-3)).exp();
        let (keep_steering, keep_speed) = (keep(self.steering_lag_s), keep(self.speed_lag_s));
        let mut steering = past.first().or(future.first()).map_or(0.0, |c| c.second);
        for command in past {
            steering = command.second + (steering - command.second) * keep_steering;
        }
        let (mut speed, [mut x, mut y, _]) = (start.velocity_m_s[0], start.position_m);
        let mut yaw = start.attitude_rad[2];
        if skid {
            // The gyro knows the turning rate of a skid-steer vehicle better than its past commands do.
            steering = start.angular_velocity_rad_s[2] * (1.0 + self.understeer_s2_m2 * speed * speed) / self.steering_gain;
        }
        let mut path = Vec::with_capacity(future.len());
        for command in future {
            let next_steering = command.second + (steering - command.second) * keep_steering;
            let wanted = self.speed_gain * command.speed_m_s;
            let next_speed = wanted + (speed - wanted) * keep_speed;
            let (middle_speed, middle_steering) = (0.5 * (speed + next_speed), 0.5 * (steering + next_steering));
            let demand = if skid { middle_steering } else { middle_speed * curvature_1_m(vehicle, middle_steering) };
            let yaw_rate = self.steering_gain * demand / (1.0 + self.understeer_s2_m2 * middle_speed * middle_speed);
            let lateral = self.turning_lever_m * yaw_rate;
            let (sin, cos) = (yaw + 0.5 * dt_s * yaw_rate).sin_cos();
            x += dt_s * (middle_speed * cos - lateral * sin);
            y += dt_s * (middle_speed * sin + lateral * cos);
            yaw = wrap_angle(yaw + dt_s * yaw_rate);
            (speed, steering) = (next_speed, next_steering);
            path.push([x, y, yaw]);
        }
        path
    }

    /// All six dimensions: the plane path, and z, roll, pitch from the plane through the map under the four wheels plus the offset
    /// that the start has from it. Without a map, or where the map ends, they stay as they were.
    pub fn predict(
        &self,
        vehicle: &Vehicle,
        start: &VehicleState<f64>,
        past: &[Control<f64>],
        future: &[Control<f64>],
        dt_s: f64,
        map: Option<&WorldMap>,
    ) -> Vec<Pose> {
        let tilt = |x, y, yaw| map.and_then(|m| ground_pose(vehicle, m, x, y, yaw));
        let [_, _, z] = start.position_m;
        let [roll, pitch, yaw] = start.attitude_rad;
        let mut held = [z, roll, pitch];
        let offset =
            tilt(start.position_m[0], start.position_m[1], yaw).map(|ground| std::array::from_fn::<f64, 3, _>(|i| held[i] - ground[i]));
        self.plane_path(vehicle, start, past, future, dt_s)
            .into_iter()
            .map(|[x, y, yaw]| {
                if let (Some(offset), Some(ground)) = (offset, tilt(x, y, yaw)) {
                    held = std::array::from_fn(|i| ground[i] + offset[i]);
                }
                [x, y, held[0], held[1], held[2], yaw]
            })
            .collect()
    }
}

pub(crate) fn is_skid(vehicle: &Vehicle) -> bool {
    vehicle.second == SecondCommand::YawRateRadS
}

/// Curvature of the ideal bicycle for an actuator position, 1/m: tan of the mean front angle over the wheelbase.
pub fn curvature_1_m(vehicle: &Vehicle, steering: f64) -> f64 {
    let angle = road_wheel_angles(vehicle, steering);
    (0.5 * (angle[0] + angle[1])).tan() / vehicle.wheelbase_m
}

/// Height (m), roll and pitch (rad) of the least-squares plane through the ground under the four wheels; `None` where the map ends.
///
/// With slopes s_x, s_y along the yaw-aligned axes the plane's normal is (-s_x, -s_y, 1), hence pitch = -atan(s_x) (nose down is
/// positive) and roll = atan(s_y cos pitch).
pub fn ground_pose(vehicle: &Vehicle, map: &WorldMap, x_m: f64, y_m: f64, yaw_rad: f64) -> Option<[f64; 3]> {
    let (sin, cos) = yaw_rad.sin_cos();
    let mut height = [0.0; WHEELS];
    for (h, [bx, by, _]) in height.iter_mut().zip(vehicle.wheel_centre_m) {
        *h = map.height_m(x_m + cos * bx - sin * by, y_m + sin * bx + cos * by)?;
    }
    let centre = &vehicle.wheel_centre_m;
    let length = 0.5 * (centre[0][0] + centre[1][0] - centre[2][0] - centre[3][0]);
    let width = 0.5 * (centre[0][1] + centre[2][1] - centre[1][1] - centre[3][1]);
    let slope_x = 0.5 * (height[0] + height[1] - height[2] - height[3]) / length;
    let slope_y = 0.5 * (height[0] + height[2] - height[1] - height[3]) / width;
    let middle = 0.25 * centre.iter().map(|c| c[0]).sum::<f64>();
    let pitch = -slope_x.atan();
    Some([height.iter().sum::<f64>() / 4.0 - slope_x * middle, (slope_y * pitch.cos()).atan(), pitch])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_vehicle::{bicycle, skid};
    use nesam_terrain::GridGeometry;

    fn at_rest() -> VehicleState<f64> {
        VehicleState::zero()
    }

    #[test]
    fn analytic_circle_of_the_bicycle_about_its_rear_axle() {
        let vehicle = bicycle();
        let model = Kinematic { speed_lag_s: 1e-3, steering_lag_s: 1e-3, ..Kinematic::ideal(&vehicle) };
        let (speed, angle) = (2.0, 0.2_f64);
        let mut start = at_rest();
        start.velocity_m_s[0] = speed;
        let commands = vec![Control { speed_m_s: speed, second: angle }; 320];
        let path = model.plane_path(&vehicle, &start, &commands[..5], &commands, 0.01);
        let yaw_rate = speed * angle.tan() / vehicle.wheelbase_m;
        let turned = yaw_rate * 3.2;
        assert!((path[319][2] - turned).abs() < 1e-9);
        let (radius, lever) = (speed / yaw_rate, -vehicle.wheel_centre_m[2][0]);
        // The rear axle runs on a circle about (-lever, radius); the reference point is `lever` ahead of it.
        let x = -lever + radius * turned.sin() + lever * turned.cos();
        let y = radius * (1.0 - turned.cos()) + lever * turned.sin();
        assert!((path[319][0] - x).hypot(path[319][1] - y) < 1e-4, "{:?} against {x}, {y}", path[319]);
    }

    #[test]
    fn analytic_skid_steer_turns_at_the_commanded_rate_and_starts_from_the_gyro() {
        let vehicle = skid();
        let model = Kinematic { steering_lag_s: 1e9, ..Kinematic::ideal(&vehicle) };
        let mut start = at_rest();
        start.angular_velocity_rad_s[2] = 0.5;
        let path = model.plane_path(&vehicle, &start, &[], &[Control { speed_m_s: 0.0, second: 0.0 }; 10], 0.1);
        assert!((path[9][2] - 0.5).abs() < 1e-6);
    }

    #[test]
    fn analytic_pose_on_a_tilted_plane() {
        let geometry = GridGeometry { origin_m: [-20.0, -20.0], resolution_m: 0.5, width: 81, height: 81 };
        let (sx, sy) = (0.1, -0.05);
        let elevation = (0..81 * 81)
            .map(|i| {
                let (x, y) = (-20.0 + 0.5 * f64::from(i % 81), -20.0 + 0.5 * f64::from(i / 81));
                (1.0 + sx * x + sy * y) as f32
            })
            .collect();
        let map = WorldMap::from_layers("plane", 1, geometry, elevation, None).unwrap();
        let vehicle = bicycle();
        let east = ground_pose(&vehicle, &map, 1.0, 2.0, 0.0).unwrap();
        assert!((east[0] - (1.0 + 0.1 - 0.1)).abs() < 1e-5, "{east:?}");
        assert!((east[2] + sx.atan()).abs() < 1e-5, "uphill ahead is nose up, pitch < 0: {east:?}");
        assert!((east[1] - (sy * east[2].cos()).atan()).abs() < 1e-5, "left side lower is roll < 0: {east:?}");
        let back = ground_pose(&vehicle, &map, 1.0, 2.0, std::f64::consts::PI).unwrap();
        assert!((back[2] - sx.atan()).abs() < 1e-5 && back[1] > 0.0);
        assert!(ground_pose(&vehicle, &map, 19.9, 0.0, 0.0).is_none());
    }
}
