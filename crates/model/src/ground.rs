//! What rollout and training share outside the network: the ground under the wheels and the actuators after the history.

use nesam_physics::driveline::DrivelineState;
use nesam_physics::effects::MapTerms;
use nesam_physics::step::{Ground, StepModel};
use nesam_physics::{Control, Real, VehicleState, WHEELS};
use nesam_terrain::WorldMap;

use crate::rollout::HistoryStep;

/// Where the ground is.
#[derive(Clone, Copy, Debug)]
pub enum GroundSource<'a> {
    /// A map.
    Map(&'a WorldMap),
    /// Level ground at this height, m (no map: through the wheels of the start state).
    Level(f64),
}

impl<'a> GroundSource<'a> {
    /// The map, or level ground on which the start state would stand at static ride height.
    pub fn new(map: Option<&'a WorldMap>, model: &StepModel, start: &VehicleState<f64>) -> Self {
        match map {
            Some(map) => Self::Map(map),
            None => Self::Level(level_m(model, start)),
        }
    }

    /// Height of a state above the ground on which it would stand at static ride height, mean over the wheels, m.
    pub(crate) fn clearance_m(&self, model: &StepModel, state: &VehicleState<f64>) -> f64 {
        let (ground, _) = self.under_wheels(model, state, 0.0);
        level_m(model, state) - ground.iter().map(|under| under.height_m).sum::<f64>() / WHEELS as f64
    }

    /// Ground at a point: height (m), slope along x and y of World, and whether the point is known. Effects say how the ground differs from the map.
    pub fn at(&self, effects: &MapTerms, x_m: f64, y_m: f64) -> (f64, [f64; 2], bool) {
        match self {
            Self::Level(height) => (*height, [0.0; 2], true),
            Self::Map(map) => {
                let (mapped, known) = match map.ground(x_m, y_m) {
                    Some(ground) => ((ground.height_m, [ground.slope_x, ground.slope_y]), true),
                    None => ((map.nearest_height_m(x_m, y_m), [0.0; 2]), false),
                };
                let (x_m, y_m) = self.from_middle(x_m, y_m);
                let (height, slope) = effects.raised(x_m, y_m, mapped);
                (height, slope, known)
            }
        }
    }

    /// A point of World seen from the middle of the map, where effects on the map begin to count, m.
    pub fn from_middle(&self, x_m: f64, y_m: f64) -> (f64, f64) {
        match self {
            Self::Level(_) => (x_m, y_m),
            Self::Map(map) => {
                let [middle_x, middle_y] = map.geometry().middle_m();
                (x_m - middle_x, y_m - middle_y)
            }
        }
    }

    /// Ground under each wheel in the heading frame, heights relative to `datum_m`; false when a wheel is off the map.
    pub fn under_wheels(&self, model: &StepModel, state: &VehicleState<f64>, datum_m: f64) -> ([Ground<f64>; WHEELS], bool) {
        let turn = state.attitude_rad[2].sin_cos();
        let mut known = true;
        let ground = wheel_points(model, state).map(|[x, y]| {
            let (height, slope, inside) = self.at(&model.vehicle().effects.map, x, y);
            known &= inside;
            in_heading(turn, height - datum_m, slope)
        });
        (ground, known)
    }
}

/// Level ground on which a state would stand at static ride height, m.
fn level_m(model: &StepModel, state: &VehicleState<f64>) -> f64 {
    let [roll, pitch, _] = state.attitude_rad;
    let offsets = model.wheel_offsets_heading(roll, pitch);
    let mean = offsets.iter().map(|o| o[2]).sum::<f64>() / WHEELS as f64;
    state.position_m[2] + mean - model.vehicle().wheel_radius_m
}

/// Ground of a height and a slope in World (∂z/∂x, ∂z/∂y), seen from a heading of the given sine and cosine.
pub(crate) fn in_heading<T: Real>((sin, cos): (T, T), height_m: T, [east, north]: [T; 2]) -> Ground<T> {
    Ground { height_m, slope_ahead: cos * east + sin * north, slope_left: cos * north - sin * east }
}

/// Points of World under the wheel centres of a state, (x, y) each, m.
pub(crate) fn wheel_points<T: Real>(model: &StepModel, state: &VehicleState<T>) -> [[T; 2]; WHEELS] {
    let [roll, pitch, yaw] = state.attitude_rad;
    let (sin, cos) = yaw.sin_cos();
    model.wheel_offsets_heading(roll, pitch).map(|offset| {
        let x = state.position_m[0] + cos * offset[0] - sin * offset[1];
        let y = state.position_m[1] + sin * offset[0] + cos * offset[1];
        [x, y]
    })
}

/// Actuators at the start of a rollout, rebuilt from the commands and the measured motion of the history.
/// `start` and `first` are the state and the command at the start itself; they begin a history that is empty.
pub fn history_actuators(
    model: &StepModel,
    history: &[HistoryStep],
    start: &VehicleState<f64>,
    first: &Control<f64>,
    dt_s: f64,
) -> DrivelineState {
    actuators_along(|_| model, history, start, first, dt_s)
}

/// The same where effects begin on the way: `model_before(n)` is the physics of the step that begins n steps before the start.
pub(crate) fn actuators_along<'a>(
    model_before: impl Fn(usize) -> &'a StepModel,
    history: &[HistoryStep],
    start: &VehicleState<f64>,
    first: &Control<f64>,
    dt_s: f64,
) -> DrivelineState {
    let (state, control) = history.first().map_or((start, first), |step| (&step.state, &step.control));
    let initial = DrivelineState::starting(model_before(history.len()).vehicle(), state, control);
    history.iter().enumerate().fold(initial, |actuators, (j, step)| {
        let model = model_before(history.len() - j);
        let advanced = actuators.advance(model.vehicle(), &step.control, step.state.velocity_m_s[0], dt_s);
        // The start itself observes nothing: what is predicted from it is smooth in it.
        match history.get(j + 1) {
            Some(next) => model.observed_actuators(&advanced, &step.control, &step.state, &next.state, dt_s),
            None => advanced,
        }
    })
}

#[cfg(test)]
mod tests {
    use nesam_physics::effects::{Effect, EffectTerms, MapTilt};
    use nesam_terrain::GridGeometry;

    use super::*;

    /// Goal: a map that is tilted is tilted about its middle, wherever World begins. Method: the same level map at the origin and far from it.
    #[test]
    fn regress_a_tilted_map_turns_about_its_middle() {
        let mut terms = EffectTerms::default();
        Effect::MapTilt(MapTilt { pitch_rad: 0.01, roll_rad: -0.02 }).add_to(&mut terms);
        for middle in [[0.0, 0.0], [5.0e5, 5.4e6]] {
            let geometry = GridGeometry { origin_m: middle.map(|m| m - 20.0), resolution_m: 0.5, width: 81, height: 81 };
            let map = WorldMap::from_layers("level", 1, geometry, vec![3.0; geometry.cells()], None).expect("a map");
            let at = |x: f64, y: f64| GroundSource::Map(&map).at(&terms.map, middle[0] + x, middle[1] + y);
            assert!((at(0.0, 0.0).0 - 3.0).abs() < 1e-9, "{middle:?}: {}", at(0.0, 0.0).0);
            let want = 3.0 - 10.0 * 0.01f64.tan() + 8.0 * (-0.02f64).tan();
            assert!((at(10.0, 8.0).0 - want).abs() < 1e-6, "{middle:?}: {} {want}", at(10.0, 8.0).0);
        }
    }
}
