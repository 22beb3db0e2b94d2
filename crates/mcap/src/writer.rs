//! Writing a file.

use std::collections::BTreeMap;
use std::io::{self, Write};

use crate::record::{Fields, MAGIC, kind};

/// Size from which a chunk is ended, bytes.
const CHUNK_BYTES: usize = 1 << 20;

/// Places of the messages of one chunk: (time, offset in the chunk) for each channel.
type MessageIndex = BTreeMap<u16, Vec<(u64, u64)>>;

/// The chunk that is being filled, in memory until it is whole.
#[derive(Debug, Default)]
struct Chunk {
    records: Vec<u8>,
    messages: MessageIndex,
    /// First and last time, ns.
    span_ns: Option<(u64, u64)>,
}

/// A file that is being written. Dropping it leaves a file without index, which [`crate::Reader`] reads.
#[derive(Debug)]
pub struct Writer<W: Write> {
    out: W,
    /// Bytes given to `out`.
    position: u64,
    chunk: Chunk,
    chunks: u32,
    /// Records that the summary repeats or that index the file, in the order of the summary.
    schemas: Vec<Vec<u8>>,
    channels: Vec<Vec<u8>>,
    chunk_indexes: Vec<Vec<u8>>,
    metadata_indexes: Vec<Vec<u8>>,
    messages: BTreeMap<u16, u64>,
    span_ns: Option<(u64, u64)>,
}

fn widen(span: &mut Option<(u64, u64)>, time_ns: u64) {
    *span = Some(span.map_or((time_ns, time_ns), |(first, last)| (first.min(time_ns), last.max(time_ns))));
}

impl<W: Write> Writer<W> {
    /// Begins a file. `profile` says what its messages are about, `library` what wrote it.
    ///
    /// # Errors
    /// What `out` says, as all functions below.
    pub fn create(out: W, profile: &str, library: &str) -> io::Result<Self> {
        let mut writer = Self {
            out,
            position: 0,
            chunk: Chunk::default(),
            chunks: 0,
            schemas: Vec::new(),
            channels: Vec::new(),
            chunk_indexes: Vec::new(),
            metadata_indexes: Vec::new(),
            messages: BTreeMap::new(),
            span_ns: None,
        };
        writer.put(&MAGIC)?;
        writer.put(&Fields::default().text(profile).text(library).record(kind::HEADER))?;
        Ok(writer)
    }

    /// Adds a type of messages and gives its number.
    ///
    /// # Errors
    /// `InvalidInput` when the file can hold no more of them.
    pub fn add_schema(&mut self, name: &str, encoding: &str, data: &[u8]) -> io::Result<u16> {
        let id = next_id(self.schemas.len() + 1)?;
        let record = Fields::default().u16(id).text(name).text(encoding).sized(data).record(kind::SCHEMA);
        self.chunk.records.extend(&record);
        self.schemas.push(record);
        Ok(id)
    }

    /// Adds a stream of messages and gives its number.
    ///
    /// # Errors
    /// `InvalidInput` when the file can hold no more of them.
    pub fn add_channel(&mut self, schema_id: u16, topic: &str, message_encoding: &str) -> io::Result<u16> {
        let id = next_id(self.channels.len())?;
        let fields = Fields::default().u16(id).u16(schema_id).text(topic).text(message_encoding).texts(&BTreeMap::new());
        let record = fields.record(kind::CHANNEL);
        self.chunk.records.extend(&record);
        self.channels.push(record);
        self.messages.insert(id, 0);
        Ok(id)
    }

    /// Writes a message of a channel; `time_ns` is its Unix time.
    ///
    /// # Errors
    /// `InvalidInput` for a channel that was not added.
    pub fn write(&mut self, channel_id: u16, sequence: u32, time_ns: u64, data: &[u8]) -> io::Result<()> {
        let Some(count) = self.messages.get_mut(&channel_id) else {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, format!("channel {channel_id} was not added")));
        };
        *count += 1;
        widen(&mut self.span_ns, time_ns);
        widen(&mut self.chunk.span_ns, time_ns);
        let at = self.chunk.records.len() as u64;
        self.chunk.messages.entry(channel_id).or_default().push((time_ns, at));
        let head = Fields::default().u16(channel_id).u32(sequence).u64(time_ns).u64(time_ns).0;
        self.chunk.records.push(kind::MESSAGE);
        self.chunk.records.extend(((head.len() + data.len()) as u64).to_le_bytes());
        self.chunk.records.extend(head);
        self.chunk.records.extend(data);
        if self.chunk.records.len() >= CHUNK_BYTES {
            self.end_chunk()?;
        }
        Ok(())
    }

    /// Writes named texts.
    ///
    /// # Errors
    /// What `out` says.
    pub fn write_metadata(&mut self, name: &str, texts: &BTreeMap<String, String>) -> io::Result<()> {
        self.end_chunk()?;
        let record = Fields::default().text(name).texts(texts).record(kind::METADATA);
        let index = Fields::default().u64(self.position).u64(record.len() as u64).text(name);
        self.metadata_indexes.push(index.record(kind::METADATA_INDEX));
        self.put(&record)
    }

    /// Ends the chunk and hands everything to the system: from here on a crash of the program loses nothing of it.
    ///
    /// # Errors
    /// What `out` says.
    pub fn flush(&mut self) -> io::Result<()> {
        self.end_chunk()?;
        self.out.flush()
    }

    /// Writes index and footer, and gives `out` back.
    ///
    /// # Errors
    /// What `out` says.
    pub fn finish(mut self) -> io::Result<W> {
        self.end_chunk()?;
        // 0: the data section has no checksum of its own, its chunks have.
        self.put(&Fields::default().u32(0).record(kind::DATA_END))?;
        let (first, last) = self.span_ns.unwrap_or((0, 0));
        let statistics = Fields::default()
            .u64(self.messages.values().sum())
            .u16(next_id(self.schemas.len())?)
            .u32(self.channels.len() as u32)
            .u32(0)
            .u32(self.metadata_indexes.len() as u32)
            .u32(self.chunks)
            .u64(first)
            .u64(last)
            .sized(&self.messages.iter().fold(Fields::default(), |fields, (id, count)| fields.u16(*id).u64(*count)).0)
            .record(kind::STATISTICS);
        let groups = [
            (kind::SCHEMA, std::mem::take(&mut self.schemas)),
            (kind::CHANNEL, std::mem::take(&mut self.channels)),
            (kind::STATISTICS, vec![statistics]),
            (kind::CHUNK_INDEX, std::mem::take(&mut self.chunk_indexes)),
            (kind::METADATA_INDEX, std::mem::take(&mut self.metadata_indexes)),
        ];
        let start = self.position;
        let (mut summary, mut offsets) = (Vec::new(), Vec::new());
        for (group, records) in groups.into_iter().filter(|(_, records)| !records.is_empty()) {
            let from = start + summary.len() as u64;
            records.iter().for_each(|record| summary.extend(record));
            let length = start + summary.len() as u64 - from;
            offsets.extend(Fields::default().u8(group).u64(from).u64(length).record(kind::SUMMARY_OFFSET));
        }
        let offsets_start = start + summary.len() as u64;
        summary.extend(offsets);
        // The checksum covers the summary and the footer up to the checksum itself.
        let mut footer = Fields::default().u64(start).u64(offsets_start).u32(0).record(kind::FOOTER);
        let crc_at = footer.len() - 4;
        summary.extend(&footer[..crc_at]);
        footer.splice(crc_at.., crc32fast::hash(&summary).to_le_bytes());
        summary.extend(&footer[crc_at..]);
        self.put(&summary)?;
        self.put(&MAGIC)?;
        self.out.flush()?;
        Ok(self.out)
    }

    fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.out.write_all(bytes)?;
        self.position += bytes.len() as u64;
        Ok(())
    }

    /// Writes the chunk in one piece, then where its messages are.
    fn end_chunk(&mut self) -> io::Result<()> {
        let Chunk { records, messages, span_ns } = std::mem::take(&mut self.chunk);
        if records.is_empty() {
            return Ok(());
        }
        let ((first, last), size) = (span_ns.unwrap_or((0, 0)), records.len() as u64);
        let head = Fields::default().u64(first).u64(last).u64(size).u32(crc32fast::hash(&records)).text("").u64(size);
        let at = self.position;
        let mut record = Fields(head.0);
        record.0.extend(&records);
        let record = record.record(kind::CHUNK);
        self.put(&record)?;
        self.chunks += 1;
        let index_start = self.position;
        let mut places = Fields::default();
        for (channel, entries) in &messages {
            places = places.u16(*channel).u64(self.position);
            let entries = entries.iter().fold(Fields::default(), |fields, (time_ns, offset)| fields.u64(*time_ns).u64(*offset));
            let index = Fields::default().u16(*channel).sized(&entries.0).record(kind::MESSAGE_INDEX);
            self.put(&index)?;
        }
        let index = Fields::default().u64(first).u64(last).u64(at).u64(record.len() as u64).sized(&places.0);
        let index = index.u64(self.position - index_start).text("").u64(size).u64(size);
        self.chunk_indexes.push(index.record(kind::CHUNK_INDEX));
        Ok(())
    }
}

fn next_id(number: usize) -> io::Result<u16> {
    u16::try_from(number).map_err(|_| io::Error::new(io::ErrorKind::InvalidInput, "more schemas or channels than a file can hold"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The layout of mcap.dev/spec, byte by byte, for a file with one metadata record and nothing else.
    #[test]
    fn published_layout_of_a_small_file() {
        let mut writer = Writer::create(Vec::new(), "p", "lib").unwrap();
        writer.write_metadata("m", &BTreeMap::from([("k".to_string(), "v".to_string())])).unwrap();
        let bytes = writer.finish().unwrap();
        let metadata = [&[0x0c][..], &19u64.to_le_bytes(), &[1, 0, 0, 0, b'm', 10, 0, 0, 0, 1, 0, 0, 0, b'k', 1, 0, 0, 0, b'v']].concat();
        let header = [&[0x01][..], &12u64.to_le_bytes(), &[1, 0, 0, 0, b'p', 3, 0, 0, 0, b'l', b'i', b'b']].concat();
        let data_end = [&[0x0f][..], &4u64.to_le_bytes(), &[0; 4]].concat();
        let data = [&MAGIC[..], &header, &metadata, &data_end].concat();
        assert_eq!(&bytes[..data.len()], &data);
        let start = data.len() as u64;
        let statistics = [&[0x0b][..], &46u64.to_le_bytes(), &[0; 8 + 2 + 4 + 4], &[1, 0, 0, 0], &[0; 4 + 8 + 8 + 4]].concat();
        let at = (MAGIC.len() + header.len()) as u64;
        let index =
            [&[0x0d][..], &21u64.to_le_bytes(), &at.to_le_bytes(), &(metadata.len() as u64).to_le_bytes(), &[1, 0, 0, 0, b'm']].concat();
        let offset = |group: u8, from: u64, length: usize| {
            [&[0x0e, 17, 0, 0, 0, 0, 0, 0, 0, group][..], &from.to_le_bytes(), &(length as u64).to_le_bytes()].concat()
        };
        let second = start + statistics.len() as u64;
        let offsets = [offset(0x0b, start, statistics.len()), offset(0x0d, second, index.len())].concat();
        let offsets_start = second + index.len() as u64;
        let footer = [&[0x02][..], &20u64.to_le_bytes(), &start.to_le_bytes(), &offsets_start.to_le_bytes()].concat();
        let summary = [statistics, index, offsets, footer].concat();
        let end = [&summary[..], &crc32fast::hash(&summary).to_le_bytes(), &MAGIC].concat();
        assert_eq!(&bytes[data.len()..], &end);
    }
}
