//! One lap.

use std::collections::BTreeMap;

use nesam_physics::{Control, DT_S};
use serde::{Deserialize, Serialize};

use crate::caution::{Caution, CautionSettings};
use crate::error::NavigationError;
use crate::forecast::{Forecaster, Situation};
use crate::link::{PlantLink, Reading, Start};
use crate::mppi::{Mppi, MppiSettings};
use crate::plausibility::{OVERTURNED, TurnCheck, VelocityCheck, usable};
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
/// Ends of laps that the driving alone makes: the vehicle was let drive until then.
pub(crate) const OWN_ENDS: [&str; 3] = ["complete", "off_path", "too_slow"];
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

impl LapPlan {
    /// Where the vehicle is set down: on the tangent, so far behind the beginning of the lap that the run-up ends there.
    pub fn start(&self) -> Start {
        let ([x, y], yaw_rad) = (self.path.point(self.start_phi), self.path.heading(self.start_phi));
        let run_up_m = RUN_UP_SHARE * self.cost.speed_m_s * DT_S * ACCELERATION_STEPS as f64;
        let position_m = [x - run_up_m * yaw_rad.cos(), y - run_up_m * yaw_rad.sin()];
        Start { world: self.world.clone(), seed: self.seed, position_m, yaw_rad }
    }
}

/// What a lap is scored by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scored {
    /// The true motion.
    #[default]
    Truth,
    /// What the sensors say, of a plant that does not tell the truth.
    State,
}

/// What came of it. Distances and angles are those of the true motion where the plant tells it; `None` of a lap that ended before its first step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lap {
    /// Whether the whole lap was driven in time and never more than 5 m off the path.
    pub completed: bool,
    /// `complete`, `off_path`, `too_slow`, `overturned`, `plant_lost`, or the text with which the plant ended the lap.
    pub end: String,
    /// Time from the beginning of the lap to its end, s.
    pub time_s: f64,
    /// Share of the lap driven.
    pub progress: f64,
    /// Hausdorff distance between what was driven and that part of the path, m: how well the path was kept to, also by a lap that ends early.
    pub hausdorff_m: Option<f64>,
    /// Hausdorff distance between what was driven and the whole path, m: a lap that ends early is as far off as the farthest place that it never came to. `None`
    /// also of a lap that an earlier version has kept.
    #[serde(default)]
    pub hausdorff_whole_path_m: Option<f64>,
    /// Mean distance from the path, m.
    pub off_path_mean_m: Option<f64>,
    /// Mean |roll|, degrees.
    pub roll_deg: Option<f64>,
    /// Mean |pitch|, degrees.
    pub pitch_deg: Option<f64>,
    /// What became of the measurements.
    pub measurements: BTreeMap<String, usize>,
    /// Correction of the soil prior that the service held at the end.
    pub soil_delta: Option<[f64; 6]>,
    /// What distances and angles are those of.
    #[serde(default)]
    pub scored: Scored,
    /// Root mean square, over the lap, of what measured positions and measured velocities (Body) say differently of the horizontal motion of a second, m/s; `None`
    /// for a lap of less than a second.
    #[serde(default)]
    pub velocity_mismatch_m_s: Option<f64>,
    /// How many times as far as measured velocities say the measured positions move, where one factor is most of what they differ by: a step that takes another
    /// time than 0.1 s, or another unit.
    #[serde(default)]
    pub moved_over_told: Option<f64>,
    /// Correlation of the commanded second with the measured yaw rate above 1 m/s: near -1 where the vehicle turns the other way; `None` where it hardly turned.
    #[serde(default)]
    pub turn_correlation: Option<f64>,
    /// Mean horizontal distance of the measured positions from the true ones, m: noise of the sensors, or another point or frame; `None` where the plant does not tell the
    /// truth.
    #[serde(default)]
    pub measured_off_m: Option<f64>,
    /// x, y driven from the beginning of the lap to its end, every 0.1 s, m; every 0.2 s in a lap that an earlier version has kept.
    pub path: Vec<[f64; 2]>,
    /// How the vehicle leant, every 0.1 s.
    pub lean: Vec<Lean>,
}

/// How the vehicle leans at a place.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lean {
    /// Share of the lap driven.
    pub progress: f64,
    /// |roll|, degrees.
    pub roll_deg: f64,
    /// |pitch|, degrees.
    pub pitch_deg: f64,
}

impl Lap {
    /// Whether it was driven at all: one that ended before its first step says nothing of how the vehicle drives.
    pub fn is_begun(&self) -> bool {
        !self.lean.is_empty()
    }

    /// Whether the vehicle was let drive until it had come round, left the path, was too slow or overturned: of a lap that ended otherwise nobody knows how far off the path
    /// the rest of it would have been.
    pub fn is_driven_out(&self) -> bool {
        OWN_ENDS.contains(&self.end.as_str()) || self.end == OVERTURNED
    }

    /// Leaves out what is told of a lap that was not driven: an earlier version kept zeros for it, and the place where it was to begin.
    pub(crate) fn without_inventions(mut self) -> Self {
        if !self.is_begun() {
            (self.hausdorff_m, self.hausdorff_whole_path_m, self.off_path_mean_m) = (None, None, None);
            (self.roll_deg, self.pitch_deg, self.measured_off_m) = (None, None, None);
            self.path.clear();
        }
        self
    }

    /// Mean of an angle over the first part of the lap, from its beginning to where the vehicle first came to `progress`: what two laps, of which one ends
    /// earlier, are compared by, since ground that one never came to says nothing of how the other drives. `None` where nothing was driven.
    pub fn mean_lean_until(&self, progress: f64, of: fn(&Lean) -> f64) -> Option<f64> {
        let steps = self.lean.iter().position(|lean| lean.progress >= progress).map_or(self.lean.len(), |first| first + 1);
        mean_lean(&self.lean[..steps], of)
    }
}

/// Mean of an angle; `None` of no step.
fn mean_lean(lean: &[Lean], of: fn(&Lean) -> f64) -> Option<f64> {
    (!lean.is_empty()).then(|| lean.iter().map(of).sum::<f64>() / lean.len() as f64)
}

/// Drives a lap.
///
/// # Errors
/// `NavigationError` when plant or service fail; leaving the path, getting stuck, overturning or a simulation that diverges is a result.
pub async fn run_lap(plan: &LapPlan, plant: &mut dyn PlantLink, model: &mut Forecaster) -> Result<Lap, NavigationError> {
    let guess = Control { speed_m_s: plan.cost.speed_m_s, second: plan.steering_guess };
    let mut drive = Driver {
        plan,
        planner: Mppi::new(plan.mppi, vec![guess; plan.horizon], plan.seed.wrapping_mul(0x9e37_79b9) ^ 0x5bd1),
        past: Vec::new(),
        stamp_ns: 0,
        caution: Caution::new(plan.caution),
    };
    let mut lap = match drive.run_up(plant, model).await? {
        Ok(reading) => drive.circuit(reading, plant, model).await?.lap(plan),
        Err(end) => Track { ended: Some(end), ..Track::at(plan, plan.start().position_m) }.lap(plan),
    };
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
    /// Sets the vehicle down, lets it settle and accelerates it. Gives the reading with which the lap begins, or how it ends before.
    async fn run_up(&mut self, plant: &mut dyn PlantLink, model: &mut Forecaster) -> Result<Result<Reading, String>, NavigationError> {
        let mut next = usable(&plant.reset(&self.plan.start())?);
        for _ in 0..SETTLE_STEPS {
            if next.is_err() {
                return Ok(next);
            }
            next = usable(&plant.step(Control { speed_m_s: 0.0, second: 0.0 })?);
        }
        let straight = Control { speed_m_s: self.plan.cost.speed_m_s, second: 0.0 };
        for _ in 0..ACCELERATION_STEPS {
            let Ok(reading) = &next else { break };
            self.tell(model, reading, straight).await?;
            next = usable(&plant.step(straight)?);
        }
        Ok(next)
    }

    /// Drives from the beginning of the lap to its end.
    async fn circuit(&mut self, mut reading: Reading, plant: &mut dyn PlantLink, model: &mut Forecaster) -> Result<Track, NavigationError> {
        let plan = self.plan;
        let mut track = Track::new(plan, &reading);
        let mut step = 0;
        while track.end(plan).is_none() {
            let command = self.planner.next_command();
            self.tell(model, &reading, command).await?;
            self.look_ahead(model, &reading, track.phi, step).await?;
            if step % plan.plan_every == 0 {
                self.think(model, &reading, track.phi).await?;
            }
            match usable(&plant.step(command)?) {
                Ok(next) => {
                    track.add(plan, &next, command);
                    reading = next;
                }
                Err(end) => track.ended = Some(end),
            }
            step += 1;
        }
        Ok(track)
    }

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
    lean: Vec<Lean>,
    /// The whole path.
    whole: Vec<[f64; 2]>,
    scored: Scored,
    measured_off_sum_m: f64,
    velocity: VelocityCheck,
    turns: TurnCheck,
    /// How the lap ended before its time: the vehicle or its simulation is beyond driving.
    ended: Option<String>,
}

impl Track {
    /// A lap that begins at a place of which nothing has been read yet.
    fn at(plan: &LapPlan, [x, y]: [f64; 2]) -> Self {
        let phi = unwrapped(plan.path.offset(x, y).phi, plan.start_phi);
        Self {
            begun_phi: phi,
            phi,
            positions: vec![[x, y]],
            off_path_m: 0.0,
            off_path_sum_m: 0.0,
            lean: Vec::new(),
            whole: plan.path.points_between(0.0, std::f64::consts::TAU, REFERENCE_STEP_M),
            scored: Scored::Truth,
            measured_off_sum_m: 0.0,
            velocity: VelocityCheck::default(),
            turns: TurnCheck::default(),
            ended: None,
        }
    }

    fn new(plan: &LapPlan, reading: &Reading) -> Self {
        let [x, y, ..] = *reading.scored();
        let mut track = Self::at(plan, [x, y]);
        track.note(reading);
        track
    }

    /// What is kept of every reading beside its place.
    fn note(&mut self, reading: &Reading) {
        match &reading.truth {
            None => self.scored = Scored::State,
            Some(truth) => self.measured_off_sum_m += (reading.measured[0] - truth[0]).hypot(reading.measured[1] - truth[1]),
        }
        self.velocity.add(&reading.measured);
    }

    /// What the vehicle did with a command.
    fn add(&mut self, plan: &LapPlan, reading: &Reading, command: Control<f64>) {
        let [x, y, _, roll, pitch, ..] = *reading.scored();
        self.phi = unwrapped(plan.path.offset(x, y).phi, self.phi);
        self.positions.push([x, y]);
        self.off_path_m = distance_to_line([x, y], &self.whole);
        self.off_path_sum_m += self.off_path_m;
        self.lean.push(Lean { progress: self.progress(plan), roll_deg: roll.abs().to_degrees(), pitch_deg: pitch.abs().to_degrees() });
        self.turns.add(command, &reading.measured);
        self.note(reading);
    }

    fn progress(&self, plan: &LapPlan) -> f64 {
        (plan.path.arc_m(self.phi) - plan.path.arc_m(self.begun_phi)) / plan.path.length_m()
    }

    fn time_s(&self) -> f64 {
        (self.positions.len() - 1) as f64 * DT_S
    }

    fn end(&self, plan: &LapPlan) -> Option<&str> {
        if self.ended.is_some() {
            return self.ended.as_deref();
        }
        if self.off_path_m > OFF_PATH_MAX_M {
            return Some("off_path");
        }
        if self.progress(plan) >= 1.0 {
            return Some("complete");
        }
        (self.time_s() >= TIME_FACTOR * plan.path.length_m() / plan.cost.speed_m_s).then_some("too_slow")
    }

    fn lap(&self, plan: &LapPlan) -> Lap {
        let end = self.end(plan).unwrap_or("too_slow");
        let reached = self.phi.max(self.begun_phi + 1e-3);
        let part = plan.path.points_between(self.begun_phi, reached, REFERENCE_STEP_M);
        let lap = Lap {
            // Whatever a plant calls the end that it makes, it is none of a whole lap.
            completed: self.ended.is_none() && end == "complete",
            end: end.into(),
            time_s: self.time_s(),
            progress: self.progress(plan).clamp(0.0, 1.0),
            hausdorff_m: Some(hausdorff_m(&self.positions, &part)),
            hausdorff_whole_path_m: Some(hausdorff_m(&self.positions, &self.whole)),
            off_path_mean_m: Some(self.off_path_sum_m / self.lean.len() as f64),
            roll_deg: mean_lean(&self.lean, |lean| lean.roll_deg),
            pitch_deg: mean_lean(&self.lean, |lean| lean.pitch_deg),
            measurements: BTreeMap::new(),
            soil_delta: None,
            scored: self.scored,
            velocity_mismatch_m_s: self.velocity.mismatch_m_s(),
            moved_over_told: self.velocity.moved_over_told(),
            turn_correlation: self.turns.correlation(),
            measured_off_m: (self.scored == Scored::Truth).then(|| self.measured_off_sum_m / self.positions.len() as f64),
            path: self.positions.clone(),
            lean: self.lean.clone(),
        };
        lap.without_inventions()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: how far a lap that ends early is from the path is told of the part that was driven and of the whole. Method: half of the path, exactly on it, and all of it;
    /// the farthest place that the half never came to lies as far from its nearest end as a count over the path's points says.
    #[test]
    fn analytic_distances_of_the_part_that_was_driven_and_of_the_whole_path() {
        let path = ReferencePath::of_ood_soil();
        let plan = LapPlan {
            world: String::new(),
            start_phi: 0.0,
            seed: 1,
            path: path.clone(),
            cost: TrackingCost { speed_m_s: 3.0, lag: 0.1, tilt: 2.0 },
            mppi: MppiSettings {
                candidates: 2,
                limits: [[0.5, 4.0], [-1.0, 1.0]],
                noise_sd: [0.4, 0.1],
                noise_correlation: 0.8,
                temperature: 0.1,
            },
            horizon: 1,
            plan_every: 1,
            steering_guess: 0.0,
            caution: None,
        };
        let driven = |until_phi: f64| {
            let mut track = Track::at(&plan, path.point(0.0));
            track.positions = path.points_between(0.0, until_phi, REFERENCE_STEP_M);
            track.phi = until_phi;
            track.lean.push(Lean { progress: 1.0, roll_deg: 0.0, pitch_deg: 0.0 });
            let lap = track.lap(&plan);
            assert_eq!(lap.path, track.positions, "figures can be computed again");
            (lap.hausdorff_m.unwrap(), lap.hausdorff_whole_path_m.unwrap())
        };
        let (half_m, half_of_whole_m) = driven(std::f64::consts::PI);
        let left = path.points_between(std::f64::consts::PI, std::f64::consts::TAU, REFERENCE_STEP_M);
        let line = path.points_between(0.0, std::f64::consts::PI, REFERENCE_STEP_M);
        let farthest_m = left.iter().map(|point| distance_to_line(*point, &line)).fold(0.0, f64::max);
        assert!(half_m < 0.01, "{half_m}");
        assert!(farthest_m > 10.0 && (half_of_whole_m - farthest_m).abs() < 0.1, "{half_of_whole_m} {farthest_m}");
        let (whole_m, of_whole_m) = driven(std::f64::consts::TAU);
        assert!(whole_m < 0.01 && of_whole_m < 0.01, "{whole_m} {of_whole_m}");
    }
}
