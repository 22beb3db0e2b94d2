//! Reading a file from the front.

use std::io::{self, Read};

use crate::record::{Cursor, MAGIC, Record, kind};

/// Largest record that is read, bytes.
const RECORD_BYTES_MAX: u64 = 256 << 20;

/// Why there is no further record.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The system refused to read on.
    #[error("{0}")]
    Io(#[from] io::Error),
    /// The first bytes are not those of an MCAP file.
    #[error("not an MCAP file")]
    NotMcap,
    /// The file ends before its footer: it was not finished, or it was cut off.
    #[error("the file ends before its footer")]
    CutOff,
    /// The bytes contradict themselves.
    #[error("at byte {at}: {reason}")]
    Damaged {
        /// Where the record begins.
        at: u64,
        /// What is wrong.
        reason: String,
    },
}

/// A file that is being read, record by record; chunks are opened.
#[derive(Debug)]
pub struct Reader<R: Read> {
    input: R,
    /// Bytes read.
    position: u64,
    begun: bool,
    ended: bool,
    /// Records of the present chunk and the place of the next one.
    chunk: Vec<u8>,
    next: usize,
}

impl<R: Read> Reader<R> {
    /// A reader at the front of a file.
    pub fn new(input: R) -> Self {
        Self { input, position: 0, begun: false, ended: false, chunk: Vec::new(), next: 0 }
    }

    /// The next record; `None` after the footer.
    ///
    /// # Errors
    /// See [`ReadError`]; nothing is to be had after one.
    pub fn next_record(&mut self) -> Result<Option<Record>, ReadError> {
        if !self.begun {
            let magic = self.bytes(MAGIC.len() as u64)?;
            self.begun = true;
            if magic.len() < MAGIC.len() && MAGIC.starts_with(&magic) {
                return Err(ReadError::CutOff);
            }
            if magic != MAGIC {
                return Err(ReadError::NotMcap);
            }
        }
        loop {
            if self.ended {
                return Ok(None);
            }
            if self.next < self.chunk.len() {
                match self.in_chunk()? {
                    Some(record) => return Ok(Some(record)),
                    None => continue,
                }
            }
            let at = self.position;
            let damaged = |reason: &str| ReadError::Damaged { at, reason: reason.into() };
            let head = self.bytes(9)?;
            let (Some(record_kind), Some(length)) = (Cursor(&head).u8(), Cursor(head.get(1..).unwrap_or_default()).u64()) else {
                return Err(ReadError::CutOff);
            };
            if length > RECORD_BYTES_MAX {
                return Err(ReadError::Damaged { at, reason: format!("a record of {length} bytes, {RECORD_BYTES_MAX} are read at most") });
            }
            let fields = self.bytes(length)?;
            if (fields.len() as u64) < length {
                return Err(ReadError::CutOff);
            }
            if record_kind == kind::CHUNK {
                (self.chunk, self.next) = (chunk(&fields).map_err(|reason| ReadError::Damaged { at, reason })?, 0);
                continue;
            }
            if let Some(record) = Record::parse(record_kind, &fields).ok_or_else(|| damaged("a record is shorter than its fields"))? {
                self.ended = record == Record::Footer;
                return Ok(Some(record));
            }
        }
    }

    /// Up to `count` bytes, fewer at the end of the file.
    fn bytes(&mut self, count: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.input.by_ref().take(count).read_to_end(&mut bytes)?;
        self.position += bytes.len() as u64;
        Ok(bytes)
    }

    /// The next record of the chunk, `None` for one that no reader needs.
    fn in_chunk(&mut self) -> Result<Option<Record>, ReadError> {
        let mut cursor = Cursor(&self.chunk[self.next..]);
        let parsed = (|| {
            let record_kind = cursor.u8()?;
            let length = usize::try_from(cursor.u64()?).ok()?;
            let record = Record::parse(record_kind, cursor.take(length)?)?;
            Some((record, 9 + length))
        })();
        let at = self.position;
        let (record, size) = parsed.ok_or_else(|| ReadError::Damaged { at, reason: "a chunk ends within a record".into() })?;
        self.next += size;
        Ok(record)
    }
}

/// The records of a chunk whose checksum is right.
fn chunk(fields: &[u8]) -> Result<Vec<u8>, String> {
    let mut cursor = Cursor(fields);
    let parsed = (|| {
        cursor.take(16)?; // first and last time
        let (size, crc, compression) = (cursor.u64()?, cursor.u32()?, cursor.text()?);
        let stored = usize::try_from(cursor.u64()?).ok()?;
        Some((size, crc, compression, cursor.take(stored)?))
    })();
    let (size, crc, compression, records) = parsed.ok_or("a chunk is shorter than its fields")?;
    let records = match compression.as_str() {
        "" => records.to_vec(),
        "zstd" => unpacked(zstd::Decoder::with_buffer(records).map_err(|error| format!("a chunk is no zstd: {error}"))?, size)?,
        "lz4" => unpacked(lz4_flex::frame::FrameDecoder::new(records), size)?,
        other => return Err(format!("a chunk is compressed with {other}, which is not read here; undo it with `mcap decompress`")),
    };
    // 0 stands for "no checksum".
    if size != records.len() as u64 || (crc != 0 && crc != crc32fast::hash(&records)) {
        return Err("the checksum of a chunk is wrong: its bytes were changed".into());
    }
    Ok(records)
}

/// What comes out of a compressed chunk that says that it has `size` bytes; no more than that is taken, whatever the bytes would become.
fn unpacked(compressed: impl Read, size: u64) -> Result<Vec<u8>, String> {
    if size > RECORD_BYTES_MAX {
        return Err(format!("a chunk says that it has {size} bytes, more than the {RECORD_BYTES_MAX} that are read"));
    }
    let mut records = Vec::new();
    compressed.take(size + 1).read_to_end(&mut records).map_err(|error| format!("a compressed chunk is damaged: {error}"))?;
    Ok(records)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::io::Write as _;

    use super::*;
    use crate::Writer;

    fn file() -> Vec<u8> {
        let mut writer = Writer::create(Vec::new(), "test", "test").unwrap();
        writer.write_metadata("first", &BTreeMap::from([("a".into(), "b".into())])).unwrap();
        let schema = writer.add_schema("T", "protobuf", &[1, 2, 3]).unwrap();
        let channels = ["/a", "/b"].map(|topic| writer.add_channel(schema, topic, "protobuf").unwrap());
        for i in 0..100u32 {
            writer.write(channels[i as usize % 2], i, u64::from(i) * 10, &vec![i as u8; 20_000]).unwrap();
        }
        assert!(writer.write(7, 0, 0, &[]).is_err());
        writer.finish().unwrap()
    }

    /// Messages until the end, and what ended it.
    fn read(bytes: &[u8]) -> (Vec<(u16, u32, u64, Vec<u8>)>, Option<ReadError>) {
        let (mut reader, mut messages) = (Reader::new(bytes), Vec::new());
        loop {
            match reader.next_record() {
                Ok(Some(Record::Message { channel_id, sequence, log_time_ns, data })) => {
                    messages.push((channel_id, sequence, log_time_ns, data))
                }
                Ok(Some(_)) => {}
                Ok(None) => return (messages, None),
                Err(error) => return (messages, Some(error)),
            }
        }
    }

    #[test]
    fn property_what_is_written_is_read() {
        let (messages, error) = read(&file());
        assert!(error.is_none(), "{error:?}");
        let expected: Vec<_> = (0..100u32).map(|i| ((i % 2) as u16, i, u64::from(i) * 10, vec![i as u8; 20_000])).collect();
        assert!(messages == expected);
    }

    /// The same file with its chunks compressed; indices behind them are not read.
    fn compressed(bytes: &[u8], compression: &str, pack: impl Fn(&[u8]) -> Vec<u8>) -> Vec<u8> {
        let mut out = MAGIC.to_vec();
        let mut rest = &bytes[MAGIC.len()..bytes.len() - MAGIC.len()];
        while let [record_kind, lengths @ ..] = rest {
            let length = u64::from_le_bytes(lengths[..8].try_into().unwrap()) as usize;
            let fields = &lengths[8..8 + length];
            rest = &lengths[8 + length..];
            let fields = match *record_kind {
                kind::CHUNK => {
                    let packed = pack(&fields[28 + 4 + 8..]);
                    let name = [&(compression.len() as u32).to_le_bytes()[..], compression.as_bytes()].concat();
                    [&fields[..28], &name, &(packed.len() as u64).to_le_bytes(), &packed].concat()
                }
                _ => fields.to_vec(),
            };
            out.push(*record_kind);
            out.extend((fields.len() as u64).to_le_bytes());
            out.extend(fields);
        }
        [&out[..], &MAGIC].concat()
    }

    /// Goal: files of others are often compressed. Method: the same file with each compression, what is damaged or says that it becomes more than it does, and one that
    /// nobody knows.
    #[test]
    fn property_compressed_chunks_are_read() {
        let (plain, zstd) = (file(), |bytes: &[u8]| zstd::encode_all(bytes, 3).unwrap());
        let lz4 = |bytes: &[u8]| {
            let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
            encoder.write_all(bytes).unwrap();
            encoder.finish().unwrap()
        };
        let (all, _) = read(&plain);
        for packed in [compressed(&plain, "zstd", zstd), compressed(&plain, "lz4", lz4)] {
            assert!(packed.len() < plain.len() / 10);
            let (messages, error) = read(&packed);
            assert!(messages == all && error.is_none(), "{error:?}");
        }
        for (bad, why) in [
            (compressed(&plain, "zstd", |bytes| zstd(bytes)[..40].to_vec()), "damaged"),
            (compressed(&plain, "lz4", |_| b"no lz4 at all".to_vec()), "damaged"),
            (compressed(&plain, "zstd", |bytes| zstd(&[bytes, &[0; 9]].concat())), "checksum"),
            (compressed(&plain, "brotli", <[u8]>::to_vec), "brotli, which is not read"),
        ] {
            let (messages, error) = read(&bad);
            assert!(messages.is_empty() && error.as_ref().is_some_and(|error| error.to_string().contains(why)), "{why}: {error:?}");
        }
    }

    #[test]
    fn property_every_prefix_is_read_up_to_whole_chunks() {
        let bytes = file();
        let (all, _) = read(&bytes);
        let mut most = 0;
        for length in (0..bytes.len() - 8).step_by(16_381) {
            let (messages, error) = read(&bytes[..length]);
            assert!(matches!(error, Some(ReadError::CutOff)) || messages.len() == all.len(), "{length}: {error:?}");
            assert!(messages == all[..messages.len()] && messages.len() >= most);
            most = messages.len();
        }
        assert!(most > 0);
        // Without its footer a file is cut off, and all its messages are there.
        let (messages, error) = read(&bytes[..bytes.len() - 20]);
        assert!(messages == all && matches!(error, Some(ReadError::CutOff)), "{error:?}");
    }

    #[test]
    fn property_a_changed_byte_is_found_or_changes_no_message() {
        let bytes = file();
        let (all, _) = read(&bytes);
        for at in (0..bytes.len()).step_by(16_411) {
            let mut changed = bytes.clone();
            changed[at] ^= 0x10;
            let (messages, _) = read(&changed);
            assert!(messages == all[..messages.len()], "byte {at}");
        }
        assert!(matches!(read(b"something else").1, Some(ReadError::NotMcap)));
        assert!(matches!(read(b"").1, Some(ReadError::CutOff)));
    }
}
