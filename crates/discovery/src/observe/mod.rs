//! Measured drives as segments of the frozen reference: what the physics predicts there, with or without effects.
//!
//! The network is asked once, at every measured sample ([`Predictor::transition`]); its sinkage ratios and residuals are then constants, so
//! an effect or another soil changes the prediction through the physics alone. A segment starts at a measured state and runs a few steps: long
//! enough for forces to rise above the noise of one sample, short enough to stay near the measured path.

pub mod channels;
pub mod condense;
pub(crate) mod consistency;
pub(crate) mod lack;
pub(crate) mod metric;
pub(crate) mod still;

use std::sync::Arc;

use nesam_evaluation::{DriveMaps, history_steps};
use nesam_model::{GroundSource, ModelBundle, Predictor, Transition};
use nesam_physics::driveline::{DrivelineState, command_wheels, rim_twist};
use nesam_physics::effects::{Effect, MapTerms, Phases, ScheduledEffect};
use nesam_physics::step::{StepInput, StepModel, StepOutput};
use nesam_physics::{Ride, SOIL_DIM, STATE_DIM, SecondCommand, Soil, SoilCorrection, UsualRide, Vehicle, VehicleState, WHEELS, wrap_angle};
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use crate::candidates::Candidate;
use crate::candidates::bend::Driven;
use crate::error::DiscoveryError;
use crate::observe::channels::{BINS, CHANNELS, RIM_AT, Row, SEGMENT_STEPS, STATE_CHANNELS, STEERING_AT, available};
use crate::observe::consistency::add_consistency;

/// First sample of the first segment, so that the actuators are known from the commands before it.
const FIRST_START: usize = 16;
/// The same where the measured rims tell where the actuators begin.
const FIRST_START_SERVOED: usize = 1;
/// Over-speed beyond which a wheel spins more than it grips, m/s (chosen: a slip of a fifth at the usual speed).
const GRIPPING_M_S: f64 = 0.5;
/// How far apart, m and rad, the poses are that the network is asked about: a few times what a load makes (chosen).
const ASKED_APART: f64 = 0.01;
/// Smallest change of tractive force per rim over-speed that is believed, N per m/s (a wheel in the air has none).
const TRACTION_SLOPE_FLOOR: f64 = 2000.0;

/// Step and sub-steps of the physics, and how the vehicle usually rides.
#[derive(Clone, Copy, Debug)]
pub struct Stepping {
    /// Step, s.
    pub dt_s: f64,
    /// Sub-steps.
    pub substeps: usize,
    /// Ride without effects; `None` where the network says nothing, so that nobody needs to know how effects shift the ride.
    pub usual_ride: Option<UsualRide>,
}

impl Stepping {
    /// As a bundle steps.
    pub fn of(bundle: &ModelBundle) -> Self {
        let scales = &bundle.normalization;
        Self { dt_s: scales.dt_s, substeps: scales.substeps, usual_ride: bundle.speaks().then(|| bundle.usual_ride()) }
    }

    /// The physics of a vehicle.
    pub fn model(&self, vehicle: &Vehicle) -> StepModel {
        let model = StepModel::new(vehicle, self.dt_s, self.substeps);
        match self.usual_ride {
            Some(usual) => model.riding_as(|| usual),
            None => model,
        }
    }
}

/// The reference that drives are compared with, and what may explain the difference.
#[derive(Clone, Copy, Debug)]
pub struct Bench<'a> {
    /// Vehicle of the reference, all of its effects begun.
    pub vehicle: &'a Vehicle,
    /// Effects of the reference, each from its onset on.
    pub effects: &'a [ScheduledEffect],
    /// Physics.
    pub stepping: Stepping,
    /// All hypotheses.
    pub catalogue: &'a [Candidate],
    /// What was found of the ground under all drives beside the effects found so far, where a model on trial has no map to tell it.
    pub ground: SoilCorrection,
}

impl<'a> Bench<'a> {
    /// With all of these hypotheses, on the ground as it is assumed.
    pub fn new(bundle: &'a ModelBundle, catalogue: &'a [Candidate]) -> Self {
        let ModelBundle { vehicle, effects, .. } = bundle;
        Self { vehicle, effects, stepping: Stepping::of(bundle), catalogue, ground: SoilCorrection::NONE }
    }
}

impl Bench<'_> {
    /// Physics of the vehicle in each phase of a drive in which effects begin, beside those of the reference that always act.
    fn phases(&self, effects: &[ScheduledEffect]) -> Phases<StepModel> {
        let of = |vehicle: &Vehicle| Phases::of(effects, |begun| self.stepping.model(&vehicle.with_effects(begun)));
        if self.late().next().is_none() {
            return of(self.vehicle);
        }
        let always: Vec<Effect> = self.effects.iter().filter(|e| e.onset_s <= 0.0).map(|e| e.effect).collect();
        let bare = Vehicle { effects: Default::default(), ..self.vehicle.clone() };
        of(&bare.with_effects(&always))
    }

    /// Effects of the reference that begin within a log.
    fn late(&self) -> impl Iterator<Item = ScheduledEffect> {
        self.effects.iter().filter(|e| e.onset_s > 0.0).copied()
    }
}

/// A measured drive, prepared: nothing of it depends on an effect or a soil correction.
#[derive(Clone, Debug)]
pub struct ObservedDrive {
    /// Trajectory id.
    pub id: String,
    /// Measured channels.
    pub available: [bool; CHANNELS],
    /// First sample of each segment, ascending.
    pub starts: Vec<usize>,
    map: Option<Arc<WorldMap>>,
    states: Vec<VehicleState<f64>>,
    transitions: Vec<Transition>,
    /// How what the network says of each sample follows the pose that it is asked about; empty where it says nothing.
    follows: Vec<Follows>,
    /// What the network knew of effects when it was asked.
    known: Known,
    wheel_speed_rad_s: Option<Vec<[f64; WHEELS]>>,
    road_wheel_angle_rad: Option<Vec<[f64; 2]>>,
    /// ∂(tractive force)/∂(rim over-speed) of each wheel at each sample, N per m/s.
    traction_slope: Vec<[f64; WHEELS]>,
}

/// Effects of the bundle, without which the network was asked about a pose.
#[derive(Clone, Copy, Debug)]
struct Known {
    /// What they make of the ride.
    ride_shift: Ride,
    /// Where they put the ground.
    map: MapTerms,
}

/// A drive as a vehicle with some effects would explain it: its physics, its actuators, and the states behind what was measured.
struct Reading {
    model: StepModel,
    actuators: Vec<[DrivelineState; 2]>,
    states: Vec<VehicleState<f64>>,
}

/// Change of what the network says of a sample, per metre of height and per rad of roll and pitch that the pose it is asked about is the less.
#[derive(Clone, Copy, Debug)]
struct Follows {
    residual: [[f64; STATE_DIM]; 3],
    sinkage_log_ratio: [[f64; WHEELS]; 3],
}

impl Follows {
    /// From what it says of the pose itself and of poses that are less by [`ASKED_APART`] in height, roll and pitch.
    fn between(here: &Transition, apart: [&Transition; 3]) -> Self {
        let slope = |there: f64, here: f64| (there - here) / ASKED_APART;
        Self {
            residual: apart.map(|t| core::array::from_fn(|i| slope(t.residual[i], here.residual[i]))),
            sinkage_log_ratio: apart
                .map(|t| core::array::from_fn(|w| slope(t.input.sinkage_log_ratio[w], here.input.sinkage_log_ratio[w]))),
        }
    }

    /// What the network says where effects shift the ride: of the pose without the shift, since it knows the vehicle without the effects.
    fn said(&self, transition: &Transition, ride_shift: &Ride) -> ([f64; STATE_DIM], [f64; WHEELS]) {
        let more = |slopes: [f64; 3]| slopes.iter().zip(ride_shift).map(|(slope, shift)| slope * shift).sum::<f64>();
        (
            core::array::from_fn(|i| transition.residual[i] + more(self.residual.map(|r| r[i]))),
            core::array::from_fn(|w| transition.input.sinkage_log_ratio[w] + more(self.sinkage_log_ratio.map(|s| s[w]))),
        )
    }
}

/// Physics, state and actuators of one sample.
type WayToDrive<'a> = (&'a StepModel, &'a VehicleState<f64>, &'a [DrivelineState; 2], &'a StepOutput<f64>);

/// Prepares drives, world by world, because a predictor keeps terrain features of a few maps only; `done` is called after each drive.
///
/// # Errors
/// `DiscoveryError::NoSegments` for a drive without a usable segment.
pub fn observe_all(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &DriveMaps,
    done: &(dyn Fn(usize) + Sync),
) -> Result<Vec<ObservedDrive>, DiscoveryError> {
    in_order(drives, maps, &|drive, map| observe(predictor, drive, map), done)
}

/// The same for deviations without effects alone: how the network follows the pose, which is most of the work, is not asked.
pub(crate) fn observe_plain(predictor: &Predictor, drives: &[Trajectory], maps: &DriveMaps) -> Result<Vec<ObservedDrive>, DiscoveryError> {
    in_order(drives, maps, &|drive, map| observed(predictor, drive, map, false), &|_| {})
}

fn in_order(
    drives: &[Trajectory],
    maps: &DriveMaps,
    observe: &dyn Fn(&Trajectory, Option<&Arc<WorldMap>>) -> Result<ObservedDrive, DiscoveryError>,
    done: &(dyn Fn(usize) + Sync),
) -> Result<Vec<ObservedDrive>, DiscoveryError> {
    let mut order: Vec<usize> = (0..drives.len()).collect();
    order.sort_by_key(|&d| maps[d].as_ref().map(|m| m.hash().to_string()));
    let mut observed = Vec::with_capacity(drives.len());
    for (count, d) in order.into_iter().enumerate() {
        observed.push((d, observe(&drives[d], maps[d].as_ref())?));
        done(count + 1);
    }
    observed.sort_by_key(|(d, _)| *d);
    Ok(observed.into_iter().map(|(_, o)| o).collect())
}

/// Prepares one drive.
///
/// # Errors
/// `DiscoveryError::NoSegments` when no segment fits on known ground.
pub fn observe(predictor: &Predictor, drive: &Trajectory, map: Option<&Arc<WorldMap>>) -> Result<ObservedDrive, DiscoveryError> {
    observed(predictor, drive, map, predictor.bundle().speaks())
}

fn observed(
    predictor: &Predictor,
    drive: &Trajectory,
    map: Option<&Arc<WorldMap>>,
    following: bool,
) -> Result<ObservedDrive, DiscoveryError> {
    let steps = history_steps(drive);
    let asked = |predictor: &Predictor| -> Vec<Transition> {
        let of = |k: usize| predictor.transition(&steps[..k], &steps[k].state, &steps[k].control, map);
        (0..steps.len().saturating_sub(1)).into_par_iter().map(of).collect()
    };
    let transitions = asked(predictor);
    let mut follows = Vec::new();
    if following {
        let elsewhere: [Vec<Transition>; 3] = core::array::from_fn(|i| {
            let mut without = [0.0; 3];
            without[i] = ASKED_APART;
            asked(&predictor.asked_without(&without))
        });
        follows.extend((0..transitions.len()).map(|k| Follows::between(&transitions[k], elsewhere.each_ref().map(|apart| &apart[k]))));
    }
    let last = drive.states.len().saturating_sub(SEGMENT_STEPS + 1);
    let model = predictor.step_model();
    let servoed = rims_servoed(model.vehicle());
    let known = servoed && drive.measured.wheel_speed;
    let first = if known { FIRST_START_SERVOED } else { FIRST_START }.min(last);
    let finite = |k: usize| drive.states[k].to_array().iter().all(|v| v.is_finite());
    let usable = |&k: &usize| {
        k + SEGMENT_STEPS < drive.states.len()
            && (k..=k + SEGMENT_STEPS).all(finite)
            && transitions[k..k + SEGMENT_STEPS].iter().all(|t| t.ground_known)
    };
    let starts: Vec<usize> = (first..=last).step_by(SEGMENT_STEPS).filter(usable).collect();
    if starts.is_empty() {
        return Err(DiscoveryError::NoSegments { trajectory: drive.id.clone(), steps: SEGMENT_STEPS });
    }
    let traction_slope = transitions.par_iter().map(|t| traction_slopes(model, t)).collect();
    Ok(ObservedDrive {
        id: drive.id.clone(),
        available: available(&drive.measured, servoed, map.is_some()),
        starts,
        map: map.cloned(),
        states: drive.states.clone(),
        transitions,
        follows,
        known: Known { ride_shift: *model.ride_shift(), map: model.vehicle().effects.map },
        wheel_speed_rad_s: drive.wheel_speed_rad_s.clone(),
        road_wheel_angle_rad: drive.road_wheel_angle_rad.clone(),
        traction_slope,
    })
}

/// Channels that all of these drives have.
pub(crate) fn available_in_all<'a>(drives: impl IntoIterator<Item = &'a ObservedDrive>) -> [bool; CHANNELS] {
    drives.into_iter().fold([true; CHANNELS], |all, d| core::array::from_fn(|c| all[c] && d.available[c]))
}

/// Whether the rims turn as they are told, whatever the ground does.
fn rims_servoed(vehicle: &Vehicle) -> bool {
    vehicle.second == SecondCommand::YawRateRadS
}

/// An over-speed as far as it says something of the torque: of a wheel that spins only that it does, m/s. Near the strength of the soil a rim's answer to a
/// torque has no bound, and a few such moments would outweigh a drive.
fn gripping(overspeed_m_s: f64) -> f64 {
    GRIPPING_M_S * (overspeed_m_s / GRIPPING_M_S).tanh()
}

/// How much more each wheel pulls per rim over-speed, by central differences of the contact forces.
fn traction_slopes(model: &StepModel, transition: &Transition) -> [f64; WHEELS] {
    const STEP_M_S: f64 = 0.05;
    let forces = |step: f64| {
        let mut input = transition.input;
        input.wheels.rim_base_m_s = input.wheels.rim_base_m_s.map(|v| v + step);
        model.step(&input).contacts.map(|c| c.forward_n)
    };
    let (more, less) = (forces(STEP_M_S), forces(-STEP_M_S));
    core::array::from_fn(|i| ((more[i] - less[i]) / (2.0 * STEP_M_S)).max(TRACTION_SLOPE_FLOOR))
}

impl ObservedDrive {
    /// Measured minus predicted for every segment, with effects (each from its onset on) and a soil correction. One row per segment.
    pub fn deviations(&self, bench: &Bench<'_>, effects: &[ScheduledEffect], soil: &SoilCorrection) -> Vec<Row> {
        let effects: Vec<ScheduledEffect> = bench.late().chain(effects.iter().copied()).collect();
        let acting = |start: usize| -> u32 {
            let time_s = start as f64 * bench.stepping.dt_s;
            effects.iter().enumerate().map(|(i, e)| u32::from(e.onset_s <= time_s) << i).sum()
        };
        let mut sets: Vec<u32> = self.starts.iter().map(|&s| acting(s)).collect();
        sets.sort_unstable();
        sets.dedup();
        let readings: Vec<Reading> = sets
            .iter()
            .map(|set| {
                let on: Vec<ScheduledEffect> = effects.iter().enumerate().filter(|(i, _)| set & (1 << i) != 0).map(|(_, e)| *e).collect();
                self.reading(bench, &on)
            })
            .collect();
        self.starts
            .par_iter()
            .map(|&start| {
                let set = acting(start);
                let reading = sets.iter().position(|s| *s == set).expect("every segment's set was listed; this is a bug");
                self.segment(bench, &readings[reading], soil, start)
            })
            .collect()
    }

    /// Start of each segment, s since the start of the drive.
    pub fn times_s(&self, dt_s: f64) -> Vec<f64> {
        self.starts.iter().map(|&s| s as f64 * dt_s).collect()
    }

    /// Number of samples with a transition.
    pub fn samples(&self) -> usize {
        self.transitions.len()
    }

    /// Last hidden layer of the network at a sample.
    pub fn hidden(&self, k: usize) -> &[f32] {
        &self.transitions[k].hidden
    }

    /// The same drive with something added to what the network says of each sample, per step: displacement in the heading frame (m), attitude (rad), velocities
    /// in Body.
    pub fn with_residual(&self, added: impl Fn(usize) -> [f64; STATE_DIM]) -> Self {
        let mut changed = self.clone();
        for (k, transition) in changed.transitions.iter_mut().enumerate() {
            let added = added(k);
            transition.residual = core::array::from_fn(|i| transition.residual[i] + added[i]);
        }
        changed
    }

    /// Forward speed (m/s), road-wheel angle of the front wheels (rad) and mean slope of the ground ahead and to the left at every sample.
    pub fn conditions(&self) -> impl Iterator<Item = [f64; 4]> {
        self.transitions.iter().zip(&self.states).map(|(t, state)| {
            let mean = |of: &dyn Fn(usize) -> f64, count: usize| (0..count).map(of).sum::<f64>() / count as f64;
            let slope = [mean(&|i| t.input.ground[i].slope_ahead, WHEELS), mean(&|i| t.input.ground[i].slope_left, WHEELS)];
            [state.velocity_m_s[0], mean(&|i| t.input.wheels.angle_rad[i], 2), slope[0], slope[1]]
        })
    }

    /// What the drive says to a model with all of these effects. Actuators remember: before an effect begins they are those of a vehicle without it.
    fn reading(&self, bench: &Bench<'_>, effects: &[ScheduledEffect]) -> Reading {
        let phases = bench.phases(effects);
        let model = phases.last().clone();
        let states = model.vehicle().effects.sensor.to_true_along(&self.states, bench.stepping.dt_s);
        let mut now = self.first_actuators(phases.at(Some(0.0)).vehicle(), &states[0]);
        let actuators = self
            .transitions
            .iter()
            .zip(states.windows(2))
            .enumerate()
            .map(|(k, (transition, states))| {
                let model = phases.at(Some(k as f64 * bench.stepping.dt_s));
                let after = now.advance(model.vehicle(), &transition.control, states[0].velocity_m_s[0], model.dt_s());
                let pair = [now, after];
                now = model.observed_actuators(&after, &transition.control, &states[0], &states[1], model.dt_s());
                pair
            })
            .collect();
        Reading { model, actuators, states }
    }

    /// Actuators at the first sample: measured rims where they are servoed and measured, else what motion and command tell.
    fn first_actuators(&self, vehicle: &Vehicle, state: &VehicleState<f64>) -> DrivelineState {
        let control = &self.transitions[0].control;
        let rims = self.wheel_speed_rad_s.as_ref().map(|w| rim_twist(vehicle, &w[0]));
        match rims.filter(|twist| rims_servoed(vehicle) && twist.iter().all(|v| v.is_finite())) {
            Some(twist) => DrivelineState::turning(vehicle, twist),
            None => DrivelineState::starting(vehicle, state, control),
        }
    }

    /// The drive as a vehicle with effects would have driven it under the recorded commands, in place of what `drive` records.
    ///
    /// x'_{k+1} = x'_k + step(x'_k with effects) + residual_k + e_k, where e_k is what the recorded drive did beyond the physics at step k, so that no effect
    /// gives the recording back. Soil and what the network says stay those of the recorded place. Wheel speeds and road-wheel angles move by what the
    /// physics says of them.
    pub fn driven_again(&self, bench: &Bench<'_>, effects: &[ScheduledEffect], drive: &mut Trajectory) {
        let dt_s = bench.stepping.dt_s;
        let plain = self.reading(bench, &[]);
        let phases = bench.phases(effects);
        let mut actuators = plain.actuators[0][0];
        let mut state = self.states[0];
        for (k, transition) in self.transitions.iter().enumerate() {
            let model = phases.at(Some(k as f64 * dt_s));
            let recorded = self.stepped(&plain.model, k, dt_s, &self.states[k], &plain.actuators[k]);
            let after = actuators.advance(model.vehicle(), &transition.control, state.velocity_m_s[0], dt_s);
            let driven = self.stepped(model, k, dt_s, &state, &[actuators, after]);
            let from = (&plain.model, &self.states[k], &plain.actuators[k], &recorded);
            self.move_wheels(k, from, (model, &state, &[actuators, after], &driven), drive);
            let [recorded, driven] = [recorded, driven].map(|s| s.increment.to_array());
            // The recorded increment in its own heading frame, with what the physics says of the difference.
            let total = core::array::from_fn(|i| between(&self.states[k], &self.states[k + 1])[i] + driven[i] - recorded[i]);
            state = VehicleState::from_array(state.advanced(&total));
            actuators = after;
            // What the recorded motion told of the controller's integral beyond its law belongs to the drive.
            if let Some(next) = plain.actuators.get(k + 1) {
                actuators.speed_error_integral_m += next[0].speed_error_integral_m - plain.actuators[k][1].speed_error_integral_m;
            }
            drive.states[k + 1] = state;
        }
    }

    /// The step that the physics makes of a sample.
    fn stepped(
        &self,
        model: &StepModel,
        k: usize,
        dt_s: f64,
        state: &VehicleState<f64>,
        actuators: &[DrivelineState; 2],
    ) -> StepOutput<f64> {
        let transition = &self.transitions[k];
        let ground = GroundSource::new(self.map.as_deref(), model, state);
        let input = StepInput {
            state: *state,
            wheels: command_wheels(model.vehicle(), &actuators[0], &actuators[1], &transition.control),
            soil: Soil::from_array(self.soil_at(model, [&SoilCorrection::NONE; 2], k, dt_s)),
            ground: ground.under_wheels(model, state, 0.0).0,
            ..transition.input
        };
        model.step(&input)
    }

    /// Soil of a sample with corrections, one after the other, and what effects change of it in time.
    fn soil_at(&self, model: &StepModel, [ground, soil]: [&SoilCorrection; 2], k: usize, dt_s: f64) -> [f64; SOIL_DIM] {
        let nominal = soil.apply(&ground.apply(&self.transitions[k].input.soil.to_array()));
        model.vehicle().effects.soil.drifted(nominal, Some(k as f64 * dt_s))
    }

    /// Moves the recorded wheel speeds and road-wheel angles of a sample by what the physics says of the difference between two ways to drive.
    fn move_wheels(&self, k: usize, from: WayToDrive<'_>, to: WayToDrive<'_>, drive: &mut Trajectory) {
        let of = |(model, state, actuators, step): WayToDrive<'_>| {
            let mut row = [0.0; CHANNELS];
            let reading = Reading { model: model.clone(), actuators: vec![*actuators; k + 1], states: vec![*state; k + 1] };
            self.actuators(&reading, k, 0, step.contacts.map(|c| c.overspeed_m_s), |overspeed| overspeed, &mut row);
            row
        };
        let (before, after) = (of(from), of(to));
        if let Some(angles) = &mut drive.road_wheel_angle_rad {
            let bin = (BINS[0][1] - BINS[0][0] + 1) as f64;
            angles[k] = angles[k].map(|a| a + bin * (before[STEERING_AT] - after[STEERING_AT]));
        }
        if let Some(speeds) = &mut drive.wheel_speed_rad_s {
            for i in 0..WHEELS {
                speeds[k][i] += SEGMENT_STEPS as f64 * (before[RIM_AT + i] - after[RIM_AT + i]) / from.0.vehicle().wheel_radius_m;
            }
        }
    }

    /// What was commanded and done in each segment, in the mean.
    pub fn driven(&self) -> Vec<Driven> {
        let of = |start: &usize| {
            let steps = *start..*start + SEGMENT_STEPS;
            let commanded = |of: fn(&Transition) -> f64| self.transitions[steps.clone()].iter().map(of).sum::<f64>() / SEGMENT_STEPS as f64;
            let done = |of: fn(&VehicleState<f64>) -> f64| self.states[steps.clone()].iter().map(of).sum::<f64>() / SEGMENT_STEPS as f64;
            Driven {
                commanded_m_s: commanded(|t| t.control.speed_m_s),
                second: commanded(|t| t.control.second),
                forward_m_s: done(|s| s.velocity_m_s[0]),
                yaw_rate_rad_s: done(|s| s.angular_velocity_rad_s[2]),
            }
        };
        self.starts.iter().map(of).collect()
    }

    fn segment(&self, bench: &Bench<'_>, reading: &Reading, soil: &SoilCorrection, start: usize) -> Row {
        let (model, states) = (&reading.model, &reading.states);
        let mut row = [0.0; CHANNELS];
        add_consistency(&states[start..=start + SEGMENT_STEPS], model.dt_s(), &mut row);
        let mut state = states[start];
        let ground = GroundSource::new(self.map.as_deref(), model, &state);
        let ride_shift: Ride = core::array::from_fn(|i| model.ride_shift()[i] - self.known.ride_shift[i]);
        for (j, transition) in self.transitions[start..start + SEGMENT_STEPS].iter().enumerate() {
            let [before, after] = &reading.actuators[start + j];
            let unshifted = (transition.residual, transition.input.sinkage_log_ratio);
            let (residual, sinkage_log_ratio) = self.follows.get(start + j).map_or(unshifted, |follows| {
                // A vehicle is as much lower over the ground as that lies higher than the map says.
                let [x_m, y_m, _] = self.states[start + j].position_m;
                let (x_m, y_m) = ground.from_middle(x_m, y_m);
                let raised = |map: &MapTerms| map.raised(x_m, y_m, (0.0, [0.0; 2])).0;
                let up_m = raised(&model.vehicle().effects.map) - raised(&self.known.map);
                follows.said(transition, &[ride_shift[0] + up_m, ride_shift[1], ride_shift[2]])
            });
            let input = StepInput {
                state,
                wheels: command_wheels(model.vehicle(), before, after, &transition.control),
                sinkage_log_ratio,
                soil: Soil::from_array(self.soil_at(model, [&bench.ground, soil], start + j, bench.stepping.dt_s)),
                ground: ground.under_wheels(model, &state, 0.0).0,
            };
            let StepOutput { increment, contacts } = model.step(&input);
            self.actuators(reading, start + j, j, contacts.map(|c| c.overspeed_m_s), gripping, &mut row);
            let increment = increment.to_array();
            let total: [f64; STATE_DIM] = core::array::from_fn(|i| increment[i] + residual[i]);
            state = VehicleState::from_array(state.advanced(&total));
            for (b, [from, to]) in BINS.iter().enumerate() {
                if (*from..=*to).contains(&(j + 1)) {
                    let share = 1.0 / (to - from + 1) as f64;
                    let deviation = deviation(&states[start + j + 1], &state);
                    for c in 0..STATE_CHANNELS {
                        row[b * STATE_CHANNELS + c] += share * deviation[c];
                    }
                }
            }
        }
        row
    }

    /// Adds the actuator layer of one sample, step `j` of its segment: road-wheel angle, and rim over-speeds with what a drag at the wheel takes from them.
    ///
    /// A drag torque τ lowers the rim speed until the tread makes up for what the coupling of the axle does not:
    /// Δ(over-speed) = -(τ at the tread / r) / (∂F/∂over-speed), see `StepModel`.
    /// Of a vehicle driven by torque the step knows the over-speeds (`overspeed_m_s`), drags and locks included; `heard` says what of an over-speed is compared.
    fn actuators(
        &self,
        reading: &Reading,
        sample: usize,
        j: usize,
        overspeed_m_s: [f64; WHEELS],
        heard: impl Fn(f64) -> f64,
        row: &mut Row,
    ) {
        let vehicle = reading.model.vehicle();
        let [before, after] = &reading.actuators[sample];
        let mut angles = before.road_wheel_angles(vehicle);
        if let Some(measured) = self.road_wheel_angle_rad.as_ref().map(|m| m[sample]) {
            let bin = usize::from(j >= BINS[0][1]);
            let share = 1.0 / (BINS[bin][1] - BINS[bin][0] + 1) as f64;
            row[STEERING_AT + bin] += share * 0.5 * (measured[0] + measured[1] - angles[0] - angles[1]);
            angles[..2].copy_from_slice(&measured);
        }
        let Some(wheel_speed) = self.wheel_speed_rad_s.as_ref().map(|m| m[sample]) else { return };
        let share = 1.0 / SEGMENT_STEPS as f64;
        // Servoed rims are measured at the instant of the sample; a step takes their mean over it.
        let until = if rims_servoed(vehicle) { before } else { after };
        let wheels = command_wheels::<f64>(vehicle, before, until, &self.transitions[sample].control);
        let state = &reading.states[sample];
        let (v, w) = (state.velocity_m_s, state.angular_velocity_rad_s);
        for i in 0..WHEELS {
            let at = vehicle.wheel_centre_m[i];
            let centre = [v[0] + w[1] * at[2] - w[2] * at[1], v[1] + w[2] * at[0] - w[0] * at[2]];
            let (sin, cos) = angles[i].sin_cos();
            let own = cos * centre[0] + sin * centre[1];
            let radius = 1.0 + vehicle.effects.force.radius_relative[i / 2];
            if vehicle.driveline.torque.is_some() {
                let [seen, told] = [wheel_speed[i] * vehicle.wheel_radius_m * radius - own, overspeed_m_s[i]].map(&heard);
                row[RIM_AT + i] += share * (seen - told) / radius;
                continue;
            }
            // A locked axle turns both rims at the mean of what their own ground asks for; Ω is read as a speed of the card's radius.
            let middle = own + cos * 0.5 * w[2] * (at[1] - vehicle.wheel_centre_m[i ^ 1][1]);
            let forward = own + vehicle.effects.actuator.lock * (middle - own);
            let slope = self.traction_slope[sample][i];
            let drag = vehicle.drag_at_tread_n_m(i, slope) / vehicle.wheel_radius_m / slope;
            let predicted = (wheels.rim_speed_m_s(i, forward, v[0]) - drag * forward.signum()) / radius;
            row[RIM_AT + i] += share * (wheel_speed[i] * vehicle.wheel_radius_m - predicted);
        }
    }
}

/// Increment from one state to the next in the heading frame of the first, as the physics gives it.
fn between(first: &VehicleState<f64>, next: &VehicleState<f64>) -> [f64; STATE_DIM] {
    let (a, b) = (first.to_array(), next.to_array());
    let (sin, cos) = a[5].sin_cos();
    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
    core::array::from_fn(|i| match i {
        0 => cos * dx + sin * dy,
        1 => cos * dy - sin * dx,
        3..=5 => wrap_angle(b[i] - a[i]),
        _ => b[i] - a[i],
    })
}

/// Measured minus predicted, positions in the measured heading frame, angles wrapped.
fn deviation(measured: &VehicleState<f64>, predicted: &VehicleState<f64>) -> [f64; STATE_CHANNELS] {
    let (m, p) = (measured.to_array(), predicted.to_array());
    let (sin, cos) = m[5].sin_cos();
    let (dx, dy) = (m[0] - p[0], m[1] - p[1]);
    core::array::from_fn(|c| match c {
        0 => cos * dx + sin * dy,
        1 => cos * dy - sin * dx,
        3..=5 => wrap_angle(m[c] - p[c]),
        _ => m[c] - p[c],
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_a_gripping_wheel_is_heard_and_a_spinning_one_only_spins() {
        assert!((gripping(0.05) / 0.05 - 1.0).abs() < 0.01 && (gripping(-0.05) + gripping(0.05)).abs() < 1e-15);
        assert!(gripping(2.5) - gripping(1.5) < 0.005 && gripping(2.5) <= GRIPPING_M_S);
    }
}
