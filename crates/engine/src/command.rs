//! Everything that can be asked of the engine.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use nesam_model::{HistoryStep, Interruption};
use nesam_terrain::WorldMap;

use crate::fleet::{FleetCell, FleetShare};
use crate::measurement::{Measurement, Outcome};
use crate::query::{PredictQuery, Prediction, Provenance};
use crate::session::{Alarm, AppliedEffects, SessionImage, SoilEstimate};

/// A command. The list is closed: what is not here cannot happen to a session.
#[derive(Clone, Debug)]
pub enum Command {
    /// Opens a session. Answer: `Reply::Session`.
    Open(OpenSession),
    /// Reads a session. Answer: `Reply::Session`.
    Get {
        /// Name of the session.
        session: String,
    },
    /// Lists the sessions by name. Answer: `Reply::Sessions`.
    List,
    /// Copies a session. Answer: `Reply::Session`.
    Fork {
        /// Name of the session.
        session: String,
        /// Name of the copy.
        copy: String,
    },
    /// Copies everything that a session remembers. Answer: `Reply::Image`.
    Export {
        /// Name of the session.
        session: String,
    },
    /// Reads, all at one instant, what a store keeps of these sessions and maps. It changes nothing, not even what keeps a session from being idle, and
    /// is no part of a recording. Answer: `Reply::Snapshot`.
    Snapshot {
        /// Names of sessions, open or not.
        sessions: Vec<String>,
        /// Ids of maps, held or not.
        maps: Vec<String>,
    },
    /// Opens a session from such a copy. Answer: `Reply::Session`.
    Import {
        /// The copy.
        image: Box<SessionImage>,
        /// Name of the session; empty = that of the copy.
        session: String,
    },
    /// Closes a session. Answer: `Reply::Done`.
    Close {
        /// Name of the session.
        session: String,
    },
    /// Puts physical effects on a session, in place of those that were applied before; none = takes them away. The soil begins again from its prior where
    /// that changes the vehicle. Answer: `Reply::Session`.
    SetEffects {
        /// Name of the session.
        session: String,
        /// The effects.
        effects: AppliedEffects,
    },
    /// Closes the sessions that were idle for longer than the limit. Answer: `Reply::Expired`.
    Expire,
    /// Feeds a session. Answer: `Reply::Measured`.
    Measure {
        /// Name of the session.
        session: String,
        /// Vehicle that the measurement claims to come from, where the transport tells; the session must belong to it.
        vehicle: Option<String>,
        /// The measurement.
        measurement: Measurement,
    },
    /// Reads the soil map of the fleet. Answer: `Reply::FleetSoil`.
    FleetSoil {
        /// World map; empty = all.
        map: String,
    },
    /// Reads what was brought to the soil map of the fleet here and elsewhere, to be told to other services. Answer: `Reply::FleetShares`.
    TellFleetSoil,
    /// Takes what another service tells. Answer: `Reply::FleetSoilHeard`.
    HearFleetSoil {
        /// Edge of a cell there, m: cells of another size are not taken.
        cell_m: f64,
        /// What was brought to it, and to others that it has heard of.
        shares: Vec<FleetShare>,
    },
    /// Rolls candidates out. Answer: `Reply::Predicted`.
    Predict(PredictQuery),
    /// Takes a new map or a new version. Answer: `Reply::Map`.
    PutMap {
        /// The map.
        map: Arc<WorldMap>,
        /// Version that a patched map was made from.
        base: Option<u64>,
    },
    /// Reads a map. Answer: `Reply::Map`.
    GetMap {
        /// Id of the map.
        map: String,
    },
    /// Lists the maps by id. Answer: `Reply::Maps`.
    ListMaps,
    /// Forgets a map that no session uses. Answer: `Reply::Done`.
    DeleteMap {
        /// Id of the map.
        map: String,
    },
}

/// When to end a prediction before it is complete. The default is never.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Until<'a> {
    /// It is given up, or waits.
    pub interruption: Interruption<'a>,
    /// Raised when the answer is due: it ends with the samples that are done, where fewer are of use.
    pub due: Option<&'a AtomicBool>,
}

impl Command {
    /// The names of all commands: counters of what seldom happens are there before it does.
    pub const LABELS: [&str; 19] = [
        "open",
        "get",
        "list",
        "fork",
        "export",
        "snapshot",
        "import",
        "close",
        "set_effects",
        "expire",
        "measure",
        "fleet_soil",
        "tell_fleet_soil",
        "hear_fleet_soil",
        "predict",
        "put_map",
        "get_map",
        "list_maps",
        "delete_map",
    ];

    /// Name for metrics and logs, one of [`Command::LABELS`].
    pub fn label(&self) -> &'static str {
        match self {
            Self::Open(_) => "open",
            Self::Get { .. } => "get",
            Self::List => "list",
            Self::Fork { .. } => "fork",
            Self::Export { .. } => "export",
            Self::Snapshot { .. } => "snapshot",
            Self::Import { .. } => "import",
            Self::Close { .. } => "close",
            Self::SetEffects { .. } => "set_effects",
            Self::Expire => "expire",
            Self::Measure { .. } => "measure",
            Self::FleetSoil { .. } => "fleet_soil",
            Self::TellFleetSoil => "tell_fleet_soil",
            Self::HearFleetSoil { .. } => "hear_fleet_soil",
            Self::Predict(_) => "predict",
            Self::PutMap { .. } => "put_map",
            Self::GetMap { .. } => "get_map",
            Self::ListMaps => "list_maps",
            Self::DeleteMap { .. } => "delete_map",
        }
    }

    /// The session that this command keeps from being idle: one that is fed or asked. Reading it is no use of it.
    pub fn uses(&self) -> Option<&str> {
        match self {
            Self::Measure { session, .. } | Self::Fork { session, .. } | Self::Export { session } | Self::SetEffects { session, .. } => {
                Some(session)
            }
            Self::Predict(query) => Some(&query.session),
            _ => None,
        }
    }
}

/// A session to open.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct OpenSession {
    /// Name of the session; empty = the vehicle's.
    pub session: String,
    /// Vehicle.
    pub vehicle: String,
    /// Name of the vehicle card that the client expects; empty = the bundle's.
    pub vehicle_card: String,
    /// Map; empty = none.
    pub map: String,
    /// First measurement.
    pub initial: Option<Measurement>,
}

/// The answer to a command that was not refused.
#[derive(Clone, Debug)]
pub enum Reply {
    /// A session.
    Session(Box<SessionView>),
    /// Sessions.
    Sessions(Vec<SessionView>),
    /// Everything that a session remembers.
    Image(Box<SessionImage>),
    /// What a store keeps.
    Snapshot(Box<Snapshot>),
    /// Names of the sessions that were closed because they were idle.
    Expired(Vec<String>),
    /// What became of a measurement.
    Measured(Box<MeasureAnswer>),
    /// Edge of a cell in m, and the cells with evidence, by map, colour and place.
    FleetSoil(f64, Vec<FleetCell>),
    /// Edge of a cell in m, and what was brought to each service.
    FleetShares(f64, Vec<FleetShare>),
    /// Number of cells that were news.
    FleetSoilHeard(usize),
    /// A prediction; shared, because a recording keeps it too.
    Predicted(Arc<Prediction>),
    /// A map.
    Map(Arc<WorldMap>),
    /// Maps.
    Maps(Vec<Arc<WorldMap>>),
    /// Done, and nothing to tell.
    Done,
}

/// Sessions and maps as they were at one instant; `None` = not open, not held.
#[derive(Clone, Debug, Default)]
pub struct Snapshot {
    /// Asked sessions, in the order asked.
    pub sessions: Vec<(String, Option<Box<SessionImage>>)>,
    /// Asked maps and those of the sessions.
    pub maps: BTreeMap<String, Option<Arc<WorldMap>>>,
}

/// What became of a measurement, and where the session stands now.
#[derive(Clone, Debug, PartialEq)]
pub struct MeasureAnswer {
    /// What became of it.
    pub outcome: Outcome,
    /// It arrived after a later one and was put in its place.
    pub reordered: bool,
    /// Steps in the history.
    pub history_steps: usize,
    /// What a prediction made now would be computed from.
    pub provenance: Provenance,
    /// Measurements that the session has accepted, this one included where it was.
    pub accepted: u64,
    /// What is known of the soil now.
    pub soil: SoilEstimate,
}

/// A session as the outside sees it.
#[derive(Clone, Debug, PartialEq)]
pub struct SessionView {
    /// Name of the session.
    pub session: String,
    /// Vehicle.
    pub vehicle: String,
    /// What a prediction made now would be computed from.
    pub provenance: Provenance,
    /// Steps in the history.
    pub history_steps: usize,
    /// Newest step of the history.
    pub newest: Option<HistoryStep>,
    /// Stamp of the newest accepted measurement, ns of the vehicle's clock.
    pub last_stamp_ns: Option<i64>,
    /// Highest accepted sequence number.
    pub last_sequence: Option<u64>,
    /// Measurements accepted so far.
    pub accepted: u64,
    /// Start of the vehicle's software that feeds the session, where it tells.
    pub boot: Option<u64>,
    /// What was learned of the soil.
    pub soil: SoilEstimate,
    /// Effects that were applied to the session, on top of those of the bundle.
    pub effects: AppliedEffects,
    /// The alarm that is active.
    pub alarm: Option<Alarm>,
}

/// What watchers of the engine hear.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// The soil estimate of a session changed.
    SoilChanged {
        /// Name of the session.
        session: String,
        /// Vehicle that it belongs to.
        vehicle: String,
        /// The new estimate.
        soil: Box<SoilEstimate>,
        /// What a prediction made now would be computed from.
        provenance: Box<Provenance>,
    },
    /// A session has brought evidence into the soil map of the fleet.
    FleetSoilChanged {
        /// Edge of a cell, m.
        cell_m: f64,
        /// All that is known of the cell that changed.
        cell: Box<FleetCell>,
        /// What was brought here of it.
        own: Box<FleetCell>,
    },
    /// A session is there: opened, copied or imported.
    SessionOpened {
        /// Name of the session.
        session: String,
        /// Vehicle that it belongs to.
        vehicle: String,
    },
    /// An alarm of a session was raised or cleared; also told of a session that comes with an active one.
    AlarmChanged {
        /// Name of the session.
        session: String,
        /// Vehicle that it belongs to.
        vehicle: String,
        /// The alarm.
        alarm: Box<Alarm>,
        /// The session came with it, as a copy or from elsewhere: nothing was raised.
        carried: bool,
    },
    /// The soil filter of a session could not learn from a buffer, take over what the fleet knows or bring something to it. It goes on with what it knew.
    SoilFilterFailed {
        /// Name of the session.
        session: String,
        /// Vehicle that it belongs to.
        vehicle: String,
        /// What failed.
        reason: String,
    },
    /// Other effects act in a session from now on.
    EffectsChanged {
        /// Name of the session.
        session: String,
        /// Vehicle that it belongs to.
        vehicle: String,
    },
    /// A session accepted a measurement.
    MeasurementAccepted {
        /// Name of the session.
        session: String,
        /// A buffer of the soil filter ended with it.
        buffer_ended: bool,
    },
    /// A map was taken, patched or deleted.
    MapChanged {
        /// Id of the map.
        map: String,
        /// Maps that are held now.
        held: usize,
    },
    /// A session was closed.
    SessionClosed {
        /// Name of the session.
        session: String,
        /// Because it was idle.
        expired: bool,
    },
}

impl Event {
    /// Label of [`Event::SoilFilterFailed`].
    pub const SOIL_FILTER_FAILED: &str = "soil_filter_failed";

    /// Name for metrics.
    pub fn label(&self) -> &'static str {
        match self {
            Self::SoilChanged { .. } => "soil_changed",
            Self::FleetSoilChanged { .. } => "fleet_soil_changed",
            Self::SessionOpened { .. } => "session_opened",
            Self::AlarmChanged { carried: true, .. } => "alarm_carried",
            Self::AlarmChanged { alarm, .. } if alarm.active => "alarm_raised",
            Self::AlarmChanged { .. } => "alarm_cleared",
            Self::SoilFilterFailed { .. } => Self::SOIL_FILTER_FAILED,
            Self::EffectsChanged { .. } => "effects_changed",
            Self::MeasurementAccepted { .. } => "measurement_accepted",
            Self::MapChanged { .. } => "map_changed",
            Self::SessionClosed { expired: false, .. } => "session_closed",
            Self::SessionClosed { expired: true, .. } => "session_expired",
        }
    }
}
