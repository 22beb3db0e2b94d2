//! What a patched bundle was fitted to.

use nesam_model::bundle::sha256_hex;
use nesam_trajectories::Trajectory;

/// SHA-256 (hex) over ids and measured values of the fitted drives, in the order of the set. Drives that were not fitted change nothing of it, so that a patched
/// bundle is the same whether they are there or not.
pub fn hash(drives: &[Trajectory], fitted: &[String]) -> String {
    let mut bytes: Vec<u8> = Vec::new();
    for drive in drives.iter().filter(|drive| fitted.contains(&drive.id)) {
        bytes.extend(drive.id.bytes().chain([0]));
        bytes.extend(values(drive).flat_map(f64::to_le_bytes));
    }
    sha256_hex(&bytes)
}

fn values(drive: &Trajectory) -> impl Iterator<Item = f64> {
    let samples = drive.time_s.iter().zip(&drive.states).zip(&drive.controls);
    let motion =
        samples.flat_map(|((time_s, state), command)| state.to_array().into_iter().chain([*time_s, command.speed_m_s, command.second]));
    let wheels = drive.wheel_speed_rad_s.iter().flatten().flatten();
    motion.chain(wheels.chain(drive.road_wheel_angle_rad.iter().flatten().flatten()).copied())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nesam_physics::{Control, DT_S, VehicleState};
    use nesam_trajectories::MeasuredChannels;

    fn drive(id: &str, speed_m_s: f64) -> Trajectory {
        Trajectory {
            id: id.into(),
            set: "set".into(),
            world: None,
            split: None,
            dt_s: DT_S,
            time_s: vec![0.0, DT_S],
            states: vec![VehicleState::zero(); 2],
            controls: vec![Control { speed_m_s, second: 0.0 }; 2],
            wheel_speed_rad_s: None,
            road_wheel_angle_rad: None,
            measured: MeasuredChannels::POSE_AND_TWIST,
            truth: None,
        }
    }

    /// Goal: the hash is of the fitted drives and of nothing else. Method: the same drives alone, among others, and with each channel changed.
    #[test]
    fn property_only_fitted_drives_are_in_the_hash() {
        let fitted = ["a".to_string(), "c".to_string()];
        let alone = hash(&[drive("a", 1.0), drive("c", 2.0)], &fitted);
        assert_eq!(hash(&[drive("a", 1.0), drive("b", 9.0), drive("c", 2.0)], &fitted), alone);
        assert_ne!(hash(&[drive("a", 1.0), drive("c", 2.5)], &fitted), alone);
        assert_ne!(hash(&[drive("a", 1.0)], &fitted), alone);
        let mut turned = drive("c", 2.0);
        turned.states[1].attitude_rad[2] = 0.1;
        assert_ne!(hash(&[drive("a", 1.0), turned], &fitted), alone);
        let rims = Trajectory { wheel_speed_rad_s: Some(vec![[1.0; 4]; 2]), ..drive("c", 2.0) };
        assert_ne!(hash(&[drive("a", 1.0), rims], &fitted), alone);
    }
}
