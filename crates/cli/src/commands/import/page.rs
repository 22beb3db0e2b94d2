//! What an import looks like: the path of each drive, its speed against the commanded one, its turning against what the command asks for.

use nesam_evaluation::curvature_1_m;
use nesam_evaluation::report::{LinePlot, Page, Series};
use nesam_physics::{SecondCommand, Vehicle};
use nesam_trajectories::Trajectory;

use crate::output::command_line;

/// Drives that are drawn; a set may have hundreds.
const DRAWN: usize = 24;
/// Points of a line: more are not seen on a plot of 400 pixels.
const POINTS: usize = 600;

/// The page of a set as every other command reads it.
pub(super) fn page(set: &str, drives: &[Trajectory], vehicle: &Vehicle) -> String {
    let seconds: f64 = drives.iter().map(|d| d.dt_s * d.states.len().saturating_sub(1) as f64).sum();
    let lead = format!(
        "{} drives of {seconds:.0} s altogether as set {set}, in the conventions of a data root: x east, y north, m; yaw rates to the left are positive. \
         Where the log means something else, a line here runs against the other.",
        drives.len()
    );
    let mut page = Page::new(&format!("nesam import: {set}"), &lead);
    for drive in drives.iter().take(DRAWN) {
        let caption = format!("{}. The path begins at the dot; hover for values.", turning_caption(vehicle));
        page.section(&drive.id).plots(&[path(drive), speed(drive), turning(drive, vehicle)], &caption);
    }
    if drives.len() > DRAWN {
        page.text(&format!("{} further drives are not drawn.", drives.len() - DRAWN));
    }
    page.footer("command", &command_line())
        .footer("version", &format!("nesam {}", env!("CARGO_PKG_VERSION")))
        .footer("vehicle", &vehicle.name);
    page.render()
}

/// Samples that are drawn, the first included.
fn drawn(drive: &Trajectory) -> impl Iterator<Item = usize> {
    (0..drive.states.len()).step_by(drive.states.len().div_ceil(POINTS).max(1))
}

fn path(drive: &Trajectory) -> LinePlot {
    let mut plot = LinePlot::new("path", "x [m]", "y [m]");
    plot.equal_aspect = true;
    let points = drawn(drive).map(|k| (drive.states[k].position_m[0], drive.states[k].position_m[1]));
    plot.series = vec![Series { mark_start: true, ..Series::line("measured", 0, points.collect()) }];
    plot
}

fn speed(drive: &Trajectory) -> LinePlot {
    let source = if drive.measured.linear_velocity { "forward speed" } else { "forward speed, from positions" };
    over_time(drive, source, "m/s", |k| drive.states[k].velocity_m_s[0], |k| drive.controls[k].speed_m_s)
}

fn turning(drive: &Trajectory, vehicle: &Vehicle) -> LinePlot {
    let source = if drive.measured.angular_velocity[2] { "yaw rate" } else { "yaw rate, from the yaw" };
    let asked = |k: usize| commanded_yaw_rate_rad_s(vehicle, drive.controls[k].second, drive.states[k].velocity_m_s[0]);
    over_time(drive, source, "rad/s", |k| drive.states[k].angular_velocity_rad_s[2], asked)
}

/// Yaw rate that the second command asks for at a forward speed, rad/s: the command itself, or that of the ideal bicycle.
fn commanded_yaw_rate_rad_s(vehicle: &Vehicle, second: f64, speed_m_s: f64) -> f64 {
    match vehicle.second {
        SecondCommand::YawRateRadS => second,
        SecondCommand::RoadWheelAngleRad | SecondCommand::SteeringNormalised => speed_m_s * curvature_1_m(vehicle, second),
    }
}

fn turning_caption(vehicle: &Vehicle) -> &'static str {
    match vehicle.second {
        SecondCommand::YawRateRadS => "Measured and commanded motion",
        SecondCommand::RoadWheelAngleRad | SecondCommand::SteeringNormalised => {
            "Measured and commanded motion; the commanded yaw rate is that of a bicycle with the commanded steering at the measured speed"
        }
    }
}

/// A measured channel and its command over the time since the start of the drive.
fn over_time(drive: &Trajectory, title: &str, unit: &str, measured: impl Fn(usize) -> f64, commanded: impl Fn(usize) -> f64) -> LinePlot {
    let mut plot = LinePlot::new(title, "time [s]", &format!("{title} [{unit}]"));
    let line = |of: &dyn Fn(usize) -> f64| drawn(drive).map(|k| (drive.time_s[k] - drive.time_s[0], of(k))).collect();
    plot.series = vec![Series::line("measured", 0, line(&measured)), Series::line("commanded", 1, line(&commanded))];
    plot
}

#[cfg(test)]
mod tests {
    use super::*;
    use nesam_physics::{Control, VehicleState};
    use nesam_trajectories::MeasuredChannels;

    fn drive(id: &str, samples: usize) -> Trajectory {
        Trajectory {
            id: id.into(),
            set: "s".into(),
            world: None,
            split: None,
            dt_s: 0.1,
            time_s: (0..samples).map(|k| 5.0 + 0.1 * k as f64).collect(),
            states: vec![VehicleState::zero(); samples],
            controls: vec![Control { speed_m_s: 2.0, second: 0.3 }; samples],
            wheel_speed_rad_s: None,
            road_wheel_angle_rad: None,
            measured: MeasuredChannels { linear_velocity: false, ..MeasuredChannels::POSE_AND_TWIST },
            truth: None,
        }
    }

    /// Goal: three plots of each drive, with measured and commanded values over the time since its start; a long drive in fewer points.
    #[test]
    fn analytic_a_page_draws_path_speed_and_turning() {
        let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/data/chrono_sample/vehicle_hmmwv.json");
        let car = nesam_trajectories::read_vehicle_card(std::path::Path::new(root)).expect("the card of the sample");
        let html = page("mine", &[drive("a", 30), drive("b", 5000)], &car);
        assert_eq!((html.matches("<svg class=\"plot\"").count(), html.matches("<h2>").count()), (6, 2));
        for word in ["forward speed, from positions [m/s]", "yaw rate [rad/s]", "commanded", "bicycle"] {
            assert!(html.contains(word), "{word}");
        }
        let plot = speed(&drive("b", 5000));
        let (measured, commanded) = (&plot.series[0].points, &plot.series[1].points);
        assert!((500..=POINTS).contains(&measured.len()), "{}", measured.len());
        assert_eq!((measured[0], commanded[0]), ((0.0, 0.0), (0.0, 2.0)));
        let many: Vec<Trajectory> = (0..DRAWN + 3).map(|i| drive(&format!("d{i}"), 10)).collect();
        assert!(page("mine", &many, &car).contains("3 further drives are not drawn"));
    }

    #[test]
    fn analytic_the_yaw_rate_of_a_command() {
        let base = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles/clearpath-husky/vehicle.json");
        let husky = nesam_trajectories::read_vehicle_card(&base).expect("a card");
        assert_eq!(commanded_yaw_rate_rad_s(&husky, 0.4, 7.0), 0.4);
        let car = Vehicle { second: SecondCommand::RoadWheelAngleRad, steering: None, wheelbase_m: 2.0, ..husky };
        assert!((commanded_yaw_rate_rad_s(&car, 0.3, 4.0) - 4.0 * 0.3_f64.tan() / 2.0).abs() < 1e-12);
    }
}
