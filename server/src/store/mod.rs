//! Sessions that outlive the process.
//!
//! The engine knows nothing of disks: it tells what changed ([`nesam_engine::Event`]) and hands out snapshots when asked. The [`Keeper`] notes what
//! changed, and on a thread of its own asks for snapshots of it and commits them together; a session is due when a buffer of its soil filter has
//! ended, at the latest `store.interval_s` after its first change. What a commit held is DURABLE, what came after is RECEIVED: a client sends that again after
//! a crash, and since a snapshot is everything that a session remembers, the estimate goes on bit for bit.
//!
//! Several servers share sessions through etcd, which knows whose each one is: see `cluster`.
//!
//! ```text
//! engine ── Event ──► Keeper (what is dirty) ── Command::Snapshot ──► engine
//!                        └── Change ──► SessionStore::commit (fsync) ──► durable places
//! ```

mod etcd;
mod keeper;
mod map_bytes;
mod redb;
mod restore;
mod stall;

use std::path::PathBuf;
use std::pin::Pin;

pub(crate) use self::etcd::EtcdStore;
pub use self::keeper::Keeper;
pub(crate) use self::keeper::{Key, StoreCounts};
pub use self::map_bytes::map_of;
pub(crate) use self::map_bytes::map_version;
pub use self::redb::RedbStore;
pub use self::restore::Restored;
pub(crate) use self::restore::{restore, resumed};
pub(crate) use self::stall::tell_stalls;

/// Something that keeps sessions and maps on stable storage: [`RedbStore`] for one process, etcd for several.
pub trait SessionStore: Send {
    /// Everything that is held.
    ///
    /// # Errors
    /// `StoreError` when it cannot be read.
    fn load(&self) -> Result<Contents, StoreError>;

    /// Called before the changes of these sessions are read from the engine. What is committed next was read after this, and a store of several servers
    /// writes it only for a session that has stayed here since.
    fn begin(&mut self, _sessions: &[String]) {}

    /// Makes each change whole or not at all. They are on stable storage when it returns: neither the end of the process nor that of the machine undoes
    /// them. Gives the sessions that belong to another server now: of those nothing was written.
    ///
    /// # Errors
    /// `StoreError` when changes were not made, or when it is not known whether they were; all may be made again.
    fn commit(&mut self, changes: &[Change]) -> Result<Vec<String>, StoreError>;

    /// The same in a task, which must not wait as a thread may.
    fn commit_in_task<'a>(&'a mut self, changes: &'a [Change]) -> Commit<'a> {
        Box::pin(std::future::ready(self.commit(changes)))
    }
}

/// A commit on its way.
pub type Commit<'a> = Pin<Box<dyn Future<Output = Result<Vec<String>, StoreError>> + Send + 'a>>;

/// What a store holds.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Contents {
    /// By name.
    pub sessions: Vec<StoredSession>,
    /// Ids and bytes, by id.
    pub maps: Vec<(String, Vec<u8>)>,
    /// By key.
    pub soil: Vec<StoredSoil>,
}

/// What was brought to one cell of the soil map of a fleet, in a store.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredSoil {
    /// Server in the life in which it was brought, and cell: one row for each.
    pub key: String,
    /// When it was brought, ns since 1970 by the machine's clock.
    pub saved_unix_ns: i64,
    /// A `nesam.v1.FleetSoilShares` with that cell alone.
    pub share: Vec<u8>,
}

/// A session in a store.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredSession {
    /// Name of the session.
    pub name: String,
    /// When it was saved, ns since 1970 by the machine's clock.
    pub saved_unix_ns: i64,
    /// A `nesam.v1.SessionImage`.
    pub image: Vec<u8>,
}

/// A change of what a store holds.
#[derive(Clone, Debug, PartialEq)]
pub enum Change {
    /// A session, new or not.
    PutSession(StoredSession),
    /// What is held under this name, which no server could read, goes to another place: a session of that name begins.
    SetAside(String),
    /// No session of this name.
    RemoveSession(String),
    /// A map, new or not: id and bytes.
    PutMap(String, Vec<u8>),
    /// No map of this id.
    RemoveMap(String),
    /// Evidence of the soil, new or later than what is held.
    PutSoil(StoredSoil),
    /// No evidence under this key.
    RemoveSoil(String),
}

/// Why a store cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The folder or a file in it cannot be used.
    #[error("{}: {source}", path.display())]
    File {
        /// Path at fault.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Another process has it.
    #[error("{} is in use by another server; one store belongs to one server at a time", path.display())]
    InUse {
        /// File of the store.
        path: PathBuf,
    },
    /// The database refuses.
    #[error("database: {reason}")]
    Database {
        /// What it said.
        reason: String,
    },
    /// What is held cannot be used.
    #[error("holds {what}: {reason}")]
    Content {
        /// Which session or map.
        what: String,
        /// Why, and what to do.
        reason: String,
    },
}
