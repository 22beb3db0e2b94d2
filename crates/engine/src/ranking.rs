//! What candidates are worth along a path, so that a planner need not be sent what it will not look at.

use nesam_model::{Rollout, flag};
use nesam_physics::{STATE_DIM, WHEELS};

use crate::error::EngineError;

/// Points of a path.
const POINTS_MAX: usize = 1024;
/// Segments that are looked at beyond the one that was nearest a step before, back and ahead, at least.
const REACH: [usize; 2] = [4, 16];
/// Way along the path that is looked at beyond it, back and ahead, m: a step at 12 m/s is 1.2 m.
const REACH_M: [f64; 2] = [1.0, 3.5];
/// Points nearer than this to the one before tell no direction, m: those of a recorded path while the vehicle stood.
const POINT_M: f64 = 0.05;
/// What makes a candidate worthless.
const FATAL: u32 = flag::NOT_FINITE | flag::OFF_MAP | flag::OVERTURNED;

/// Cost of a candidate: the mean over the steps of weighted squares.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PathCost {
    /// (points, 2), World, m.
    pub path: Vec<f32>,
    /// Speed to be made along the path, m/s.
    pub speed_m_s: f64,
    /// Weights.
    pub weights: CostWeights,
    /// Candidates to keep, best first.
    pub best: usize,
    /// Temperature of the mean command, in units of the cost; 0 = no mean.
    pub temperature: f64,
}

/// Weights of the squares, at least 0.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CostWeights {
    /// Distance from the path, per m².
    pub path: f64,
    /// Velocity along the path against the wanted one, per (m/s)²: of vx and vy, turned by the yaw alone.
    pub speed: f64,
    /// Roll and pitch, per rad².
    pub tilt: f64,
    /// Change of the commands from step to step: speed, per (m/s)², and second, per unit squared.
    pub change: [f64; 2],
}

/// What became of all candidates.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ranking {
    /// Of every candidate; infinite where it is worthless.
    pub costs: Vec<f32>,
    /// Indices of the candidates that are kept, best first; of two equal ones the earlier.
    pub best: Vec<u32>,
    /// (horizon, 2): all candidates weighted with exp(−(cost − least) / temperature); empty without a temperature or a finite cost.
    pub mean_controls: Vec<f32>,
}

impl PathCost {
    /// Checks path, weights and numbers.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the field below `cost`.
    pub fn check(&self, samples: usize) -> Result<(), EngineError> {
        let fail = |field: &str, reason: String| Err(EngineError::invalid(format!("cost.{field}"), reason));
        let points = self.path.len() / 2;
        if !self.path.len().is_multiple_of(2) || !(2..=POINTS_MAX).contains(&points) {
            return fail("path", format!("has {} numbers, allowed are 2 to {POINTS_MAX} points of two", self.path.len()));
        }
        if !self.path.iter().all(|v| v.is_finite()) {
            return fail("path", "holds a number that is not finite".into());
        }
        if self.path.chunks_exact(2).all(|point| point == &self.path[..2]) {
            return fail("path", format!("holds {points} times the same point, which has no direction"));
        }
        let CostWeights { path, speed, tilt, change: [speed_change, second_change] } = self.weights;
        let at_least_0 = [
            ("path_weight", path),
            ("speed_weight", speed),
            ("tilt_weight", tilt),
            ("speed_change_weight", speed_change),
            ("second_change_weight", second_change),
            ("temperature", self.temperature),
        ];
        for (field, value) in at_least_0 {
            if !(0.0..=1e12).contains(&value) {
                return fail(field, format!("is {value}, allowed are 0 to 1e12"));
            }
        }
        if !self.speed_m_s.is_finite() {
            return fail("speed_m_s", format!("is {}", self.speed_m_s));
        }
        if self.best > samples {
            return fail("best", format!("is {}, there are {samples} candidates", self.best));
        }
        Ok(())
    }

    /// Ranks the candidates of a rollout; `controls` are theirs, (samples, horizon, 2).
    pub fn rank(&self, rollout: &Rollout, controls: &[f32]) -> Ranking {
        let (rows, commands) = (rollout.horizon * STATE_DIM, rollout.horizon * 2);
        let path = Polyline::new(&self.path);
        let candidates = rollout.states.chunks_exact(rows).zip(controls.chunks_exact(commands)).zip(&rollout.flags);
        let costs: Vec<f32> = candidates
            .map(|((states, controls), flags)| if flags & FATAL == 0 { self.cost(&path, states, controls) as f32 } else { f32::INFINITY })
            .map(|cost| if cost.is_nan() { f32::INFINITY } else { cost })
            .collect();
        let mut order: Vec<u32> = (0..costs.len() as u32).collect();
        order.sort_by(|a, b| costs[*a as usize].total_cmp(&costs[*b as usize]).then(a.cmp(b)));
        let mean_controls = self.mean(&costs, controls, commands);
        order.truncate(self.best);
        Ranking { costs, best: order, mean_controls }
    }

    /// Cost of one candidate, states (horizon, 12) and commands (horizon, 2).
    fn cost(&self, polyline: &Polyline, states: &[f32], controls: &[f32]) -> f64 {
        let CostWeights { path, speed, tilt, change } = self.weights;
        let mut nearest = None;
        let mut sum = 0.0;
        for state in states.chunks_exact(STATE_DIM).map(|s| core::array::from_fn::<f64, STATE_DIM, _>(|i| f64::from(s[i]))) {
            let [x, y, _, roll, pitch, yaw, forward, left, ..] = state;
            let place = polyline.nearest([x, y], nearest);
            nearest = Some(place.segment);
            let (sin, cos) = yaw.sin_cos();
            let velocity = [forward * cos - left * sin, forward * sin + left * cos];
            let along = velocity[0] * place.direction[0] + velocity[1] * place.direction[1];
            sum += path * place.distance_2 + speed * (along - self.speed_m_s).powi(2) + tilt * (roll * roll + pitch * pitch);
        }
        for pair in controls.windows(4).step_by(2) {
            sum += (0..2).map(|i| change[i] * f64::from(pair[i + 2] - pair[i]).powi(2)).sum::<f64>();
        }
        sum / (states.len() / STATE_DIM) as f64
    }

    fn mean(&self, costs: &[f32], controls: &[f32], commands: usize) -> Vec<f32> {
        let least = costs.iter().copied().fold(f32::INFINITY, f32::min);
        if self.temperature <= 0.0 || !least.is_finite() {
            return Vec::new();
        }
        let mut sum = vec![0.0; commands];
        let mut total = 0.0;
        for (cost, controls) in costs.iter().zip(controls.chunks_exact(commands)) {
            let weight = (-f64::from(cost - least) / self.temperature).exp();
            total += weight;
            sum.iter_mut().zip(controls).for_each(|(sum, value)| *sum += weight * f64::from(*value));
        }
        sum.iter().map(|sum| (sum / total) as f32).collect()
    }
}

/// A path as it is looked at.
struct Polyline {
    points: Vec<[f64; 2]>,
    /// Way along it to each point, m.
    along_m: Vec<f64>,
}

impl Polyline {
    /// Of points x, y, x, y, …; of two that are as good as one the earlier stays, the first and the last of all stay.
    fn new(path: &[f32]) -> Self {
        let mut points: Vec<[f64; 2]> = Vec::with_capacity(path.len() / 2);
        let mut along_m: Vec<f64> = Vec::with_capacity(path.len() / 2);
        let last = path.len() / 2 - 1;
        for (i, point) in path.chunks_exact(2).map(|p| [f64::from(p[0]), f64::from(p[1])]).enumerate() {
            let step = |points: &[[f64; 2]]| points.last().map(|[x, y]| (point[0] - x).hypot(point[1] - y));
            let near = step(&points).is_some_and(|step| step < POINT_M);
            if near && i < last {
                continue;
            }
            if near && points.len() > 1 {
                points.pop();
                along_m.pop();
            }
            along_m.push(along_m.last().copied().unwrap_or(0.0) + step(&points).unwrap_or(0.0));
            points.push(point);
        }
        Self { points, along_m }
    }

    /// Segments near one of them: some, and those that a step may reach.
    fn near(&self, segment: usize) -> core::ops::Range<usize> {
        let segments = self.points.len() - 1;
        let back = self.along_m[..segment].partition_point(|along| *along < self.along_m[segment] - REACH_M[0]);
        let ahead = self.along_m[..segments].partition_point(|along| *along <= self.along_m[segment + 1] + REACH_M[1]);
        back.min(segment.saturating_sub(REACH[0]))..ahead.max(segment + REACH[1] + 1).min(segments)
    }

    /// The nearest place of the path: anywhere at first, then near the segment of the step before.
    fn nearest(&self, at: [f64; 2], before: Option<usize>) -> Place {
        let range = before.map_or(0..self.points.len() - 1, |segment| self.near(segment));
        let places = range.map(|segment| {
            let ([ax, ay], [bx, by]) = (self.points[segment], self.points[segment + 1]);
            let (dx, dy) = (bx - ax, by - ay);
            let length_2 = dx * dx + dy * dy;
            let t = if length_2 > 0.0 { (((at[0] - ax) * dx + (at[1] - ay) * dy) / length_2).clamp(0.0, 1.0) } else { 0.0 };
            let (ex, ey) = (at[0] - ax - t * dx, at[1] - ay - t * dy);
            let length = length_2.sqrt().max(f64::MIN_POSITIVE);
            Place { segment, distance_2: ex * ex + ey * ey, direction: [dx / length, dy / length] }
        });
        places.reduce(|best, place| if place.distance_2 < best.distance_2 { place } else { best }).unwrap_or_default()
    }
}

/// A place of the path.
#[derive(Clone, Copy, Default)]
struct Place {
    segment: usize,
    /// Squared distance, m².
    distance_2: f64,
    /// Unit vector of the segment.
    direction: [f64; 2],
}

impl Ranking {
    /// The rows of `width` numbers of the best candidates, in their order.
    pub fn rows_of_best(&self, values: &[f32], width: usize) -> Vec<f32> {
        self.best.iter().flat_map(|n| &values[*n as usize * width..(*n as usize + 1) * width]).copied().collect()
    }

    /// The rollout of the best candidates alone, in their order.
    pub fn best_of(&self, rollout: &Rollout) -> Rollout {
        Rollout {
            states: self.rows_of_best(&rollout.states, rollout.horizon * STATE_DIM),
            position_m: Vec::new(),
            sinkage_m: self.rows_of_best(&rollout.sinkage_m, rollout.horizon * WHEELS),
            flags: self.best.iter().map(|n| rollout.flags[*n as usize]).collect(),
            samples: self.best.len(),
            ..*rollout
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Candidates that drive straight at `y` with this speed and roll.
    fn straight(candidates: &[(f64, f64, f64)], horizon: usize) -> Rollout {
        let states = candidates.iter().flat_map(|(y, speed, roll)| {
            (1..=horizon).flat_map(move |k| {
                let mut state = [0.0; STATE_DIM];
                (state[0], state[1], state[3], state[6]) = ((0.1 * k as f64 * speed) as f32, *y as f32, *roll as f32, *speed as f32);
                state
            })
        });
        let n = candidates.len();
        Rollout {
            states: states.collect(),
            sinkage_m: vec![0.0; n * horizon * 4],
            flags: vec![0; n],
            samples: n,
            horizon,
            ..Default::default()
        }
    }

    fn along_x() -> PathCost {
        let weights = CostWeights { path: 2.0, speed: 3.0, tilt: 5.0, change: [7.0, 11.0] };
        PathCost { path: vec![0.0, 0.0, 5.0, 0.0, 10.0, 0.0], speed_m_s: 2.0, weights, best: 2, temperature: 0.5 }
    }

    #[test]
    fn analytic_costs_of_straight_lines() {
        let (cost, horizon) = (along_x(), 4);
        let mut rollout = straight(&[(0.5, 2.0, 0.0), (0.0, 1.0, 0.1), (0.0, 2.0, 0.0), (0.0, 2.0, 0.0)], horizon);
        rollout.flags[3] = flag::OFF_MAP;
        // The third changes both commands once by 0.5 and 0.25.
        let mut controls = vec![0.0; 4 * horizon * 2];
        controls[2 * horizon * 2] = 0.5;
        controls[2 * horizon * 2 + 1] = -0.25;
        let ranking = cost.rank(&rollout, &controls);
        let expected = [2.0 * 0.25, 3.0 + 5.0 * 0.01, (7.0 * 0.25 + 11.0 * 0.0625) / 4.0];
        for (found, expected) in ranking.costs.iter().zip(expected) {
            assert!((f64::from(*found) - expected).abs() < 1e-5, "{found} {expected}");
        }
        assert_eq!(ranking.costs[3], f32::INFINITY);
        assert_eq!(ranking.best, [0, 2]);
        let weight = |cost: f64| (-(cost - expected[0]) / 0.5).exp();
        let total: f64 = expected.into_iter().map(weight).sum();
        assert!((f64::from(ranking.mean_controls[0]) - 0.5 * weight(expected[2]) / total).abs() < 1e-6);
        let kept = ranking.best_of(&rollout);
        assert_eq!(kept.state(1, 3), rollout.state(2, 3));
        assert_eq!((kept.samples, kept.flags.len(), kept.sinkage_m.len()), (2, 2, 2 * horizon * 4));
    }

    #[test]
    fn analytic_a_path_that_crosses_itself_is_followed_in_order() {
        // Out and back, half a metre apart: the way back is nearer from some way out, and drives the other way.
        let mut path: Vec<f32> = (0..=40).flat_map(|i| [0.25 * i as f32, 0.0]).collect();
        path.extend((0..=40).flat_map(|i| [10.0 - 0.25 * i as f32, 0.5]));
        let cost = PathCost { path, speed_m_s: 2.0, weights: CostWeights { speed: 1.0, ..Default::default() }, ..Default::default() };
        let mut rollout = straight(&[(0.0, 2.0, 0.0)], 10);
        // It drifts towards the way back after its first step.
        rollout.states.chunks_exact_mut(STATE_DIM).skip(1).for_each(|state| state[1] = 0.3);
        let ranking = cost.rank(&rollout, &[0.0; 20]);
        assert!(ranking.costs[0] < 1e-6, "{:?}", ranking.costs);
    }

    /// Goal: what candidates are worth along a path does not hang on how many points it has, nor on the vehicle having stood while it was recorded. Method: an
    /// arc in points 0.25 m apart, 1.25 cm apart, and with thirty points within a centimetre where it begins; a candidate at 6 m/s beside it.
    #[test]
    fn regress_points_close_together_change_no_cost() {
        let (radius, horizon) = (20.0_f64, 20);
        let arc = |spacing: f64| {
            let points = (12.0 / spacing).round() as usize;
            let at = move |i: usize| spacing * i as f64 / radius;
            (0..=points).flat_map(move |i| [(radius * at(i).sin()) as f32, (radius - radius * at(i).cos()) as f32]).collect::<Vec<f32>>()
        };
        let mut stood: Vec<f32> = (0..30).flat_map(|i| [0.005 * (i as f32).sin(), 0.005 * (1.7 * i as f32).cos()]).collect();
        stood.extend(arc(0.25).split_off(2));
        let mut rollout = straight(&[(0.0, 6.0, 0.0)], horizon);
        for (k, state) in rollout.states.chunks_exact_mut(STATE_DIM).enumerate() {
            let angle = 0.6 * (k + 1) as f64 / radius;
            (state[0], state[1]) = ((radius * angle.sin()) as f32, (radius - radius * angle.cos() + 0.2) as f32);
            state[5] = angle as f32;
        }
        let cost = |path: Vec<f32>| {
            let weights = CostWeights { path: 1.0, speed: 0.5, ..Default::default() };
            PathCost { path, speed_m_s: 5.0, weights, ..Default::default() }.rank(&rollout, &[0.0; 40]).costs[0]
        };
        let plain = cost(arc(0.25));
        assert!((0.4..0.8).contains(&plain), "{plain}");
        for path in [arc(0.0125), arc(0.04), stood] {
            let found = cost(path);
            assert!((found - plain).abs() < 0.02 * plain, "{found} for {plain}");
        }
    }

    #[test]
    fn regress_wrong_costs_are_refused_with_the_field_and_no_finite_cost_has_no_mean() {
        let sound = along_x();
        assert!(sound.check(4).is_ok());
        for (wrong, field) in [
            (PathCost { path: vec![0.0, 0.0], ..sound.clone() }, "cost.path"),
            (PathCost { path: vec![0.0; 5], ..sound.clone() }, "cost.path"),
            (PathCost { path: vec![0.0, f32::NAN, 1.0, 1.0], ..sound.clone() }, "cost.path"),
            (PathCost { path: vec![3.0, -4.0, 3.0, -4.0, 3.0, -4.0], ..sound.clone() }, "cost.path"),
            (PathCost { temperature: -1.0, ..sound.clone() }, "cost.temperature"),
            (PathCost { speed_m_s: f64::NAN, ..sound.clone() }, "cost.speed_m_s"),
            (PathCost { best: 5, ..sound.clone() }, "cost.best"),
            (PathCost { weights: CostWeights { tilt: f64::INFINITY, ..sound.weights }, ..sound.clone() }, "cost.tilt_weight"),
        ] {
            assert_eq!(wrong.check(4).unwrap_err().field(), field);
        }
        let mut rollout = straight(&[(0.0, 1.0, 0.0)], 3);
        rollout.flags[0] = flag::NOT_FINITE;
        let ranking = PathCost { best: 1, ..sound }.rank(&rollout, &[0.0; 6]);
        assert_eq!((ranking.best, ranking.mean_controls), (vec![0], Vec::new()));
    }
}
