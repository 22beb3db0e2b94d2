//! Which manoeuvre would separate an effect from its rivals.

use crate::claims::Finding;

/// The manoeuvre in which an effect and its closest rival differ most; `None` without a rival.
///
/// From what tells effects apart in general (discovery catalogue, column "what separates"): heading reversal separates what is fixed to the world from what is
/// fixed to the vehicle, speed separates drags, standstill shows sensors.
pub fn separating(finding: &Finding) -> Option<&'static str> {
    let rival = finding.rivals.first()?;
    let ids = [finding.candidate.id(), rival.candidate.id()];
    let either = |group: &[&str]| ids.iter().any(|id| group.contains(id));
    let both = |group: &[&str]| ids.iter().all(|id| group.contains(id));
    Some(if either(&["gyro_bias", "gyro_scale", "mount_angle", "lever_arm"]) {
        "stand still for 20 s, then one full circle to each side and back to the same place"
    } else if either(&["map_tilt", "map_offset", "wind"]) {
        "drive the same straight line in both directions"
    } else if both(&["tow", "linear_drag", "quadratic_drag", "rolling_resistance", "wheel_drag", "speed_gain", "front_bulldozing"]) {
        "coast straight ahead from full speed to rest on level ground, up and down the same slope"
    } else if either(&["tyre_radius", "tyre_radius_front", "tyre_radius_rear", "speed_gain", "velocity_scale", "clock_drift"]) {
        "drive a measured straight distance at two constant speeds on hard ground"
    } else if either(&[
        "steering_lag",
        "steering_delay",
        "steering_backlash",
        "position_latency",
        "pose_latency",
        "speed_lag",
        "speed_delay",
    ]) {
        "step steers and step changes of speed, with pauses between them"
    } else if either(&["steering_offset", "steering_ratio", "steering_compliance", "cg_lateral", "side_bulldozing", "locked_differential"])
    {
        "circles of one radius to the left and to the right at two speeds"
    } else if either(&["payload", "cg_forward", "cg_height", "roll_stiffness", "pitch_stiffness"]) {
        "hard braking and starting straight ahead, then a slalom at constant speed, on hard and on soft ground"
    } else {
        "the same course on hard and on soft ground"
    })
}
