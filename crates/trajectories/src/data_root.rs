//! A data root: one vehicle, its worlds, its sets.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use nesam_physics::{SecondCommand, Vehicle};
use nesam_terrain::WorldMap;
use sha2::{Digest, Sha256};

use crate::card_parts::mass_of_parts_kg;
use crate::channels::{Channels, implied_second};
use crate::data_sheet::{CardReading, read_with_notes};
use crate::drive;
use crate::error::TrajectoryError;
use crate::index::{Entry, Index};
use crate::lacking::Lacking;
use crate::table::Table;
use crate::trajectory::{Split, Trajectory};

/// File that makes a folder a set.
pub(crate) const SAMPLES: &str = "samples.parquet";

/// Depth to which sets are searched (`effect_open/payload` is at 2).
const SET_DEPTH: usize = 4;

/// Ids listed in an error that says what is there.
const LISTED: usize = 8;

/// Which split of a set is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum SplitFilter {
    /// Training drives only.
    Train,
    /// Test drives only.
    Test,
    /// Every drive.
    #[default]
    All,
}

impl SplitFilter {
    fn admits(self, split: Option<Split>) -> bool {
        match self {
            Self::Train => split == Some(Split::Train),
            Self::Test => split == Some(Split::Test),
            Self::All => true,
        }
    }

    /// As on the command line and in JSON.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Test => "test",
            Self::All => "all",
        }
    }
}

/// Which drives to load, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct SetQuery {
    /// Set, e.g. `nominal` or `effect_open/payload`.
    pub set: String,
    /// Split.
    pub split: SplitFilter,
    /// Only these trajectories; no other drive's values are looked at.
    pub trajectories: Option<Vec<String>>,
    /// Step to resample to, s.
    pub dt_s: f64,
    /// Whether to read the `gt_` columns too (evaluation only).
    pub ground_truth: bool,
    /// Whether drives that the index lists may have no samples; else that is an error, as whoever loads a whole split must get all of it.
    pub may_lack_drives: bool,
}

impl SetQuery {
    /// Every drive of a set at 10 Hz, without ground truth.
    pub fn all(set: impl Into<String>) -> Self {
        Self {
            set: set.into(),
            split: SplitFilter::All,
            trajectories: None,
            dt_s: nesam_physics::DT_S,
            ground_truth: false,
            may_lack_drives: false,
        }
    }
}

/// An opened data root.
///
/// Only the vehicle card is read on opening, and where it does not say what the second command means, the sets until one tells it; sets and worlds are read
/// when asked for, and worlds are kept.
#[derive(Debug)]
pub struct DataRoot {
    root: PathBuf,
    card: PathBuf,
    vehicle: Vehicle,
    /// Which of the two command ranges the kind of drive implies and the card does not state.
    implied_range: [bool; 2],
    worlds: Mutex<HashMap<String, Arc<WorldMap>>>,
    /// Relative path and SHA-256 of the set files read so far.
    hashes: Mutex<BTreeMap<String, String>>,
    /// What the card and the sets read so far lack, one sentence each.
    notes: Mutex<BTreeSet<String>>,
    /// Where index, samples and worlds of the sets read so far do not belong together, one sentence each.
    contradictions: Mutex<BTreeSet<String>>,
}

impl DataRoot {
    /// Opens a root; the vehicle card is `vehicle`, else the one `vehicle_*.json` in the root. Where the card does not say what the second command means, the
    /// columns of the first set that name it do.
    ///
    /// # Errors
    /// `TrajectoryError::Layout` when the root is not a folder or has no card or several; the errors of
    /// [`read_vehicle_card`](crate::read_vehicle_card).
    pub fn open(root: &Path, vehicle: Option<&Path>) -> Result<Self, TrajectoryError> {
        let card = match vehicle {
            Some(path) => {
                if !root.is_dir() {
                    return Err(TrajectoryError::layout(root, "is not a folder"));
                }
                path.to_path_buf()
            }
            None => find_card(root)?,
        };
        let CardReading { vehicle, notes, implied_range } = read_with_notes(&card, &|| second_of_columns(root))?;
        let notes = Mutex::new(notes.into_iter().collect());
        Ok(Self {
            root: root.into(),
            card,
            vehicle,
            implied_range,
            worlds: Mutex::default(),
            hashes: Mutex::default(),
            notes,
            contradictions: Mutex::default(),
        })
    }

    /// The vehicle that drove.
    pub fn vehicle(&self) -> &Vehicle {
        &self.vehicle
    }

    /// The vehicle with room for the commands of these drives, where the card states no range of commands and its kind of drive implies one.
    pub fn vehicle_of(&self, drives: &[Trajectory]) -> Vehicle {
        let mut vehicle = self.vehicle.clone();
        for control in drives.iter().flat_map(|drive| &drive.controls) {
            for (axis, value) in [control.speed_m_s, control.second].into_iter().enumerate().filter(|(axis, _)| self.implied_range[*axis]) {
                let [low, high] = vehicle.command_range[axis];
                vehicle.command_range[axis] = [low.min(value), high.max(value)];
            }
        }
        vehicle
    }

    /// Whether the ranges of the speed and of the second command are implied by the kind of drive, and not stated by the card.
    pub fn implied_range(&self) -> [bool; 2] {
        self.implied_range
    }

    /// File of its card.
    pub fn card(&self) -> &Path {
        &self.card
    }

    /// What the parts that the card states weigh together, chassis and wheels, kg; `None` where it states none.
    pub fn mass_of_parts_kg(&self) -> Option<f64> {
        mass_of_parts_kg(&self.card)
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.root
    }

    /// Names of the sets, sorted; slashes separate folders.
    pub fn sets(&self) -> Vec<String> {
        sets_of(&self.root)
    }

    /// Ids of the worlds that have a folder, sorted; empty for a root without maps.
    pub fn world_ids(&self) -> Vec<String> {
        let mut ids: Vec<String> = subfolders(&self.root.join("worlds")).into_iter().map(|(name, _)| name).collect();
        ids.sort();
        ids
    }

    /// Folder of a world.
    pub fn world_dir(&self, id: &str) -> PathBuf {
        self.root.join("worlds").join(id)
    }

    /// The map of a world; read once, then shared.
    ///
    /// # Errors
    /// `TrajectoryError::Layout` naming the worlds present when there is no such world; `TrajectoryError::World` when it is damaged.
    pub fn world(&self, id: &str) -> Result<Arc<WorldMap>, TrajectoryError> {
        let mut worlds = self.worlds.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(map) = worlds.get(id) {
            return Ok(Arc::clone(map));
        }
        if !is_plain_name(id) || !self.world_dir(id).is_dir() {
            let reason = format!("no world `{id}`; present: {}", listed(self.world_ids()));
            return Err(TrajectoryError::layout(&self.root.join("worlds"), reason));
        }
        let map = Arc::new(WorldMap::load(&self.world_dir(id))?);
        worlds.insert(id.into(), Arc::clone(&map));
        Ok(map)
    }

    /// What the card and the sets loaded so far lack and is done without, one sentence each: numbers of the card that are estimated, elevation images, channels
    /// of the pose, splits.
    pub fn notes(&self) -> Vec<String> {
        self.notes.lock().unwrap_or_else(PoisonError::into_inner).iter().cloned().collect()
    }

    /// Where index, samples and worlds of the sets loaded so far do not belong together, one sentence each: worlds that an index names and that are not there,
    /// drives that are not in it. They are loaded without a map all the same.
    pub fn contradictions(&self) -> Vec<String> {
        self.contradictions.lock().unwrap_or_else(PoisonError::into_inner).iter().cloned().collect()
    }

    /// SHA-256 (hex) over all set files read so far: samples and indices, by relative path.
    pub fn hash(&self) -> String {
        hash_of(self.hashes.lock().unwrap_or_else(PoisonError::into_inner).iter())
    }

    /// Loads drives in the order of the samples file.
    ///
    /// A drive without an index entry has neither split nor world; one whose split is neither train nor test has no split, which [`DataRoot::notes`] says.
    /// `world` is `None` where the root has no map of it, and where the drive does not measure its whole pose; [`DataRoot::contradictions`] and
    /// [`DataRoot::notes`] then say so.
    ///
    /// # Errors
    /// `TrajectoryError` naming file, column and row of the first value that is not usable among the drives asked for, the sets
    /// present when there is no such set, the splits present when none of its drives is in the split, or the trajectories present
    /// when one asked for is not there.
    pub fn load_set(&self, query: &SetQuery) -> Result<Vec<Trajectory>, TrajectoryError> {
        self.check(query)?;
        let dir = self.set_dir(&query.set)?;
        let index = Index::read(&dir)?;
        let table = Table::open(&dir.join(SAMPLES))?;
        self.note_hashes(&query.set, &table, &index)?;
        let drives = rows_by_trajectory(&table)?;
        let wanted = wanted(query, &index, &drives, table.path())?;
        let channels = Channels::read(&table, self.vehicle.second, query.ground_truth)?;
        let mut lacking = Lacking::default();
        let mut loaded = Vec::with_capacity(wanted.len());
        for at in wanted {
            let (id, rows) = &drives[at];
            let built = drive::build(&channels, rows, &self.vehicle, table.path(), query.dt_s);
            let mut trajectory = built.map_err(|error| error.in_drive(id))?;
            trajectory.id.clone_from(id);
            trajectory.set.clone_from(&query.set);
            if let Some(entry) = index.entries.get(id) {
                trajectory.split = entry.split();
                if let Some(name) = entry.split_name.as_ref().filter(|_| trajectory.split.is_none()) {
                    *lacking.splits.entry(name.clone()).or_default() += 1;
                }
                trajectory.world.clone_from(&entry.world);
            } else if index.exists() {
                lacking.not_in_index += 1;
            }
            self.leave_off_map(&mut trajectory, &mut lacking);
            loaded.push(trajectory);
        }
        self.notes.lock().unwrap_or_else(PoisonError::into_inner).extend(lacking.sentences(&query.set));
        self.contradictions.lock().unwrap_or_else(PoisonError::into_inner).extend(lacking.contradictions(&query.set));
        Ok(loaded)
    }

    fn check(&self, query: &SetQuery) -> Result<(), TrajectoryError> {
        if query.dt_s.is_finite() && query.dt_s >= 1e-3 && query.dt_s <= 10.0 {
            return Ok(());
        }
        let reason = format!("a step of {} s is outside 0.001..=10 s", query.dt_s);
        Err(TrajectoryError::Query { set: query.set.clone(), reason })
    }

    pub(crate) fn set_dir(&self, set: &str) -> Result<PathBuf, TrajectoryError> {
        let plain = !set.is_empty() && set.split('/').all(is_plain_name);
        let dir = self.root.join(set);
        if plain && dir.join(SAMPLES).is_file() {
            return Ok(dir);
        }
        let reason = format!("no set `{set}` (a folder with {SAMPLES}); present: {}", listed(self.sets()));
        Err(TrajectoryError::layout(&self.root, reason))
    }

    /// Takes the world from a drive that cannot be put on its map, and counts why.
    fn leave_off_map(&self, drive: &mut Trajectory, lacking: &mut Lacking) {
        let names = ["x", "y", "z", "roll", "pitch", "yaw"];
        let assumed: Vec<&str> =
            names.into_iter().zip(drive.measured.pose()).filter(|(_, measured)| !measured).map(|(name, _)| name).collect();
        if !assumed.is_empty() {
            *lacking.channels.entry(assumed.join(", ")).or_default() += 1;
        }
        let Some(world) = drive.world.take() else { return };
        let dir = self.world_dir(&world);
        if !is_plain_name(&world) || !dir.is_dir() {
            *lacking.worlds.entry(world).or_default() += 1;
        } else if !WorldMap::has_elevation(&dir) {
            *lacking.elevations.entry(world).or_default() += 1;
        } else if drive.measured.whole_pose() {
            drive.world = Some(world);
        }
    }

    fn note_hashes(&self, set: &str, table: &Table, index: &Index) -> Result<(), TrajectoryError> {
        let mut hashes = self.hashes.lock().unwrap_or_else(PoisonError::into_inner);
        hashes.insert(format!("{set}/{SAMPLES}"), table.hash().into());
        if let Some(path) = &index.path {
            let content = std::fs::read(path).map_err(|source| TrajectoryError::Read { path: path.clone(), source })?;
            let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            hashes.insert(format!("{set}/{name}"), hex(&Sha256::digest(content)));
        }
        Ok(())
    }
}

/// A drive's id and its rows, in file order.
pub(crate) type DriveRows = (String, Vec<usize>);

/// Groups the rows of the samples by trajectory, in order of first appearance.
pub(crate) fn rows_by_trajectory(table: &Table) -> Result<Vec<DriveRows>, TrajectoryError> {
    let ids = table.texts("trajectory")?;
    let mut drives: Vec<DriveRows> = Vec::new();
    let mut places: HashMap<Arc<str>, usize> = HashMap::new();
    for (row, id) in ids.into_iter().enumerate() {
        let Some(id) = id else {
            return Err(TrajectoryError::cell(table.path(), "trajectory", row, "null, expected an id"));
        };
        let at = *places.entry(Arc::clone(&id)).or_insert_with(|| {
            drives.push((id.to_string(), Vec::new()));
            drives.len() - 1
        });
        drives[at].1.push(row);
    }
    if drives.is_empty() {
        return Err(TrajectoryError::column(table.path(), "trajectory", "the file has no rows"));
    }
    Ok(drives)
}

/// Places of the drives that the query asks for.
fn wanted(query: &SetQuery, index: &Index, drives: &[DriveRows], samples: &Path) -> Result<Vec<usize>, TrajectoryError> {
    let refuse = |reason| Err(TrajectoryError::Query { set: query.set.clone(), reason });
    let has_samples: BTreeSet<&str> = drives.iter().map(|(id, _)| id.as_str()).collect();
    let split = |id: &str| index.entries.get(id).and_then(Entry::split);
    let split_name = |id: &str| index.entries.get(id).and_then(|entry| entry.split_name.as_deref());
    if let Some(ids) = &query.trajectories {
        for id in ids {
            if !has_samples.contains(id.as_str()) {
                let present = listed(drives.iter().map(|(id, _)| id.clone()).collect());
                return refuse(format!("no trajectory `{id}`; present: {present}"));
            }
            if !query.split.admits(split(id)) {
                let found = split_name(id).unwrap_or("no split");
                return refuse(format!("trajectory `{id}` is in {found}, not in split {}", query.split.as_str()));
            }
        }
    } else if !query.may_lack_drives {
        let lost = index.order.iter().find(|id| query.split.admits(split(id)) && !has_samples.contains(id.as_str()));
        if let (Some(id), Some(path)) = (lost, &index.path) {
            let reason = format!("`{id}` has no samples in {}", samples.display());
            return Err(TrajectoryError::cell(path, "trajectory", index.entries[id].row, reason));
        }
    }
    let asked = |id: &String| query.trajectories.as_ref().is_none_or(|ids| ids.contains(id));
    let chosen: Vec<usize> = (0..drives.len()).filter(|at| asked(&drives[*at].0) && query.split.admits(split(&drives[*at].0))).collect();
    if chosen.is_empty() {
        let splits: BTreeSet<&str> = drives.iter().filter_map(|(id, _)| split_name(id)).collect();
        let present = listed(splits.into_iter().map(String::from).collect());
        let why = if index.exists() { "" } else { " (the set has no index)" };
        return refuse(format!("no drive in split {}; splits present: {present}{why}", query.split.as_str()));
    }
    Ok(chosen)
}

/// The one `vehicle_*.json` of a root.
fn find_card(root: &Path) -> Result<PathBuf, TrajectoryError> {
    let entries = std::fs::read_dir(root).map_err(|source| TrajectoryError::Read { path: root.into(), source })?;
    let is_card = |name: &str| name.starts_with("vehicle_") && name.ends_with(".json");
    let mut cards: Vec<PathBuf> =
        entries.flatten().filter(|entry| is_card(&entry.file_name().to_string_lossy())).map(|entry| entry.path()).collect();
    cards.sort();
    match cards.as_slice() {
        [card] => Ok(card.clone()),
        [] => Err(TrajectoryError::layout(root, "has no vehicle_*.json; name a vehicle card with --vehicle FILE")),
        several => {
            let names = several.iter().filter_map(|p| p.file_name()).map(|n| n.to_string_lossy().into_owned()).collect();
            let reason = format!("has several vehicle cards ({}); choose one with --vehicle FILE", listed(names));
            Err(TrajectoryError::layout(root, reason))
        }
    }
}

/// What the second command means by the columns of the first set of a root that name it.
fn second_of_columns(root: &Path) -> Option<(SecondCommand, String)> {
    sets_of(root).iter().find_map(|set| {
        let table = Table::open(&root.join(set).join(SAMPLES)).ok()?;
        implied_second(&table).map(|(second, column)| (second, format!("column `{column}` of set `{set}`")))
    })
}

/// Names of the sets of a root, sorted.
fn sets_of(root: &Path) -> Vec<String> {
    let mut sets = Vec::new();
    collect_sets(root, "", SET_DEPTH, &mut sets);
    sets.sort();
    sets
}

/// Adds the sets below a folder, depth first; `worlds` holds maps, not sets.
fn collect_sets(dir: &Path, prefix: &str, depth: usize, sets: &mut Vec<String>) {
    for (name, path) in subfolders(dir) {
        if prefix.is_empty() && name == "worlds" {
            continue;
        }
        let set = format!("{prefix}{name}");
        if path.join(SAMPLES).is_file() {
            sets.push(set.clone());
        }
        if depth > 1 {
            collect_sets(&path, &format!("{set}/"), depth - 1, sets);
        }
    }
}

/// Names and paths of the folders in a folder; hidden ones are left out, a folder that cannot be read has none.
fn subfolders(dir: &Path) -> Vec<(String, PathBuf)> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let named = entries.map(|entry| (entry.file_name().to_string_lossy().into_owned(), entry.path()));
    named.filter(|(name, path)| !name.starts_with('.') && path.is_dir()).collect()
}

fn is_plain_name(name: &str) -> bool {
    !name.is_empty() && !name.starts_with('.') && !name.contains(['/', '\\', '\0', ':'])
}

/// The first few names, and how many more there are.
fn listed(mut names: Vec<String>) -> String {
    if names.is_empty() {
        return "none".into();
    }
    let more = names.len().saturating_sub(LISTED);
    names.truncate(LISTED);
    let shown = names.join(", ");
    if more > 0 { format!("{shown} and {more} more") } else { shown }
}

fn hash_of<'a>(files: impl Iterator<Item = (&'a String, &'a String)>) -> String {
    let mut hash = Sha256::new();
    for (path, content) in files {
        hash.update(format!("{path} {content}\n"));
    }
    hex(&hash.finalize())
}

/// Bytes as lower-case hex.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
