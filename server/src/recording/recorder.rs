//! The recording side of a running server: a tap on the engine's thread, a bounded queue, a thread that writes.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nesam_engine::{Command, Executed, Reply, Tap};
use nesam_physics::Vehicle;

use super::answer::{SoilEpochs, to_entry};
use super::command::{HeldMaps, to_entries};
use super::error::RecordingError;
use super::header::RecordingHeader;
use super::part::Part;
use super::schema::Descriptors;
use crate::call::Timing;
use crate::clock::unix_ns;
use crate::config::RecordingConfig;

/// Commands that may wait for the disk, besides the limit on their bytes.
const WAITING_MAX: usize = 1 << 16;
/// What a command without arrays weighs, bytes.
const COMMAND_BYTES: u64 = 2048;
/// Longest time that a command stays in memory only: what a crash loses at most.
pub(crate) const FLUSH_EVERY: Duration = Duration::from_millis(500);

/// A command on its way to the disk.
struct Item {
    /// Counts the executed commands from 1, the dropped ones too.
    index: u64,
    weight: u64,
    executed: Box<Executed>,
}

/// What both threads count.
#[derive(Debug, Default)]
struct Shared {
    recorded: AtomicU64,
    dropped: AtomicU64,
    bytes: AtomicU64,
    waiting_bytes: AtomicU64,
    /// Since when nothing is written any more, Unix time, ns: the disk failed or a limit is reached.
    ended: OnceLock<i64>,
    parts: Mutex<Vec<PathBuf>>,
}

/// Counters of a recording.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RecorderCounts {
    /// Commands in the file; those of the last half second are not counted yet.
    pub recorded: u64,
    /// Commands that the disk could not follow or that came after the end.
    pub dropped: u64,
    /// Bytes written, about.
    pub bytes: u64,
    /// Whether nothing is written any more because the disk failed or a limit was reached.
    pub ended: bool,
}

/// A running recording.
#[derive(Debug)]
pub struct Recorder {
    shared: Arc<Shared>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Recorder {
    /// Makes the folder and the first file, starts the thread, and gives the tap for the engine.
    ///
    /// # Errors
    /// `RecordingError::File` or `Write` when folder or file cannot be written.
    pub fn start(config: &RecordingConfig, header: RecordingHeader, vehicle: Vehicle) -> Result<(Self, Tap), RecordingError> {
        let folder = config.directory.clone();
        std::fs::create_dir_all(&folder).map_err(|source| RecordingError::file(&folder, source))?;
        let part = Part::create(&folder, &header, 1)?;
        let shared = Arc::new(Shared::default());
        note_part(&shared, part.path());
        let (sender, receiver) = sync_channel(WAITING_MAX);
        let tap = tap(sender, Arc::clone(&shared), config.queue_bytes_max);
        let work = Work {
            folder,
            header,
            vehicle,
            part_bytes_max: config.part_bytes_max,
            bytes_max: config.bytes_max,
            descriptors: Descriptors::of_program(),
            maps: HeldMaps::default(),
            soil: SoilEpochs::default(),
            next_index: 1,
            unflushed: 0,
            finished_bytes: 0,
            part_number: 1,
            shared: Arc::clone(&shared),
        };
        let thread = std::thread::Builder::new().name("nesam-recording".into()).spawn(move || work.run(part, &receiver));
        let thread = thread.map_err(|source| RecordingError::file(&config.directory, source))?;
        Ok((Self { shared, thread: Mutex::new(Some(thread)) }, tap))
    }

    /// Counters.
    pub fn counts(&self) -> RecorderCounts {
        let shared = &self.shared;
        RecorderCounts {
            recorded: shared.recorded.load(Ordering::Relaxed),
            dropped: shared.dropped.load(Ordering::Relaxed),
            bytes: shared.bytes.load(Ordering::Relaxed),
            ended: shared.ended.get().is_some(),
        }
    }

    /// Since when nothing is written any more, Unix time, ns; `None` while it goes on.
    pub fn ended_unix_ns(&self) -> Option<i64> {
        self.shared.ended.get().copied()
    }

    /// Files so far, the first part first.
    pub fn parts(&self) -> Vec<PathBuf> {
        self.shared.parts.lock().map(|parts| parts.clone()).unwrap_or_default()
    }

    /// Waits until everything is written. The tap must be gone: stop the engine first.
    pub fn join(&self) {
        let thread = self.thread.lock().ok().and_then(|mut thread| thread.take());
        if thread.is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the recording thread panicked; the recording ends where it was; this is a bug");
        }
    }
}

fn note_part(shared: &Shared, path: &Path) {
    if let Ok(mut parts) = shared.parts.lock() {
        parts.push(path.into());
    }
}

/// What a command holds in memory, bytes. Maps are shared with the engine and count as much as they are written.
fn weight(executed: &Executed) -> u64 {
    let asked = match &executed.command {
        Command::Predict(query) => 4 * query.controls.asked().1.len() as u64,
        Command::PutMap { map, .. } => 7 * map.geometry().cells() as u64,
        _ => 0,
    };
    let answered = match &executed.result {
        Ok(Reply::Predicted(prediction)) => {
            let drawn = prediction.drawn_controls.len() + prediction.ranking.as_ref().map_or(0, |ranking| ranking.costs.len());
            4 * (prediction.rollout.states.len() + prediction.rollout.sinkage_m.len() + drawn) as u64
        }
        Ok(Reply::Sessions(sessions)) => COMMAND_BYTES * sessions.len() as u64,
        _ => 0,
    };
    COMMAND_BYTES + asked + answered
}

/// Runs on the engine's thread: hands over or drops, and never waits. A command that alone is above the limit passes while nothing waits.
fn tap(sender: SyncSender<Item>, shared: Arc<Shared>, queue_bytes_max: u64) -> Tap {
    let mut index = 0;
    Box::new(move |executed| {
        index += 1;
        let weight = weight(&executed);
        let waiting = shared.waiting_bytes.load(Ordering::Relaxed);
        let room = waiting == 0 || waiting.saturating_add(weight) <= queue_bytes_max;
        if room && shared.ended.get().is_none() {
            shared.waiting_bytes.fetch_add(weight, Ordering::Relaxed);
            if sender.try_send(Item { index, weight, executed: executed.into() }).is_ok() {
                return;
            }
            shared.waiting_bytes.fetch_sub(weight, Ordering::Relaxed);
        }
        shared.dropped.fetch_add(1, Ordering::Relaxed);
    })
}

/// What the writing thread owns.
struct Work {
    folder: PathBuf,
    header: RecordingHeader,
    vehicle: Vehicle,
    part_bytes_max: u64,
    bytes_max: u64,
    descriptors: Descriptors,
    maps: HeldMaps,
    soil: SoilEpochs,
    next_index: u64,
    /// Commands that are handed over and not yet known to be in the file.
    unflushed: u64,
    /// Bytes of the parts before the present one.
    finished_bytes: u64,
    part_number: u32,
    shared: Arc<Shared>,
}

impl Work {
    /// The thread: writes until the engine is gone.
    fn run(mut self, part: Part, receiver: &Receiver<Item>) {
        let mut part = Some(part);
        let mut flushed = Instant::now();
        loop {
            let item = match receiver.recv_timeout(FLUSH_EVERY) {
                Ok(item) => Some(item),
                Err(RecvTimeoutError::Timeout) => None,
                Err(RecvTimeoutError::Disconnected) => break,
            };
            let weight = item.as_ref().map_or(0, |item| item.weight);
            let result = self.turn(part.take(), item, &mut flushed);
            self.shared.waiting_bytes.fetch_sub(weight, Ordering::Relaxed);
            part = result.unwrap_or_else(|error| {
                tracing::error!(%error, "recording ended; what was written until now can be replayed");
                self.shared.dropped.fetch_add(std::mem::take(&mut self.unflushed), Ordering::Relaxed);
                self.end();
                None
            });
        }
        match part.map(|part| part.finish("stopped", self.dropped())) {
            Some(Err(error)) => {
                tracing::error!(%error, "recording not finished; it can be replayed as far as it goes");
                self.shared.dropped.fetch_add(self.unflushed, Ordering::Relaxed);
            }
            _ => self.flushed(),
        }
    }

    /// Nothing is written any more.
    fn end(&self) {
        let _ = self.shared.ended.set(unix_ns());
    }

    fn dropped(&self) -> u64 {
        self.shared.dropped.load(Ordering::Relaxed)
    }

    /// Writes one command, or only flushes; gives the part to go on with, `None` after the end.
    fn turn(&mut self, part: Option<Part>, item: Option<Item>, flushed: &mut Instant) -> Result<Option<Part>, RecordingError> {
        let Some(mut part) = part else {
            if item.is_some() {
                self.shared.dropped.fetch_add(1, Ordering::Relaxed);
            }
            return Ok(None);
        };
        if let Some(item) = item {
            self.write(&mut part, item)?;
        }
        self.shared.bytes.store(self.finished_bytes + part.bytes(), Ordering::Relaxed);
        if flushed.elapsed() >= FLUSH_EVERY {
            part.flush()?;
            self.flushed();
            *flushed = Instant::now();
        }
        if self.finished_bytes + part.bytes() >= self.bytes_max {
            part.finish("recording.bytes_max is reached", self.dropped())?;
            self.flushed();
            tracing::error!(bytes_max = self.bytes_max, "recording ended: `recording.bytes_max` is reached");
            self.end();
            return Ok(None);
        }
        if part.bytes() >= self.part_bytes_max {
            self.finished_bytes += part.bytes();
            self.part_number += 1;
            part.finish("continued in the next part", self.dropped())?;
            self.flushed();
            let next = Part::create(&self.folder, &self.header, self.part_number)?;
            note_part(&self.shared, next.path());
            return Ok(Some(next));
        }
        Ok(Some(part))
    }

    fn write(&mut self, part: &mut Part, item: Item) -> Result<(), RecordingError> {
        let Item { index, executed, .. } = item;
        if index != self.next_index {
            let lost = index - self.next_index;
            tracing::error!(lost, "the disk cannot follow: commands are missing in the recording, replay will stop there");
        }
        self.next_index = index + 1;
        let Ok(sequence) = u32::try_from(index) else {
            return Err(RecordingError::unusable(part.path(), "holds as many commands as a recording can count"));
        };
        let time_ns = self.header.clock_zero_unix_ns.saturating_add(executed.now_ns);
        let timing = Timing { queue_s: executed.queued_ns as f64 * 1e-9, compute_s: executed.busy_ns as f64 * 1e-9 };
        let asked = to_entries(&executed.command, &self.maps);
        let answer = to_entry(&executed.command, &executed.result, &self.vehicle, timing);
        let soil = self.soil.changed(&executed);
        self.maps.follow(&executed.command, &executed.result);
        for entry in asked.iter().chain(&soil).chain([&answer]) {
            part.write(&self.descriptors, sequence, time_ns, entry)?;
        }
        self.unflushed += 1;
        Ok(())
    }

    /// What was handed over is in the file.
    fn flushed(&mut self) {
        self.shared.recorded.fetch_add(std::mem::take(&mut self.unflushed), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn executed() -> Executed {
        Executed { now_ns: 0, command: Command::List, result: Ok(Reply::Done), queued_ns: 0, busy_ns: 0 }
    }

    /// The tap never waits: with nobody at the other end it takes what fits, counts the rest, and goes on when there is room again.
    #[test]
    fn property_what_does_not_fit_is_dropped_and_counted() {
        for (capacity, bytes_max, fits) in [(64, 3 * COMMAND_BYTES, 3), (4, u64::MAX, 4), (64, 1, 1)] {
            let (sender, receiver) = sync_channel(capacity);
            let shared = Arc::new(Shared::default());
            let mut tap = tap(sender, Arc::clone(&shared), bytes_max);
            (0..10).for_each(|_| tap(executed()));
            let items: Vec<Item> = receiver.try_iter().collect();
            assert_eq!(items.iter().map(|item| item.index).collect::<Vec<_>>(), (1..=fits).collect::<Vec<_>>());
            assert_eq!(shared.dropped.load(Ordering::Relaxed), 10 - fits);
            shared.waiting_bytes.fetch_sub(items.iter().map(|item| item.weight).sum(), Ordering::Relaxed);
            tap(executed());
            assert_eq!(receiver.try_iter().map(|item| item.index).collect::<Vec<_>>(), [11], "numbers have no holes of their own");
            shared.ended.set(1).unwrap();
            tap(executed());
            assert_eq!((receiver.try_iter().count(), shared.dropped.load(Ordering::Relaxed)), (0, 11 - fits));
        }
    }
}
