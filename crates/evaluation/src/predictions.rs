//! `--predictions FILE.parquet`: every predicted pose, so that anybody can compute the errors without this code.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use parquet::basic::{Compression, ZstdLevel};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int32Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::parser::parse_message_type;

use crate::dimension::POSE_DIM;
use crate::error::EvaluationError;
use crate::evaluate::ModelPaths;
use crate::windows::Window;

const SCHEMA: &str = "message predictions {
    required binary model (UTF8);
    required binary trajectory (UTF8);
    required double t0;
    required int32 k;
    optional double x;
    optional double y;
    optional double z;
    optional double roll;
    optional double pitch;
    optional double yaw;
}";

/// Writes one row per named model, window and step: model, trajectory, t0 (s, time of the start in the drive, to the nanosecond), k (1…K), x, y, z (m), roll,
/// pitch, yaw (rad). What a model does not predict is null. One row group per model, zstd.
///
/// # Errors
/// `EvaluationError::File` when the file cannot be written.
pub fn write_predictions(path: &Path, models: &[(&str, &ModelPaths)], windows: &[Window<'_>]) -> Result<(), EvaluationError> {
    write(path, models, windows).map_err(|e| EvaluationError::file(path, e))
}

fn write(path: &Path, models: &[(&str, &ModelPaths)], windows: &[Window<'_>]) -> Result<(), ParquetError> {
    let schema = Arc::new(parse_message_type(SCHEMA)?);
    let properties = WriterProperties::builder().set_compression(Compression::ZSTD(ZstdLevel::default())).build();
    let file = File::create(path)?;
    let mut writer = SerializedFileWriter::new(file, schema, Arc::new(properties))?;
    for (name, model) in models {
        let mut group = writer.next_row_group()?;
        write_model(&mut group, name, model, windows)?;
        group.close()?;
    }
    writer.close()?;
    Ok(())
}

fn write_model(
    group: &mut SerializedRowGroupWriter<'_, File>,
    name: &str,
    model: &ModelPaths,
    windows: &[Window<'_>],
) -> Result<(), ParquetError> {
    let steps = |w: &Window<'_>| w.horizon;
    let repeat = |make: &dyn Fn(&Window<'_>) -> ByteArray| -> Vec<ByteArray> {
        windows.iter().flat_map(|w| std::iter::repeat_n(make(w), steps(w))).collect()
    };
    text(group, &repeat(&|_| ByteArray::from(name)))?;
    text(group, &repeat(&|w| ByteArray::from(w.trajectory.id.as_str())))?;
    let t0: Vec<f64> = windows.iter().flat_map(|w| std::iter::repeat_n(to_the_nanosecond(w.start_time_s()), steps(w))).collect();
    number(group, &t0, None)?;
    let k: Vec<i32> = windows.iter().flat_map(|w| 1..=i32::try_from(w.horizon).unwrap_or(i32::MAX)).collect();
    let mut column = next(group)?;
    column.typed::<Int32Type>().write_batch(&k, None, None)?;
    column.close()?;
    for d in 0..POSE_DIM {
        let all = || model.paths.iter().flat_map(|p| p.poses.iter().map(move |pose| (p.predicts[d], pose[d])));
        let levels: Vec<i16> = all().map(|(there, _)| i16::from(there)).collect();
        let values: Vec<f64> = all().filter(|(there, _)| *there).map(|(_, v)| v).collect();
        number(group, &values, Some(&levels))?;
    }
    Ok(())
}

/// Without what a sum of steps leaves in the last bits: 4.8, not 4.800000000000001.
fn to_the_nanosecond(time_s: f64) -> f64 {
    (time_s * 1e9).round() / 1e9
}

fn next<'a>(group: &'a mut SerializedRowGroupWriter<'_, File>) -> Result<parquet::file::writer::SerializedColumnWriter<'a>, ParquetError> {
    group.next_column()?.ok_or_else(|| ParquetError::General("fewer columns than the schema names".into()))
}

fn text(group: &mut SerializedRowGroupWriter<'_, File>, values: &[ByteArray]) -> Result<(), ParquetError> {
    let mut column = next(group)?;
    column.typed::<ByteArrayType>().write_batch(values, None, None)?;
    column.close()
}

fn number(group: &mut SerializedRowGroupWriter<'_, File>, values: &[f64], levels: Option<&[i16]>) -> Result<(), ParquetError> {
    let mut column = next(group)?;
    column.typed::<DoubleType>().write_batch(values, levels, None)?;
    column.close()
}
