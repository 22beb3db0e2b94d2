//! What the service remembers of one vehicle.

use std::collections::VecDeque;
use std::sync::Arc;

use nesam_adaptation::{FORECAST_AHEAD, ForecastCheck, SoilFilter};
use nesam_model::rollout_noise::NoiseScale;
use nesam_model::{HistoryStep, Predictor, RolloutNoise, SoilByClass};
use nesam_physics::{SOIL_DIM, Vehicle};
use nesam_terrain::WorldMap;

mod alarm;
mod effects;
mod forecast;
mod image;
mod numbers;
mod order;
mod soil;
mod track;
mod watch;

pub use self::alarm::{Alarm, AlarmKind};
pub(crate) use self::effects::Acting;
pub use self::effects::{AppliedEffect, AppliedEffects, AppliedParameter, UNCERTAIN_MAX};
pub use self::forecast::OpenForecast;
pub(crate) use self::image::refused;
pub use self::image::{SessionImage, TrackImage, WatchImage};
use self::order::{Order, Verdict};
pub use self::soil::{BufferTest, SoilState};
use self::soil::{Judged, Learned, Models, SoilLearner};
use self::track::{Stamped, Taken, Track};
use self::watch::{Watch, WatchedBuffer};
use crate::clock::seconds;
use crate::error::EngineError;
use crate::fleet::{Brought, Fleet};
use crate::forward::Newest;
use crate::limits::{Limits, outside_card};
use crate::measurement::{Measurement, Outcome};
use crate::query::{ALARM_ACTIVE, SOIL_NOT_LEARNED};

/// Measurements that the reorder window holds at most; more become final early. 200 Hz over the longest window.
const OPEN_MAX: usize = 200;

/// What is known of the soil: the estimate and its whole covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoilEstimate {
    /// Correction of the prior, its variance, and what of it is learned.
    pub state: SoilState,
    /// P⁺, in the coordinates of the correction.
    pub covariance: [[f64; SOIL_DIM]; SOIL_DIM],
    /// How many times the model's noise counts on this ground as far as the soil filter has told; 1 before the first update.
    pub noise_scale: f64,
    /// How predictions of the session came true: its scale counts on top.
    pub forecasts: ForecastCheck,
}

/// A session: identity, recent measured motion, soil.
///
/// Measurements inside the reorder window are open: one that arrives late is put in its place among them, and the steps are made again. What has left the window is
/// final, and only then does the soil filter see it; so the posterior depends on the stamps and not on the order of arrival.
#[derive(Clone, Debug)]
pub struct Session {
    id: String,
    vehicle: String,
    map: Option<String>,
    /// Every accepted measurement; the newest step is the start of the next prediction.
    live: Track,
    /// Those that are final.
    settled: Track,
    /// Those that are not, by ascending stamp.
    open: VecDeque<Measurement>,
    /// Those that became final and wait for the soil filter.
    leaving: VecDeque<Leaving>,
    order: Order,
    /// Engine clock when the newest step of the history arrived, ns.
    arrived_ns: i64,
    /// Engine clock when the session was fed or asked last, ns.
    used_ns: u64,
    history_epoch: u64,
    /// Accepted measurements.
    accepted: u64,
    learner: SoilLearner,
    soil: SoilEstimate,
    fleet: FleetPart,
    /// Effects that were applied to this session; `None` = those of the bundle alone.
    acting: Option<Arc<Acting>>,
    /// The prediction that is compared next.
    forecast: Option<OpenForecast>,
    /// Whether measurements go on agreeing with predictions; `None` = not watched.
    watch: Option<Watch>,
    /// Alarms that were raised or cleared since they were last asked for.
    told: Vec<Alarm>,
}

/// What a session has to do with the soil map of the fleet.
#[derive(Clone, Debug, PartialEq)]
struct FleetPart {
    /// It has not asked yet what the fleet knows of the ground that it begins on.
    asks: bool,
    /// What it learns goes into the map; not for copies and further sessions of one vehicle, whose evidence would count twice.
    brings: bool,
    /// What it has brought since it was last asked.
    brought: Vec<Brought>,
}

/// What leaves the reorder window.
#[derive(Clone, Debug, PartialEq)]
enum Leaving {
    /// A measurement.
    Measured(Measurement),
    /// The end of a line: what follows is another clock or another start of the vehicle.
    End,
}

/// What became of a measurement.
#[derive(Clone, Debug, PartialEq)]
pub struct Observed {
    /// Outcome.
    pub outcome: Outcome,
    /// It arrived after a later one and was put in its place.
    pub reordered: bool,
}

/// What a session needs to judge a measurement.
#[derive(Clone, Copy, Debug)]
pub struct Rules<'a> {
    /// Step of the model, ns.
    pub step_ns: i64,
    /// Card of the vehicle.
    pub vehicle: &'a Vehicle,
    /// Limits.
    pub limits: &'a Limits,
}

impl SoilEstimate {
    /// One of which neither filter nor forecasts have told how the model errs.
    pub(crate) fn begun(state: SoilState, covariance: [[f64; SOIL_DIM]; SOIL_DIM]) -> Self {
        Self { state, covariance, noise_scale: 1.0, forecasts: ForecastCheck::default() }
    }

    /// How many times the covariance of the model's errors counts in a prediction.
    pub fn model_noise_scale(&self) -> NoiseScale {
        let Self { noise_scale, forecasts, .. } = self;
        NoiseScale { height: noise_scale * forecasts.height_scale(), rest: noise_scale * forecasts.scale() }
    }
}

impl Session {
    /// A session without history, whose soil filter knows the prior only.
    pub fn new(id: &str, vehicle: &str, map: Option<&str>, filter: SoilFilter, now_ns: u64) -> Self {
        let covariance = filter.posterior().covariance;
        let learner = SoilLearner::new(filter);
        Self {
            id: id.into(),
            vehicle: vehicle.into(),
            map: map.map(Into::into),
            live: Track::default(),
            settled: Track::default(),
            open: VecDeque::new(),
            leaving: VecDeque::new(),
            order: Order::default(),
            arrived_ns: 0,
            used_ns: now_ns,
            history_epoch: 0,
            accepted: 0,
            soil: SoilEstimate::begun(learner.state(0, None), covariance),
            learner,
            forecast: None,
            fleet: FleetPart { asks: true, brings: true, brought: Vec::new() },
            acting: None,
            watch: None,
            told: Vec::new(),
        }
    }

    /// Takes one measurement. One that is not `accepted` leaves no trace but the suspicion that a clock was set.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the entry that is implausible or outside the card; the session is unchanged.
    pub fn observe(&mut self, measurement: &Measurement, now_ns: u64, rules: Rules<'_>) -> Result<Observed, EngineError> {
        let refused = |outcome| Ok(Observed { outcome, reordered: false });
        if let Some(field) = measurement.not_finite() {
            return refused(Outcome::NotFinite { field });
        }
        rules.limits.check_state("state", &measurement.state)?;
        rules.limits.check_wheels(&measurement.wheels, rules.vehicle.wheel_radius_m)?;
        if let Some((entry, reason)) = outside_card(rules.vehicle, &measurement.command) {
            return Err(EngineError::invalid(format!("command.{entry}"), reason));
        }
        match self.order.judge(measurement, now_ns, rules.step_ns, rules.limits)? {
            Verdict::Refuse(outcome) => refused(outcome),
            Verdict::Accept => Ok(self.accept(measurement, now_ns, rules)),
            Verdict::Begin(outcome) => {
                self.begin(measurement.boot);
                Ok(Observed { outcome, ..self.accept(measurement, now_ns, rules) })
            }
        }
    }

    /// Ends the present line. What was open becomes final, what was learned of the soil stays.
    fn begin(&mut self, boot: Option<u64>) {
        self.leaving.extend(self.open.drain(..).map(Leaving::Measured));
        self.leaving.push_back(Leaving::End);
        self.order.begin(boot);
        self.live = Track::default();
    }

    fn accept(&mut self, measurement: &Measurement, now_ns: u64, rules: Rules<'_>) -> Observed {
        let newest = self.order.accept(measurement, now_ns);
        self.accepted += 1;
        let taken = if newest {
            self.open.push_back(*measurement);
            self.live.advance(measurement, rules.step_ns)
        } else {
            let place = self.open.partition_point(|other| other.stamp_ns < measurement.stamp_ns);
            self.open.insert(place, *measurement);
            self.remake(measurement.stamp_ns, rules.step_ns)
        };
        if !newest || !matches!(taken, Taken::Waiting(_)) {
            self.history_epoch += 1;
        }
        if newest && !matches!(taken, Taken::Waiting(_)) {
            self.arrived_ns = now_ns as i64;
        }
        self.close_window(rules.limits.reorder_window_ns());
        let outcome = match taken {
            Taken::Steps(..) => Outcome::Applied,
            Taken::AfterGap(_, gap_ns) => Outcome::Gap { gap_s: seconds(gap_ns) },
            Taken::Waiting(remaining_ns) => Outcome::Buffered { next_step_in_s: seconds(remaining_ns) },
        };
        Observed { outcome, reordered: !newest }
    }

    /// Makes the live steps again and says what the measurement with this stamp made.
    fn remake(&mut self, stamp_ns: i64, step_ns: i64) -> Taken {
        let mut live = self.settled.clone();
        for leaving in &self.leaving {
            match leaving {
                Leaving::Measured(measurement) => drop(live.advance(measurement, step_ns)),
                Leaving::End => live = Track::default(),
            }
        }
        let mut made = Taken::Waiting(0);
        for measurement in &self.open {
            let taken = live.advance(measurement, step_ns);
            if measurement.stamp_ns == stamp_ns {
                made = taken;
            }
        }
        self.live = live;
        made
    }

    /// Lets go what lies behind the window before the newest measurement.
    fn close_window(&mut self, window_ns: i64) {
        let edge_ns = self.order.newest_ns().map_or(i64::MIN, |newest| newest.saturating_sub(window_ns));
        while let Some(first) = self.open.front().filter(|first| first.stamp_ns <= edge_ns || self.open.len() > OPEN_MAX) {
            self.order.final_ns = Some(first.stamp_ns);
            self.leaving.extend(self.open.pop_front().map(Leaving::Measured));
        }
    }

    /// Lets the soil filter learn from what has become final with an observation; every B-th step makes an update (paper Alg. 1). The steps
    /// stay in the history when the filter refuses its buffer: then the outcome says so. `predictor` is that of the bundle; applied effects act on top of it.
    /// `noise` is what its bundle knows of its errors, against which predictions that came true are held.
    pub fn learn(
        &mut self,
        predictor: &Predictor,
        noise: Option<&RolloutNoise>,
        map: Option<&Arc<WorldMap>>,
        step_ns: i64,
        outcome: Outcome,
    ) -> Outcome {
        let mut outcome = outcome;
        let acting = self.acting.clone();
        let models = match &acting {
            Some(acting) => Models { usual: acting.predictor(), shifted: acting.shifted() },
            None => Models { usual: predictor, shifted: &[] },
        };
        while let Some(leaving) = self.leaving.pop_front() {
            let Leaving::Measured(measurement) = leaving else {
                self.settled = Track::default();
                self.forget_open();
                // What follows has the stamps of another clock.
                if let Some(watch) = &mut self.watch {
                    watch.window.clear();
                }
                continue;
            };
            let (first, second) = match self.settled.take(&measurement, step_ns) {
                Taken::Waiting(_) => continue,
                Taken::Steps(first, second) => (first, second),
                Taken::AfterGap(first, _) => {
                    self.forget_open();
                    (first, None)
                }
            };
            for step in [Some(first), second].into_iter().flatten() {
                // A new line or a gap is said before the refusal of a buffer that it ended.
                let usual = matches!(outcome, Outcome::Applied | Outcome::Buffered { .. } | Outcome::Gated { .. });
                if let Some(nis) = self.learn_step(step, models, map).filter(|_| usual) {
                    outcome = Outcome::Gated { nis };
                }
                self.check_forecast(models.usual, noise, map);
            }
        }
        outcome
    }

    /// The next step does not follow the last one.
    fn forget_open(&mut self) {
        self.learner.forget_open();
        self.forecast = None;
    }

    /// Compares a prediction with the newest final step, where one has come true with it, and begins the next. Without a map, or with a bundle that does not know
    /// its errors so far ahead, nothing is compared.
    fn check_forecast(&mut self, predictor: &Predictor, noise: Option<&RolloutNoise>, map: Option<&Arc<WorldMap>>) {
        let Self { settled, learner, forecast, soil, .. } = self;
        let history = settled.history.make_contiguous();
        let (Some(noise), Some(map), Some(newest)) = (noise.filter(|noise| noise.steps() >= FORECAST_AHEAD), map, history.last()) else {
            *forecast = None;
            return;
        };
        if let Some(open) = forecast {
            if !open.follow(newest) {
                return;
            }
            open.compare(predictor, noise, map, &mut soil.forecasts);
        }
        *forecast = OpenForecast::begin(history, || learner.corrections(), soil.noise_scale);
    }

    /// Lets the filter learn from one final step; NIS of the buffer that it ended if that was refused.
    fn learn_step(&mut self, newest: Stamped, models: Models<'_>, map: Option<&Arc<WorldMap>>) -> Option<f64> {
        self.settled.push(newest.1);
        let (_, before) = self.settled.history.make_contiguous().split_last()?;
        let Judged { stamps_ns, learned, contradiction, unseen, standing } = self.learner.step(models, before, newest, map)?;
        if let Some(watch) = self.watch.as_mut().filter(|_| !standing) {
            let agreement = learned.as_ref().map(|learned| &learned.update.agreement);
            self.told.extend(watch.feed(WatchedBuffer::new(stamps_ns, agreement, contradiction, unseen)));
        }
        let Learned { update, brought } = learned?;
        self.fleet.brought.extend(brought.filter(|_| self.fleet.brings));
        let judged = self.soil.state.last_buffer.map_or(0, |last| last.judged) + 1;
        let last_buffer = Some(BufferTest { judged, nis: update.nis, dof: update.dof, rejected: update.rejected });
        if update.rejected {
            self.soil.state.last_buffer = last_buffer;
            return Some(update.nis);
        }
        let state = SoilState { last_buffer, ..self.learner.state(self.soil.state.epoch + 1, Some(stamps_ns[1])) };
        self.soil = SoilEstimate { state, covariance: update.posterior.covariance, noise_scale: update.noise_scale, ..self.soil };
        None
    }

    /// Puts effects on the vehicle of this session, or takes them away, and begins to learn the soil from the prior of `filter`: what was learned answered for
    /// another vehicle. Effects that act already make no other one: then only their source changes.
    pub(crate) fn act(&mut self, acting: Option<Arc<Acting>>, filter: SoilFilter) {
        let before = self.applied();
        self.acting = acting;
        if self.applied().effects == before.effects {
            return;
        }
        self.told.extend(self.watch.as_mut().and_then(Watch::begin_again));
        self.learner = SoilLearner::new(filter);
        self.forecast = None;
        let begun = self.learner.state(self.soil.state.epoch + 1, None);
        let state = SoilState { last_buffer: self.soil.state.last_buffer, ..begun };
        self.soil = SoilEstimate::begun(state, self.learner.covariance());
    }

    /// Watches from now on whether measurements go on agreeing with predictions.
    pub(crate) fn begin_watch(&mut self) {
        self.watch.get_or_insert_default();
    }

    /// The alarm of the present episode.
    pub fn alarm(&self) -> Option<Alarm> {
        self.watch.as_ref().and_then(|watch| watch.active)
    }

    /// Flags of all its predictions, beside those of the model.
    pub(crate) fn flags(&self) -> u32 {
        let not_learned = if self.soil.state.is_prior() { SOIL_NOT_LEARNED } else { 0 };
        not_learned | if self.alarm().is_some() { ALARM_ACTIVE } else { 0 }
    }

    /// Alarms that were raised or cleared since the last time.
    pub(crate) fn take_told(&mut self) -> Vec<Alarm> {
        core::mem::take(&mut self.told)
    }

    /// Why the soil filter learned less than it could have since the last time.
    pub(crate) fn take_soil_failures(&mut self) -> Vec<String> {
        self.learner.take_failures()
    }

    /// The predictor of this session's vehicle, where effects were applied to it.
    pub(crate) fn predictor(&self) -> Option<&Predictor> {
        self.acting.as_ref().map(|acting| acting.predictor())
    }

    /// The effects that were applied.
    pub fn applied(&self) -> AppliedEffects {
        self.acting.as_ref().map(|acting| acting.applied().clone()).unwrap_or_default()
    }

    /// Begins from what the fleet knows of the ground at its first step, once it has one; then never again.
    pub(crate) fn begin_from(&mut self, fleet: Option<&mut Fleet>, map: Option<&Arc<WorldMap>>, now_ns: u64) {
        let Some([x, y, _]) = self.newest().filter(|_| self.fleet.asks).map(|step| step.state.position_m) else { return };
        self.fleet.asks = false;
        let (filter, ..) = self.learner.parts();
        let prior = fleet.zip(map).and_then(|(fleet, map)| fleet.prior(map, [x, y], filter.config(), now_ns));
        if prior.is_some_and(|prior| self.learner.begin_from(&prior)) {
            let state = self.learner.state(self.soil.state.epoch + 1, None);
            self.soil = SoilEstimate { state, covariance: self.learner.covariance(), ..self.soil };
        }
    }

    /// What the session learns does not go into the soil map of the fleet.
    pub(crate) fn bring_nothing(&mut self) {
        self.fleet.brings = false;
    }

    /// Whether it goes there.
    pub(crate) fn brings(&self) -> bool {
        self.fleet.brings
    }

    /// What the session has brought for the map of the fleet since the last time.
    pub(crate) fn take_brought(&mut self) -> Vec<Brought> {
        core::mem::take(&mut self.fleet.brought)
    }

    /// A copy of everything under another name. What it learns does not go into the soil map of the fleet.
    pub fn fork(&self, id: &str, now_ns: u64) -> Self {
        let mut copy = Self { id: id.into(), used_ns: now_ns, ..self.clone() };
        copy.bring_nothing();
        copy
    }

    /// Notes that the session is fed or asked.
    pub fn touch(&mut self, now_ns: u64) {
        self.used_ns = now_ns;
    }

    /// Time since the session was fed or asked last, s.
    pub fn idle_s(&self, now_ns: u64) -> f64 {
        seconds(now_ns.saturating_sub(self.used_ns) as i64)
    }

    /// Name of the session.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Vehicle that it belongs to.
    pub fn vehicle(&self) -> &str {
        &self.vehicle
    }

    /// Map that the vehicle drives on.
    pub fn map(&self) -> Option<&str> {
        self.map.as_deref()
    }

    /// Measured steps, oldest first, the newest included; at most 32.
    pub fn history(&self) -> &VecDeque<HistoryStep> {
        &self.live.history
    }

    /// Newest step of the history.
    pub fn newest(&self) -> Option<&HistoryStep> {
        self.live.history.back()
    }

    /// Stamp and command of the newest step of the history.
    pub(crate) fn newest_at(&self) -> Option<Newest> {
        let (grid, step) = (self.live.grid.as_ref()?, self.newest()?);
        Some(Newest { stamp_ns: grid.last_ns(), command: step.control })
    }

    /// Counts the changes of the history.
    pub fn history_epoch(&self) -> u64 {
        self.history_epoch
    }

    /// Measurements accepted so far, those before an export included.
    pub fn accepted(&self) -> u64 {
        self.accepted
    }

    /// Stamp of the newest accepted measurement, ns of the vehicle's clock.
    pub fn last_stamp_ns(&self) -> Option<i64> {
        self.order.newest_ns()
    }

    /// Highest accepted sequence number.
    pub fn last_sequence(&self) -> Option<u64> {
        self.order.last_sequence
    }

    /// Start of the vehicle's software that feeds the session, where it tells.
    pub fn boot(&self) -> Option<u64> {
        self.order.boot
    }

    /// What was learned of the soil.
    pub fn soil(&self) -> &SoilEstimate {
        &self.soil
    }

    /// The soil that predictions meet on a map: every class of ground as far as it was learned.
    pub(crate) fn soil_field(&self, map: Option<&Arc<WorldMap>>) -> SoilByClass {
        self.learner.field(map)
    }

    /// Time since the newest step of the history arrived, s; `None` before the first.
    pub fn age_s(&self, now_ns: u64) -> Option<f64> {
        self.newest().map(|_| seconds((now_ns as i64).saturating_sub(self.arrived_ns).max(0)))
    }
}

#[cfg(test)]
mod tests;
