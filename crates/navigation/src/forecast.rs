//! Who says what candidates would do.

use std::sync::Arc;

use nesam_evaluation::Kinematic;
use nesam_physics::{Control, DT_S, Vehicle, VehicleState};
use nesam_terrain::WorldMap;

use crate::error::NavigationError;
use crate::reference_path::ReferencePath;
use crate::session::ServedForecaster;

/// What is known when a plan is made.
#[derive(Clone, Copy, Debug)]
pub struct Situation<'a> {
    /// Instant of the newest measurement, ns of the plant's time.
    pub stamp_ns: i64,
    /// Newest measured state.
    pub measured: &'a [f64; 12],
    /// Command sent with it; candidates apply from the step after.
    pub sent: Control<f64>,
    /// Commands sent before, oldest first.
    pub past: &'a [Control<f64>],
}

/// x, y, roll, pitch of every candidate at every step, row-major (samples, horizon).
pub type Poses = Vec<[f64; 4]>;

/// A model behind one interface.
pub enum Forecaster {
    /// The service, over its client.
    Served(Box<ServedForecaster>),
    /// A fitted bicycle that rides on the map.
    Kinematic(KinematicForecaster),
}

impl Forecaster {
    /// Tells the model what was measured and which command was sent then.
    ///
    /// # Errors
    /// `NavigationError::Service` when the service is gone or refuses the measurement.
    pub async fn measure(&mut self, situation: &Situation<'_>) -> Result<(), NavigationError> {
        match self {
            Self::Served(served) => served.measure(situation).await,
            Self::Kinematic(_) => Ok(()),
        }
    }

    /// Rolls candidates out, row-major (samples, horizon, 2), from the step after the newest measurement on.
    ///
    /// # Errors
    /// `NavigationError::Service` when the service is gone or refuses.
    pub async fn forecast(&mut self, situation: &Situation<'_>, controls: Vec<f32>, horizon: usize) -> Result<Poses, NavigationError> {
        match self {
            Self::Served(served) => served.forecast(situation, controls, horizon).await,
            Self::Kinematic(kinematic) => Ok(kinematic.forecast(situation, &controls, horizon)),
        }
    }

    /// How far outside the path a vehicle would be after two seconds, m, that begins on it at an arc length, whatever it steers; `None` from a model that knows of no
    /// ground that gives, and beyond the map.
    ///
    /// # Errors
    /// `NavigationError::Service` when the service is gone or refuses.
    pub async fn slide_m(
        &mut self,
        measured: &[f64; 12],
        path: &ReferencePath,
        arc_m: f64,
        speed_m_s: f64,
    ) -> Result<Option<f64>, NavigationError> {
        match self {
            Self::Served(served) => served.slide_m(measured, path, arc_m, speed_m_s).await,
            Self::Kinematic(_) => Ok(None),
        }
    }
}

/// The planner's model without terramechanics.
pub struct KinematicForecaster {
    /// Fitted parameters.
    pub model: Kinematic,
    /// Geometry of the vehicle.
    pub vehicle: Arc<Vehicle>,
    /// Map under it.
    pub map: Arc<WorldMap>,
}

impl KinematicForecaster {
    fn forecast(&self, situation: &Situation<'_>, controls: &[f32], horizon: usize) -> Poses {
        let start = VehicleState::from_array(*situation.measured);
        let control = |c: &[f32]| Control { speed_m_s: f64::from(c[0]), second: f64::from(c[1]) };
        let rows = controls.chunks_exact(2 * horizon).flat_map(|row| {
            let future: Vec<Control<f64>> = std::iter::once(situation.sent).chain(row.chunks_exact(2).map(control)).collect();
            let poses = self.model.predict(&self.vehicle, &start, situation.past, &future, DT_S, Some(&self.map));
            poses.into_iter().skip(1).map(|[x, y, _, roll, pitch, _]| [x, y, roll, pitch])
        });
        rows.collect()
    }
}
