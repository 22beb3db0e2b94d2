//! From the point of the vehicle whose pose a log tells to the reference point of the vehicle card.

use nesam_physics::VehicleState;
use nesam_physics::vec3::in_world;

use crate::part::{Channel, Notes};

/// Velocities of a data root, and whether they are in Body.
const VELOCITIES: [([&str; 3], bool); 2] = [(["vbx", "vby", "vbz"], true), (["vx", "vy", "vz"], false)];
const RATES: [&str; 3] = ["wx", "wy", "wz"];

/// Moves positions and measured velocities to the point that lies at `reference_m` in Body. Attitudes and rates of roll and pitch that a log lacks are taken for zero;
/// velocities that no yaw rate moves are left out.
pub(crate) fn move_to_reference(reference_m: [f64; 3], pose: &mut [Channel], measured: &mut Vec<Channel>, notes: &mut Notes) {
    let rows = pose.first().map_or(0, |(_, values)| values.len());
    // Channels that are not there count as zero in every row.
    let at = |channels: &[Channel], names: [&str; 3], row: usize| -> Option<[f64; 3]> {
        let value = |name| channels.iter().find(|(held, _)| held == name).map_or(Some(0.0), |(_, values)| values[row]);
        let [x, y, z] = names.map(value);
        Some([x?, y?, z?])
    };
    let there = |channels: &[Channel], name: &str| channels.iter().any(|(held, _)| held == name);
    let moved: Vec<Option<[[f64; 3]; 3]>> = (0..rows)
        .map(|row| {
            let attitude_rad = at(pose, ["roll", "pitch", "yaw"], row)?;
            let angular_velocity_rad_s = at(measured, RATES, row).unwrap_or([f64::NAN; 3]);
            let point = VehicleState { attitude_rad, angular_velocity_rad_s, ..VehicleState::zero() }.at_point(reference_m);
            Some([point.position_m, point.velocity_m_s, in_world(&attitude_rad, point.velocity_m_s)])
        })
        .collect();
    let add = |channels: &mut [Channel], names: [&str; 3], which: usize| {
        for (axis, name) in names.into_iter().enumerate() {
            let Some((_, values)) = channels.iter_mut().find(|(held, _)| held == name) else { continue };
            let by = |row: usize| moved[row].map(|moved| moved[which][axis]).filter(|by| by.is_finite());
            values.iter_mut().enumerate().for_each(|(row, value)| *value = value.and_then(|value| Some(value + by(row)?)));
        }
    };
    add(pose, ["x", "y", "z"], 0);
    let mut what = "positions";
    for (names, in_body) in VELOCITIES {
        if !there(measured, names[0]) {
            continue;
        }
        if there(measured, "wz") {
            add(measured, names, if in_body { 1 } else { 2 });
            what = "positions and velocities";
        } else {
            measured.retain(|(name, _)| !names.contains(&name.as_str()));
            notes.push(format!(
                "{}, … not used: the log has no yaw rate `wz`, without which the reference point has another velocity",
                names[0]
            ));
        }
    }
    let [x, y, z] = reference_m;
    notes.push(format!("{what} moved to the reference point, {x} m ahead, {y} m to the left and {z} m up"));
}
