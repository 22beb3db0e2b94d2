//! Laps one after the other: taken from the files of earlier commands, or driven.

use std::collections::HashMap;
use std::path::PathBuf;

use nesam_navigation::{KeptLap, Lap, Run, Scored};
use nesam_physics::DT_S;
use serde_json::{Value, json};
use tokio::runtime::Runtime;

use super::Task;
use super::stage::Stage;
use crate::failure::Failure;
use crate::interrupt;
use crate::output::{self, note};
use crate::progress::Progress;

/// Measured positions and velocities that differ by more are not those of one point in one frame, m/s: noise of a few centimetres makes a tenth of it.
const VELOCITY_MISMATCH_MAX_M_S: f64 = 0.5;

/// Positions that move more than this share further or less far than velocities say are those of a step that takes another time.
const STEP_OFF_MAX: f64 = 0.05;
/// Mean distance between measured and true positions from which on they are of two points or frames, m: noise is a few centimetres.
const TRUTH_OFF_MAX_M: f64 = 0.3;
/// A vehicle whose yaw rate correlates with the command by less turns the other way.
const TURN_CORRELATION_MIN: f64 = -0.5;

/// Which plant laps are driven on.
#[derive(Clone, Debug, PartialEq)]
pub enum Identity {
    /// That of this program.
    BuiltIn,
    /// Another that says which it is.
    Named(String),
    /// Another that does not.
    Unnamed,
}

impl Identity {
    /// As in the settings of a lap.
    pub fn in_settings(&self) -> Value {
        match self {
            Self::BuiltIn => Value::Null,
            Self::Named(name) => json!({ "name": name }),
            Self::Unnamed => json!({ "name": null }),
        }
    }
}

/// The files of laps: where they are, and with which settings a lap is the same.
pub struct Kept {
    /// Folder.
    pub out: PathBuf,
    /// Settings of a lap by its world.
    pub settings: HashMap<String, Value>,
    /// The plant.
    pub plant: Identity,
    /// Whether laps of a plant that does not say which it is are taken nevertheless.
    pub resume: bool,
}

impl Kept {
    fn file(&self, task: &Task) -> PathBuf {
        self.out.join(task.file_name())
    }

    /// A lap that was driven before with the same settings, on the same plant.
    fn earlier(&self, task: &Task) -> Option<Run> {
        if self.plant == Identity::Unnamed && !self.resume {
            return None;
        }
        let file = self.file(task);
        let other = match KeptLap::from_json(&std::fs::read(&file).ok()?) {
            Err(reason) => format!("cannot be read ({reason})"),
            Ok(kept) if self.settings.get(&task.world) != Some(&kept.settings) => "was driven with other settings".into(),
            Ok(kept) if !task.is_of(&kept.run) => "is another lap than its name says".into(),
            Ok(kept) => return Some(kept.run),
        };
        note!("{} {other}; it is driven again", file.display());
        None
    }

    fn keep(&self, task: &Task, run: &Run) -> Result<(), Failure> {
        let kept = KeptLap { settings: self.settings.get(&task.world).cloned().unwrap_or_default(), run: run.clone() };
        output::write_file(&self.file(task), kept.to_json().as_bytes())
    }

    /// What to do when a command has ended after so many laps.
    fn to_go_on(&self, failure: Failure, laps: usize) -> Failure {
        if laps == 0 {
            return failure;
        }
        let with = if self.plant == Identity::Unnamed { " with --resume" } else { "" };
        let text = format!("{failure}; {laps} laps are kept in {}: the same command{with} goes on after them", self.out.display());
        match failure {
            Failure::Input(_) => Failure::Input(text),
            Failure::Failed(_) => Failure::Failed(text),
        }
    }
}

/// The laps there are, what is doubtful about them, and why there are no more.
pub struct Driven {
    /// Laps in the order of the tasks.
    pub runs: Vec<Run>,
    /// A sentence each.
    pub warnings: Vec<String>,
    /// What ended the command early.
    pub ended: Result<(), Failure>,
}

/// Drives the laps that are not in files yet.
pub fn drive_all(stage: &mut Stage<'_>, runtime: &Runtime, tasks: &[Task], kept: &Kept) -> Driven {
    let progress = Progress::start("laps", tasks.len());
    let mut notes = Notes { of_another: kept.plant != Identity::BuiltIn, ..Notes::default() };
    let (mut runs, mut taken, mut ended) = (Vec::new(), 0, Ok(()));
    for task in tasks {
        if interrupt::is_noted() {
            ended = Err(kept.to_go_on(Failure::Failed("interrupted".into()), runs.len()));
            break;
        }
        let run = match kept.earlier(task) {
            Some(run) => {
                taken += 1;
                Ok(run)
            }
            None => runtime.block_on(stage.drive(task)).and_then(|run| kept.keep(task, &run).map(|()| run)),
        };
        match run {
            Ok(run) => {
                progress.set_with(runs.len() + 1, &format!("{} {} {}", task.configuration.as_str(), task.world, run.lap.end));
                notes.of(task, &run);
                runs.push(run);
            }
            Err(failure) => {
                ended = Err(kept.to_go_on(failure, runs.len()));
                break;
            }
        }
    }
    if ended.is_ok() {
        progress.finish();
    }
    if taken > 0 {
        note!("{taken} laps taken from {}", kept.out.display());
    }
    Driven { runs, warnings: notes.warnings, ended }
}

/// What is to be said once of laps on another simulator.
#[derive(Default)]
struct Notes {
    of_another: bool,
    no_truth: bool,
    truth: bool,
    velocity: bool,
    turning: bool,
    warnings: Vec<String>,
}

impl Notes {
    fn of(&mut self, task: &Task, run: &Run) {
        if !self.of_another {
            return;
        }
        let lap = &run.lap;
        if lap.scored == Scored::State && !self.no_truth {
            self.no_truth = true;
            self.say("note: the plant tells no `truth`: laps are scored by `state`, with its noise".into());
        }
        if let Some(off_m) = lap.measured_off_m.filter(|off_m| *off_m > TRUTH_OFF_MAX_M && !self.truth) {
            self.truth = true;
            self.say(format!(
                "warning: {}: positions of `truth` are {off_m:.2} m from those of `state` in the mean: laps are scored by `truth`; are both of the reference point?",
                task.file_name()
            ));
        }
        if let Some(doubt) = doubt_of_velocities(lap).filter(|_| !self.velocity) {
            self.velocity = true;
            self.say(format!("warning: {}: {doubt}", task.file_name()));
        }
        if lap.turn_correlation.is_some_and(|correlation| correlation < TURN_CORRELATION_MIN) && !self.turning {
            self.turning = true;
            self.say(format!(
                "warning: {}: the vehicle turns right where it is told to turn left: a positive `second` is to the left, and so is a positive yaw rate",
                task.file_name()
            ));
        }
    }

    /// Says it now, and in the report.
    fn say(&mut self, warning: String) {
        note!("{warning}");
        self.warnings.push(warning);
    }
}

/// What positions and velocities that do not fit each other say.
fn doubt_of_velocities(lap: &Lap) -> Option<String> {
    let mismatch_m_s = lap.velocity_mismatch_m_s?;
    if let Some(factor) = lap.moved_over_told.filter(|factor| (factor - 1.0).abs() > STEP_OFF_MAX) {
        return Some(format!(
            "positions of `state` move {factor:.2} times as far as its velocities say: does a step take {DT_S} s, and are velocities in m/s?"
        ));
    }
    (mismatch_m_s > VELOCITY_MISMATCH_MAX_M_S).then(|| {
        format!("positions and velocities of `state` differ by {mismatch_m_s:.2} m/s (rms): are velocities in Body, and those of the reference point?")
    })
}
