//! Drives from what a vehicle reported to a service, instant by instant.

use nesam_physics::{Control, VehicleState, WHEELS};

use crate::resample::Grid;
use crate::trajectory::{MeasuredChannels, Trajectory};

/// Pause between reports that ends a stretch, s.
const PAUSE_S: f64 = 0.5;
/// Shortest piece that is kept, s: a history and a rollout of a diagnosis' segments.
const PIECE_MIN_S: f64 = 4.0;

/// What a vehicle reported of one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Report {
    /// Instant, s; the clock may start anywhere.
    pub time_s: f64,
    /// Measured state: pose in World, twist in Body.
    pub state: VehicleState<f64>,
    /// Command applied from this instant on.
    pub command: Control<f64>,
    /// Speeds of FL, FR, RL, RR, rad/s, where they are measured.
    pub wheel_speed_rad_s: Option<[f64; WHEELS]>,
    /// Road-wheel angles of the front wheels (left, right), rad, where they are measured.
    pub road_wheel_angle_rad: Option<[f64; 2]>,
}

/// Cuts reports into about `pieces` drives of equal length at steps of `dt_s`, named `<id>-1`, `<id>-2`, …: at every pause longer than half a second and
/// every step back of the clock, and each stretch between into equal parts. Parts of less than 4 s are left out.
///
/// Pieces of one drive share its ground and its driver: they are less independent of each other than drives are, and what is concluded from their scatter
/// is surer of itself than it should be.
pub fn drives_of_reports(id: &str, reports: &[Report], dt_s: f64, pieces: usize) -> Vec<Trajectory> {
    let stretches: Vec<&[Report]> = stretches(reports).collect();
    let total_s: f64 = stretches.iter().map(|s| length_s(s)).sum();
    let piece_s = (total_s / pieces.max(1) as f64).max(PIECE_MIN_S);
    let mut drives = Vec::new();
    for stretch in stretches {
        let parts = ((length_s(stretch) / piece_s).round() as usize).clamp(1, (length_s(stretch) / PIECE_MIN_S) as usize);
        let each_s = length_s(stretch) / parts as f64;
        let begin = |part: usize| stretch[0].time_s + part as f64 * each_s;
        for part in 0..parts {
            // The end of a piece is the start of the next.
            let (from, to) = (begin(part) - 1e-6, begin(part + 1) + 1e-6);
            let of_part: Vec<Report> = stretch.iter().filter(|r| (from..=to).contains(&r.time_s)).copied().collect();
            drives.extend(drive(&format!("{id}-{}", drives.len() + 1), &of_part, dt_s));
        }
    }
    drives
}

/// Whether [`drives_of_reports`] has something to cut: a stretch of 4 s.
pub fn has_a_piece(reports: &[Report]) -> bool {
    stretches(reports).next().is_some()
}

/// What lies between pauses and steps back of the clock and is long enough.
fn stretches(reports: &[Report]) -> impl Iterator<Item = &[Report]> {
    reports.chunk_by(|a, b| b.time_s > a.time_s && b.time_s - a.time_s <= PAUSE_S).filter(|stretch| length_s(stretch) >= PIECE_MIN_S)
}

fn length_s(reports: &[Report]) -> f64 {
    reports.first().zip(reports.last()).map_or(0.0, |(first, last)| last.time_s - first.time_s)
}

/// One drive at steps of `dt_s`; `None` when a gap cannot be bridged.
fn drive(id: &str, reports: &[Report], dt_s: f64) -> Option<Trajectory> {
    let start_s = reports.first()?.time_s;
    let times: Vec<f64> = reports.iter().map(|r| r.time_s - start_s).collect();
    let grid = Grid::new(&times, dt_s).ok()?;
    let all = |of: &dyn Fn(&Report) -> [f64; 3]| reports.iter().map(of).collect::<Vec<_>>();
    let position = grid.linear(&all(&|r| r.state.position_m));
    let attitude = grid.angles(&all(&|r| r.state.attitude_rad));
    let velocity = grid.linear(&all(&|r| r.state.velocity_m_s));
    let angular = grid.linear(&all(&|r| r.state.angular_velocity_rad_s));
    let commands = grid.averaged(&reports.iter().map(|r| [r.command.speed_m_s, r.command.second]).collect::<Vec<_>>());
    let wheels: Option<Vec<_>> = reports.iter().map(|r| r.wheel_speed_rad_s).collect();
    let angles: Option<Vec<_>> = reports.iter().map(|r| r.road_wheel_angle_rad).collect();
    let states = (0..position.len()).map(|k| VehicleState {
        position_m: position[k],
        attitude_rad: attitude[k],
        velocity_m_s: velocity[k],
        angular_velocity_rad_s: angular[k],
    });
    Some(Trajectory {
        id: id.into(),
        set: String::new(),
        world: None,
        split: None,
        dt_s,
        states: states.collect(),
        controls: commands.into_iter().map(|[speed_m_s, second]| Control { speed_m_s, second }).collect(),
        measured: MeasuredChannels {
            wheel_speed: wheels.is_some(),
            road_wheel_angle: angles.is_some(),
            ..MeasuredChannels::POSE_AND_TWIST
        },
        wheel_speed_rad_s: wheels.map(|w| grid.linear(&w)),
        road_wheel_angle_rad: angles.map(|a| grid.linear(&a)),
        truth: None,
        time_s: grid.time_s,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(time_s: f64) -> Report {
        let mut state = VehicleState::zero();
        state.position_m[0] = 2.0 * time_s;
        let command = Control { speed_m_s: time_s.floor(), second: 0.0 };
        Report { time_s, state, command, wheel_speed_rad_s: None, road_wheel_angle_rad: Some([0.1, 0.2]) }
    }

    #[test]
    fn analytic_reports_are_cut_at_pauses_and_into_equal_pieces() {
        // 12 s at 20 Hz, a pause, 6 s at 10 Hz, a pause, 2 s.
        let first = (0..=240).map(|k| report(100.0 + 0.05 * f64::from(k)));
        let second = (0..=60).map(|k| report(120.0 + 0.1 * f64::from(k)));
        let third = (0..=20).map(|k| report(130.0 + 0.1 * f64::from(k)));
        let reports: Vec<Report> = first.chain(second).chain(third).collect();
        let drives = drives_of_reports("w", &reports, 0.1, 3);
        let seen: Vec<(&str, usize, f64)> = drives.iter().map(|d| (d.id.as_str(), d.states.len(), d.states[0].position_m[0])).collect();
        assert_eq!(seen, [("w-1", 61, 200.0), ("w-2", 61, 212.0), ("w-3", 61, 240.0)]);
        assert!(drives.iter().all(|d| d.measured.road_wheel_angle && d.wheel_speed_rad_s.is_none() && d.time_s[0] == 0.0));
        assert!((drives[1].states[7].position_m[0] - 213.4).abs() < 1e-9);
        assert_eq!(drives[0].controls[15].speed_m_s, 101.0);
        assert!(drives_of_reports("w", &[], 0.1, 3).is_empty());
    }
}
