//! The sessions in an update of the live page: what is new to a cursor.

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_engine::{ALARM_ACTIVE, FORECAST_AHEAD, ForecastCheck, SOIL_NOT_LEARNED};
use nesam_model::{Predictor, flag};
use nesam_physics::{SOIL_BOUNDS, SOIL_DIM, SOIL_LOGARITHMIC, SOIL_NAMES, SOIL_UNITS, STATE_DIM};
use nesam_terrain::{Pose2, WorldMap};
use serde_json::{Value, json};

use super::notes::{Notes, PredictionTiming, SessionNotes, Shown};

/// Candidates of a fan that are drawn.
const FAN_ROWS: usize = 48;
/// Points of each.
const FAN_POINTS: usize = 16;
/// Regions along a predicted path.
const REGIONS: usize = 8;
/// Half width of a two-sided 95 % interval in standard deviations.
const TWO_SIDED_95: f64 = 1.96;
/// Flags that speak of session and start and not of the candidate.
const OF_SESSION: u32 = flag::NO_MAP | flag::START_OFF_GROUND | SOIL_NOT_LEARNED | ALARM_ACTIVE;

/// What has been told already.
#[derive(Clone, Debug, Default)]
pub(crate) struct Cursor {
    timings: u64,
    sessions: BTreeMap<String, SeenSession>,
}

#[derive(Clone, Copy, Debug, Default)]
struct SeenSession {
    trail: u64,
    tests: u64,
    fan: u64,
    region: u64,
}

/// What updates are made with besides the notes.
#[derive(Clone, Debug)]
pub(crate) struct Scenery {
    /// The bundle's model: step, soil prior, cache of terrain.
    pub predictor: Arc<Predictor>,
    /// The maps that sessions drive on, by id.
    pub maps: BTreeMap<String, Arc<WorldMap>>,
    /// Soil prior under the vehicle of each session, as far as it is known.
    priors: BTreeMap<String, [f64; SOIL_DIM]>,
}

impl Scenery {
    /// A scenery without maps.
    pub fn new(predictor: Arc<Predictor>) -> Self {
        Self { predictor, maps: BTreeMap::new(), priors: BTreeMap::new() }
    }

    /// Looks up the soil prior under each vehicle. What the engine has not encoded yet is left at the place before: the page asks the network for nothing.
    pub fn look_at_soil(&mut self, notes: &Notes) {
        self.priors.retain(|name, _| notes.sessions.contains_key(name));
        for (name, session) in &notes.sessions {
            let Some((measurement, _)) = &session.newest else { continue };
            let map = session.map.as_ref().map(|(id, ..)| self.maps.get(id));
            // A map that the engine has not handed over yet says nothing.
            let (None | Some(Some(_))) = map else { continue };
            let [x_m, y_m, _] = measurement.state.position_m;
            let pose = Pose2 { x_m, y_m, yaw_rad: measurement.state.attitude_rad[2] };
            if let Some(prior) = self.predictor.known_soil_prior(map.flatten(), pose) {
                self.priors.insert(name.clone(), prior);
            }
        }
    }

    /// The map that a vehicle stands on.
    fn map_under(&self, session: &SessionNotes) -> Option<&Arc<WorldMap>> {
        let [x_m, y_m, _] = session.newest.as_ref()?.0.state.position_m;
        self.maps.get(&session.map.as_ref()?.0).filter(|map| map.contains(x_m, y_m))
    }
}

fn rounded(value: f64, digits: i32) -> f64 {
    let scale = 10f64.powi(digits);
    (value * scale).round() / scale
}

impl Cursor {
    /// The sessions, and what is new of each; a default cursor gives everything.
    pub fn sessions(&mut self, notes: &Notes, scenery: &Scenery, now_s: f64) -> Value {
        self.sessions.retain(|name, _| notes.sessions.contains_key(name));
        let of = |(name, session): (&String, &SessionNotes)| {
            let seen = self.sessions.entry(name.clone()).or_default();
            session_json(name, session, seen, scenery, now_s)
        };
        notes.sessions.iter().map(of).collect()
    }

    /// New timings of predictions: when in s, queue and computation in ms, candidates.
    pub fn timings(&mut self, notes: &Notes) -> Value {
        let row = |t: &PredictionTiming| json!([rounded(t.at_s, 3), rounded(1e3 * t.queue_s, 3), rounded(1e3 * t.compute_s, 3), t.samples]);
        let fresh = notes.timings.after(self.timings).map(row).collect();
        self.timings = notes.timings.total();
        fresh
    }
}

fn session_json(name: &str, session: &SessionNotes, seen: &mut SeenSession, scenery: &Scenery, now_s: f64) -> Value {
    let trail: Vec<_> =
        session.trail.after(seen.trail).map(|p| [rounded(p[0], 3), rounded(p[1], 3), rounded(p[2], 3), rounded(p[3], 2)]).collect();
    let tests: Vec<_> =
        session.tests.after(seen.tests).map(|t| json!({"judged": t.judged, "nis": t.nis, "dof": t.dof, "rejected": t.rejected})).collect();
    let fresh = |shown: &Option<Shown>, before: u64| shown.clone().filter(|shown| shown.number != before);
    let fan = fresh(&session.fan, seen.fan).map(|fan| fan_json(&fan, scenery));
    let region = fresh(&session.region, seen.region).map(|region| region_json(&region, scenery));
    let number = |shown: &Option<Shown>| shown.as_ref().map_or(0, |shown| shown.number);
    *seen = SeenSession {
        trail: session.trail.total(),
        tests: session.tests.total(),
        fan: number(&session.fan),
        region: number(&session.region),
    };
    let newest = session.newest.as_ref().map(|(m, at_s)| {
        json!({
            "stamp_s": m.stamp_ns as f64 * 1e-9,
            "age_s": rounded((now_s - at_s).max(0.0), 2),
            "position_m": m.state.position_m,
            "attitude_rad": m.state.attitude_rad,
            "velocity_m_s": m.state.velocity_m_s,
            "angular_velocity_rad_s": m.state.angular_velocity_rad_s,
            "command": {"speed_m_s": m.command.speed_m_s, "second": m.command.second},
        })
    });
    json!({
        "session": name,
        "vehicle": session.vehicle,
        "map": session.map.as_ref().map(|(id, version, hash)| json!({"id": id, "version": version, "hash": hash})),
        "history_steps": session.history_steps,
        "outcomes": session.outcomes,
        "newest": newest,
        "trail": trail,
        "tests": tests,
        "soil": soil_json(name, session, scenery),
        "forecasts": session.soil.as_ref().and_then(|soil| forecasts_json(&soil.forecasts)),
        "fan": fan,
        "region": region,
    })
}

/// The soil under the vehicle: prior of the place, estimate, 95 % band, whether each number is learned.
fn soil_json(name: &str, session: &SessionNotes, scenery: &Scenery) -> Value {
    let (Some(soil), Some((measurement, _)), Some(prior)) = (&session.soil, &session.newest, scenery.priors.get(name)) else {
        return Value::Null;
    };
    let [x_m, y_m, _] = measurement.state.position_m;
    let correction = soil.state.correction;
    let value = correction.apply(prior);
    let bound = |side: f64| {
        let deviation = soil.state.variance.map(|v| v.map(|v| side * TWO_SIDED_95 * v.max(0.0).sqrt()));
        deviation.map(|deviation| correction.coordinates.correct(&value, &deviation))
    };
    json!({
        "names": SOIL_NAMES,
        "units": SOIL_UNITS,
        "bounds": SOIL_BOUNDS,
        "logarithmic": SOIL_LOGARITHMIC,
        "epoch": soil.state.epoch,
        "prior": prior,
        "value": value,
        "low": bound(-1.0),
        "high": bound(1.0),
        "learned": soil.state.learned,
        "noise_scale": soil.noise_scale,
        "class": scenery.map_under(session).and_then(|map| map.soil_class(x_m, y_m)).map(|class| class.name.clone()),
    })
}

/// How predictions came true; absent before the first comparison.
fn forecasts_json(check: &ForecastCheck) -> Option<Value> {
    let (error_rms_m, expected_rms_m) = check.error_rms_m().zip(check.expected_rms_m())?;
    let [.., error_m] = error_rms_m;
    let [.., expected_m] = expected_rms_m;
    Some(json!({
        "checked": check.checked(),
        "steps": FORECAST_AHEAD,
        "error_rms_m": rounded(error_m, 3),
        "expected_rms_m": rounded(expected_m, 3),
    }))
}

/// Candidates that are drawn: all, or so many evenly chosen with the first among them.
fn drawn(samples: usize) -> Vec<usize> {
    let shown = samples.min(FAN_ROWS);
    (0..shown).map(|i| i * samples / shown).collect()
}

/// Steps that are drawn, the last always among them.
fn steps(horizon: usize) -> Vec<usize> {
    let points = horizon.min(FAN_POINTS);
    (1..=points).map(|i| i * horizon / points - 1).collect()
}

fn fan_json(fan: &Shown, scenery: &Scenery) -> Value {
    let (prediction, rollout) = (&fan.prediction, &fan.prediction.rollout);
    let [x, y, _] = prediction.start.position_m;
    let at = |n: usize, k: usize| {
        let first = (n * rollout.horizon + k) * STATE_DIM;
        [f64::from(rollout.states[first]), f64::from(rollout.states[first + 1])].map(|v| v.is_finite().then(|| rounded(v, 2)))
    };
    // Rows of further what-if soils are the same candidates again.
    let rows = drawn(rollout.samples / prediction.extras.soil_groups.max(1));
    let steps = steps(rollout.horizon);
    let paths: Vec<Vec<_>> = rows.iter().map(|n| steps.iter().flat_map(|k| at(*n, *k)).collect()).collect();
    let flags: Vec<u32> = rows.iter().map(|n| rollout.flags.get(*n).copied().unwrap_or(0)).collect();
    json!({
        "number": fan.number,
        "at_s": rounded(fan.at_s, 3),
        "start": [rounded(x, 2), rounded(y, 2)],
        "stamp_s": prediction.start_stamp_ns.map(|ns| ns as f64 * 1e-9),
        "samples": prediction.candidates(),
        "soils": prediction.extras.soil_groups,
        "horizon_s": rollout.horizon as f64 * scenery.predictor.bundle().normalization.dt_s,
        "paths": paths,
        "flagged": flags.iter().map(|f| f & !OF_SESSION != 0).collect::<Vec<_>>(),
    })
}

/// The first candidate of a prediction with a covariance, and the 90 % regions along it: centre, semi-axes in m, direction of the longer one in rad.
fn region_json(region: &Shown, scenery: &Scenery) -> Value {
    let (prediction, rollout) = (&region.prediction, &region.prediction.rollout);
    let Some(covariances) = &prediction.extras.covariance else { return Value::Null };
    let regions: Vec<_> = (1..=REGIONS.min(rollout.horizon))
        .map(|i| i * rollout.horizon / REGIONS.min(rollout.horizon) - 1)
        .filter_map(|k| {
            let p = &covariances.states[k * STATE_DIM * STATE_DIM..];
            let [xx, xy, yy] = [p[0], p[1], p[STATE_DIM + 1]].map(f64::from);
            let ([a, b], angle) = ellipse(xx, xy, yy, covariances.region_90_planar)?;
            let [x, y] = [0, 1].map(|c| f64::from(rollout.states[k * STATE_DIM + c]));
            let ahead_s = (k + 1) as f64 * scenery.predictor.bundle().normalization.dt_s;
            Some(json!([rounded(ahead_s, 2), rounded(x, 3), rounded(y, 3), rounded(a, 4), rounded(b, 4), rounded(angle, 4)]))
        })
        .collect();
    let path: Vec<f64> =
        (0..rollout.horizon).flat_map(|k| [0, 1].map(|c| rounded(f64::from(rollout.states[k * STATE_DIM + c]), 2))).collect();
    let [x, y, _] = prediction.start.position_m;
    json!({
        "number": region.number,
        "at_s": rounded(region.at_s, 3),
        "start": [rounded(x, 2), rounded(y, 2)],
        "stamp_s": prediction.start_stamp_ns.map(|ns| ns as f64 * 1e-9),
        "path": path,
        "regions": regions,
    })
}

/// Semi-axes and direction of {d : dᵀ P⁻¹ d ≤ r²} of a 2 x 2 covariance; `None` when it is not positive.
fn ellipse(xx: f64, xy: f64, yy: f64, radius_squared: f64) -> Option<([f64; 2], f64)> {
    let (mean, half) = (0.5 * (xx + yy), 0.5 * (xx - yy));
    let spread = half.hypot(xy);
    let axes = [mean + spread, mean - spread].map(|eigenvalue| (radius_squared * eigenvalue).sqrt());
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    (axes.iter().all(|a| a.is_finite()) && angle.is_finite()).then_some((axes, angle))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_axes_of_a_turned_ellipse() {
        // Variances 4 and 1 along axes turned by 30 degrees.
        let (c, s) = (30f64.to_radians().cos(), 30f64.to_radians().sin());
        let ([a, b], angle) = ellipse(4.0 * c * c + s * s, 3.0 * c * s, 4.0 * s * s + c * c, 9.0).expect("positive");
        assert!((a - 6.0).abs() < 1e-12 && (b - 3.0).abs() < 1e-12 && (angle - 30f64.to_radians()).abs() < 1e-12, "{a} {b} {angle}");
        assert!(ellipse(1.0, 2.0, 1.0, 1.0).is_none(), "not positive definite");
    }

    #[test]
    fn property_what_is_drawn_is_inside_and_ends_at_the_end() {
        for n in [1, 7, 48, 64, 1000] {
            let rows = drawn(n);
            assert!(
                rows.len() == n.min(FAN_ROWS) && rows[0] == 0 && rows.iter().all(|r| *r < n) && rows.is_sorted_by(|a, b| a < b),
                "{n}: {rows:?}"
            );
        }
        for k in [1, 5, 16, 20, 32] {
            let steps = steps(k);
            assert!(steps.last() == Some(&(k - 1)) && steps.is_sorted_by(|a, b| a < b), "{k}: {steps:?}");
        }
    }
}
