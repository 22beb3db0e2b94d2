//! Records: one byte of kind, eight of length, then fields in little-endian order; texts, maps and arrays begin with their size in four bytes.

use std::collections::BTreeMap;

/// First and last bytes of a file.
pub const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];

/// Kinds of records.
pub(crate) mod kind {
    pub const HEADER: u8 = 0x01;
    pub const FOOTER: u8 = 0x02;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const MESSAGE_INDEX: u8 = 0x07;
    pub const CHUNK_INDEX: u8 = 0x08;
    pub const STATISTICS: u8 = 0x0b;
    pub const METADATA: u8 = 0x0c;
    pub const METADATA_INDEX: u8 = 0x0d;
    pub const SUMMARY_OFFSET: u8 = 0x0e;
    pub const DATA_END: u8 = 0x0f;
}

/// A record that a reader gives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Record {
    /// Type of messages.
    Schema {
        /// Number within the file.
        id: u16,
        /// Name of the type.
        name: String,
        /// How `data` describes it, for instance `protobuf`.
        encoding: String,
        /// The description.
        data: Vec<u8>,
    },
    /// A stream of messages of one type.
    Channel {
        /// Number within the file.
        id: u16,
        /// Number of the schema, 0 = none.
        schema_id: u16,
        /// Topic.
        topic: String,
        /// How messages are encoded, for instance `protobuf`.
        message_encoding: String,
    },
    /// A message.
    Message {
        /// Number of its channel.
        channel_id: u16,
        /// Number that the writer gave it.
        sequence: u32,
        /// Time at which it was recorded, ns.
        log_time_ns: u64,
        /// The encoded message.
        data: Vec<u8>,
    },
    /// Named texts.
    Metadata {
        /// Name of the record.
        name: String,
        /// Texts by name.
        texts: BTreeMap<String, String>,
    },
    /// The messages end here; what follows repeats and indexes them.
    DataEnd,
    /// The file ends here.
    Footer,
}

/// Fields of a record that is written.
#[derive(Debug, Default)]
pub(crate) struct Fields(pub Vec<u8>);

impl Fields {
    pub fn u8(mut self, value: u8) -> Self {
        self.0.push(value);
        self
    }

    pub fn u16(mut self, value: u16) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    pub fn u32(mut self, value: u32) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    pub fn u64(mut self, value: u64) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    /// A size in four bytes, then the bytes.
    pub fn sized(self, bytes: &[u8]) -> Self {
        let mut sized = self.u32(u32::try_from(bytes.len()).unwrap_or(u32::MAX));
        sized.0.extend(bytes);
        sized
    }

    pub fn text(self, text: &str) -> Self {
        self.sized(text.as_bytes())
    }

    pub fn texts(self, texts: &BTreeMap<String, String>) -> Self {
        let inner = texts.iter().fold(Self::default(), |fields, (key, value)| fields.text(key).text(value));
        self.sized(&inner.0)
    }

    /// The record of these fields.
    pub fn record(self, kind: u8) -> Vec<u8> {
        let mut record = Vec::with_capacity(9 + self.0.len());
        record.push(kind);
        record.extend((self.0.len() as u64).to_le_bytes());
        record.extend(self.0);
        record
    }
}

/// Fields of a record that is read; every step fails where the record is too short.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cursor<'a>(pub &'a [u8]);

impl<'a> Cursor<'a> {
    pub fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(taken)
    }

    pub fn u8(&mut self) -> Option<u8> {
        self.take(1)?.first().copied()
    }

    pub fn u16(&mut self) -> Option<u16> {
        self.take(2)?.try_into().ok().map(u16::from_le_bytes)
    }

    pub fn u32(&mut self) -> Option<u32> {
        self.take(4)?.try_into().ok().map(u32::from_le_bytes)
    }

    pub fn u64(&mut self) -> Option<u64> {
        self.take(8)?.try_into().ok().map(u64::from_le_bytes)
    }

    pub fn sized(&mut self) -> Option<&'a [u8]> {
        let size = usize::try_from(self.u32()?).ok()?;
        self.take(size)
    }

    pub fn text(&mut self) -> Option<String> {
        String::from_utf8(self.sized()?.to_vec()).ok()
    }

    pub fn texts(&mut self) -> Option<BTreeMap<String, String>> {
        let mut inner = Self(self.sized()?);
        let mut texts = BTreeMap::new();
        while !inner.0.is_empty() {
            texts.insert(inner.text()?, inner.text()?);
        }
        Some(texts)
    }
}

impl Record {
    /// The record of a kind with these fields: `Some(None)` for a kind that no reader needs, `None` for fields that do not fit.
    pub(crate) fn parse(record_kind: u8, fields: &[u8]) -> Option<Option<Self>> {
        let mut cursor = Cursor(fields);
        Some(Some(match record_kind {
            kind::SCHEMA => {
                Self::Schema { id: cursor.u16()?, name: cursor.text()?, encoding: cursor.text()?, data: cursor.sized()?.to_vec() }
            }
            kind::CHANNEL => {
                Self::Channel { id: cursor.u16()?, schema_id: cursor.u16()?, topic: cursor.text()?, message_encoding: cursor.text()? }
            }
            kind::MESSAGE => {
                let (channel_id, sequence, log_time_ns) = (cursor.u16()?, cursor.u32()?, cursor.u64()?);
                cursor.u64()?; // publish time
                Self::Message { channel_id, sequence, log_time_ns, data: cursor.0.to_vec() }
            }
            kind::METADATA => Self::Metadata { name: cursor.text()?, texts: cursor.texts()? },
            kind::DATA_END => Self::DataEnd,
            kind::FOOTER => Self::Footer,
            _ => return Some(None),
        }))
    }
}
