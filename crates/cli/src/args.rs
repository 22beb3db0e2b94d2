//! Options that several commands share.

use std::borrow::Borrow;
use std::ops::RangeInclusive;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use nesam_evaluation::{Inputs, Truth};
use nesam_model::{HISTORY, MAX_HORIZON};
use nesam_trajectories::{SplitFilter, Trajectory};

use crate::failure::Failure;
use crate::output::note;

/// Which drives to read.
#[derive(Args, Clone, Debug)]
pub struct DataArgs {
    /// Data root: a vehicle card, `worlds/` and one folder per set [default: the sample shipped with the repository]
    #[arg(long, value_name = "ROOT")]
    pub data: Option<PathBuf>,
    /// Set to read, a folder of the data root; may contain slashes [default: `nominal` if there is one, else the only set]
    #[arg(long, value_name = "NAME", value_parser = set_name)]
    pub set: Option<String>,
    /// Rows of the set's index to use
    #[arg(long, value_enum, default_value_t = SplitArg::All)]
    pub split: SplitArg,
    /// Only these drives
    #[arg(long, value_name = "ID,…", value_delimiter = ',', value_parser = name)]
    pub trajectories: Option<Vec<String>>,
    /// Vehicle card, when the data root has none of its own
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
    /// Step to which drives are resampled, s
    #[arg(long, value_name = "SECONDS", default_value_t = 0.1)]
    pub dt: f64,
    /// Whether drives of the index may have no samples: where other options say which drives count.
    #[arg(skip)]
    pub may_lack_drives: bool,
}

impl DataArgs {
    /// All drives of a root, at the step of the model.
    pub fn of(data: Option<PathBuf>) -> Self {
        Self { data, set: None, split: SplitArg::All, trajectories: None, vehicle: None, dt: nesam_physics::DT_S, may_lack_drives: false }
    }
}

/// Split of a set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SplitArg {
    /// Drives that training may see.
    Train,
    /// Drives held back from training.
    Test,
    /// Both.
    All,
}

impl SplitArg {
    /// As in JSON.
    pub fn as_str(self) -> &'static str {
        SplitFilter::from(self).as_str()
    }
}

impl From<SplitArg> for SplitFilter {
    fn from(split: SplitArg) -> Self {
        match split {
            SplitArg::Train => Self::Train,
            SplitArg::Test => Self::Test,
            SplitArg::All => Self::All,
        }
    }
}

/// What drives a prediction over its horizon.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum InputsArg {
    /// The recorded commands: what a planner knows.
    Commands,
    /// The measured wheel speeds and steering angles of the future: for studying the model, not for planning; the baselines that read no wheels keep
    /// the commands.
    Wheels,
}

impl From<InputsArg> for Inputs {
    fn from(inputs: InputsArg) -> Self {
        match inputs {
            InputsArg::Commands => Self::Commands,
            InputsArg::Wheels => Self::Wheels,
        }
    }
}

/// What errors are measured against.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum TruthArg {
    /// The measured channels.
    Measured,
    /// The noise-free channels, where a set has them.
    Gt,
}

impl From<TruthArg> for Truth {
    fn from(truth: TruthArg) -> Self {
        match truth {
            TruthArg::Measured => Self::Measured,
            TruthArg::Gt => Self::Gt,
        }
    }
}

/// What drives the predictions of a command that knows commands alone.
#[derive(Args, Clone, Copy, Debug)]
pub struct CommandsArgs {
    /// What drives the prediction over the horizon; here the recorded commands alone, `wheels` is for `nesam evaluate`
    #[arg(long, value_name = "INPUTS", value_enum, default_value_t = InputsArg::Commands, hide_possible_values = true)]
    inputs: InputsArg,
}

impl CommandsArgs {
    /// Refuses measured wheels of the future.
    ///
    /// # Errors
    /// Wrong usage: `why` this command has no use for them.
    pub fn check(self, why: &str) -> Result<(), Failure> {
        match self.inputs {
            InputsArg::Commands => Ok(()),
            InputsArg::Wheels => Err(Failure::input(format!("--inputs wheels: {why}; `nesam evaluate --inputs wheels` scores them"))),
        }
    }
}

/// Which model to use.
#[derive(Args, Clone, Debug)]
pub struct BundleArgs {
    /// Model bundle [default: the one in deploy/bundles for the vehicle, else the last by name there; found from the executable]
    #[arg(long, value_name = "DIR")]
    pub bundle: Option<PathBuf>,
}

/// Length of a window.
#[derive(Args, Clone, Copy, Debug)]
pub struct WindowArgs {
    /// Steps to predict [default: 32, fewer where every drive is shorter]
    #[arg(long, value_name = "STEPS", value_parser = positive)]
    pub horizon: Option<usize>,
    /// Steps of measured history that the model may see, the start included; it sees 32 at most
    #[arg(long, value_name = "STEPS", default_value_t = HISTORY, value_parser = history)]
    pub history: usize,
}

impl WindowArgs {
    /// Steps to predict on these drives: what was asked for, else as many as the longest drive allows. Says so where that is less than the model knows, and
    /// how many drives are too short for it.
    pub fn horizon_on(&self, drives: &[impl Borrow<Trajectory>]) -> usize {
        horizon_of(self.horizon, drives, "scored")
    }

    /// Refuses more steps than the model knows.
    ///
    /// # Errors
    /// Wrong usage.
    pub fn check_horizon(&self) -> Result<(), Failure> {
        self.horizon.map_or(Ok(()), |horizon| check_count("--horizon", horizon, 1..=MAX_HORIZON))
    }
}

/// Steps of a window on these drives: what was asked for, else as many as the longest drive allows. Says so where that is less than the model knows, and how
/// many drives are too short to be `used`.
pub fn horizon_of(asked: Option<usize>, drives: &[impl Borrow<Trajectory>], used: &str) -> usize {
    let horizon = asked.unwrap_or_else(|| longest_horizon(drives));
    if asked.is_none() && horizon < MAX_HORIZON {
        note!(
            "note: windows of {horizon} steps, as many as the longest drive allows ({MAX_HORIZON} where drives are longer); --horizon sets another number"
        );
    }
    if let Some(told) = too_short(drives, horizon, used) {
        note!("note: {told}");
    }
    horizon
}

/// Which drives have no window of this many steps; `None` where every drive or none has one.
fn too_short(drives: &[impl Borrow<Trajectory>], horizon: usize, used: &str) -> Option<String> {
    /// Names in full at most.
    const LISTED: usize = 8;
    let short: Vec<&str> =
        drives.iter().map(Borrow::borrow).filter(|d: &&Trajectory| d.states.len() <= horizon).map(|d| d.id.as_str()).collect();
    if short.is_empty() || short.len() == drives.len() {
        return None;
    }
    let names = short.iter().take(LISTED).copied().collect::<Vec<_>>().join(", ");
    let more = if short.len() > LISTED { format!(" and {} more", short.len() - LISTED) } else { String::new() };
    Some(format!(
        "{} of {} drives are too short for windows of {horizon} steps and are not {used} ({names}{more}); a smaller --horizon takes them in",
        short.len(),
        drives.len()
    ))
}

/// As many steps as the model knows and the longest drive allows, at least one.
pub fn longest_horizon(drives: &[impl Borrow<Trajectory>]) -> usize {
    let longest = drives.iter().map(|d| d.borrow().states.len()).max().unwrap_or(0);
    MAX_HORIZON.min(longest.saturating_sub(1)).max(1)
}

/// Refuses a number that an option does not take.
///
/// # Errors
/// Wrong usage: the option and what it takes.
pub fn check_count(option: &str, value: usize, allowed: RangeInclusive<usize>) -> Result<(), Failure> {
    if allowed.contains(&value) {
        return Ok(());
    }
    let limits = match allowed.into_inner() {
        (least, usize::MAX) => format!("at least {least}"),
        (least, most) => format!("{least} to {most}"),
    };
    Err(Failure::input(format!("{option} must be {limits}, not {value}")))
}

fn positive(text: &str) -> Result<usize, String> {
    match text.parse::<usize>() {
        Ok(0) => Err("must be at least 1".into()),
        Ok(n) => Ok(n),
        Err(_) => Err("not a whole number of at least 1".into()),
    }
}

/// Steps of history that the model has places for.
fn history(text: &str) -> Result<usize, String> {
    match positive(text)? {
        steps if steps > HISTORY => Err(format!("the model sees {HISTORY} steps at most")),
        steps => Ok(steps),
    }
}

/// The name of a set as the data root has it, whichever way its folder is written.
fn set_name(text: &str) -> Result<String, String> {
    let parts: Vec<&str> = text.split('/').filter(|part| !part.is_empty() && *part != ".").collect();
    if parts.is_empty() { Err("empty name of a set".into()) } else { Ok(parts.join("/")) }
}

/// One of the names of a list.
fn name(text: &str) -> Result<String, String> {
    if text.is_empty() { Err("empty name in --trajectories".into()) } else { Ok(text.into()) }
}

#[cfg(test)]
mod tests {
    use nesam_physics::{Control, VehicleState};
    use nesam_trajectories::MeasuredChannels;

    use super::*;

    fn drive(id: &str, samples: usize) -> Trajectory {
        Trajectory {
            id: id.into(),
            set: String::new(),
            world: None,
            split: None,
            dt_s: 0.1,
            time_s: (0..samples).map(|k| 0.1 * k as f64).collect(),
            states: vec![VehicleState::zero(); samples],
            controls: vec![Control { speed_m_s: 1.0, second: 0.0 }; samples],
            wheel_speed_rad_s: None,
            road_wheel_angle_rad: None,
            measured: MeasuredChannels::POSE_AND_TWIST,
            truth: None,
        }
    }

    #[test]
    fn analytic_a_set_is_named_by_its_folder_however_it_is_written() {
        for text in ["effect_open/payload", "effect_open/payload/", "./effect_open//payload", "effect_open/./payload"] {
            assert_eq!(set_name(text), Ok("effect_open/payload".into()), "{text}");
        }
        assert!(set_name("").is_err() && set_name("./").is_err());
    }

    #[test]
    fn analytic_windows_are_as_long_as_the_longest_drive_allows() {
        // Goal: logs of 2 s are used without an option, and drives too short for a window are said. Method: drives of 21, 20 and 40 samples.
        let drives = [drive("a", 21), drive("b", 20), drive("c", 40)];
        assert_eq!(horizon_of(None, &drives[..2], "trained on"), 20);
        assert_eq!(horizon_of(None, &drives, "scored"), MAX_HORIZON);
        assert_eq!(horizon_of(Some(5), &drives, "scored"), 5);
        let told = too_short(&drives, 20, "scored").expect("b is too short");
        assert!(told.starts_with("1 of 3 drives are too short for windows of 20 steps and are not scored (b);"), "{told}");
        assert_eq!(too_short(&drives, 19, "scored"), None);
        assert_eq!(too_short(&drives, 40, "scored"), None, "that no drive has a window is an error of its own");
    }
}
