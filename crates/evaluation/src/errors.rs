//! Errors of one model, window by window and step by step.

use crate::dimension::{POSE_DIM, Pose, absolute_error, horizontal_distance};

/// What a model predicts for one window: one pose per step 1…K, and which dimensions it claims.
#[derive(Clone, Debug, PartialEq)]
pub struct PosePath {
    /// Poses after steps 1…K.
    pub poses: Vec<Pose>,
    /// Dimensions the model predicts, in the order of `DIMENSION_KEYS`.
    pub predicts: [bool; POSE_DIM],
}

/// Error of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepError {
    /// Absolute error per dimension, m and degrees; NaN where the drive does not measure it or the model does not predict it.
    pub absolute: [f64; POSE_DIM],
    /// Horizontal distance between predicted and true position, m.
    pub position_m: f64,
}

/// Errors of one model over many windows.
#[derive(Clone, Debug, PartialEq)]
pub struct WindowErrors {
    /// Steps K of each window.
    pub horizon: usize,
    /// Dimensions that the model predicts and a drive measures.
    pub scored: [bool; POSE_DIM],
    /// Drive of each window (index, also the cluster of the bootstrap).
    pub trajectory: Vec<usize>,
    /// True path length of each window, horizontal, m.
    pub path_m: Vec<f64>,
    /// Row-major (windows, K).
    pub steps: Vec<StepError>,
    /// Of each window, whether the model gave a number in it that is not finite.
    pub broken: Vec<bool>,
}

impl WindowErrors {
    /// No windows yet.
    pub fn empty(horizon: usize) -> Self {
        Self { horizon, scored: [false; POSE_DIM], trajectory: Vec::new(), path_m: Vec::new(), steps: Vec::new(), broken: Vec::new() }
    }

    /// Number of windows in which the model gave a number that is not finite.
    pub fn not_finite(&self) -> usize {
        self.broken.iter().filter(|broken| **broken).count()
    }

    /// Number of windows.
    pub fn windows(&self) -> usize {
        self.trajectory.len()
    }

    /// Number of windows whose path is too short for a relative error.
    pub fn below_path_floor(&self) -> usize {
        self.path_m.iter().filter(|path_m| !above_path_floor(**path_m)).count()
    }

    /// Steps of window `w`.
    pub fn window(&self, w: usize) -> &[StepError] {
        &self.steps[w * self.horizon..(w + 1) * self.horizon]
    }

    /// Adds a window: `start` is the measured pose the prediction began from, `truth` the poses after steps 1…K, `path_m` how long the way to the last of them is,
    /// and `measured` which dimensions the drive measures.
    ///
    /// A step that is not finite is scored as if the vehicle had stayed at the last finite pose, and the window is counted by
    /// [`WindowErrors::not_finite`]: leaving it out would flatter the model, and a NaN would hide every other window.
    pub fn push(&mut self, trajectory: usize, start: &Pose, path: &PosePath, truth: &[Pose], path_m: f64, measured: [bool; POSE_DIM]) {
        assert_eq!(path.poses.len(), self.horizon, "a prediction has one pose per step; this is a bug");
        assert_eq!(truth.len(), self.horizon, "a window has one true pose per step; this is a bug");
        let scored: [bool; POSE_DIM] = core::array::from_fn(|d| path.predicts[d] && measured[d]);
        let (mut last, mut broken) = (*start, false);
        for (pose, true_pose) in path.poses.iter().zip(truth) {
            let usable = (0..POSE_DIM).all(|d| !path.predicts[d] || pose[d].is_finite());
            broken |= !usable;
            if usable {
                last = *pose;
            }
            let errors = absolute_error(&last, true_pose);
            let absolute = core::array::from_fn(|d| if scored[d] { errors[d] } else { f64::NAN });
            self.steps.push(StepError { absolute, position_m: horizontal_distance(&last, true_pose) });
        }
        self.broken.push(broken);
        for (any, scored) in self.scored.iter_mut().zip(scored) {
            *any |= scored;
        }
        self.trajectory.push(trajectory);
        self.path_m.push(path_m);
    }

    /// The windows for which `keep` is true, with the same drive indices.
    pub fn filter(&self, mut keep: impl FnMut(usize) -> bool) -> Self {
        let mut out = Self { scored: self.scored, ..Self::empty(self.horizon) };
        for w in (0..self.windows()).filter(|&w| keep(w)) {
            out.trajectory.push(self.trajectory[w]);
            out.path_m.push(self.path_m[w]);
            out.steps.extend_from_slice(self.window(w));
            out.broken.push(self.broken[w]);
        }
        out
    }

    /// Value of step `k` (0-based) in every window: one of the six dimensions, or the horizontal position for `d == POSE_DIM`.
    pub fn column(&self, k: usize, d: usize) -> Vec<f64> {
        let pick = |s: &StepError| if d < POSE_DIM { s.absolute[d] } else { s.position_m };
        (0..self.windows()).map(|w| pick(&self.window(w)[k])).collect()
    }
}

/// Path below which the relative error of a window says nothing, m (chosen: several times the position noise).
pub const PATH_FLOOR_M: f64 = 0.2;

/// Whether the relative error of a window of this path counts.
pub(crate) fn above_path_floor(path_m: f64) -> bool {
    path_m > PATH_FLOOR_M
}

/// Horizontal length of the polyline from `start` through `truth`, m. Position noise lengthens it by well under one percent at driving speed.
pub fn path_length_m(start: &Pose, truth: &[Pose]) -> f64 {
    let mut previous = start;
    let mut length = 0.0;
    for pose in truth {
        length += horizontal_distance(previous, pose);
        previous = pose;
    }
    length
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along_x(x: f64) -> Pose {
        [x, 0.0, 0.0, 0.0, 0.0, 0.0]
    }

    #[test]
    fn analytic_errors_and_path_of_a_straight_drive() {
        let mut e = WindowErrors::empty(2);
        let path = PosePath { poses: vec![along_x(1.5), along_x(2.5)], predicts: [true; 6] };
        let truth = [along_x(1.0), along_x(3.0)];
        e.push(3, &along_x(0.0), &path, &truth, path_length_m(&along_x(0.0), &truth), [true, true, true, true, true, false]);
        assert_eq!(e.path_m, [3.0]);
        assert_eq!(e.trajectory, [3]);
        assert_eq!(e.column(0, 0), [0.5]);
        assert_eq!(e.column(1, 6), [0.5]);
        assert_eq!(e.scored, [true, true, true, true, true, false]);
        assert!(e.column(1, 5)[0].is_nan());
    }

    #[test]
    fn analytic_a_step_that_is_not_finite_counts_as_standing_still() {
        let mut e = WindowErrors::empty(2);
        let path = PosePath { poses: vec![along_x(1.0), along_x(f64::NAN)], predicts: [true; 6] };
        e.push(0, &along_x(0.0), &path, &[along_x(1.0), along_x(2.0)], 2.0, [true; 6]);
        assert_eq!(e.column(1, 0), [1.0]);
        assert_eq!(e.not_finite(), 1);
    }

    /// Goal: a part of the windows counts those of its own that are not finite. Method: three windows, the second broken, every part of two.
    #[test]
    fn regress_windows_that_are_kept_keep_whether_they_are_finite() {
        let mut e = WindowErrors::empty(1);
        for (drive, x) in [1.0, f64::NAN, 1.0].into_iter().enumerate() {
            e.push(drive, &along_x(0.0), &PosePath { poses: vec![along_x(x)], predicts: [true; 6] }, &[along_x(1.0)], 1.0, [true; 6]);
        }
        for (left_out, not_finite) in [(0, 1), (1, 0), (2, 1)] {
            let kept = e.filter(|w| w != left_out);
            assert_eq!((kept.windows(), kept.not_finite()), (2, not_finite), "without {left_out}");
            assert_eq!(kept.filter(|_| true), kept);
        }
        assert_eq!((e.not_finite(), e.filter(|_| false).not_finite()), (1, 0));
    }
}
