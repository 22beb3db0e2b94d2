//! The oracle: a session that is told the true soil instead of learning it.

use nesam_client::{Candidates, Client, v1};
use nesam_physics::SoilCoordinates;
use nesam_plant::{Ground, SoilParameters};

use crate::error::NavigationError;
use crate::reference_path::ReferencePath;
use crate::session::session_request;

/// Distance of the places at which prior and truth are compared, m.
const STEP_M: f64 = 0.5;
/// Name of the session that is asked for the prior.
const SESSION: &str = "oracle-prior";

/// What turns the model's soil prior into the true soil, along a path. A session applies one correction over a whole horizon, so the oracle tells it the mean
/// over the stretch ahead.
#[derive(Clone, Debug)]
pub struct SoilAhead {
    path: ReferencePath,
    stretch: usize,
    /// Correction at every [`STEP_M`] of the lap, in the coordinates of the service.
    deltas: Vec<[f64; 6]>,
}

impl SoilAhead {
    /// Compares the prior of the service with the true soil along the path: asks for one-step predictions from standing starts there and reads the soil that
    /// they used. `stretch_m` is how far a horizon reaches.
    ///
    /// # Errors
    /// `NavigationError::Service` as the service says.
    pub async fn along(
        client: &mut Client,
        map: &str,
        ground: &Ground,
        path: &ReferencePath,
        stretch_m: f64,
    ) -> Result<Self, NavigationError> {
        client.open_session(session_request(SESSION, map)).await?;
        let mut deltas = Vec::new();
        let count = (path.length_m() / STEP_M).ceil() as usize;
        for i in 0..count {
            let phi = path.phi_at(path.length_m() * i as f64 / count as f64);
            let ([x, y], yaw) = (path.point(phi), path.heading(phi));
            let height = ground.height_m(x, y).unwrap_or(0.0) + 0.6;
            let mut question = Candidates::new(SESSION, 1, 1, vec![1.0, 0.0]);
            question.start = Some([x, y, height, 0.0, 0.0, yaw, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
            question.use_history = false;
            let answer = client.predict(question).await?;
            let physical = answer.soil_correction.coordinates == v1::SoilCoordinates::Physical as i32;
            let coordinates = if physical { SoilCoordinates::Physical } else { SoilCoordinates::Logarithmic };
            let truth = ground.soil_at(x, y).map_or(answer.soil, |soil| soil_vector(&soil));
            deltas.push(coordinates.between(&answer.soil, &truth));
        }
        client.close_session(SESSION).await?;
        Ok(Self { path: path.clone(), stretch: ((stretch_m / STEP_M) as usize).clamp(1, count), deltas })
    }

    /// Mean correction over the stretch ahead of a place.
    pub fn ahead_of(&self, [x_m, y_m]: [f64; 2]) -> [f64; 6] {
        let share = self.path.arc_m(self.path.offset(x_m, y_m).phi) / self.path.length_m();
        let first = (share.rem_euclid(1.0) * self.deltas.len() as f64) as usize;
        let over = (0..self.stretch).map(|i| &self.deltas[(first + i) % self.deltas.len()]);
        over.fold([0.0; 6], |sum, delta| std::array::from_fn(|p| sum[p] + delta[p] / self.stretch as f64))
    }
}

/// In the order of the service's soil vector.
fn soil_vector(soil: &SoilParameters) -> [f64; 6] {
    [soil.k_phi, soil.k_c, soil.n, soil.cohesion_pa, soil.friction_rad, soil.shear_m]
}
