//! The windows that are scored, and the truth that they are scored against.

use nesam_model::HistoryStep;
use nesam_trajectories::Trajectory;

use crate::dimension::{Pose, pose_of};
use crate::error::EvaluationError;
use crate::errors::path_length_m;

/// What errors are measured against.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Truth {
    /// The measured channels.
    #[default]
    Measured,
    /// The noise-free twins, where a set has them.
    Gt,
}

impl Truth {
    /// `measured` or `gt`.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Measured => "measured",
            Self::Gt => "gt",
        }
    }
}

/// One window of one drive: predict steps `start + 1 ..= start + horizon` from what was measured up to `start`.
#[derive(Clone, Copy, Debug)]
pub struct Window<'a> {
    /// The drive.
    pub trajectory: &'a Trajectory,
    /// Index of the drive among those evaluated.
    pub drive: usize,
    /// Sample i at which the prediction starts.
    pub start: usize,
    /// First sample of the history (history = `first_history ..= start`).
    pub first_history: usize,
    /// Steps K.
    pub horizon: usize,
}

/// Measured states and commands of a whole drive, oldest first.
pub fn history_steps(drive: &Trajectory) -> Vec<HistoryStep> {
    drive.states.iter().zip(&drive.controls).map(|(&state, &control)| HistoryStep { state, control }).collect()
}

impl Window<'_> {
    /// Time of the start in the drive, s.
    pub fn start_time_s(&self) -> f64 {
        self.trajectory.time_s[self.start]
    }

    /// Time of the start since the start of the log, s: what the onsets of effects count from.
    pub fn since_log_start_s(&self) -> f64 {
        self.start_time_s() - self.trajectory.time_s[0]
    }

    /// True poses after steps 1…K.
    pub fn truth(&self, truth: Truth) -> Vec<Pose> {
        self.true_poses(truth, 1)
    }

    /// True pose at the start, where the driven path begins; of measured channels that of [`Window::start_pose`].
    pub fn true_start(&self, truth: Truth) -> Pose {
        self.true_poses(truth, 0)[0]
    }

    /// Length of the driven path, horizontal, m.
    pub fn path_m(&self, truth: Truth) -> f64 {
        let poses = self.true_poses(truth, 0);
        path_length_m(&poses[0], &poses[1..])
    }

    /// True poses from a step on.
    fn true_poses(&self, truth: Truth, first: usize) -> Vec<Pose> {
        let range = self.start + first..=self.start + self.horizon;
        let states = match (truth, &self.trajectory.truth) {
            (Truth::Gt, Some(gt)) => &gt.states[range],
            _ => &self.trajectory.states[range],
        };
        states.iter().map(pose_of).collect()
    }

    /// Measured pose at the start.
    pub fn start_pose(&self) -> Pose {
        pose_of(&self.trajectory.states[self.start])
    }
}

/// Every window of the drives, by the rule of the contract (`nesam_trajectories::windows`).
///
/// # Errors
/// `EvaluationError::NoWindows` when none fits, `EvaluationError::NoGroundTruth` when `truth` asks for channels that a drive lacks.
pub fn all_windows(drives: &[Trajectory], horizon: usize, history: usize, truth: Truth) -> Result<Vec<Window<'_>>, EvaluationError> {
    if let (Truth::Gt, Some(without)) = (truth, drives.iter().find(|t| t.truth.is_none())) {
        return Err(EvaluationError::NoGroundTruth { trajectory: without.id.clone() });
    }
    let windows: Vec<Window<'_>> = drives
        .iter()
        .enumerate()
        .flat_map(|(drive, trajectory)| {
            nesam_trajectories::windows(trajectory.states.len(), horizon, history).into_iter().map(move |start| Window {
                trajectory,
                drive,
                start,
                first_history: (start + 1).saturating_sub(history.max(1)),
                horizon,
            })
        })
        .collect();
    if windows.is_empty() {
        let longest = drives.iter().map(|t| t.states.len()).max().unwrap_or(0);
        return Err(EvaluationError::NoWindows { horizon, trajectories: drives.len(), longest });
    }
    Ok(windows)
}
