//! The fit of the kinematic baseline on training drives.

use nesam_physics::{Control, Vehicle, VehicleState, wrap_angle};
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use crate::error::EvaluationError;
use crate::kinematic::{KINEMATIC_PARAMETERS, Kinematic};

/// Most windows used by the fit; more change the third digit only (chosen).
const FIT_WINDOWS: usize = 2000;

/// Smallest and largest value of each parameter.
const BOUNDS: [(f64, f64); KINEMATIC_PARAMETERS] = [(0.2, 2.0), (0.01, 10.0), (0.1, 3.0), (0.005, 2.0), (-0.02, 0.5), (-3.0, 5.0)];

/// First step of the search in each parameter.
const FIRST_STEP: [f64; KINEMATIC_PARAMETERS] = [0.05, 0.2, 0.05, 0.05, 0.01, 0.3];

/// One window of the fit.
struct Sample<'a> {
    start: &'a VehicleState<f64>,
    past: &'a [Control<f64>],
    future: &'a [Control<f64>],
    truth: &'a [VehicleState<f64>],
    dt_s: f64,
}

impl Kinematic {
    /// Fits the six parameters to the measured x, y and yaw of `trajectories` over `horizon` steps.
    ///
    /// The loss is the mean over windows and steps of the horizontal error (m) plus the yaw error times half the wheelbase (m/rad), that is the
    /// figure by which the baseline is later judged, so that no other fit of this form would do better by much. The search is
    /// Hooke and Jeeves (1961): coordinate moves, then a move along the improvement, steps halved when nothing helps; it is
    /// deterministic and needs no derivative of an absolute value.
    ///
    /// # Errors
    /// `EvaluationError::Fit` when no window fits the drives.
    pub fn fit(vehicle: &Vehicle, trajectories: &[Trajectory], horizon: usize) -> Result<Self, EvaluationError> {
        let samples = samples(trajectories, horizon);
        if samples.is_empty() {
            let reason = format!("no window of {horizon} steps in {} training drives; use a shorter --horizon", trajectories.len());
            return Err(EvaluationError::Fit { reason });
        }
        let loss = |p: &[f64; KINEMATIC_PARAMETERS]| loss_m(vehicle, &Self::from_array(*p), &samples);
        Ok(Self::from_array(hooke_jeeves(Self::ideal(vehicle).to_array(), loss)))
    }
}

fn samples(trajectories: &[Trajectory], horizon: usize) -> Vec<Sample<'_>> {
    let mut all: Vec<Sample<'_>> = trajectories
        .iter()
        .flat_map(|t| {
            nesam_trajectories::windows(t.states.len(), horizon, nesam_model::HISTORY).into_iter().map(move |i| Sample {
                start: &t.states[i],
                past: &t.controls[i.saturating_sub(nesam_model::HISTORY)..i],
                future: &t.controls[i..i + horizon],
                truth: &t.states[i + 1..=i + horizon],
                dt_s: t.dt_s,
            })
        })
        .collect();
    let stride = all.len().div_ceil(FIT_WINDOWS).max(1);
    let mut index = 0;
    all.retain(|_| {
        index += 1;
        (index - 1) % stride == 0
    });
    all
}

fn loss_m(vehicle: &Vehicle, model: &Kinematic, samples: &[Sample<'_>]) -> f64 {
    let lever_m = 0.5 * vehicle.wheelbase_m;
    // Collected in order before the sum: a parallel float sum would depend on the number of threads.
    let each: Vec<f64> = samples
        .par_iter()
        .map(|s| {
            let path = model.plane_path(vehicle, s.start, s.past, s.future, s.dt_s);
            let total: f64 = path
                .iter()
                .zip(s.truth)
                .map(|([x, y, yaw], t)| {
                    let position = (x - t.position_m[0]).hypot(y - t.position_m[1]);
                    position + lever_m * wrap_angle(yaw - t.attitude_rad[2]).abs()
                })
                .sum();
            total / path.len() as f64
        })
        .collect();
    each.iter().sum::<f64>() / each.len() as f64
}

fn hooke_jeeves<F>(start: [f64; KINEMATIC_PARAMETERS], loss: F) -> [f64; KINEMATIC_PARAMETERS]
where
    F: Fn(&[f64; KINEMATIC_PARAMETERS]) -> f64,
{
    let clamp = |p: [f64; KINEMATIC_PARAMETERS]| std::array::from_fn(|i| p[i].clamp(BOUNDS[i].0, BOUNDS[i].1));
    let mut step = FIRST_STEP;
    let mut base = clamp(start);
    let mut best = loss(&base);
    for _ in 0..400 {
        let (mut point, value) = explore(base, best, &step, &loss, clamp);
        if value < best {
            let along = clamp(std::array::from_fn(|i| 2.0 * point[i] - base[i]));
            let ahead = loss(&along);
            base = point;
            best = value;
            if ahead < best {
                (point, best) = (along, ahead);
                base = point;
            }
        } else {
            step = step.map(|s| 0.5 * s);
            if step.iter().zip(FIRST_STEP).all(|(s, first)| *s < first * 1e-3) {
                break;
            }
        }
    }
    base
}

fn explore<F>(
    mut point: [f64; KINEMATIC_PARAMETERS],
    mut value: f64,
    step: &[f64; KINEMATIC_PARAMETERS],
    loss: &F,
    clamp: impl Fn([f64; KINEMATIC_PARAMETERS]) -> [f64; KINEMATIC_PARAMETERS],
) -> ([f64; KINEMATIC_PARAMETERS], f64)
where
    F: Fn(&[f64; KINEMATIC_PARAMETERS]) -> f64,
{
    for i in 0..KINEMATIC_PARAMETERS {
        for direction in [1.0, -1.0] {
            let mut trial = point;
            trial[i] += direction * step[i];
            let trial = clamp(trial);
            let there = loss(&trial);
            if there < value {
                (point, value) = (trial, there);
                break;
            }
        }
    }
    (point, value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_vehicle::bicycle;

    /// Goal: the fit finds the parameters that made the data. Method: 240 windows of a bicycle with known parameters under sinusoidal
    /// commands, no noise; tolerance 2 % of each parameter (the search stops at 1/1000 of its first step).
    #[test]
    fn analytic_fit_recovers_a_synthetic_bicycle() {
        let vehicle = bicycle();
        let truth = Kinematic {
            speed_gain: 0.93,
            speed_lag_s: 0.8,
            steering_gain: 0.85,
            steering_lag_s: 0.2,
            understeer_s2_m2: 0.02,
            turning_lever_m: 1.4,
        };
        let commands: Vec<Vec<Control<f64>>> = (0..60)
            .map(|w| {
                let phase = f64::from(w);
                (0..64)
                    .map(|k| {
                        let t = 0.1 * f64::from(k);
                        let speed_m_s = 2.5 + 1.5 * (0.9 * t + phase).sin();
                        Control { speed_m_s, second: 0.3 * (0.7 * t + 2.0 * phase).sin() }
                    })
                    .collect()
            })
            .collect();
        let drives: Vec<(VehicleState<f64>, Vec<VehicleState<f64>>)> = commands
            .iter()
            .enumerate()
            .map(|(w, c)| {
                let mut start = VehicleState::zero();
                start.velocity_m_s[0] = 1.0 + 0.04 * w as f64;
                let path = truth.plane_path(&vehicle, &start, &c[..32], &c[32..], 0.1);
                let states = path
                    .iter()
                    .map(|[x, y, yaw]| {
                        let mut s = VehicleState::zero();
                        (s.position_m[0], s.position_m[1], s.attitude_rad[2]) = (*x, *y, *yaw);
                        s
                    })
                    .collect();
                (start, states)
            })
            .collect();
        let samples: Vec<Sample<'_>> = commands
            .iter()
            .zip(&drives)
            .map(|(c, (start, states))| Sample { start, past: &c[..32], future: &c[32..], truth: states, dt_s: 0.1 })
            .collect();
        let found = hooke_jeeves(Kinematic::ideal(&vehicle).to_array(), |p| loss_m(&vehicle, &Kinematic::from_array(*p), &samples));
        for (name, (f, t)) in ["g_v", "tau_v", "g_s", "tau_s", "k", "lever"].iter().zip(found.iter().zip(truth.to_array())) {
            assert!((f - t).abs() < 0.02 * t.abs().max(0.05), "{name}: found {f}, made with {t}");
        }
    }
}
