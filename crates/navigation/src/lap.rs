//! One lap.

use std::collections::BTreeMap;

use nesam_physics::{Control, DT_S};
use serde::{Deserialize, Serialize};

use crate::caution::{Caution, CautionSettings};
use crate::error::NavigationError;
use crate::forecast::{Forecaster, Situation};
use crate::link::{PlantLink, Reading, Start};
use crate::mppi::{Mppi, MppiSettings};
use crate::reference_path::{ReferencePath, distance_to_line, hausdorff_m, unwrapped};
use crate::tracker::TrackingCost;

/// Steps at rest before the vehicle is driven off, and steps of straight acceleration before the lap begins (as in the recorded drives).
const SETTLE_STEPS: usize = 10;
const ACCELERATION_STEPS: usize = 15;
/// Share of their travel at the wanted speed that the acceleration steps make good: the vehicle is set down so far behind the beginning of its lap, on the
/// tangent, that it begins the lap on the path and along it.
const RUN_UP_SHARE: f64 = 0.5;
/// A lap is given up this far off the path, m.
const OFF_PATH_MAX_M: f64 = 5.0;
/// Longest time of a lap over that at the wanted speed.
const TIME_FACTOR: f64 = 1.5;
/// Distance between points of the reference for the Hausdorff distance, m.
const REFERENCE_STEP_M: f64 = 0.1;
/// Commands that are remembered for models that want them.
const PAST_MAX: usize = 32;

/// What is to be driven.
#[derive(Clone, Debug)]
pub struct LapPlan {
    /// World to drive in.
    pub world: String,
    /// Angle of the path at which the lap begins, rad.
    pub start_phi: f64,
    /// Seed of sensors and planner.
    pub seed: u64,
    /// The path.
    pub path: ReferencePath,
    /// The cost.
    pub cost: TrackingCost,
    /// The planner.
    pub mppi: MppiSettings,
    /// Steps of a candidate.
    pub horizon: usize,
    /// Steps between plans.
    pub plan_every: usize,
    /// Steering that follows the path on firm ground, the planner's first guess.
    pub steering_guess: f64,
    /// What is tried further ahead than candidates reach; `None` = nothing.
    pub caution: Option<CautionSettings>,
}

/// What came of it. Distances and angles are those of the true motion where the plant tells it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lap {
    /// Whether the whole lap was driven in time and never more than 5 m off the path.
    pub completed: bool,
    /// `complete`, `off_path` or `too_slow`.
    pub end: String,
    /// Time from the beginning of the lap to its end, s.
    pub time_s: f64,
    /// Share of the lap driven.
    pub progress: f64,
    /// Hausdorff distance between what was driven and that part of the path, m.
    pub hausdorff_m: f64,
    /// Mean distance from the path, m.
    pub off_path_mean_m: f64,
    /// Mean |roll|, degrees.
    pub roll_deg: f64,
    /// Mean |pitch|, degrees.
    pub pitch_deg: f64,
    /// What became of the measurements.
    pub measurements: BTreeMap<String, usize>,
    /// Correction of the soil prior that the service held at the end.
    pub soil_delta: Option<[f64; 6]>,
    /// x, y driven, every 0.2 s, m.
    pub path: Vec<[f64; 2]>,
}

/// Drives a lap.
///
/// # Errors
/// `NavigationError` when plant or service fail; leaving the path or getting stuck is a result.
pub async fn run_lap(plan: &LapPlan, plant: &mut dyn PlantLink, model: &mut Forecaster) -> Result<Lap, NavigationError> {
    let ([x, y], yaw_rad) = (plan.path.point(plan.start_phi), plan.path.heading(plan.start_phi));
    let run_up_m = RUN_UP_SHARE * plan.cost.speed_m_s * DT_S * ACCELERATION_STEPS as f64;
    let position_m = [x - run_up_m * yaw_rad.cos(), y - run_up_m * yaw_rad.sin()];
    let start = Start { world: plan.world.clone(), seed: plan.seed, position_m, yaw_rad };
    let mut reading = plant.reset(&start)?;
    for _ in 0..SETTLE_STEPS {
        reading = plant.step(Control { speed_m_s: 0.0, second: 0.0 })?;
    }
    let guess = Control { speed_m_s: plan.cost.speed_m_s, second: plan.steering_guess };
    let mut drive = Driver {
        plan,
        planner: Mppi::new(plan.mppi, vec![guess; plan.horizon], plan.seed.wrapping_mul(0x9e37_79b9) ^ 0x5bd1),
        past: Vec::new(),
        stamp_ns: 0,
        caution: Caution::new(plan.caution),
    };
    let straight = Control { speed_m_s: plan.cost.speed_m_s, second: 0.0 };
    for _ in 0..ACCELERATION_STEPS {
        drive.tell(model, &reading, straight).await?;
        reading = plant.step(straight)?;
    }
    let mut track = Track::new(plan, &reading);
    let mut step = 0;
    while track.end(plan).is_none() {
        let command = drive.planner.next_command();
        drive.tell(model, &reading, command).await?;
        drive.look_ahead(model, &reading, track.phi, step).await?;
        if step % plan.plan_every == 0 {
            drive.think(model, &reading, track.phi).await?;
        }
        reading = plant.step(command)?;
        track.add(plan, &reading);
        step += 1;
    }
    let mut lap = track.lap(plan);
    if let Forecaster::Served(served) = model {
        lap.measurements = served.outcomes.iter().map(|(name, count)| ((*name).to_string(), *count)).collect();
        lap.soil_delta = served.soil_delta;
    }
    Ok(lap)
}

/// The planner with its clock and its memory of commands.
struct Driver<'a> {
    plan: &'a LapPlan,
    planner: Mppi,
    past: Vec<Control<f64>>,
    stamp_ns: i64,
    caution: Caution,
}

impl Driver<'_> {
    /// Tells the model what was measured and what is commanded from now on.
    async fn tell(&mut self, model: &mut Forecaster, reading: &Reading, command: Control<f64>) -> Result<(), NavigationError> {
        self.stamp_ns += (DT_S * 1e9).round() as i64;
        if self.past.len() == PAST_MAX {
            self.past.remove(0);
        }
        self.past.push(command);
        model.measure(&self.situation(reading)).await
    }

    fn situation<'b>(&'b self, reading: &'b Reading) -> Situation<'b> {
        let (sent, past) = self.past.split_last().map_or((Control { speed_m_s: 0.0, second: 0.0 }, &[][..]), |(sent, past)| (*sent, past));
        Situation { stamp_ns: self.stamp_ns, measured: &reading.measured, sent, past }
    }

    /// Tries places of the path ahead, every few steps.
    async fn look_ahead(&mut self, model: &mut Forecaster, reading: &Reading, phi: f64, step: usize) -> Result<(), NavigationError> {
        let Some(settings) = self.caution.settings().copied().filter(|s| step.is_multiple_of(s.every_steps)) else { return Ok(()) };
        let path = &self.plan.path;
        for ahead_m in settings.ahead_m {
            let arc_m = path.arc_m(phi) + ahead_m;
            if let Some(slide_m) = model.slide_m(&reading.measured, path, arc_m, settings.trial_speed_m_s).await? {
                self.caution.note(arc_m, slide_m);
            }
        }
        Ok(())
    }

    /// Moves the plan, which begins with the command after the one just sent.
    async fn think(&mut self, model: &mut Forecaster, reading: &Reading, phi: f64) -> Result<(), NavigationError> {
        let arc_m = self.plan.path.arc_m(phi);
        self.planner.limit_speed(self.caution.speed_limits_m_s(arc_m, self.plan.mppi.limits[0]));
        let controls = self.planner.propose(&[]);
        let poses = model.forecast(&self.situation(reading), controls, self.plan.horizon).await?;
        let (plan, caution) = (self.plan, &self.caution);
        let costs: Vec<f64> = poses.chunks_exact(plan.horizon).map(|rows| plan.cost.of(&plan.path, caution, phi, rows, DT_S)).collect();
        self.planner.improve(&costs);
        Ok(())
    }
}

/// What was driven since the lap began.
struct Track {
    begun_phi: f64,
    /// Angle reached, unwrapped.
    phi: f64,
    positions: Vec<[f64; 2]>,
    off_path_m: f64,
    off_path_sum_m: f64,
    roll_sum: f64,
    pitch_sum: f64,
    local: Vec<[f64; 2]>,
}

impl Track {
    fn new(plan: &LapPlan, reading: &Reading) -> Self {
        let [x, y] = [reading.truth[0], reading.truth[1]];
        let phi = unwrapped(plan.path.offset(x, y).phi, plan.start_phi);
        let local = plan.path.points_between(0.0, std::f64::consts::TAU, REFERENCE_STEP_M);
        let nothing = (0.0, 0.0, 0.0, 0.0);
        let (off_path_m, off_path_sum_m, roll_sum, pitch_sum) = nothing;
        Self { begun_phi: phi, phi, positions: vec![[x, y]], off_path_m, off_path_sum_m, roll_sum, pitch_sum, local }
    }

    fn add(&mut self, plan: &LapPlan, reading: &Reading) {
        let [x, y] = [reading.truth[0], reading.truth[1]];
        self.phi = unwrapped(plan.path.offset(x, y).phi, self.phi);
        self.positions.push([x, y]);
        self.off_path_m = distance_to_line([x, y], &self.local);
        self.off_path_sum_m += self.off_path_m;
        self.roll_sum += reading.truth[3].abs();
        self.pitch_sum += reading.truth[4].abs();
    }

    fn progress(&self, plan: &LapPlan) -> f64 {
        (plan.path.arc_m(self.phi) - plan.path.arc_m(self.begun_phi)) / plan.path.length_m()
    }

    fn time_s(&self) -> f64 {
        (self.positions.len() - 1) as f64 * DT_S
    }

    fn end(&self, plan: &LapPlan) -> Option<&'static str> {
        // A position that is not a number is off any path.
        if !(self.off_path_m <= OFF_PATH_MAX_M) {
            return Some("off_path");
        }
        if self.progress(plan) >= 1.0 {
            return Some("complete");
        }
        (self.time_s() >= TIME_FACTOR * plan.path.length_m() / plan.cost.speed_m_s).then_some("too_slow")
    }

    fn lap(&self, plan: &LapPlan) -> Lap {
        let end = self.end(plan).unwrap_or("too_slow");
        let steps = (self.positions.len() - 1).max(1) as f64;
        let reached = self.phi.max(self.begun_phi + 1e-3);
        let part = plan.path.points_between(self.begun_phi, reached, REFERENCE_STEP_M);
        Lap {
            completed: end == "complete",
            end: end.into(),
            time_s: self.time_s(),
            progress: self.progress(plan).clamp(0.0, 1.0),
            hausdorff_m: hausdorff_m(&self.positions, &part),
            off_path_mean_m: self.off_path_sum_m / steps,
            roll_deg: (self.roll_sum / steps).to_degrees(),
            pitch_deg: (self.pitch_sum / steps).to_degrees(),
            measurements: BTreeMap::new(),
            soil_delta: None,
            path: self.positions.iter().step_by(2).copied().collect(),
        }
    }
}
