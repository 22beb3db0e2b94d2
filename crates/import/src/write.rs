//! A set of a data root: `samples.parquet` and `index.json`.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use parquet::basic::{Compression, ZstdLevel};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::parser::parse_message_type;
use serde_json::json;

use crate::error::ImportError;
use crate::part::{Drive, Notes};

/// Writes drives as a set; channels that not all of them have are left out and noted. `world` and `split` (`train`, `test`) go into the index.
///
/// # Errors
/// `ImportError` when two drives have one name, or the folder cannot be written.
pub fn write_set(folder: &Path, drives: &[Drive], world: Option<&str>, split: Option<&str>) -> Result<Notes, ImportError> {
    if let Some(twice) = drives.iter().enumerate().find(|(i, d)| drives[..*i].iter().any(|other| other.id == d.id)).map(|(_, d)| d) {
        return Err(ImportError::log(folder, format!("two drives are named `{}`; give the logs different names", twice.id)));
    }
    let all = drives.first().map_or(&[][..], |drive| &drive.columns);
    let has = |drive: &Drive, name: &str| drive.columns.iter().any(|(held, _)| held == name);
    let names: Vec<&str> = all.iter().map(|(name, _)| name.as_str()).filter(|name| drives.iter().all(|d| has(d, name))).collect();
    let mut notes: Notes = drives
        .iter()
        .flat_map(|drive| drive.columns.iter().map(|(name, _)| name.as_str()))
        .filter(|name| !names.contains(name))
        .map(|name| format!("{name} not used: not every log has it"))
        .collect();
    notes.sort();
    notes.dedup();
    std::fs::create_dir_all(folder).map_err(|source| ImportError::file(folder, source))?;
    let samples = folder.join("samples.parquet");
    write_samples(&samples, &names, drives).map_err(|e| ImportError::log(&samples, e.to_string()))?;
    let entry = |d: &Drive| {
        let t = d.time_s();
        let duration_s = t.last().copied().unwrap_or(0.0) - t.first().copied().unwrap_or(0.0);
        json!({"trajectory": d.id, "world": world, "split": split, "n_samples": t.len(), "duration_s": duration_s})
    };
    let index = folder.join("index.json");
    let text =
        serde_json::to_string_pretty(&drives.iter().map(entry).collect::<Vec<_>>()).expect("names and hashes serialise; this is a bug");
    std::fs::write(&index, text + "\n").map_err(|source| ImportError::file(&index, source))?;
    Ok(notes)
}

fn write_samples(path: &Path, names: &[&str], drives: &[Drive]) -> Result<(), ParquetError> {
    let fields: String = names.iter().map(|name| format!("required double {name};\n")).collect();
    let schema = parse_message_type(&format!("message samples {{ required binary trajectory (UTF8);\n{fields} }}"))?;
    let properties = WriterProperties::builder().set_compression(Compression::ZSTD(ZstdLevel::default())).build();
    let mut file = SerializedFileWriter::new(File::create(path)?, Arc::new(schema), Arc::new(properties))?;
    let mut group = file.next_row_group()?;
    let fewer = || ParquetError::General("fewer columns than the schema names".into());
    let ids: Vec<ByteArray> = drives.iter().flat_map(|d| std::iter::repeat_n(ByteArray::from(d.id.as_str()), d.time_s().len())).collect();
    let mut column = group.next_column()?.ok_or_else(fewer)?;
    column.typed::<ByteArrayType>().write_batch(&ids, None, None)?;
    column.close()?;
    for name in names {
        let of = |d: &Drive| d.columns.iter().find(|(held, _)| held == name).map_or(Vec::new(), |(_, values)| values.clone());
        let values: Vec<f64> = drives.iter().flat_map(of).collect();
        let mut column = group.next_column()?.ok_or_else(fewer)?;
        column.typed::<DoubleType>().write_batch(&values, None, None)?;
        column.close()?;
    }
    group.close()?;
    file.close().map(|_| ())
}
