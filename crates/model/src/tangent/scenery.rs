//! The terrain along one rollout, held as it was found there.

use nesam_physics::effects::MapTerms;
use nesam_physics::step::{Ground, StepModel};
use nesam_physics::{SOIL_DIM, VehicleState, WHEELS};

use crate::ground::{GroundSource, in_heading, wheel_points};
use crate::tangent::Number;
use crate::terrain_tokens::TerrainToken;

/// The ground around a point of World as a plane.
#[derive(Clone, Copy, Debug)]
pub struct Plane {
    x_m: f64,
    y_m: f64,
    height_m: f64,
    slope: [f64; 2],
}

impl Plane {
    /// The plane at a point; level beyond the map.
    pub fn at(ground: &GroundSource<'_>, effects: &MapTerms, x_m: f64, y_m: f64) -> Self {
        let (height_m, slope, _) = ground.at(effects, x_m, y_m);
        Self { x_m, y_m, height_m, slope }
    }

    /// Height at a point of World, m.
    pub fn height_m<T: Number>(&self, x_m: T, y_m: T) -> T {
        let ([east, north], lit) = (self.slope, T::lit);
        lit(self.height_m) + lit(east) * (x_m - lit(self.x_m)) + lit(north) * (y_m - lit(self.y_m))
    }
}

/// Terrain that one step of a rollout meets: context token and soil prior at the predicted pose, planes under the reference point and the wheels.
#[derive(Clone, Debug)]
pub struct Scenery {
    /// Context token and raw soil.
    pub token: TerrainToken,
    /// Soil prior θ̄.
    pub prior: [f64; SOIL_DIM],
    /// Ground under the reference point.
    pub reference: Plane,
    /// Ground under each wheel centre.
    pub wheels: [Plane; WHEELS],
}

impl Scenery {
    /// Ground under each wheel of a state near the one that the planes were taken at, in the heading frame.
    pub fn under_wheels<T: Number>(&self, model: &StepModel, state: &VehicleState<T>) -> [Ground<T>; WHEELS] {
        let turn = state.attitude_rad[2].sin_cos();
        let points = wheel_points(model, state);
        core::array::from_fn(|i| {
            let plane = &self.wheels[i];
            in_heading(turn, plane.height_m(points[i][0], points[i][1]), plane.slope.map(T::lit))
        })
    }
}
