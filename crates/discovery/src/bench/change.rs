//! Hidden effects on recorded drives: what a recording would be if the vehicle, its sensors or its map had the effect.
//!
//! * *Actuators*: the vehicle did what it was told; a vehicle with the effect would have done the same when told something else. The commands are changed,
//!   and every other channel stays a recording: exact, up to the inverse of the actuator.
//! * *Sensors and maps*: what was recorded is changed: exact.
//! * *Forces and soil*: the drive is driven again by the physics with the effect, under the recorded commands, with everything by which the recorded drive
//!   differed from the physics carried along step by step ([`crate::observe::ObservedDrive::driven_again`]). Without an effect this gives the recording
//!   back. The response to the effect is that of our own physics, so sizes found there say nothing about another simulator.

use std::sync::Arc;

use nesam_physics::vec3::Tilt;
use nesam_physics::wrap_angle;
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;

/// A change of what was recorded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Change {
    /// second = (u - size): the vehicle has a steering offset.
    SteeringOffset(f64),
    /// second = u / (1 + size).
    SteeringRatio(f64),
    /// second(t) = u(t + size), s.
    SteeringDelay(f64),
    /// The command whose first-order lag by `size` seconds is u.
    SteeringLag(f64),
    /// speed = u / (1 + size).
    SpeedGain(f64),
    /// speed(t) = u(t + size), s.
    SpeedDelay(f64),
    /// Yaw rate + size, rad/s.
    GyroBias(f64),
    /// Angular velocity · (1 + size).
    GyroScale(f64),
    /// Velocity · (1 + size).
    VelocityScale(f64),
    /// Position (t - size), s.
    PositionLatency(f64),
    /// Position and heading (t - size), s.
    PoseLatency(f64),
    /// Position and velocity of a point `size` ahead of the reference point, m.
    LeverArm(f64),
    /// Roll + size, rad, velocity and gyro turned likewise.
    MountRoll(f64),
    /// The ground is `size` higher than the map says, m.
    MapOffset(f64),
    /// The ground falls to the east by `size` rad more than the map says.
    MapTilt(f64),
    /// Wheel speeds of the front axle as of a radius larger by this share, the vehicle's own motion unchanged: what a larger tyre shows first.
    FrontRims(f64),
    /// Outside of the catalogue: the yaw rate read with a bias that follows the roll rate.
    GyroCross(f64),
    /// Outside of the catalogue: steering that sticks near the middle and overshoots outside, u + size sin(2 π u).
    SteeringWarp(f64),
    /// Outside of the catalogue: a steering that turns further to the left, by this share of it.
    SteeringLeft(f64),
    /// Outside of the catalogue: speed over ground that breathes with time, size sin(2 π t / 4 s).
    VelocityRipple(f64),
    /// Noise of every state channel as large again as it is, `size` times (a trap: not an effect).
    Noise(f64),
}

/// Applies a change from an onset on; returns the map that the changed vehicle is given.
pub fn apply(change: Change, onset_s: f64, drive: &mut Trajectory, map: Option<Arc<WorldMap>>) -> Option<Arc<WorldMap>> {
    let first = (onset_s / drive.dt_s).round() as usize;
    let (controls, states) = (drive.controls.clone(), drive.states.clone());
    let at = |t: f64, of: &dyn Fn(usize) -> f64| -> f64 {
        let place = t.clamp(0.0, (states.len() - 1) as f64);
        let (k, share) = (place.floor() as usize, place.fract());
        of(k) + share * (of((k + 1).min(states.len() - 1)) - of(k))
    };
    for k in first.min(states.len())..states.len() {
        let (time, steps) = (k as f64, |s: f64| s / drive.dt_s);
        let (c, s) = (&mut drive.controls[k], &mut drive.states[k]);
        match change {
            Change::SteeringOffset(size) => c.second -= size,
            Change::SteeringRatio(size) => c.second /= 1.0 + size,
            Change::SteeringDelay(size) => c.second = at(time + steps(size), &|i| controls[i].second),
            Change::SteeringLag(size) => {
                // The lagged command passes half way between u of this step and of the next at their border, so that its mean over a step is u.
                let kept = (-drive.dt_s / size).exp();
                let border = |i: usize| 0.5 * (controls[i.saturating_sub(1)].second + controls[i.min(controls.len() - 1)].second);
                c.second = (border(k + 1) - kept * border(k)) / (1.0 - kept);
            }
            Change::SpeedGain(size) => c.speed_m_s /= 1.0 + size,
            Change::SpeedDelay(size) => c.speed_m_s = at(time + steps(size), &|i| controls[i].speed_m_s),
            Change::GyroBias(size) => s.angular_velocity_rad_s[2] += size,
            Change::GyroScale(size) => s.angular_velocity_rad_s = s.angular_velocity_rad_s.map(|w| w * (1.0 + size)),
            Change::VelocityScale(size) => s.velocity_m_s = s.velocity_m_s.map(|v| v * (1.0 + size)),
            Change::PositionLatency(size) | Change::PoseLatency(size) => {
                s.position_m = core::array::from_fn(|i| at(time - steps(size), &|j| states[j].position_m[i]));
                if let Change::PoseLatency(_) = change {
                    let now = s.attitude_rad[2];
                    s.attitude_rad[2] = wrap_angle(now + at(time - steps(size), &|j| wrap_angle(states[j].attitude_rad[2] - now)));
                }
            }
            Change::LeverArm(size) => {
                let [roll, pitch, yaw] = s.attitude_rad;
                let arm = Tilt::new(roll, pitch).to_heading([size, 0.0, 0.0]);
                let (sin, cos) = yaw.sin_cos();
                s.position_m[0] += cos * arm[0] - sin * arm[1];
                s.position_m[1] += sin * arm[0] + cos * arm[1];
                s.position_m[2] += arm[2];
                let w = s.angular_velocity_rad_s;
                s.velocity_m_s[1] += w[2] * size;
                s.velocity_m_s[2] -= w[1] * size;
            }
            Change::MountRoll(size) => {
                s.attitude_rad[0] += size;
                let (sin, cos) = size.sin_cos();
                let turn = |v: [f64; 3]| [v[0], cos * v[1] + sin * v[2], cos * v[2] - sin * v[1]];
                s.velocity_m_s = turn(s.velocity_m_s);
                s.angular_velocity_rad_s = turn(s.angular_velocity_rad_s);
            }
            Change::FrontRims(size) => {
                if let Some(speeds) = &mut drive.wheel_speed_rad_s {
                    speeds[k][0] /= 1.0 + size;
                    speeds[k][1] /= 1.0 + size;
                }
            }
            Change::GyroCross(size) => s.angular_velocity_rad_s[2] += size * s.attitude_rad[0],
            Change::SteeringWarp(size) => c.second -= size * (core::f64::consts::TAU * c.second).sin(),
            Change::SteeringLeft(size) => c.second /= 1.0 + if c.second > 0.0 { size } else { 0.0 },
            Change::VelocityRipple(size) => s.velocity_m_s[0] += size * (core::f64::consts::TAU * time * drive.dt_s / 4.0).sin(),
            Change::Noise(size) => {
                // The sensors' own deviations, moved elsewhere in the drive, so that their distribution is right without a model of it.
                let other = (k * 7 + 3) % (states.len() - 2) + 1;
                let rough = |v: &dyn Fn(usize) -> f64| 0.6 * (v(other) - 0.5 * (v(other - 1) + v(other + 1)));
                for i in 0..3 {
                    s.velocity_m_s[i] += size * rough(&|j| states[j].velocity_m_s[i]);
                    s.angular_velocity_rad_s[i] += size * rough(&|j| states[j].angular_velocity_rad_s[i]);
                    s.position_m[i] += size * rough(&|j| states[j].position_m[i]).clamp(-0.05, 0.05);
                }
            }
            Change::MapOffset(_) | Change::MapTilt(_) => {}
        }
    }
    match change {
        Change::MapOffset(size) => map.map(|m| lowered(&m, |_| size)),
        Change::MapTilt(size) => map.map(|m| lowered(&m, |x| -size.tan() * x)),
        _ => map,
    }
}

/// A map whose heights are less than the true ones by `missing(x)`.
fn lowered(map: &WorldMap, missing: impl Fn(f64) -> f64) -> Arc<WorldMap> {
    let geometry = *map.geometry();
    let heights: Vec<f32> = map
        .elevation_m()
        .into_iter()
        .enumerate()
        .map(|(i, h)| h - missing(geometry.to_world(i % geometry.width, i / geometry.width)[0]) as f32)
        .collect();
    let changed = WorldMap::from_layers(map.id(), map.version() + 1, geometry, heights, map.semantic_rgb());
    Arc::new(changed.expect("a map of the same size as a map; this is a bug").with_soil_classes(map.soil_classes().to_vec()))
}
