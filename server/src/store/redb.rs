//! The store of one machine: one file, one process, fsync at every commit.

use std::io::Read as _;
use std::path::Path;

use ::redb::{Database, DatabaseError, Durability, ReadTransaction, ReadableDatabase as _, ReadableTable as _, TableDefinition};

use super::{Change, Contents, SessionStore, StoreError, StoredSession, StoredSoil};

/// Name → when it was saved, image.
const SESSIONS: TableDefinition<'_, &str, (i64, &[u8])> = TableDefinition::new("sessions");
/// Name and when it was saved → image: sessions that no server could read, whose names others have now.
const SET_ASIDE: TableDefinition<'_, (&str, i64), &[u8]> = TableDefinition::new("set_aside");
/// Id → bytes.
const MAPS: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("maps");
/// Key → when it was brought, evidence of the soil.
const SOIL: TableDefinition<'_, &str, (i64, &[u8])> = TableDefinition::new("soil");
/// Facts on the store itself.
const FACTS: TableDefinition<'_, &str, &str> = TableDefinition::new("facts");
const FORMAT: (&str, &str) = ("format", "nesam.store/1");
const FILE: &str = "sessions.redb";
/// Pages that the database keeps in memory, bytes.
const CACHE_BYTES: usize = 16 << 20;

/// A `redb` database. A commit writes copies of the changed pages, then the root, and syncs the file; the checksums tell a torn commit from a whole one.
///
/// After an error of the disk, which may be full, a database refuses everything until it is opened anew: the next commit does that.
pub struct RedbStore {
    /// `None` = closed after a commit that failed.
    database: Option<Database>,
    /// Opens the same database once more, and makes none.
    reopen: Box<dyn Fn() -> Result<Database, StoreError> + Send>,
}

impl core::fmt::Debug for RedbStore {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("RedbStore").field("database", &self.database).finish_non_exhaustive()
    }
}

fn failed(error: impl core::fmt::Display) -> StoreError {
    StoreError::Database { reason: error.to_string() }
}

/// The same with the file at fault.
fn failed_in(path: &Path, error: impl core::fmt::Display) -> StoreError {
    failed(format_args!("{}: {error}", path.display()))
}

/// The same for a file that was opened.
fn of_file(path: &Path, opened: Result<Database, DatabaseError>) -> Result<Database, StoreError> {
    opened.map_err(|error| match error {
        DatabaseError::DatabaseAlreadyOpen => StoreError::InUse { path: path.into() },
        other => failed_in(path, other),
    })
}

/// Refuses a file that may be opened and is none: it would become a new store, and what was durable would be missing from it.
fn check_file(path: &Path) -> Result<(), StoreError> {
    let empty = std::fs::metadata(path).is_ok_and(|about| about.is_file() && about.len() == 0);
    if empty {
        return Err(failed_in(path, "is empty; put a copy in its place, remove it to begin without sessions, or take another folder"));
    }
    check_head(path)
}

/// Refuses a head that names pages larger than the file: the database takes the memory of a page, up to 4 GiB, before it looks whether the page is whole.
fn check_head(path: &Path) -> Result<(), StoreError> {
    // Two commits, each with the page numbers of two roots, whose five highest bits are the binary logarithm of their size in pages (redb, docs/design.md).
    const COMMITS: [usize; 2] = [64, 192];
    const ROOTS: [usize; 2] = [8, 40];
    const PAGE_BYTES: u64 = 4096;
    let mut head = [0; 320];
    let Ok(mut file) = std::fs::File::open(path) else { return Ok(()) };
    let length = file.metadata().map_or(0, |about| about.len());
    if file.read_exact(&mut head).is_err() || !head.starts_with(b"redb") {
        return Ok(());
    }
    let sizes = COMMITS.iter().flat_map(|commit| ROOTS.map(|root| PAGE_BYTES << (head[commit + root + 7] >> 3)));
    match sizes.max().filter(|size| *size > length) {
        Some(size) => Err(failed_in(
            path,
            format_args!("is damaged: a page of {size} bytes in a file of {length}; put a copy in its place, or take another folder"),
        )),
        None => Ok(()),
    }
}

impl RedbStore {
    /// Opens the store in a folder, and makes both if they are not there.
    ///
    /// # Errors
    /// `StoreError::File` when the folder cannot be made, `InUse` when another process has the store, `Database` when the file is damaged, empty or no store.
    pub fn open(folder: &Path) -> Result<Self, StoreError> {
        let at = |path: &Path| {
            let path = path.to_path_buf();
            move |source| StoreError::File { path, source }
        };
        std::fs::create_dir_all(folder).map_err(at(folder))?;
        let path = folder.join(FILE);
        check_file(&path)?;
        // What is damaged in the head of the file no checksum covers, and the database may panic on it.
        let opened = std::panic::catch_unwind(|| {
            let database = of_file(&path, Database::builder().set_cache_size(CACHE_BYTES).create(&path))?;
            // A new file is there after a power cut only when its folder is on the disk too.
            std::fs::File::open(folder).and_then(|folder| folder.sync_all()).map_err(at(folder))?;
            // A file that has gone is no empty store: what was durable in it would be missing from the new one.
            let again = path.clone();
            let prepared = Self::prepared(database, move || of_file(&again, Database::builder().set_cache_size(CACHE_BYTES).open(&again)));
            prepared.map_err(|error| match error {
                StoreError::Database { reason } => failed_in(&path, reason),
                other => other,
            })
        });
        opened.unwrap_or_else(|_| Err(failed_in(&path, "is damaged; put a copy in its place, or take another folder")))
    }

    /// Looks whether the store in a folder may be read and written, without opening it: a server may have it. A folder without one is sound.
    ///
    /// # Errors
    /// `StoreError::File` when the system refuses the file, `Database` when its head is damaged or it is empty.
    pub fn look(folder: &Path) -> Result<(), StoreError> {
        let path = folder.join(FILE);
        if !path.exists() {
            return Ok(());
        }
        std::fs::OpenOptions::new().read(true).write(true).open(&path).map_err(|source| StoreError::File { path: path.clone(), source })?;
        check_file(&path)
    }

    /// Checks every page, which the database itself does only after a crash, and makes the tables; refuses a damaged database and one of another format.
    fn prepared(mut database: Database, reopen: impl Fn() -> Result<Database, StoreError> + Send + 'static) -> Result<Self, StoreError> {
        if !database.check_integrity().map_err(failed)? {
            return Err(failed(
                "was damaged, and is now what an earlier commit held; what came later is lost: start again to go on with that, or put a copy in its place",
            ));
        }
        let transaction = database.begin_write().map_err(failed)?;
        {
            let mut facts = transaction.open_table(FACTS).map_err(failed)?;
            let held = facts.get(FORMAT.0).map_err(failed)?.map(|value| value.value().to_string());
            match held {
                Some(held) if held != FORMAT.1 => {
                    return Err(StoreError::Database { reason: format!("is of format `{held}`, this server reads `{}`", FORMAT.1) });
                }
                Some(_) => {}
                None => drop(facts.insert(FORMAT.0, FORMAT.1).map_err(failed)?),
            }
            transaction.open_table(SESSIONS).map_err(failed)?;
            transaction.open_table(SET_ASIDE).map_err(failed)?;
            transaction.open_table(MAPS).map_err(failed)?;
            transaction.open_table(SOIL).map_err(failed)?;
        }
        transaction.commit().map_err(failed)?;
        Ok(Self { database: Some(database), reopen: Box::new(reopen) })
    }
}

/// Writes the changes in one transaction.
fn write(database: &Database, changes: &[Change]) -> Result<(), StoreError> {
    let mut transaction = database.begin_write().map_err(failed)?;
    transaction.set_durability(Durability::Immediate).map_err(failed)?;
    {
        let mut sessions = transaction.open_table(SESSIONS).map_err(failed)?;
        let mut maps = transaction.open_table(MAPS).map_err(failed)?;
        let mut soil = transaction.open_table(SOIL).map_err(failed)?;
        for change in changes {
            match change {
                Change::PutSession(s) => {
                    drop(sessions.insert(s.name.as_str(), (s.saved_unix_ns, s.image.as_slice())).map_err(failed)?);
                }
                Change::SetAside(name) => {
                    if let Some(held) = sessions.remove(name.as_str()).map_err(failed)? {
                        let mut set_aside = transaction.open_table(SET_ASIDE).map_err(failed)?;
                        let (saved_unix_ns, image) = held.value();
                        drop(set_aside.insert((name.as_str(), saved_unix_ns), image).map_err(failed)?);
                    }
                }
                Change::RemoveSession(name) => drop(sessions.remove(name.as_str()).map_err(failed)?),
                Change::PutMap(id, bytes) => drop(maps.insert(id.as_str(), bytes.as_slice()).map_err(failed)?),
                Change::RemoveMap(id) => drop(maps.remove(id.as_str()).map_err(failed)?),
                Change::PutSoil(s) => drop(soil.insert(s.key.as_str(), (s.saved_unix_ns, s.share.as_slice())).map_err(failed)?),
                Change::RemoveSoil(key) => drop(soil.remove(key.as_str()).map_err(failed)?),
            }
        }
    }
    transaction.commit().map_err(failed)
}

impl RedbStore {
    fn read(&self) -> Result<ReadTransaction, StoreError> {
        let database = self.database.as_ref().ok_or_else(|| failed("is closed, as the last commit failed"))?;
        database.begin_read().map_err(failed)
    }

    /// Sessions that no server could read, whose names others have now.
    ///
    /// # Errors
    /// `StoreError` when they cannot be read.
    pub fn set_aside(&self) -> Result<Vec<StoredSession>, StoreError> {
        let (transaction, mut held) = (self.read()?, Vec::new());
        for entry in transaction.open_table(SET_ASIDE).map_err(failed)?.iter().map_err(failed)? {
            let (key, image) = entry.map_err(failed)?;
            let (name, saved_unix_ns) = key.value();
            held.push(StoredSession { name: name.into(), saved_unix_ns, image: image.value().to_vec() });
        }
        Ok(held)
    }
}

impl SessionStore for RedbStore {
    fn load(&self) -> Result<Contents, StoreError> {
        let transaction = self.read()?;
        let mut contents = Contents::default();
        for entry in transaction.open_table(SESSIONS).map_err(failed)?.iter().map_err(failed)? {
            let (name, value) = entry.map_err(failed)?;
            let (saved_unix_ns, image) = value.value();
            contents.sessions.push(StoredSession { name: name.value().into(), saved_unix_ns, image: image.to_vec() });
        }
        for entry in transaction.open_table(MAPS).map_err(failed)?.iter().map_err(failed)? {
            let (id, bytes) = entry.map_err(failed)?;
            contents.maps.push((id.value().into(), bytes.value().to_vec()));
        }
        for entry in transaction.open_table(SOIL).map_err(failed)?.iter().map_err(failed)? {
            let (key, value) = entry.map_err(failed)?;
            let (saved_unix_ns, share) = value.value();
            contents.soil.push(StoredSoil { key: key.value().into(), saved_unix_ns, share: share.to_vec() });
        }
        Ok(contents)
    }

    fn commit(&mut self, changes: &[Change]) -> Result<Vec<String>, StoreError> {
        let database = match self.database.take() {
            Some(database) => database,
            None => (self.reopen)()?,
        };
        write(&database, changes)?;
        self.database = Some(database);
        Ok(Vec::new())
    }
}

#[cfg(test)]
mod tests;
