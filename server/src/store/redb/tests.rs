//! Goal: a commit that returned survives a power cut, a commit that did not is there whole or not at all. Method: a disk that forgets, reorders and tears
//! what was not synced; the store is opened again on what is left of it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use ::redb::StorageBackend;

use super::*;

/// Sector of the disk: what is written at once or not at all, bytes.
const SECTOR: usize = 512;

/// What was not synced yet.
#[derive(Clone, Debug)]
enum Unsynced {
    Write(usize, Vec<u8>),
    Length(usize),
}

#[derive(Debug, Default)]
struct Platter {
    /// What a power cut leaves for certain.
    synced: Vec<u8>,
    /// What the program sees.
    seen: Vec<u8>,
    unsynced: Vec<Unsynced>,
    /// Writes and syncs until the power is cut; `None` = never.
    left: Option<u64>,
    operations: u64,
}

impl Platter {
    fn operate(&mut self) -> std::io::Result<()> {
        self.operations += 1;
        match &mut self.left {
            Some(0) => Err(std::io::Error::other("the power is off")),
            Some(left) => {
                *left -= 1;
                Ok(())
            }
            None => Ok(()),
        }
    }

    /// What the platter holds after the cut: of each unsynced write, any of its sectors.
    fn after_power_cut(&self, random: &mut Random) -> Vec<u8> {
        let mut bytes = self.synced.clone();
        for operation in &self.unsynced {
            match operation {
                Unsynced::Length(length) if random.coin() => bytes.resize(*length, 0),
                Unsynced::Length(_) => {}
                Unsynced::Write(offset, data) => {
                    for (i, sector) in data.chunks(SECTOR).enumerate() {
                        let at = offset + i * SECTOR;
                        if random.coin() {
                            bytes.resize(bytes.len().max(at + sector.len()), 0);
                            bytes[at..at + sector.len()].copy_from_slice(sector);
                        }
                    }
                }
            }
        }
        bytes
    }
}

#[derive(Clone, Debug, Default)]
struct Disk(Arc<Mutex<Platter>>);

impl Disk {
    fn holding(bytes: Vec<u8>) -> Self {
        Self(Arc::new(Mutex::new(Platter { synced: bytes.clone(), seen: bytes, ..Platter::default() })))
    }
}

impl StorageBackend for Disk {
    fn len(&self) -> std::io::Result<u64> {
        Ok(self.0.lock().unwrap().seen.len() as u64)
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> std::io::Result<()> {
        let platter = self.0.lock().unwrap();
        let bytes = platter.seen.get(offset as usize..offset as usize + out.len());
        out.copy_from_slice(bytes.ok_or_else(|| std::io::Error::other("beyond the end"))?);
        Ok(())
    }

    fn set_len(&self, length: u64) -> std::io::Result<()> {
        let mut platter = self.0.lock().unwrap();
        platter.operate()?;
        platter.seen.resize(length as usize, 0);
        platter.unsynced.push(Unsynced::Length(length as usize));
        Ok(())
    }

    fn sync_data(&self) -> std::io::Result<()> {
        let mut platter = self.0.lock().unwrap();
        platter.operate()?;
        platter.synced = platter.seen.clone();
        platter.unsynced.clear();
        Ok(())
    }

    fn write(&self, offset: u64, data: &[u8]) -> std::io::Result<()> {
        let mut platter = self.0.lock().unwrap();
        platter.operate()?;
        let at = offset as usize;
        platter.seen[at..at + data.len()].copy_from_slice(data);
        platter.unsynced.push(Unsynced::Write(at, data.to_vec()));
        Ok(())
    }
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn coin(&mut self) -> bool {
        self.next() & 1 == 1
    }
}

/// A session of about the size of a real one, whose bytes say which commit wrote it.
fn session(name: usize, commit: u64) -> StoredSession {
    StoredSession { name: format!("s{name}"), saved_unix_ns: commit as i64, image: commit.to_le_bytes().repeat(1500) }
}

/// The changes of commit `n`, which is from 1 on: three sessions are written and now and then one is removed.
fn changes(n: u64) -> Vec<Change> {
    let mut changes: Vec<Change> = (0..3).map(|i| Change::PutSession(session((n as usize * 3 + i) % 7, n))).collect();
    if n.is_multiple_of(5) {
        changes.push(Change::RemoveSession(format!("s{}", n % 7)));
        changes.push(Change::PutMap("map".into(), n.to_le_bytes().repeat(4000)));
        changes.push(Change::RemoveSoil(format!("c{}", n % 3)));
    }
    changes.push(Change::PutSoil(StoredSoil { key: format!("c{}", n % 4), saved_unix_ns: n as i64, share: n.to_le_bytes().repeat(50) }));
    changes
}

/// Goal: a session that no server could read does not go when another one gets its name. Method: two such sessions of one name, one after the other, each set aside as the next is
/// written; what the store holds after it was opened anew.
#[test]
fn regress_what_is_set_aside_keeps_its_bytes() {
    let session = |n: u8| StoredSession { name: "truck".into(), saved_unix_ns: i64::from(n), image: vec![n; 50] };
    let disk = Disk::default();
    let mut store = on(disk.clone()).unwrap();
    store.commit(&[Change::SetAside("truck".into()), Change::PutSession(session(1))]).unwrap();
    for n in [2, 3] {
        store.commit(&[Change::SetAside("truck".into()), Change::PutSession(session(n))]).unwrap();
    }
    drop(store);
    let store = on(disk).unwrap();
    assert_eq!((store.load().unwrap().sessions, store.set_aside().unwrap()), (vec![session(3)], vec![session(1), session(2)]));
}

/// What a store holds after commit `n`.
fn expected(n: u64) -> Contents {
    let (mut sessions, mut maps, mut soil) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
    for change in (1..=n).flat_map(changes) {
        match change {
            Change::PutSession(s) => drop(sessions.insert(s.name.clone(), s)),
            Change::RemoveSession(name) | Change::SetAside(name) => drop(sessions.remove(&name)),
            Change::PutMap(id, bytes) => drop(maps.insert(id, bytes)),
            Change::RemoveMap(id) => drop(maps.remove(&id)),
            Change::PutSoil(s) => drop(soil.insert(s.key.clone(), s)),
            Change::RemoveSoil(key) => drop(soil.remove(&key)),
        }
    }
    Contents { sessions: sessions.into_values().collect(), maps: maps.into_iter().collect(), soil: soil.into_values().collect() }
}

/// A store on such a disk.
fn on(disk: Disk) -> Result<RedbStore, StoreError> {
    let open = move || Database::builder().set_cache_size(CACHE_BYTES).create_with_backend(disk.clone()).map_err(failed);
    RedbStore::prepared(open()?, open)
}

/// Commits until the power goes; the last commit that returned.
fn run(disk: &Disk, from: u64, commits: u64) -> Option<u64> {
    let mut store = on(disk.clone()).ok()?;
    let mut returned = from;
    for n in from + 1..=from + commits {
        if store.commit(&changes(n)).is_err() {
            break;
        }
        returned = n;
    }
    Some(returned)
}

#[test]
fn property_a_power_cut_loses_no_commit_that_returned() {
    const COMMITS: u64 = 12;
    let whole = Disk::default();
    assert_eq!(run(&whole, 0, COMMITS), Some(COMMITS));
    let operations = whole.0.lock().unwrap().operations;
    // A disk with the tables, to begin from.
    let begun = Disk::default();
    assert_eq!(run(&begun, 0, 0), Some(0));
    let begun = begun.0.lock().unwrap().synced.clone();
    let (mut cuts, mut unfinished) = (0, 0);
    for left in 0..operations {
        for seed in 0..3_u64 {
            let mut random = Random(1000 * left + seed);
            let disk = Disk::holding(begun.clone());
            disk.0.lock().unwrap().left = Some(left);
            let returned = run(&disk, 0, COMMITS).unwrap_or(0);
            let left_over = disk.0.lock().unwrap().after_power_cut(&mut random);
            let store = on(Disk::holding(left_over)).unwrap_or_else(|e| panic!("cut at {left}, seed {seed}: {e}"));
            let held = store.load().unwrap();
            let next = held == expected(returned + 1) && returned < COMMITS;
            assert!(held == expected(returned) || next, "cut at {left}, seed {seed}: {returned} commits had returned");
            cuts += 1;
            unfinished += u32::from(next);
        }
    }
    // The cut lies inside commits often enough to mean something.
    assert!(cuts > 100 && unfinished > 0, "{cuts} cuts, {unfinished} with the commit that had not returned");
}

/// Goal: a disk that is full for a moment costs no more than the commits of that moment. Method: the disk refuses everything from one of the writes and syncs
/// of a commit on, then has room again; the same store takes the commit and those after it.
#[test]
fn regress_a_disk_that_was_full_is_written_to_again() {
    let begun = Disk::default();
    assert_eq!(run(&begun, 0, 3), Some(3));
    let begun = begun.0.lock().unwrap().synced.clone();
    let room = |disk: &Disk, left| disk.0.lock().unwrap().left = left;
    let mut refused = 0;
    loop {
        let disk = Disk::holding(begun.clone());
        let mut store = on(disk.clone()).unwrap();
        room(&disk, Some(refused));
        if store.commit(&changes(4)).is_ok() {
            break;
        }
        // Still full: the store is not opened either, or takes nothing.
        room(&disk, Some(0));
        assert!(store.commit(&changes(4)).is_err(), "full from operation {refused} on");
        room(&disk, None);
        for n in 4..=6 {
            store.commit(&changes(n)).unwrap_or_else(|e| panic!("full from operation {refused} on, commit {n}: {e}"));
        }
        assert_eq!(store.load().unwrap(), expected(6), "full from operation {refused} on");
        let synced = disk.0.lock().unwrap().synced.clone();
        drop(store);
        assert_eq!(on(Disk::holding(synced)).unwrap().load().unwrap(), expected(6), "what a power cut leaves");
        refused += 1;
    }
    assert!(refused > 2, "a commit of {refused} operations shows nothing");
}

/// A store whose folder has gone while its disk failed must not begin anew where the folder was.
#[test]
fn regress_a_file_that_has_gone_is_not_made_anew() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = RedbStore::open(folder.path()).unwrap();
    store.commit(&changes(1)).unwrap();
    store.database = None;
    std::fs::remove_file(folder.path().join(FILE)).unwrap();
    let message = store.commit(&changes(2)).unwrap_err().to_string();
    assert!(message.contains(FILE) && !folder.path().join(FILE).exists(), "{message}");
}

#[test]
fn service_damaged_foreign_and_shared_stores_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join(FILE);
    let mut store = RedbStore::open(folder.path()).unwrap();
    (1..=20).for_each(|n| drop(store.commit(&changes(n)).unwrap()));
    assert!(matches!(RedbStore::open(folder.path()), Err(StoreError::InUse { .. })));
    drop(store);
    assert_eq!(RedbStore::open(folder.path()).unwrap().load().unwrap(), expected(20));
    let bytes = std::fs::read(&file).unwrap();
    for length in [1, SECTOR, bytes.len() / 3] {
        std::fs::write(&file, &bytes[..length]).unwrap();
        assert!(RedbStore::open(folder.path()).is_err(), "{length} bytes of {}", bytes.len());
    }
    std::fs::write(&file, "not a store at all, but a letter to the reader").unwrap();
    let message = RedbStore::open(folder.path()).unwrap_err().to_string();
    assert!(message.contains(FILE), "{message}");
    std::fs::write(&file, &bytes).unwrap();
    assert_eq!(RedbStore::open(folder.path()).unwrap().load().unwrap(), expected(20));
    // Damage in any page, after an orderly end, when the database itself would look at none.
    const PAGE: usize = 4096;
    let used: Vec<usize> = (0..bytes.len() / PAGE).filter(|page| bytes[page * PAGE..][..PAGE].iter().any(|byte| *byte != 0)).collect();
    let mut refused = 0;
    for at in used.iter().flat_map(|page| [0, 9, 64, 70, 128, 900].map(|offset| page * PAGE + offset)) {
        let mut damaged = bytes.clone();
        damaged[at..at + 8].iter_mut().for_each(|byte| *byte ^= 0x5a);
        std::fs::write(&file, damaged).unwrap();
        match RedbStore::open(folder.path()).and_then(|store| store.load()) {
            Ok(held) => assert_eq!(held, expected(20), "damage at {at}"),
            Err(error) => {
                refused += 1;
                assert!(error.to_string().contains(FILE), "damage at {at}: {error}");
            }
        }
    }
    assert!(refused > used.len(), "{refused} of six in each of {} pages", used.len());
    // A root that is said to be larger than the file costs no memory.
    for root in [72, 104, 200, 232] {
        let mut damaged = bytes.clone();
        damaged[root + 7] = 20 << 3;
        std::fs::write(&file, damaged).unwrap();
        let error = RedbStore::open(folder.path()).unwrap_err().to_string();
        assert!(error.contains(FILE) && error.contains("a page of 4294967296 bytes"), "{root}: {error}");
    }
    // A folder that is a file.
    assert!(matches!(RedbStore::open(&file), Err(StoreError::File { .. })));
}

/// Goal: a file that was emptied is no new store, and a look at it says what opening it would. Method: a store that is made, looked at while it is open, emptied.
#[test]
fn regress_an_empty_file_is_no_store() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join(FILE);
    RedbStore::look(folder.path()).unwrap();
    assert!(!file.exists(), "a look makes nothing");
    let store = RedbStore::open(folder.path()).unwrap();
    RedbStore::look(folder.path()).unwrap();
    drop(store);
    std::fs::write(&file, "").unwrap();
    for error in [RedbStore::open(folder.path()).map(drop).unwrap_err(), RedbStore::look(folder.path()).unwrap_err()] {
        assert!(error.to_string().contains("sessions.redb: is empty; "), "{error}");
    }
    assert_eq!(std::fs::metadata(&file).unwrap().len(), 0, "nothing is made of it");
    std::fs::remove_file(&file).unwrap();
    std::fs::create_dir(&file).unwrap();
    assert!(matches!(RedbStore::look(folder.path()), Err(StoreError::File { .. })));
}
