//! A session as plain numbers, to move it to another server or another time.

use std::sync::Arc;

use nesam_adaptation::{FilterSnapshot, SoilFilter, check_covariance};
use nesam_model::{HISTORY, HistoryStep};
use nesam_physics::SOIL_DIM;

use super::forecast::OpenForecast;
use super::numbers::Numbers;
use super::order::{EndedBoot, Order};
use super::soil::SoilLearner;
use super::track::Track;
use super::watch::{VALUES, Watch, WatchedBuffer};
use super::{Acting, Alarm, AppliedEffects, FleetPart, OPEN_MAX, Rules, Session, SoilEstimate};
use crate::error::EngineError;
use crate::extras::COVARIANCE_ROUNDING;
use crate::grid::StepGrid;
use crate::limits::outside_card;
use crate::measurement::Measurement;

/// Everything that a session remembers. Only the suspicion that a clock was set is left out: it costs one more refused measurement.
#[derive(Clone, Debug, PartialEq)]
pub struct SessionImage {
    /// Name of the session.
    pub session: String,
    /// Vehicle that it belongs to.
    pub vehicle: String,
    /// Hash of the model bundle.
    pub bundle_hash: String,
    /// All settings of the soil filter, as text to compare.
    pub filter_settings: String,
    /// Id and hash of the map.
    pub map: Option<(String, String)>,
    /// Every accepted measurement.
    pub live: TrackImage,
    /// Those that are final.
    pub settled: TrackImage,
    /// Those that are not, by ascending stamp.
    pub open: Vec<Measurement>,
    /// Accepted stamps and their numbers, ascending.
    pub recent: Vec<(i64, Option<u64>)>,
    /// Highest accepted number.
    pub last_sequence: Option<u64>,
    /// Accepted numbers of the present start as runs without a gap, ascending.
    pub numbers: Vec<(u64, u64)>,
    /// Start of the vehicle's software.
    pub boot: Option<u64>,
    /// Starts before it, oldest first, and the highest number accepted of each.
    pub ended_boots: Vec<EndedBoot>,
    /// Newest stamp that is final, ns.
    pub final_ns: Option<i64>,
    /// Time since the newest measurement arrived, ns.
    pub newest_age_ns: Option<i64>,
    /// Time since the newest step of the history arrived, ns.
    pub step_age_ns: Option<i64>,
    /// Changes of the history.
    pub history_epoch: u64,
    /// Measurements accepted so far.
    pub accepted: u64,
    /// Steps that the soil filter holds.
    pub filter_steps: Vec<HistoryStep>,
    /// Where its open buffer begins among them.
    pub filter_first: usize,
    /// Stamps of the steps from there on, ns.
    pub filter_stamps_ns: Vec<i64>,
    /// What the soil filter has learned.
    pub filter: FilterSnapshot,
    /// What the session gives out of it.
    pub soil: SoilEstimate,
    /// The prediction that is compared next.
    pub forecast: Option<OpenForecast>,
    /// Effects that were applied.
    pub effects: AppliedEffects,
    /// The watch of the innovations; `None` = not watched.
    pub watch: Option<WatchImage>,
    /// It has no step yet and has to ask the fleet what it knows of the ground under its first one.
    pub asks_fleet: bool,
    /// What it learns does not go into the soil map of the fleet.
    pub brings_nothing: bool,
}

/// What a watch remembers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WatchImage {
    /// First and last stamp of each buffer in the window, oldest first, ns.
    pub stamps_ns: Vec<[i64; 2]>,
    /// Numbers of each buffer.
    pub values: Vec<[f64; WatchImage::VALUES]>,
    /// Episodes so far.
    pub episodes: u64,
    /// The alarm of the present one.
    pub active: Option<Alarm>,
    /// Calm buffers in a row.
    pub calm: u32,
}

impl WatchImage {
    /// Numbers of one buffer.
    pub const VALUES: usize = VALUES;

    fn of(watch: &Watch) -> Self {
        Self {
            stamps_ns: watch.window.iter().map(|b| b.stamps_ns).collect(),
            values: watch.window.iter().map(|b| b.to_values()).collect(),
            episodes: watch.episodes,
            active: watch.active,
            calm: watch.calm,
        }
    }

    fn watch(&self) -> Watch {
        let buffers = self.stamps_ns.iter().zip(&self.values);
        Watch {
            window: buffers.map(|(stamps_ns, values)| WatchedBuffer::from_values(*stamps_ns, values)).collect(),
            episodes: self.episodes,
            active: self.active,
            calm: self.calm,
        }
    }
}

/// A grid with the measurement before and the steps made so far.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrackImage {
    /// `None` before the first measurement, as `before`.
    pub grid: Option<StepGrid>,
    /// The last measurement.
    pub before: Option<Measurement>,
    /// Oldest first.
    pub history: Vec<HistoryStep>,
}

impl Session {
    /// Everything that the session remembers.
    pub(crate) fn image(&self, now_ns: u64, bundle_hash: &str, map: Option<(String, String)>) -> SessionImage {
        let Order { recent, last_sequence, numbers, boot, ended_boots, newest_arrival_ns, final_ns, suspect: _ } = &self.order;
        let age = |arrived_ns: i64| (now_ns as i64).saturating_sub(arrived_ns);
        let (filter, filter_steps, filter_first, filter_stamps_ns) = self.learner.parts();
        SessionImage {
            session: self.id.clone(),
            vehicle: self.vehicle.clone(),
            bundle_hash: bundle_hash.into(),
            filter_settings: settings_of(filter),
            map,
            live: self.live.image(),
            settled: self.settled.image(),
            open: self.open.iter().copied().collect(),
            recent: recent.iter().copied().collect(),
            last_sequence: *last_sequence,
            numbers: numbers.runs(),
            boot: *boot,
            ended_boots: ended_boots.iter().copied().collect(),
            final_ns: *final_ns,
            newest_age_ns: self.order.newest_ns().map(|_| age(*newest_arrival_ns)),
            step_age_ns: self.newest().map(|_| age(self.arrived_ns)),
            history_epoch: self.history_epoch,
            accepted: self.accepted,
            filter_steps: filter_steps.to_vec(),
            filter_first,
            filter_stamps_ns: filter_stamps_ns.to_vec(),
            filter: filter.snapshot(),
            soil: self.soil,
            forecast: self.forecast.clone(),
            effects: self.applied(),
            watch: self.watch.as_ref().map(WatchImage::of),
            asks_fleet: self.fleet.asks,
            brings_nothing: !self.fleet.brings,
        }
    }

    /// The session of an image under a name. The caller has compared bundle and map and prepared the effects.
    ///
    /// # Errors
    /// `EngineError::ForeignImage` when it was made with other settings of the soil filter, `Invalid` naming `image` when it holds what no session can hold.
    pub(crate) fn from_image<'a>(
        id: &str,
        image: &SessionImage,
        mut filters: impl Iterator<Item = &'a SoilFilter>,
        acting: Option<Arc<Acting>>,
        now_ns: u64,
        rules: Rules<'_>,
    ) -> Result<Self, EngineError> {
        let filter = filters
            .find(|filter| image.filter_settings == settings_of(filter))
            .ok_or_else(|| EngineError::ForeignImage { reason: "was exported with other settings of the soil filter".into() })?;
        image.check(filter.config().buffer, rules)?;
        let filter = filter.clone().restored(&image.filter).map_err(|error| refused(error.to_string()))?;
        let arrived = |age: Option<i64>| (now_ns as i64).saturating_sub(age.unwrap_or(0));
        Ok(Self {
            id: id.into(),
            vehicle: image.vehicle.clone(),
            map: image.map.as_ref().map(|(map, _)| map.clone()),
            live: Track::from_image(&image.live),
            settled: Track::from_image(&image.settled),
            open: image.open.iter().copied().collect(),
            leaving: Default::default(),
            order: Order {
                recent: image.recent.iter().copied().collect(),
                last_sequence: image.last_sequence,
                numbers: Numbers::of_runs(&image.numbers).unwrap_or_default(),
                boot: image.boot,
                ended_boots: image.ended_boots.iter().copied().collect(),
                newest_arrival_ns: arrived(image.newest_age_ns),
                final_ns: image.final_ns,
                suspect: None,
            },
            arrived_ns: arrived(image.step_age_ns),
            used_ns: now_ns,
            history_epoch: image.history_epoch,
            accepted: image.accepted,
            learner: SoilLearner::from_parts(filter, image.filter_steps.clone(), image.filter_first, image.filter_stamps_ns.clone()),
            soil: image.soil,
            forecast: image.forecast.clone(),
            fleet: FleetPart { asks: image.asks_fleet, brings: !image.brings_nothing, brought: Vec::new() },
            acting,
            watch: image.watch.as_ref().map(WatchImage::watch),
            told: Vec::new(),
        })
    }
}

impl SessionImage {
    /// Whether a session can hold this: an image may come from anywhere, and its checksum keeps out accidents only.
    fn check(&self, buffer: usize, rules: Rules<'_>) -> Result<(), EngineError> {
        let ascending = |stamps: &mut dyn Iterator<Item = i64>| stamps.is_sorted_by(|a, b| a < b);
        let newest = self.recent.last().map(|(stamp_ns, _)| *stamp_ns);
        let tracks = [&self.live, &self.settled];
        let possible = [
            ("stamps that do not ascend", ascending(&mut self.open.iter().map(|m| m.stamp_ns))),
            ("stamps that do not ascend", ascending(&mut self.recent.iter().map(|(stamp_ns, _)| *stamp_ns))),
            ("too many measurements", self.open.len() <= OPEN_MAX && self.recent.len() <= super::order::RECENT_MAX),
            ("another newest measurement", newest == self.live.before.map(|m| m.stamp_ns)),
            ("too many steps", tracks.iter().all(|track| track.history.len() <= HISTORY)),
            ("half a track", tracks.iter().all(|t| t.grid.is_some() == t.before.is_some() && t.grid.is_some() != t.history.is_empty())),
            ("a grid of another model", tracks.iter().all(|t| t.grid.is_none_or(|grid| grid.step_ns == rules.step_ns))),
            ("a grid off its stamps", tracks.iter().all(|t| t.grid.zip(t.before).is_none_or(|(grid, before)| grid.fits(before.stamp_ns)))),
            ("an impossible buffer", self.filter_steps.is_empty() || self.filter_first < HISTORY),
            ("an impossible buffer", self.filter_steps.is_empty() || self.filter_steps.len() > self.filter_first),
            ("an impossible buffer", self.filter_steps.len() <= self.filter_first + buffer),
            ("an impossible buffer", self.filter_steps.len().saturating_sub(self.filter_first) == self.filter_stamps_ns.len()),
            ("stamps that do not ascend", ascending(&mut self.filter_stamps_ns.iter().copied())),
            ("impossible numbers", Numbers::of_runs(&self.numbers).is_some()),
            ("too many starts", self.ended_boots.len() <= super::order::ENDED_BOOTS_MAX),
            (
                "a soil covariance that is none",
                check_covariance(SOIL_DIM, self.soil.covariance.as_flattened(), COVARIANCE_ROUNDING).is_ok(),
            ),
            ("a soil variance that is none", self.soil.state.variance.is_none_or(|sd2| sd2.iter().all(|v| v.is_finite() && *v >= 0.0))),
            ("a noise scale that is not positive", self.soil.noise_scale > 0.0 && self.soil.noise_scale.is_finite()),
            ("an impossible forecast", self.forecast.as_ref().is_none_or(OpenForecast::is_possible)),
            ("steps before its beginning", !self.asks_fleet || self.live.history.is_empty()),
            ("an impossible watch", self.watch.as_ref().is_none_or(|watch| watch.watch().is_possible())),
            ("a soil that is not finite", self.soil.state.correction.delta.iter().all(|v| v.is_finite())),
        ];
        if let Some((what, _)) = possible.iter().find(|(_, holds)| !holds) {
            return Err(refused(format!("holds {what}")));
        }
        let waiting = self.forecast.iter().flat_map(|open| &open.steps);
        let steps = tracks.iter().flat_map(|track| &track.history).chain(&self.filter_steps).chain(waiting);
        let measured = self.open.iter().chain(tracks.iter().filter_map(|track| track.before.as_ref()));
        for (state, command) in steps.map(|s| (&s.state, &s.control)).chain(measured.map(|m| (&m.state, &m.command))) {
            rules.limits.check_state("state", state).map_err(|error| refused(error.to_string()))?;
            if let Some((entry, reason)) = outside_card(rules.vehicle, command) {
                return Err(refused(format!("holds a command whose {entry} {reason}")));
            }
        }
        Ok(())
    }
}

impl Track {
    fn image(&self) -> TrackImage {
        TrackImage { grid: self.grid, before: self.before, history: self.history.iter().copied().collect() }
    }

    fn from_image(image: &TrackImage) -> Self {
        Self { grid: image.grid, before: image.before, history: image.history.iter().copied().collect() }
    }
}

/// All settings of a filter, with every digit.
fn settings_of(filter: &SoilFilter) -> String {
    format!("{:?}", filter.config())
}

pub(crate) fn refused(reason: impl Into<String>) -> EngineError {
    EngineError::invalid("image", reason)
}
