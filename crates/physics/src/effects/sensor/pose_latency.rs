//! Poses that are older than the rest of a sample.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Pose latency: position and heading measured at t are those of t - d; roll, pitch (which gravity tells) and velocities are of t. What a localisation by
    /// lidar or camera shows beside a gyro; a gyro that is stamped too early shows the same.
    struct PoseLatency = "pose_latency" in Sensor {
        /// d, s.
        seconds: ("s", [-0.2, 0.6], 0.1, Size),
    }
    |effect, terms| terms.sensor.pose_latency_s += effect.seconds
}
