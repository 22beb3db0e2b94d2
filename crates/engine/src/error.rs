//! What can go wrong with a command.

use nesam_model::ModelError;

use crate::query::Provenance;
use crate::shown::Shown;

/// Why a command was refused. No refused command changes anything.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EngineError {
    /// No session of this name is open.
    #[error("session `{}` is not open; open it first", Shown(session))]
    UnknownSession {
        /// Name asked for.
        session: String,
    },
    /// A session of this name is open already.
    #[error("session `{}` is open already; close it first or choose another session id", Shown(session))]
    SessionExists {
        /// Name asked for.
        session: String,
        /// Field that asked for it.
        field: &'static str,
    },
    /// No map of this name was uploaded.
    #[error("map `{}` is not known; upload it first", Shown(map))]
    UnknownMap {
        /// Name asked for.
        map: String,
    },
    /// The map is there in this or a newer version.
    #[error("map `{map}` is held in version {held}; upload a higher version")]
    MapExists {
        /// Map.
        map: String,
        /// Version held.
        held: u64,
    },
    /// A tile was made for a version that is not the newest any more.
    #[error("map `{map}` is at version {held}, the tile was made for version {base}; read it again")]
    MapChanged {
        /// Map.
        map: String,
        /// Version held.
        held: u64,
        /// Version that the tile was made for.
        base: u64,
    },
    /// A session drives on the map.
    #[error("map `{map}` is used by session `{session}`; close it first")]
    MapInUse {
        /// Map.
        map: String,
        /// One of the sessions.
        session: String,
    },
    /// A value is not acceptable.
    #[error("{}{reason}", at(field))]
    Invalid {
        /// Path of the field at fault, empty when none is.
        field: String,
        /// What was wrong and what is allowed.
        reason: String,
    },
    /// A session in bytes is sound perhaps, and not for this service: of another bundle, other settings of the soil filter, another version of the format.
    #[error("`image`: {reason}")]
    ForeignImage {
        /// What it is of.
        reason: String,
    },
    /// The session cannot answer yet.
    #[error("`{field}`: {reason}")]
    NotReady {
        /// What is missing.
        field: String,
        /// Why, and what to do.
        reason: String,
    },
    /// A limit on what the service holds is reached.
    #[error("`{field}`: {reason}")]
    Exhausted {
        /// Limit that is reached.
        field: String,
        /// How much is held and what to do.
        reason: String,
    },
    /// Too many commands wait, or so many that the deadline would pass.
    #[error("overloaded: {waiting} {kind} come first; ask again in {:.0} ms or ask for less", *retry_after_ns as f64 * 1e-6)]
    Overloaded {
        /// What comes first: predictions or commands.
        kind: &'static str,
        /// How many; of all predictions, with the one that is computed.
        waiting: usize,
        /// Pause after which there may be room, ns.
        retry_after_ns: u64,
    },
    /// The deadline passed, or would surely pass, before the answer is there.
    #[error("the deadline does not leave the time that the answer takes; ask for less or allow more time")]
    Expired,
    /// A measurement was refused, and its session stays as it is.
    #[error("{cause}")]
    RefusedMeasurement {
        /// Why.
        cause: Box<EngineError>,
        /// Where the session stands.
        standing: Box<Provenance>,
    },
    /// The asker has gone.
    #[error("the asker did not wait for the prediction")]
    Abandoned,
    /// The engine is shutting down.
    #[error("the service is shutting down")]
    Stopped,
    /// A bug of the service; the command was dropped.
    #[error("internal error: {reason}; this is a bug")]
    Internal {
        /// What is known about it.
        reason: String,
    },
}

impl EngineError {
    /// A value that is not acceptable.
    pub fn invalid(field: impl Into<String>, reason: impl Into<String>) -> Self {
        Self::Invalid { field: field.into(), reason: reason.into() }
    }

    /// The refusal without where a session stands.
    pub fn refusal(&self) -> &Self {
        match self {
            Self::RefusedMeasurement { cause, .. } => cause.refusal(),
            other => other,
        }
    }

    /// Where the session of a refused measurement stands, as far as it was looked at.
    pub fn standing(&self) -> Option<&Provenance> {
        match self {
            Self::RefusedMeasurement { standing, .. } => Some(standing),
            _ => None,
        }
    }

    /// Path of the field at fault; empty when none is.
    pub fn field(&self) -> &str {
        match self {
            Self::Invalid { field, .. } | Self::NotReady { field, .. } | Self::Exhausted { field, .. } => field,
            Self::SessionExists { field, .. } => field,
            Self::ForeignImage { .. } => "image",
            Self::UnknownSession { .. } => "session_id",
            Self::UnknownMap { .. } | Self::MapExists { .. } | Self::MapInUse { .. } => "map_id",
            Self::MapChanged { .. } => "base_version",
            Self::RefusedMeasurement { cause, .. } => cause.field(),
            Self::Overloaded { .. } | Self::Expired | Self::Abandoned | Self::Stopped | Self::Internal { .. } => "",
        }
    }
}

/// What a message about a field begins with.
fn at(field: &str) -> String {
    if field.is_empty() { String::new() } else { format!("`{field}`: ") }
}

impl From<ModelError> for EngineError {
    fn from(error: ModelError) -> Self {
        match error {
            ModelError::Query { field, reason } => Self::Invalid { field: field.into(), reason },
            ModelError::Abandoned => Self::Abandoned,
            other => Self::Internal { reason: other.to_string() },
        }
    }
}
