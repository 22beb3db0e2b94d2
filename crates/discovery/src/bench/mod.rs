//! HiddenEffect: how often a diagnosis is right on drives of validation, groups of which pose as vehicles with an effect that nobody declares.
//!
//! Each pseudo-vehicle is judged by the reference without its own drives, so nothing of it is known beforehand. The sets:
//!
//! | set | what is hidden |
//! |---|---|
//! | `actuator`, `sensor`, `map` | one effect of the catalogue in the recording, exact ([`Change`]) |
//! | `force_twin` | one force or soil effect, driven again by our own physics ([`crate::observe::ObservedDrive::driven_again`]) |
//! | `force_twin_large` | the same at two to three times the size |
//! | `other_twin` | suspension, drive line, steering and soil, driven again |
//! | `onset`, `onset_twin` | an effect that begins in the middle of the drives, recorded or driven again |
//! | `two` | two effects at once |
//! | `outside` | something that the catalogue does not have |
//! | `left_out` | an effect of the catalogue, with its id withheld from the diagnosis |
//! | `null` | nothing |
//! | `null_noise` | nothing, with twice the noise |

mod change;
mod comparators;
mod score;

use std::sync::Arc;
use std::time::Instant;

use nesam_model::Predictor;
use nesam_physics::effects::{Effect, ScheduledEffect};
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;

pub use change::{Change, apply};
pub use comparators::Comparison;
pub use score::{MethodScores, Outcome, Scores, clopper_pearson, method_scores, scores};

use self::comparators::Compared;
use crate::error::DiscoveryError;
use crate::judge::Judge;
use crate::judgement::judge;
use crate::observe::{Bench, observe, observe_all};
use crate::proof::held_out::Scoring;
use rand::SeedableRng;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;

/// Drives of a pseudo-vehicle.
pub const DRIVES: usize = 5;
/// Methods that are compared.
pub const METHODS: [&str; 7] = ["diagnosis", "oracle", "soil_only", "ridge", "stlsq", "black_box", "free_form"];

/// What is hidden in a set of drives.
#[derive(Clone, Debug)]
pub struct Hidden {
    /// Set of the benchmark.
    pub set: &'static str,
    /// Changes of the recording.
    pub changes: Vec<Change>,
    /// Effects under which the drives are driven again.
    pub driven: Vec<Effect>,
    /// Ids that are there, with the value of the parameter that is scored.
    pub truth: Vec<(&'static str, f64)>,
    /// When it begins, s.
    pub onset_s: f64,
    /// Ids withheld from the diagnosis.
    pub without: Vec<String>,
}

/// Drives as they were recorded.
fn nothing(set: &'static str) -> Hidden {
    Hidden { set, changes: Vec::new(), driven: Vec::new(), truth: Vec::new(), onset_s: 0.0, without: Vec::new() }
}

fn recorded(set: &'static str, id: &'static str, size: f64, change: Change) -> Hidden {
    Hidden { changes: vec![change], truth: vec![(id, size)], ..nothing(set) }
}

fn driven(set: &'static str, (id, values, scored): Twin) -> Hidden {
    let effect = Effect::from_parameters(id, values).expect("twins have the ids and parameters of the catalogue; this is a bug");
    Hidden { driven: vec![effect], truth: vec![(id, values[scored])], ..nothing(set) }
}

fn outside(change: Change) -> Hidden {
    Hidden { changes: vec![change], ..nothing("outside") }
}

/// An effect under which drives are driven again: id, values of its parameters, and which of them is scored.
type Twin = (&'static str, &'static [f64], usize);
/// Forces and a soil at the sizes of the catalogue or about twice that.
const FORCES: [Twin; 10] = [
    ("payload", &[500.0, -1.0, 0.0, 0.7], 0),
    ("wheel_drag", &[1.0, 900.0], 1),
    ("linear_drag", &[200.0], 0),
    ("quadratic_drag", &[60.0], 0),
    ("rolling_resistance", &[0.03], 0),
    ("tow", &[800.0, 0.0], 0),
    ("cg_forward", &[0.15], 0),
    ("cg_lateral", &[0.1], 0),
    ("tyre_radius_rear", &[0.03], 0),
    ("slip_sinkage", &[1.0], 0),
];
/// Forces that a speed control makes up for, larger.
const LARGE: [Twin; 6] = [
    ("linear_drag", &[500.0], 0),
    ("quadratic_drag", &[150.0], 0),
    ("rolling_resistance", &[0.08], 0),
    ("tow", &[2000.0, 0.0], 0),
    ("wind", &[800.0, 0.0], 0),
    ("tyre_radius_front", &[-0.05], 0),
];
/// Suspension, soil, drive line and steering.
const OTHERS: [Twin; 10] = [
    ("cg_height", &[0.3], 0),
    ("roll_stiffness", &[-0.4], 0),
    ("pitch_stiffness", &[-0.4], 0),
    ("side_bulldozing", &[0.5, 15_000.0], 0),
    ("multi_pass", &[0.5], 0),
    ("locked_differential", &[1.0], 0),
    ("torque_limit", &[0.6], 0),
    ("speed_lag", &[0.4], 0),
    ("steering_backlash", &[0.1], 0),
    ("steering_compliance", &[1e-5], 0),
];
/// When an effect begins that is not there from the start, s.
const ONSET_S: f64 = 11.0;
/// Forces that begin in the middle of a drive.
const BEGUN: [Twin; 4] =
    [("payload", &[500.0, -1.0, 0.0, 0.7], 0), ("wheel_drag", &[1.0, 900.0], 1), ("tow", &[2000.0, 0.0], 0), ("cg_lateral", &[0.1], 0)];

/// Everything that is hidden, each at the size that the catalogue calls believable on four terrains or about twice that.
pub fn plan() -> Vec<Hidden> {
    use Change as C;
    let mut plan = vec![
        recorded("actuator", "steering_offset", 0.04, C::SteeringOffset(0.04)),
        recorded("actuator", "steering_offset", -0.08, C::SteeringOffset(-0.08)),
        recorded("actuator", "steering_ratio", 0.1, C::SteeringRatio(0.1)),
        recorded("actuator", "steering_ratio", -0.15, C::SteeringRatio(-0.15)),
        recorded("actuator", "steering_delay", 0.1, C::SteeringDelay(0.1)),
        recorded("actuator", "steering_delay", 0.3, C::SteeringDelay(0.3)),
        recorded("actuator", "steering_lag", 0.2, C::SteeringLag(0.2)),
        recorded("actuator", "speed_gain", 0.05, C::SpeedGain(0.05)),
        recorded("actuator", "speed_gain", -0.1, C::SpeedGain(-0.1)),
        recorded("actuator", "speed_delay", 0.3, C::SpeedDelay(0.3)),
        recorded("sensor", "gyro_bias", 0.005, C::GyroBias(0.005)),
        recorded("sensor", "gyro_bias", -0.02, C::GyroBias(-0.02)),
        recorded("sensor", "gyro_scale", 0.03, C::GyroScale(0.03)),
        recorded("sensor", "velocity_scale", 0.02, C::VelocityScale(0.02)),
        recorded("sensor", "position_latency", 0.1, C::PositionLatency(0.1)),
        recorded("sensor", "pose_latency", 0.1, C::PoseLatency(0.1)),
        recorded("sensor", "lever_arm", 0.4, C::LeverArm(0.4)),
        recorded("sensor", "mount_angle", 0.02, C::MountRoll(0.02)),
        recorded("map", "map_offset", 0.04, C::MapOffset(0.04)),
        recorded("map", "map_tilt", 0.01, C::MapTilt(0.01)),
        outside(C::GyroCross(0.2)),
        outside(C::SteeringWarp(0.08)),
        outside(C::VelocityRipple(0.15)),
    ];
    for (set, twins) in [("force_twin", &FORCES[..]), ("force_twin_large", &LARGE), ("other_twin", &OTHERS)] {
        plan.extend(twins.iter().map(|twin| driven(set, *twin)));
    }
    plan.extend(BEGUN.map(|twin| Hidden { onset_s: ONSET_S, ..driven("onset_twin", twin) }));
    for (id, size, change) in [
        ("steering_offset", 0.08, C::SteeringOffset(0.08)),
        ("gyro_bias", 0.02, C::GyroBias(0.02)),
        ("steering_ratio", 0.15, C::SteeringRatio(0.15)),
    ] {
        plan.push(Hidden { onset_s: ONSET_S, ..recorded("onset", id, size, change) });
        plan.push(Hidden { without: vec![id.into()], ..recorded("left_out", id, size, change) });
    }
    for (first, second) in [
        (("steering_offset", 0.06, C::SteeringOffset(0.06)), ("gyro_bias", 0.015, C::GyroBias(0.015))),
        (("steering_ratio", 0.15, C::SteeringRatio(0.15)), ("map_offset", 0.05, C::MapOffset(0.05))),
        (("speed_gain", -0.1, C::SpeedGain(-0.1)), ("steering_offset", -0.06, C::SteeringOffset(-0.06))),
    ] {
        let truth = vec![(first.0, first.1), (second.0, second.1)];
        plan.push(Hidden { changes: vec![first.2, second.2], truth, ..recorded("two", first.0, first.1, first.2) });
    }
    plan.extend([nothing("null"), Hidden { changes: vec![C::Noise(1.0)], ..nothing("null_noise") }]);
    plan.extend([0.08, -0.12].map(|size| recorded("map_large", "map_offset", size, C::MapOffset(size))));
    // Last, as the drives of a group follow from its place.
    plan.push(outside(C::SteeringLeft(0.12)));
    plan
}

/// Drives of validation with their maps, and the model that they are judged by.
#[derive(Debug)]
pub struct Stage<'a> {
    /// The model.
    pub predictor: &'a Predictor,
    /// Its reference.
    pub judge: &'a Judge,
    /// Drives of the reference.
    pub drives: &'a [Trajectory],
    /// Map of each.
    pub maps: &'a [Option<Arc<WorldMap>>],
}

impl Stage<'_> {
    /// Number of disjoint pseudo-vehicles that the drives make.
    pub fn groups(&self) -> usize {
        self.drives.len() / DRIVES
    }

    /// Drives of a group: the first [`Stage::groups`] are disjoint, further ones are drawn at random and overlap with others.
    fn members(&self, group: usize) -> Vec<usize> {
        if group < self.groups() {
            // Drives are sorted by id and so by world: every sixth mixes worlds.
            return (0..DRIVES).map(|i| i * self.groups() + group).collect();
        }
        let mut members = sample(&mut ChaCha8Rng::seed_from_u64(group as u64), self.drives.len(), DRIVES).into_vec();
        members.sort_unstable();
        members
    }

    /// Hides something in a group of drives and diagnoses it; with `scoring`, other methods do so too.
    ///
    /// # Errors
    /// Those of the diagnosis.
    pub fn run(&self, hidden: &Hidden, group: usize, scoring: Option<&Scoring>) -> Result<Outcome, DiscoveryError> {
        let start = Instant::now();
        let bundle = self.predictor.bundle();
        let bench = Bench::new(bundle, &self.judge.catalogue);
        let (mut drives, mut maps) = (Vec::new(), Vec::new());
        for m in self.members(group) {
            let (mut drive, mut map) = (self.drives[m].clone(), self.maps[m].clone());
            if !hidden.driven.is_empty() {
                let effects: Vec<ScheduledEffect> =
                    hidden.driven.iter().map(|e| ScheduledEffect { effect: *e, onset_s: hidden.onset_s }).collect();
                observe(self.predictor, &drive, map.as_ref())?.driven_again(&bench, &effects, &mut drive);
            }
            for change in &hidden.changes {
                map = apply(*change, hidden.onset_s, &mut drive, map);
            }
            drives.push(drive);
            maps.push(map);
        }
        let ids: Vec<&str> = drives.iter().map(|d| d.id.as_str()).collect();
        let judge_by = self.judge.without(&ids);
        let observed = observe_all(self.predictor, &drives, &maps, &|_| {})?;
        let mut case = judge_by.case(bench, observed, &|_, _, _| {})?;
        let yardstick = judge_by.yardstick(&case.metric.channels.clone(), DRIVES, &hidden.without)?;
        let judgement = judge(&mut case, &yardstick);
        let seconds = start.elapsed().as_secs_f64();
        let comparisons = match scoring {
            None => Vec::new(),
            Some(scoring) => {
                let (case, yardstick, judgement, predictor) = (&case, &yardstick, &judgement, self.predictor);
                Compared { predictor, case, yardstick, judgement, hidden, drives: &drives, maps: &maps }.all(scoring)?
            }
        };
        Ok(Outcome { comparisons, ..Outcome::of(hidden, group, &judgement, seconds) })
    }
}
