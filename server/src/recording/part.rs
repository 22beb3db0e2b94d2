//! One MCAP file that is being written.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use nesam_mcap::Writer;

use super::command::Entry;
use super::error::RecordingError;
use super::header::{END, HEADER, RecordingHeader};
use super::schema::Descriptors;
use super::topic::Topic;

/// What a message takes beside its payload, bytes.
const MESSAGE_OVERHEAD: u64 = 31 + 16;

/// A part of a recording.
pub(crate) struct Part {
    path: PathBuf,
    writer: Writer<BufWriter<File>>,
    channels: BTreeMap<Topic, u16>,
    bytes: u64,
    dirty: bool,
}

impl Part {
    /// Makes the file and writes the description of the run.
    ///
    /// # Errors
    /// `RecordingError::File` when the file cannot be made, `Write` when it cannot be written.
    pub fn create(folder: &Path, header: &RecordingHeader, number: u32) -> Result<Self, RecordingError> {
        let path = folder.join(format!("{}.{number:04}.mcap", header.run));
        let file = File::create_new(&path).map_err(|source| RecordingError::file(&path, source))?;
        let writer = Writer::create(BufWriter::new(file), "nesam", &header.program).map_err(|error| wrong(&path, error))?;
        let mut part = Self { path, writer, channels: BTreeMap::new(), bytes: 0, dirty: true };
        part.metadata(HEADER, header.to_metadata(number))?;
        part.flush()?;
        Ok(part)
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes written so far, about.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    fn metadata(&mut self, name: &str, metadata: BTreeMap<String, String>) -> Result<(), RecordingError> {
        self.writer.write_metadata(name, &metadata).map_err(|error| wrong(&self.path, error))
    }

    /// Writes one message; `time_ns` is Unix time.
    pub fn write(&mut self, descriptors: &Descriptors, sequence: u32, time_ns: u64, (topic, data): &Entry) -> Result<(), RecordingError> {
        let channel = match self.channels.get(topic) {
            Some(id) => *id,
            None => self.add_channel(descriptors, *topic).map_err(|error| wrong(&self.path, error))?,
        };
        self.writer.write(channel, sequence, time_ns, data).map_err(|error| wrong(&self.path, error))?;
        self.bytes += data.len() as u64 + MESSAGE_OVERHEAD;
        self.dirty = true;
        Ok(())
    }

    fn add_channel(&mut self, descriptors: &Descriptors, topic: Topic) -> io::Result<u16> {
        let schema = descriptors.schema_of(topic.message());
        let schema_id = self.writer.add_schema(topic.message(), "protobuf", &schema)?;
        let id = self.writer.add_channel(schema_id, topic.name(), "protobuf")?;
        self.channels.insert(topic, id);
        self.bytes += schema.len() as u64;
        Ok(id)
    }

    /// Puts what was written where a crash of this program does not lose it.
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        if std::mem::take(&mut self.dirty) {
            self.writer.flush().map_err(|error| wrong(&self.path, error))?;
        }
        Ok(())
    }

    /// Writes why the part ends, the index and the footer.
    pub fn finish(mut self, reason: &str, dropped: u64) -> Result<(), RecordingError> {
        let metadata = [("reason", reason.to_string()), ("dropped_commands", dropped.to_string())];
        self.metadata(END, metadata.into_iter().map(|(key, value)| (key.to_string(), value)).collect())?;
        let Self { path, writer, .. } = self;
        let out = writer.finish().map_err(|error| wrong(&path, error))?;
        let file = out.into_inner().map_err(|error| wrong(&path, error.into_error()))?;
        file.sync_all().map_err(|error| wrong(&path, error))
    }
}

fn wrong(path: &Path, source: io::Error) -> RecordingError {
    RecordingError::file(path, source)
}
