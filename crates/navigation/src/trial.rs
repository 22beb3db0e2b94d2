//! Trials of places further ahead: where the vehicle would begin there, and what it would steer.

use std::f64::consts::TAU;
use std::sync::Arc;

use nesam_evaluation::{curvature_1_m, ground_pose};
use nesam_physics::{SecondCommand, Vehicle};
use nesam_terrain::WorldMap;

use crate::reference_path::ReferencePath;

/// Steps of a trial: two seconds.
pub(crate) const TRIAL_STEPS: usize = 20;
/// How far beyond the place the steering looks, m: half of the way of a trial.
const AIM_M: f64 = 2.5;
/// Stretch over which the curvature of the path is taken, m.
const CURVATURE_OVER_M: f64 = 1.0;
/// Halvings of the range of steering.
const HALVINGS: usize = 40;

/// The map and the vehicle that trials are made for.
#[derive(Clone, Debug)]
pub struct Surroundings {
    /// Map of the world.
    pub map: Arc<WorldMap>,
    /// The vehicle.
    pub vehicle: Arc<Vehicle>,
}

impl Surroundings {
    /// State of the vehicle on the path at an arc length: along the path and the ground there, as high above the ground as it was `measured` to be; `None` beyond the
    /// map.
    pub(crate) fn on_path(&self, path: &ReferencePath, arc_m: f64, speed_m_s: f64, measured: &[f64; 12]) -> Option<[f64; 12]> {
        let phi = path.phi_at(arc_m);
        let ([x, y], yaw) = (path.point(phi), path.heading(phi));
        let [there, here] =
            [[x, y, yaw], [measured[0], measured[1], measured[5]]].map(|[x, y, yaw]| ground_pose(&self.vehicle, &self.map, x, y, yaw));
        let ([ground_m, roll, pitch], [below_m, ..]) = (there?, here?);
        let z = ground_m + measured[2] - below_m;
        // Velocities are in Body: along the vehicle, which lies on the ground.
        Some([x, y, z, roll, pitch, yaw, speed_m_s, 0.0, 0.0, 0.0, 0.0, speed_m_s * curvature_of(path, arc_m)])
    }

    /// What to steer from there: as the path asks on ground that does not give, half as much again and more, and fully inside.
    pub(crate) fn steerings(&self, path: &ReferencePath, arc_m: f64, speed_m_s: f64) -> [f64; 3] {
        let [low, full] = self.vehicle.command_range[1];
        let curvature = curvature_of(path, arc_m + AIM_M);
        let guess = if self.vehicle.second == SecondCommand::YawRateRadS {
            speed_m_s * curvature
        } else {
            let halved = |[low, high]: [f64; 2], _| {
                let middle = 0.5 * (low + high);
                if curvature_1_m(&self.vehicle, middle) < curvature { [middle, high] } else { [low, middle] }
            };
            (0..HALVINGS).fold([low, full], halved)[0]
        };
        [guess, 1.6 * guess, full].map(|steering| steering.clamp(low, full))
    }
}

/// Curvature of the path, 1/m.
fn curvature_of(path: &ReferencePath, arc_m: f64) -> f64 {
    let [before, behind] = [-0.5, 0.5].map(|share| path.heading(path.phi_at(arc_m + share * CURVATURE_OVER_M)));
    let turned = behind - before;
    (turned - TAU * (turned / TAU).round()) / CURVATURE_OVER_M
}

#[cfg(test)]
mod tests {
    use nesam_physics::SecondCommand;
    use nesam_terrain::GridGeometry;

    use super::*;

    /// On a plane that rises by a tenth to the east: height, lean and velocity of a vehicle that drives along the path there, and steering that a bicycle would turn by.
    #[test]
    fn analytic_a_trial_begins_on_the_path_and_along_the_ground() {
        let geometry = GridGeometry { origin_m: [-40.0; 2], resolution_m: 1.0, width: 81, height: 81 };
        let heights = (0..81 * 81).map(|i| 0.1 * (i % 81) as f32).collect();
        let map = Arc::new(WorldMap::from_layers("slope", 1, geometry, heights, None).unwrap());
        let vehicle = Arc::new(nesam_test_vehicles::truck());
        let around = Surroundings { map: Arc::clone(&map), vehicle: Arc::clone(&vehicle) };
        let path = ReferencePath::of_ood_soil();
        let mut measured = [0.0; 12];
        measured[2] = map.height_m(0.0, 0.0).unwrap() + 0.7;
        let arc_m = 30.0;
        let state = around.on_path(&path, arc_m, 2.0, &measured).unwrap();
        let phi = path.phi_at(arc_m);
        assert_eq!([state[0], state[1]], path.point(phi));
        assert!((state[2] - map.height_m(state[0], state[1]).unwrap() - 0.7).abs() < 0.02, "{state:?}");
        let yaw = path.heading(phi);
        assert!((yaw.cos().abs() < 0.95) && state[5] == yaw && state[6..9] == [2.0, 0.0, 0.0], "{state:?}");
        assert!((state[4] + 0.1 * yaw.cos()).abs() < 0.01 && (state[3].abs() - (0.1 * yaw.sin()).abs()).abs() < 0.01, "{state:?}");
        let [guess, more, full] = around.steerings(&path, arc_m, 2.0);
        assert!((curvature_1_m(&vehicle, guess) - curvature_of(&path, arc_m + AIM_M)).abs() < 1e-6 && more > guess && full >= more);
        assert!(around.on_path(&path, arc_m, 2.0, &[1e3; 12]).is_none(), "beyond the map");
        let turning = Arc::new(Vehicle { second: SecondCommand::YawRateRadS, ..(*vehicle).clone() });
        let [rate, ..] = Surroundings { vehicle: turning, ..around }.steerings(&path, arc_m, 2.0);
        assert!((rate - 2.0 * curvature_of(&path, arc_m + AIM_M)).abs() < 1e-12);
    }
}
