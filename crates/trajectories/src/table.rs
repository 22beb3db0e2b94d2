//! A Parquet file as named columns of numbers and texts.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use parquet::basic::{Compression, LogicalType};
use parquet::column::reader::{ColumnReader, ColumnReaderImpl};
use parquet::data_type::DataType;
use parquet::file::metadata::{ColumnChunkMetaData, ParquetMetaData};
use parquet::file::reader::{FileReader, SerializedFileReader};
use sha2::{Digest, Sha256};

use crate::data_root::hex;
use crate::error::TrajectoryError;

/// Most rows for which memory is set aside before they are seen, so that a damaged footer cannot ask for all of it.
const RESERVED: usize = 1 << 18;

/// An opened Parquet file.
pub(crate) struct Table {
    path: PathBuf,
    reader: SerializedFileReader<Bytes>,
    rows: usize,
    hash: String,
}

/// A numeric column over all row groups; `None` = null.
pub(crate) struct Numbers {
    path: PathBuf,
    name: String,
    /// NaN where null.
    values: Vec<f64>,
    /// True where null; empty when nothing is.
    null: Vec<bool>,
}

/// A text column; `None` = null. Equal neighbours share one allocation.
pub(crate) type Texts = Vec<Option<Arc<str>>>;

impl Table {
    /// Reads the file whole (it is also hashed) and parses its footer.
    pub(crate) fn open(path: &Path) -> Result<Self, TrajectoryError> {
        let content = std::fs::read(path).map_err(|source| TrajectoryError::Read { path: path.into(), source })?;
        let hash = hex(&Sha256::digest(&content));
        let length = content.len();
        let bad = |reason| TrajectoryError::Parquet { path: path.into(), reason };
        let reader = guarded(|| SerializedFileReader::new(Bytes::from(content))).map_err(bad)?;
        let rows = reader.metadata().row_groups().iter().map(|g| g.num_rows()).sum::<i64>();
        let stated = reader.metadata().file_metadata().num_rows();
        let rows = usize::try_from(rows).ok().filter(|_| rows == stated && rows < i64::from(u32::MAX));
        let rows = rows.ok_or_else(|| bad(format!("the footer gives inconsistent row counts ({stated})")))?;
        if let Some(column) = column_outside(reader.metadata(), length) {
            return Err(bad(format!("the footer places column `{column}` outside the file")));
        }
        Ok(Self { path: path.into(), reader, rows, hash })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn rows(&self) -> usize {
        self.rows
    }

    /// SHA-256 of the file, hex.
    pub(crate) fn hash(&self) -> &str {
        &self.hash
    }

    pub(crate) fn has(&self, name: &str) -> bool {
        self.position(name).is_some()
    }

    fn position(&self, name: &str) -> Option<usize> {
        let schema = self.reader.metadata().file_metadata().schema_descr();
        (0..schema.num_columns()).find(|i| schema.column(*i).path().string() == name)
    }

    fn required(&self, name: &str) -> Result<usize, TrajectoryError> {
        self.position(name).ok_or_else(|| TrajectoryError::column(&self.path, name, "missing"))
    }

    /// A column of floats or integers, as f64.
    pub(crate) fn numbers(&self, name: &str) -> Result<Numbers, TrajectoryError> {
        let column = self.required(name)?;
        if self.is_scaled(column) {
            return Err(TrajectoryError::column(&self.path, name, "expected plain numbers, found decimal or time stamps"));
        }
        let (mut values, mut null) = (Vec::with_capacity(self.rows.min(RESERVED)), Vec::new());
        self.each_group(column, name, |reader, max_level, rows| {
            let before = values.len();
            let levels = match reader {
                ColumnReader::FloatColumnReader(r) => append(r, max_level, rows, &mut values, |v| f64::from(*v), f64::NAN),
                ColumnReader::DoubleColumnReader(r) => append(r, max_level, rows, &mut values, |v| *v, f64::NAN),
                ColumnReader::Int32ColumnReader(r) => append(r, max_level, rows, &mut values, |v| f64::from(*v), f64::NAN),
                ColumnReader::Int64ColumnReader(r) => append(r, max_level, rows, &mut values, |v| *v as f64, f64::NAN),
                _ => Err("expected numbers, found another type".into()),
            }?;
            if let Some(levels) = levels {
                null.resize(before, false);
                null.extend(levels);
            }
            Ok(())
        })?;
        Ok(Numbers { path: self.path.clone(), name: name.into(), values, null })
    }

    /// Whether the numbers of a column mean something else than they say: decimals, instants, times of day.
    fn is_scaled(&self, column: usize) -> bool {
        let descriptor = self.reader.metadata().file_metadata().schema_descr().column(column);
        descriptor.logical_type_ref().is_some_and(|logical| {
            matches!(logical, LogicalType::Decimal { .. } | LogicalType::Timestamp { .. } | LogicalType::Time { .. })
        })
    }

    /// A column of texts (plain or dictionary), or of whole numbers, which are read as text; a column of only nulls may have any type.
    pub(crate) fn texts(&self, name: &str) -> Result<Texts, TrajectoryError> {
        let column = self.required(name)?;
        let (scaled, is_all_null) = (self.is_scaled(column), self.is_all_null(column));
        let mut texts: Texts = Vec::with_capacity(self.rows.min(RESERVED));
        self.each_group(column, name, |reader, max_level, rows| {
            let mut whole: Vec<Option<i64>> = Vec::new();
            match reader {
                ColumnReader::ByteArrayColumnReader(r) => {
                    let mut raw = Vec::with_capacity(rows.min(RESERVED));
                    append(r, max_level, rows, &mut raw, |v| Some(v.clone()), None)?;
                    for value in raw {
                        let text = value.as_ref().map(|v| std::str::from_utf8(v.data())).transpose();
                        let text = text.map_err(|_| format!("row {}: not utf-8", texts.len()))?;
                        push_text(&mut texts, text);
                    }
                    return Ok(());
                }
                reader if is_all_null => {
                    // Memory is taken for rows that the column has, whatever a damaged footer says.
                    read_nulls(reader, max_level, rows)?;
                    texts.resize(texts.len() + rows, None);
                    return Ok(());
                }
                ColumnReader::Int32ColumnReader(r) if !scaled => append(r, max_level, rows, &mut whole, |v| Some(i64::from(*v)), None)?,
                ColumnReader::Int64ColumnReader(r) if !scaled => append(r, max_level, rows, &mut whole, |v| Some(*v), None)?,
                _ => return Err("expected text or whole numbers, found another type".into()),
            };
            for value in whole {
                push_text(&mut texts, value.map(|v| v.to_string()).as_deref());
            }
            Ok(())
        })?;
        Ok(texts)
    }

    /// Whether the statistics of every row group say that the column holds nothing but nulls.
    fn is_all_null(&self, column: usize) -> bool {
        // Arrow writes a column without values as the logical type "null", and then no statistics.
        let schema = self.reader.metadata().file_metadata().schema_descr();
        if matches!(schema.column(column).logical_type_ref(), Some(LogicalType::Unknown)) {
            return true;
        }
        self.reader.metadata().row_groups().iter().all(|group| {
            let nulls = group.column(column).statistics().and_then(|s| s.null_count_opt());
            nulls == u64::try_from(group.num_rows()).ok()
        })
    }

    /// Calls `read` with the column reader of each row group; failures name the column and the rows of the group.
    fn each_group(
        &self,
        column: usize,
        name: &str,
        mut read: impl FnMut(ColumnReader, i16, usize) -> Result<(), String>,
    ) -> Result<(), TrajectoryError> {
        let descriptor = self.reader.metadata().file_metadata().schema_descr().column(column);
        if descriptor.max_rep_level() > 0 {
            return Err(TrajectoryError::column(&self.path, name, "lists are not supported"));
        }
        let groups = self.reader.metadata().row_groups().iter();
        if let Some(codec) = groups.map(|group| group.column(column).compression()).find(|codec| !is_read(*codec)) {
            let codec = codec.to_string();
            // Without the level, which a reader does not know.
            let codec = codec.split_once('(').map_or(codec.as_str(), |(codec, _)| codec);
            let reason = format!("compressed with {codec}, which is not read; write the file anew with zstd, snappy or gzip");
            return Err(TrajectoryError::column(&self.path, name, reason));
        }
        let mut first = 0;
        for group in 0..self.reader.num_row_groups() {
            let rows = self.reader.metadata().row_group(group).num_rows() as usize;
            let outcome = guarded(|| {
                let reader = self.reader.get_row_group(group).and_then(|g| g.get_column_reader(column));
                read(reader.map_err(|error| error.to_string())?, descriptor.max_def_level(), rows)
            });
            outcome.map_err(|reason| {
                let reason = format!("{reason} (rows {first}..{})", first + rows);
                TrajectoryError::column(&self.path, name, reason)
            })?;
            first += rows;
        }
        Ok(())
    }
}

impl Numbers {
    /// The values of some rows; a null, NaN or infinity is an error that names its row.
    pub(crate) fn finite(&self, rows: &[usize]) -> Result<Vec<f64>, TrajectoryError> {
        rows.iter().map(|row| self.finite_at(*row)).collect()
    }

    fn finite_at(&self, row: usize) -> Result<f64, TrajectoryError> {
        let wrong = |reason: String| Err(TrajectoryError::cell(&self.path, &self.name, row, reason));
        if self.null.get(row) == Some(&true) {
            return wrong("null, expected a number".into());
        }
        let value = self.values[row];
        if value.is_finite() { Ok(value) } else { wrong(format!("{value}, expected a finite number")) }
    }

    /// Whether all of some rows are null or NaN, as a column of floats writes a null: the channel was not recorded there.
    pub(crate) fn is_absent(&self, rows: &[usize]) -> bool {
        rows.iter().all(|row| self.values[*row].is_nan())
    }
}

/// Appends a text, shared with an equal one before it.
fn push_text(texts: &mut Texts, text: Option<&str>) {
    let shared = match (text, texts.last()) {
        (Some(text), Some(Some(last))) if **last == *text => Some(Arc::clone(last)),
        (text, _) => text.map(Arc::from),
    };
    texts.push(shared);
}

/// Reads a row group of nothing but nulls, of any type; an error where it has other rows than the footer says, or a value.
fn read_nulls(reader: ColumnReader, max_level: i16, rows: usize) -> Result<(), String> {
    let none = &mut Vec::new();
    let nulls = match reader {
        ColumnReader::BoolColumnReader(r) => append(r, max_level, rows, none, |_| (), ()),
        ColumnReader::Int32ColumnReader(r) => append(r, max_level, rows, none, |_| (), ()),
        ColumnReader::Int64ColumnReader(r) => append(r, max_level, rows, none, |_| (), ()),
        ColumnReader::Int96ColumnReader(r) => append(r, max_level, rows, none, |_| (), ()),
        ColumnReader::FloatColumnReader(r) => append(r, max_level, rows, none, |_| (), ()),
        ColumnReader::DoubleColumnReader(r) => append(r, max_level, rows, none, |_| (), ()),
        ColumnReader::ByteArrayColumnReader(r) => append(r, max_level, rows, none, |_| (), ()),
        ColumnReader::FixedLenByteArrayColumnReader(r) => append(r, max_level, rows, none, |_| (), ()),
    }?;
    if rows == 0 || nulls.is_some_and(|nulls| nulls.iter().all(|null| *null)) {
        return Ok(());
    }
    Err("the footer says that every row is null, and one is not".into())
}

/// Appends one row group, nulls as `missing`; gives the null mask where there is a null.
fn append<T: DataType, V: Clone>(
    mut reader: ColumnReaderImpl<T>,
    max_level: i16,
    rows: usize,
    out: &mut Vec<V>,
    convert: impl Fn(&T::T) -> V,
    missing: V,
) -> Result<Option<Vec<bool>>, String> {
    let (mut values, mut levels) = (Vec::new(), Vec::new());
    let mut done = 0;
    while done < rows {
        let (records, _, _) = reader
            .read_records((rows - done).min(RESERVED), (max_level > 0).then_some(&mut levels), None, &mut values)
            .map_err(|error| error.to_string())?;
        if records == 0 {
            return Err(format!("ends after {done} of {rows} rows"));
        }
        done += records;
    }
    if max_level == 0 || values.len() == rows {
        out.extend(values.iter().map(convert));
        return if values.len() == rows { Ok(None) } else { Err(format!("{} values for {rows} rows", values.len())) };
    }
    let null: Vec<bool> = levels.iter().map(|level| *level < max_level).collect();
    if null.len() != rows || null.iter().filter(|n| !**n).count() != values.len() {
        return Err("levels and values disagree".into());
    }
    let mut present = values.iter().map(convert);
    out.extend(null.iter().map(|n| if *n { missing.clone() } else { present.next().unwrap_or(missing.clone()) }));
    Ok(Some(null))
}

/// Whether columns that are compressed in this way are read.
fn is_read(codec: Compression) -> bool {
    matches!(codec, Compression::UNCOMPRESSED | Compression::ZSTD(_) | Compression::SNAPPY | Compression::GZIP(_))
}

/// The first column chunk that the footer places outside a file of this length.
fn column_outside(metadata: &ParquetMetaData, length: usize) -> Option<String> {
    let chunks = metadata.row_groups().iter().flat_map(|group| group.columns());
    let outside = |chunk: &&ColumnChunkMetaData| {
        let start = chunk.dictionary_page_offset().unwrap_or(chunk.data_page_offset());
        let end = start.checked_add(chunk.compressed_size());
        start < 0 || chunk.compressed_size() < 0 || end.is_none_or(|end| end > length as i64)
    };
    chunks.into_iter().find(outside).map(|chunk| chunk.column_path().string())
}

/// Runs a step of the Parquet decoder. The decoder can panic on damaged bytes; that is turned into the error that it is.
fn guarded<R, E: ToString>(step: impl FnOnce() -> Result<R, E>) -> Result<R, String> {
    match catch_unwind(AssertUnwindSafe(step)) {
        Ok(outcome) => outcome.map_err(|error| error.to_string()),
        Err(_) => Err("damaged (the decoder gave up)".into()),
    }
}

#[cfg(test)]
mod tests {
    use parquet::basic::{BrotliLevel, GzipLevel, ZstdLevel};
    use parquet::data_type::{ByteArray, ByteArrayType, DoubleType};
    use parquet::file::properties::WriterProperties;
    use parquet::file::writer::SerializedFileWriter;
    use parquet::schema::parser::parse_message_type;

    use super::*;

    /// Goal: files of other tools are read as they usually compress them. Method: numbers and texts, written with each codec that is read.
    #[test]
    fn property_usual_codecs_are_read() {
        let here = tempfile::tempdir().unwrap();
        let schema = Arc::new(parse_message_type("message t { required double v; required binary n (UTF8); }").unwrap());
        let numbers: Vec<f64> = (0..1000).map(|i| f64::from(i / 10)).collect();
        for codec in [
            Compression::UNCOMPRESSED,
            Compression::ZSTD(ZstdLevel::default()),
            Compression::SNAPPY,
            Compression::GZIP(GzipLevel::default()),
        ] {
            let path = here.path().join(format!("{codec}.parquet"));
            let properties = WriterProperties::builder().set_compression(codec).build();
            let file = std::fs::File::create(&path).unwrap();
            let mut writer = SerializedFileWriter::new(file, Arc::clone(&schema), Arc::new(properties)).unwrap();
            let mut group = writer.next_row_group().unwrap();
            let mut column = group.next_column().unwrap().unwrap();
            column.typed::<DoubleType>().write_batch(&numbers, None, None).unwrap();
            column.close().unwrap();
            let mut column = group.next_column().unwrap().unwrap();
            column.typed::<ByteArrayType>().write_batch(&vec![ByteArray::from("a"); 1000], None, None).unwrap();
            column.close().unwrap();
            group.close().unwrap();
            writer.close().unwrap();
            let table = Table::open(&path).unwrap();
            assert_eq!(table.reader.metadata().row_group(0).column(0).compression(), codec);
            assert_eq!(table.numbers("v").unwrap().values, numbers, "{codec}");
            assert!(table.texts("n").unwrap().iter().all(|text| text.as_deref() == Some("a")), "{codec}");
        }
        let unread = [Compression::LZO, Compression::BROTLI(BrotliLevel::default()), Compression::LZ4, Compression::LZ4_RAW];
        assert!(unread.into_iter().all(|codec| !is_read(codec)));
    }
}
