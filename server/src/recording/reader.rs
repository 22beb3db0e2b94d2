//! Reading a recording back, part by part and command by command, as far as it goes.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use nesam_mcap::{ReadError, Reader, Record};

use super::command::Entry;
use super::error::RecordingError;
use super::header::{END, HEADER, RecordingHeader};
use super::topic::{Role, Topic};

/// A command as it was recorded.
#[derive(Clone, Debug)]
pub struct RecordedCommand {
    /// Counts the commands of the run from 1.
    pub index: u64,
    /// Instant of the engine's clock, ns.
    pub now_ns: u64,
    /// Messages that ask for it.
    pub(crate) asked: Vec<Entry>,
    /// Message that answers it.
    pub(crate) answer: Entry,
}

/// How a recording ends.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case", tag = "kind")]
pub enum Ending {
    /// It was finished.
    Finished {
        /// Why, as the recorder said.
        reason: String,
        /// Commands that the disk could not follow.
        dropped_commands: u64,
    },
    /// It was not finished: the server was killed, or the file was cut off.
    CutOff,
    /// Its bytes were changed on the way.
    Damaged {
        /// What is wrong.
        reason: String,
    },
    /// Commands are missing in the middle.
    Missing {
        /// How many.
        commands: u64,
        /// Index of the first of them.
        first: u64,
    },
}

/// Parts by their number.
type Parts = BTreeMap<u32, (PathBuf, RecordingHeader)>;

/// The parts of a recording.
#[derive(Debug)]
pub struct Recording {
    header: RecordingHeader,
    parts: VecDeque<PathBuf>,
    /// The part that is read.
    open: Option<OpenPart>,
    next_index: u64,
    ending: Option<Ending>,
}

impl Recording {
    /// Opens the parts of a recording: files, or a folder with the parts of one recording.
    ///
    /// # Errors
    /// As [`Recording::open_all`], and `RecordingError::Parts` where there are two recordings.
    pub fn open(paths: &[PathBuf]) -> Result<Self, RecordingError> {
        let mut recordings = Self::open_all(paths)?;
        if let [.., before, last] = &recordings[..] {
            let reason = format!("{} and {} are two recordings; give one at a time", before.header.run, last.header.run);
            return Err(RecordingError::Parts { reason });
        }
        Ok(recordings.pop().expect("there is at least one recording; this is a bug"))
    }

    /// Opens all recordings whose parts are among the files and in the folders, at least one: each time a server starts it begins another one. The oldest comes
    /// first.
    ///
    /// # Errors
    /// `RecordingError` naming the file that is no recording or was written by a program of another layout, or the part that is missing.
    pub fn open_all(paths: &[PathBuf]) -> Result<Vec<Self>, RecordingError> {
        let mut runs: BTreeMap<(u64, String), Parts> = BTreeMap::new();
        for path in files(paths)? {
            let (header, number) = OpenPart::open(&path)?.description()?;
            let run = (header.clock_zero_unix_ns, header.run.clone());
            runs.entry(run).or_default().insert(number, (path, header));
        }
        if runs.is_empty() {
            return Err(RecordingError::Parts { reason: "no file was given".into() });
        }
        runs.into_values().map(Self::of_parts).collect()
    }

    /// The recording of these parts, of which there is one.
    fn of_parts(parts: Parts) -> Result<Self, RecordingError> {
        let missing = (1..).zip(parts.keys()).find(|(expected, number)| expected != *number).map(|(expected, _)| expected);
        let (first, header) = parts.values().next().cloned().expect("a run is known by a part of it; this is a bug");
        if let Some(missing) = missing {
            let reason =
                format!("part {missing} of recording {} is missing beside {}; a replay begins with part 1", header.run, first.display());
            return Err(RecordingError::Parts { reason });
        }
        let parts = parts.into_values().map(|(path, _)| path).collect();
        Ok(Self { header, parts, open: None, next_index: 1, ending: None })
    }

    /// What ran.
    pub fn header(&self) -> &RecordingHeader {
        &self.header
    }

    /// Its files that are not read yet, the first part first.
    pub fn files(&self) -> Vec<PathBuf> {
        self.parts.iter().cloned().collect()
    }

    /// How the recording ends; known when no command is left.
    pub fn ending(&self) -> Option<&Ending> {
        self.ending.as_ref()
    }

    /// The next command; `None` at the end, whatever ends it.
    ///
    /// # Errors
    /// `RecordingError::File` when the system refuses to read on, `Unusable` for a message that no recording of this layout has.
    pub fn next_command(&mut self) -> Result<Option<RecordedCommand>, RecordingError> {
        if self.ending.is_some() {
            return Ok(None);
        }
        loop {
            let Some(part) = &mut self.open else {
                let Some(path) = self.parts.pop_front() else { return Ok(None) };
                let mut part = OpenPart::open(&path)?;
                part.description()?;
                self.open = Some(part);
                continue;
            };
            match part.next_group(self.header.clock_zero_unix_ns)? {
                Next::Command(command) if command.index != self.next_index => {
                    let commands = command.index.saturating_sub(self.next_index);
                    self.ending = Some(Ending::Missing { commands, first: self.next_index });
                    return Ok(None);
                }
                Next::Command(command) => {
                    self.next_index += 1;
                    return Ok(Some(command));
                }
                Next::End(Ending::Finished { .. }) if !self.parts.is_empty() => self.open = None,
                Next::End(ending) => {
                    self.ending = Some(ending);
                    return Ok(None);
                }
            }
        }
    }
}

/// The files among the given paths and in the given folders.
fn files(paths: &[PathBuf]) -> Result<Vec<PathBuf>, RecordingError> {
    let mut files = Vec::new();
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let entries = std::fs::read_dir(path).map_err(|source| RecordingError::file(path, source))?;
        let inside = entries.filter_map(Result::ok).map(|entry| entry.path());
        let before = files.len();
        files.extend(inside.filter(|path| path.extension().is_some_and(|extension| extension == "mcap")));
        if files.len() == before {
            return Err(RecordingError::unusable(path, "has no .mcap file"));
        }
    }
    files.sort();
    Ok(files)
}

/// A part that is being read.
#[derive(Debug)]
struct OpenPart {
    path: PathBuf,
    reader: Reader<BufReader<File>>,
    channels: BTreeMap<u16, Topic>,
    /// The recorder's word at the end.
    finished: Option<Ending>,
}

/// A record that matters here.
enum Piece {
    Metadata(String, BTreeMap<String, String>),
    Message {
        topic: Topic,
        sequence: u32,
        time_ns: u64,
        data: Vec<u8>,
    },
    /// A message on a topic of somebody else.
    Unknown {
        sequence: u32,
    },
    Other,
}

/// What comes next in a part.
enum Next {
    Command(RecordedCommand),
    End(Ending),
}

impl OpenPart {
    fn open(path: &Path) -> Result<Self, RecordingError> {
        let file = File::open(path).map_err(|source| RecordingError::file(path, source))?;
        Ok(Self { path: path.into(), reader: Reader::new(BufReader::new(file)), channels: BTreeMap::new(), finished: None })
    }

    /// Reads up to the description of the run.
    fn description(&mut self) -> Result<(RecordingHeader, u32), RecordingError> {
        let no_recording = "is an MCAP file, but no recording of nesam; give one that `nesam serve --record DIR` wrote";
        loop {
            match self.piece()? {
                Ok(Some(Piece::Metadata(name, texts))) if name == HEADER => return RecordingHeader::of_metadata(&self.path, &texts),
                Ok(Some(Piece::Message { .. } | Piece::Unknown { .. }) | None) => {
                    return Err(RecordingError::unusable(&self.path, no_recording));
                }
                Ok(Some(_)) => {}
                Err(Ending::CutOff) => {
                    return Err(RecordingError::unusable(&self.path, "ends before it says what ran; nothing of it can be replayed"));
                }
                Err(Ending::Damaged { reason }) => return Err(RecordingError::unusable(&self.path, format!("is damaged: {reason}"))),
                Err(_) => return Err(RecordingError::unusable(&self.path, no_recording)),
            }
        }
    }

    /// The next piece: an error of the system outside, what is wrong with the file inside.
    fn piece(&mut self) -> Result<Result<Option<Piece>, Ending>, RecordingError> {
        let record = match self.reader.next_record() {
            Ok(Some(record)) => record,
            Ok(None) => return Ok(Ok(None)),
            Err(ReadError::Io(source)) => return Err(RecordingError::file(&self.path, source)),
            Err(ReadError::NotMcap) => return Err(RecordingError::NotMcap { path: self.path.clone() }),
            Err(ReadError::CutOff) => return Ok(Err(Ending::CutOff)),
            Err(error @ ReadError::Damaged { .. }) => return Ok(Err(Ending::Damaged { reason: error.to_string() })),
        };
        Ok(Ok(Some(match record {
            Record::Metadata { name, texts } => Piece::Metadata(name, texts),
            Record::Channel { id, topic, .. } => {
                // A file of somebody else has other topics; whether it is a recording at all is decided by its description.
                if let Some(topic) = Topic::of_name(&topic) {
                    self.channels.insert(id, topic);
                }
                Piece::Other
            }
            Record::Message { channel_id, sequence, log_time_ns: time_ns, data } => match self.channels.get(&channel_id) {
                Some(topic) => Piece::Message { topic: *topic, sequence, time_ns, data },
                None => Piece::Unknown { sequence },
            },
            Record::Schema { .. } | Record::DataEnd | Record::Footer => Piece::Other,
        })))
    }

    /// Gathers the messages of one command.
    fn next_group(&mut self, clock_zero_unix_ns: u64) -> Result<Next, RecordingError> {
        let mut asked: Vec<Entry> = Vec::new();
        let mut of = None;
        loop {
            let (topic, sequence, time_ns, data) = match self.piece()? {
                Ok(Some(Piece::Message { topic, sequence, time_ns, data })) => (topic, sequence, time_ns, data),
                Ok(Some(Piece::Metadata(name, texts))) if name == END => {
                    let text = |key: &str| texts.get(key).cloned().unwrap_or_default();
                    let dropped_commands = text("dropped_commands").parse().unwrap_or(0);
                    self.finished = Some(Ending::Finished { reason: text("reason"), dropped_commands });
                    continue;
                }
                Ok(Some(Piece::Unknown { sequence })) => {
                    let reason = format!("message {sequence} is on a topic that this program does not know");
                    return Ok(Next::End(Ending::Damaged { reason }));
                }
                Ok(Some(_)) => continue,
                Ok(None) | Err(Ending::CutOff) => return Ok(Next::End(self.finished.take().unwrap_or(Ending::CutOff))),
                Err(ending) => return Ok(Next::End(ending)),
            };
            if let Some(of) = of.filter(|of| *of != sequence) {
                return Ok(Next::End(Ending::Damaged { reason: format!("command {of} has no answer") }));
            }
            match topic.role() {
                Role::View => {}
                Role::Request => {
                    of = Some(sequence);
                    asked.push((topic, data));
                }
                Role::Answer => {
                    let now_ns = time_ns.saturating_sub(clock_zero_unix_ns);
                    return Ok(Next::Command(RecordedCommand { index: u64::from(sequence), now_ns, asked, answer: (topic, data) }));
                }
            }
        }
    }
}
