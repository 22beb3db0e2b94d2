//! The engine: all sessions and maps, one command at a time.

mod effects;
mod prepared;

pub(crate) use self::prepared::Prepared;

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_adaptation::{AdaptationError, CalibratedFilter, FilterConfig, SoilFilter};
use nesam_fleet_soil::{FleetSoilError, FleetSoilSettings};
use nesam_model::{ModelError, Predictor, RolloutNoise};
use nesam_physics::Vehicle;
use nesam_terrain::{PatchScale, WorldMap};

use crate::command::{Command, Event, MeasureAnswer, OpenSession, Reply, SessionView, Snapshot, Until};
use crate::error::EngineError;
use crate::fleet::{Fleet, FleetCell, FleetShare};
use crate::limits::{Limits, check_name};
use crate::maps::MapRegistry;
use crate::measurement::Measurement;
use crate::query::Provenance;
use crate::session::{Acting, Observed, Rules, Session, SessionImage, refused};

/// Hears what happens in the engine; called on the engine's thread, so it must not wait.
pub type EventSink = Box<dyn FnMut(Event) + Send>;

/// All state of the service.
pub struct Engine {
    predictor: Arc<Predictor>,
    limits: Limits,
    /// The filter that every session starts with.
    filter: SoilFilter,
    /// The same for maps without colours, where the bundle says by how much more soils differ there.
    unseen_filter: Option<SoilFilter>,
    /// What the bundle knows of its own errors.
    noise: Option<Arc<RolloutNoise>>,
    step_ns: i64,
    sessions: BTreeMap<String, Session>,
    maps: MapRegistry,
    /// Soil map of the fleet; `None` = every session begins from the prior alone.
    fleet: Option<Fleet>,
    events: Option<EventSink>,
}

impl core::fmt::Debug for Engine {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Engine").field("sessions", &self.sessions).field("maps", &self.maps).finish_non_exhaustive()
    }
}

impl Engine {
    /// An engine without sessions. The soil filter has the settings that the bundle carries, the default ones where it carries none.
    ///
    /// # Errors
    /// `AdaptationError` when the settings or the noise that the bundle carries are not readable or not usable.
    pub fn new(predictor: Arc<Predictor>, limits: Limits) -> Result<Self, AdaptationError> {
        predictor.keep_maps(limits.maps_max);
        let step_ns = (predictor.bundle().normalization.dt_s * 1e9).round() as i64;
        let config = CalibratedFilter::config_of(predictor.bundle().soil_filter_json.as_deref())?;
        let unreadable = |error: ModelError| AdaptationError::Settings { reason: error.to_string() };
        let noise = predictor.bundle().rollout_noise_json.as_deref().map(RolloutNoise::from_json).transpose().map_err(unreadable)?;
        Self {
            predictor,
            limits,
            filter: SoilFilter::new(config.clone())?,
            unseen_filter: None,
            noise: noise.map(Arc::new),
            step_ns,
            sessions: BTreeMap::new(),
            maps: MapRegistry::default(),
            fleet: None,
            events: None,
        }
        .with_filter(config)
    }

    /// Sessions opened from now on learn the soil with these settings.
    ///
    /// # Errors
    /// `AdaptationError::Config` naming the setting that is unusable.
    pub fn with_filter(mut self, config: FilterConfig) -> Result<Self, AdaptationError> {
        let soil_sd = self.predictor.bundle().normalization.stand_in.as_ref().map(|stand_in| &stand_in.soil_sd);
        self.unseen_filter = soil_sd.map(|soil_sd| SoilFilter::new(config.on_unseen_soil(soil_sd))).transpose()?;
        self.filter = SoilFilter::new(config)?;
        Ok(self)
    }

    /// Sessions share from now on what they learn of the ground: one that begins where others were starts from what they learned.
    ///
    /// # Errors
    /// `FleetSoilError::Setting` naming the setting that is unusable.
    pub fn with_fleet_soil(mut self, settings: FleetSoilSettings) -> Result<Self, FleetSoilError> {
        self.fleet = Some(Fleet::new(settings)?);
        Ok(self)
    }

    /// Tells a sink what happens from now on.
    pub fn with_events(mut self, sink: EventSink) -> Self {
        self.events = Some(sink);
        self
    }

    /// Limits in force.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Vehicle that the bundle knows.
    pub fn vehicle(&self) -> &Vehicle {
        &self.predictor.bundle().vehicle
    }

    /// How predictions see a map.
    pub(crate) fn patch_scale(&self) -> PatchScale {
        self.predictor.bundle().normalization.patch_scale()
    }

    /// Answers one command at one instant of the engine's clock. A refused command changes nothing that an answer shows, and neither does a
    /// prediction; both only keep the session that they name from being idle.
    ///
    /// # Errors
    /// Any [`EngineError`] that names why the command was refused.
    pub fn execute(&mut self, now_ns: u64, command: &Command) -> Result<Reply, EngineError> {
        let result = self.answer(now_ns, command);
        self.touch(now_ns, command.uses());
        result
    }

    /// Keeps a session from being idle, as every command does that names it, also one that is not executed.
    pub fn touch(&mut self, now_ns: u64, session: Option<&str>) {
        if let Some(session) = session.and_then(|id| self.sessions.get_mut(id)) {
            session.touch(now_ns);
        }
    }

    fn answer(&mut self, now_ns: u64, command: &Command) -> Result<Reply, EngineError> {
        match command {
            Command::Open(open) => self.open(now_ns, open),
            Command::Get { session } => Ok(Reply::Session(Box::new(self.view(self.session(session)?)))),
            Command::List => Ok(Reply::Sessions(self.sessions.values().map(|s| self.view(s)).collect())),
            Command::Fork { session, copy } => self.fork(now_ns, session, copy),
            Command::Export { session } => self.export(now_ns, session),
            Command::Snapshot { sessions, maps } => Ok(Reply::Snapshot(Box::new(self.snapshot(now_ns, sessions, maps)))),
            Command::Import { image, session } => self.import(now_ns, image, session),
            Command::Close { session } => self.close(session),
            Command::SetEffects { session, effects } => self.set_effects(session, effects),
            Command::Expire => Ok(Reply::Expired(self.expire(now_ns))),
            Command::Measure { session, vehicle, measurement } => self.measure(now_ns, session, vehicle.as_deref(), measurement),
            Command::FleetSoil { map } => self.fleet_soil(now_ns, map),
            Command::TellFleetSoil => self.fleet().map(|fleet| Reply::FleetShares(fleet.cell_m(), fleet.shares(now_ns))),
            Command::HearFleetSoil { cell_m, shares } => self.hear_fleet_soil(now_ns, *cell_m, shares),
            Command::Predict(query) => self.prepare(now_ns, query)?.compute(query, Until::default()).map(|p| Reply::Predicted(Arc::new(p))),
            Command::PutMap { map, base } => {
                self.maps.put(map.clone(), *base, &self.limits)?;
                self.emit(Event::MapChanged { map: map.id().into(), held: self.maps.count() });
                Ok(Reply::Map(map.clone()))
            }
            Command::GetMap { map } => self.maps.get(map).cloned().map(Reply::Map),
            Command::ListMaps => Ok(Reply::Maps(self.maps.all())),
            Command::DeleteMap { map } => self.delete_map(map),
        }
    }

    /// The filter that a session begins with on a map: wider where no colours show what soil is where.
    fn filter_on(&self, map: Option<&str>) -> Result<&SoilFilter, EngineError> {
        let map = map.map(|map| self.maps.get(map)).transpose()?;
        let unseen = map.and_then(|map| self.predictor.unseen_soil_sd(map));
        Ok(unseen.and(self.unseen_filter.as_ref()).unwrap_or(&self.filter))
    }

    /// All the filters that a session can have begun with: a map may have come by its colours since.
    fn filters(&self) -> impl Iterator<Item = &SoilFilter> {
        core::iter::once(&self.filter).chain(&self.unseen_filter)
    }

    fn session(&self, id: &str) -> Result<&Session, EngineError> {
        self.sessions.get(id).ok_or_else(|| EngineError::UnknownSession { session: id.into() })
    }

    fn open(&mut self, now_ns: u64, open: &OpenSession) -> Result<Reply, EngineError> {
        check_name("vehicle_id", &open.vehicle)?;
        let id = if open.session.is_empty() { &open.vehicle } else { &open.session };
        check_name("session_id", id)?;
        let card = self.vehicle();
        if !open.vehicle_card.is_empty() && open.vehicle_card != card.name {
            let reason = format!("is `{}`, the bundle was trained for `{}`", open.vehicle_card, card.name);
            return Err(EngineError::invalid("vehicle_card", reason));
        }
        let map = (!open.map.is_empty()).then_some(open.map.as_str());
        let filter = self.filter_on(map)?.clone();
        self.check_room("session_id", id, &open.vehicle)?;
        let mut session = Session::new(id, &open.vehicle, map, filter, now_ns);
        if self.watches() {
            session.begin_watch();
        }
        if self.brings(&open.vehicle) {
            session.bring_nothing();
        }
        if let Some(initial) = &open.initial {
            let rules = Rules { step_ns: self.step_ns, vehicle: card, limits: &self.limits };
            let observed = session.observe(initial, now_ns, rules).map_err(|e| below("initial", e))?;
            if let crate::Outcome::NotFinite { field } = observed.outcome {
                return Err(EngineError::invalid(format!("initial.{field}"), "is not finite"));
            }
            let map = map.and_then(|id| self.maps.get(id).ok());
            session.begin_from(self.fleet.as_mut(), map, now_ns);
            session.learn(&self.predictor, self.noise.as_deref(), map, self.step_ns, observed.outcome);
        }
        Ok(self.insert(session))
    }

    /// Whether sessions watch their innovations: only against a noise that was measured for this bundle.
    fn watches(&self) -> bool {
        self.predictor.bundle().soil_filter_json.is_some()
    }

    /// Holds a new session.
    fn insert(&mut self, session: Session) -> Reply {
        let view = self.view(&session);
        self.emit(Event::SessionOpened { session: view.session.clone(), vehicle: view.vehicle.clone() });
        if let Some(alarm) = view.alarm {
            let (session, vehicle, alarm) = (view.session.clone(), view.vehicle.clone(), Box::new(alarm));
            self.emit(Event::AlarmChanged { session, vehicle, alarm, carried: true });
        }
        self.sessions.insert(view.session.clone(), session);
        Reply::Session(Box::new(view))
    }

    /// Whether a session of this vehicle brings what it learns to the soil map of the fleet.
    fn brings(&self, vehicle: &str) -> bool {
        self.sessions.values().any(|session| session.vehicle() == vehicle && session.brings())
    }

    /// Whether one more session of this name and this vehicle may be open.
    fn check_room(&self, field: &'static str, id: &str, vehicle: &str) -> Result<(), EngineError> {
        if self.sessions.contains_key(id) {
            return Err(EngineError::SessionExists { session: id.into(), field });
        }
        if self.sessions.len() >= self.limits.sessions_max {
            let reason = format!("{} sessions are open, the limit; close one", self.sessions.len());
            return Err(EngineError::Exhausted { field: field.into(), reason });
        }
        let own = self.sessions.values().filter(|session| session.vehicle() == vehicle).count();
        if own >= self.limits.sessions_per_vehicle_max {
            let reason = format!("{own} sessions of vehicle `{vehicle}` are open, the limit for one vehicle; close one");
            return Err(EngineError::Exhausted { field: field.into(), reason });
        }
        Ok(())
    }

    fn fork(&mut self, now_ns: u64, id: &str, copy: &str) -> Result<Reply, EngineError> {
        let session = self.session(id)?;
        check_name("new_session_id", copy)?;
        self.check_room("new_session_id", copy, session.vehicle())?;
        let session = session.fork(copy, now_ns);
        Ok(self.insert(session))
    }

    fn export(&self, now_ns: u64, id: &str) -> Result<Reply, EngineError> {
        let session = self.session(id)?;
        let map = session.map().map(|id| self.maps.get(id)).transpose()?;
        Ok(Reply::Image(Box::new(self.image(now_ns, session, map))))
    }

    fn image(&self, now_ns: u64, session: &Session, map: Option<&Arc<WorldMap>>) -> SessionImage {
        let map = map.map(|map| (map.id().to_string(), map.hash().to_string()));
        session.image(now_ns, &self.predictor.bundle().hash, map)
    }

    fn snapshot(&self, now_ns: u64, sessions: &[String], maps: &[String]) -> Snapshot {
        let held = |id: &str| self.maps.get(id).ok();
        let mut snapshot = Snapshot { maps: maps.iter().map(|id| (id.clone(), held(id).cloned())).collect(), ..Snapshot::default() };
        for id in sessions {
            let session = self.sessions.get(id);
            let map = session.and_then(Session::map).and_then(held);
            if let Some(map) = map {
                snapshot.maps.insert(map.id().into(), Some(Arc::clone(map)));
            }
            snapshot.sessions.push((id.clone(), session.map(|session| Box::new(self.image(now_ns, session, map)))));
        }
        snapshot
    }

    fn import(&mut self, now_ns: u64, image: &SessionImage, name: &str) -> Result<Reply, EngineError> {
        let id = if name.is_empty() { &image.session } else { name };
        check_name("session_id", id)?;
        check_name("image", &image.vehicle)?;
        let bundle = self.predictor.bundle();
        if image.bundle_hash != bundle.hash {
            let reason = format!("was exported with bundle {}, this service has {} ({})", image.bundle_hash, bundle.hash, bundle.name);
            return Err(EngineError::ForeignImage { reason });
        }
        if let Some((map, hash)) = &image.map {
            let held = self.maps.get(map)?;
            if held.hash() != hash {
                let reason =
                    format!("drives on map `{map}` with layers {hash}, the map held here has {}; upload that one first", held.hash());
                return Err(EngineError::NotReady { field: "image".into(), reason });
            }
        }
        self.check_room("session_id", id, &image.vehicle)?;
        let rules = Rules { step_ns: self.step_ns, vehicle: &bundle.vehicle, limits: &self.limits };
        let acting = Acting::new(&self.predictor, &image.effects).map_err(|error| refused(error.to_string()))?;
        let mut session = Session::from_image(id, image, self.filters(), acting, now_ns, rules)?;
        if self.watches() {
            session.begin_watch();
        }
        if self.brings(&image.vehicle) {
            session.bring_nothing();
        }
        Ok(self.insert(session))
    }

    fn close(&mut self, id: &str) -> Result<Reply, EngineError> {
        self.session(id)?;
        self.sessions.remove(id);
        self.emit(Event::SessionClosed { session: id.into(), expired: false });
        Ok(Reply::Done)
    }

    /// Closes the idle sessions and gives their names.
    fn expire(&mut self, now_ns: u64) -> Vec<String> {
        let limit_s = self.limits.session_idle_s;
        let idle: Vec<String> = self.sessions.values().filter(|s| s.idle_s(now_ns) > limit_s).map(|s| s.id().into()).collect();
        for id in &idle {
            self.sessions.remove(id);
            self.emit(Event::SessionClosed { session: id.clone(), expired: true });
        }
        idle
    }

    fn measure(&mut self, now_ns: u64, id: &str, vehicle: Option<&str>, measurement: &Measurement) -> Result<Reply, EngineError> {
        let session = self.sessions.get_mut(id).ok_or_else(|| EngineError::UnknownSession { session: id.into() })?;
        if let Some(vehicle) = vehicle
            && vehicle != session.vehicle()
        {
            // Whose it is is not told: whoever asks may have no right to know.
            let reason =
                format!("session `{id}` is of another vehicle than `{vehicle}`, which sent the measurement; open one for this vehicle");
            return Err(EngineError::invalid("session_id", reason));
        }
        let before = (session.soil().state, session.accepted());
        let rules = Rules { step_ns: self.step_ns, vehicle: &self.predictor.bundle().vehicle, limits: &self.limits };
        let Observed { outcome, reordered } = match session.observe(measurement, now_ns, rules) {
            Ok(observed) => observed,
            Err(cause) => {
                let standing = self.provenance(self.session(id)?).into();
                return Err(EngineError::RefusedMeasurement { cause: cause.into(), standing });
            }
        };
        let map = session.map().and_then(|id| self.maps.get(id).ok()).cloned();
        session.begin_from(self.fleet.as_mut(), map.as_ref(), now_ns);
        let outcome = session.learn(&self.predictor, self.noise.as_deref(), map.as_ref(), self.step_ns, outcome);
        let (vehicle, brought, told) = (session.vehicle().to_string(), session.take_brought(), session.take_told());
        let failures = session.take_soil_failures();
        let (soil, history_steps, accepted) = (*session.soil(), session.history().len(), session.accepted());
        let provenance = self.provenance(self.session(id)?);
        if let (Some(fleet), Some(map)) = (&mut self.fleet, &map) {
            let cell_m = fleet.cell_m();
            let changed: Vec<[FleetCell; 2]> = brought.iter().filter_map(|brought| fleet.add(map, brought, now_ns)).collect();
            for [cell, own] in changed {
                self.emit(Event::FleetSoilChanged { cell_m, cell: Box::new(cell), own: Box::new(own) });
            }
        }
        if accepted != before.1 {
            let buffer_ended = soil.state.last_buffer != before.0.last_buffer;
            self.emit(Event::MeasurementAccepted { session: id.into(), buffer_ended });
        }
        self.emit_alarms(id, &vehicle, told);
        for reason in failures {
            self.emit(Event::SoilFilterFailed { session: id.into(), vehicle: vehicle.clone(), reason });
        }
        if soil.state.epoch != before.0.epoch {
            let provenance = provenance.clone().into();
            self.emit(Event::SoilChanged { session: id.into(), vehicle, soil: soil.into(), provenance });
        }
        Ok(Reply::Measured(Box::new(MeasureAnswer { outcome, reordered, history_steps, provenance, accepted, soil })))
    }

    fn fleet(&self) -> Result<&Fleet, EngineError> {
        self.fleet.as_ref().ok_or_else(|| EngineError::NotReady {
            field: "map_id".into(),
            reason: "the service keeps no soil map of the fleet; set `fleet_soil.enabled` in its configuration".into(),
        })
    }

    fn fleet_soil(&self, now_ns: u64, map: &str) -> Result<Reply, EngineError> {
        self.fleet().map(|fleet| Reply::FleetSoil(fleet.cell_m(), fleet.cells(map, now_ns)))
    }

    fn hear_fleet_soil(&mut self, now_ns: u64, cell_m: f64, shares: &[FleetShare]) -> Result<Reply, EngineError> {
        let own_m = self.fleet()?.cell_m();
        if cell_m != own_m {
            return Err(EngineError::invalid("cell_m", format!("cells are {cell_m} m wide, those of this service {own_m} m")));
        }
        let heard = self.fleet.as_mut().map_or(0, |fleet| fleet.hear(shares, now_ns));
        Ok(Reply::FleetSoilHeard(heard))
    }

    fn delete_map(&mut self, id: &str) -> Result<Reply, EngineError> {
        if let Some(user) = self.sessions.values().find(|s| s.map() == Some(id)) {
            return Err(EngineError::MapInUse { map: id.into(), session: user.id().into() });
        }
        self.maps.delete(id)?;
        if let Some(fleet) = &mut self.fleet {
            fleet.forget_colours(id);
        }
        self.emit(Event::MapChanged { map: id.into(), held: self.maps.count() });
        Ok(Reply::Done)
    }

    fn provenance(&self, session: &Session) -> Provenance {
        let map = session.map().and_then(|id| self.maps.get(id).ok());
        let bundle = self.predictor.bundle();
        Provenance {
            history_epoch: session.history_epoch(),
            soil_epoch: session.soil().state.epoch,
            map: map.map(|m| (m.id().to_string(), m.version(), m.hash().to_string())),
            bundle_name: bundle.name.clone(),
            bundle_hash: bundle.hash.clone(),
        }
    }

    fn view(&self, session: &Session) -> SessionView {
        SessionView {
            session: session.id().into(),
            vehicle: session.vehicle().into(),
            provenance: self.provenance(session),
            history_steps: session.history().len(),
            newest: session.newest().copied(),
            last_stamp_ns: session.last_stamp_ns(),
            last_sequence: session.last_sequence(),
            accepted: session.accepted(),
            boot: session.boot(),
            soil: *session.soil(),
            effects: session.applied(),
            alarm: session.alarm(),
        }
    }

    fn emit(&mut self, event: Event) {
        if let Some(sink) = &mut self.events {
            sink(event);
        }
    }
}

/// Puts the field of an error below a parent field.
fn below(parent: &str, error: EngineError) -> EngineError {
    match error {
        EngineError::Invalid { field, reason } => EngineError::Invalid { field: format!("{parent}.{field}"), reason },
        other => other,
    }
}
