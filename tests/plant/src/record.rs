//! Drives of the plant as a set of a data root, in the layout of the recorded ones.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use parquet::basic::{Compression, ZstdLevel};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::parser::parse_message_type;

use crate::error::PlantError;
use crate::math::{Rotation, Vec3};
use crate::plant::{Command, STEP_S, Truth};
use crate::sensors::Measured;

const WHEEL: [&str; 4] = ["fl", "fr", "rl", "rr"];

/// A recorded drive.
#[derive(Clone, Debug, PartialEq)]
pub struct Drive {
    /// Trajectory id.
    pub id: String,
    /// World.
    pub world: String,
    /// `train` or `test`.
    pub split: String,
    /// Columns by name, all of one length; the first is `t`.
    pub columns: Vec<(String, Vec<f64>)>,
}

/// Collects the samples of a drive.
#[derive(Clone, Debug, Default)]
pub struct DriveRecorder {
    columns: Vec<(String, Vec<f64>)>,
    samples: usize,
}

impl DriveRecorder {
    /// Takes one sample: what was measured, what was the case, and the command from now on. The latency of positions counts as their noise.
    pub fn sample(&mut self, measured: &Measured, truth: &Truth, command: Command) {
        let mut row = vec![("t".to_string(), self.samples as f64 * STEP_S)];
        row.extend(motion("", &measured.state));
        row.push(("cmd_speed".into(), command.speed_m_s));
        row.push(("cmd_steer".into(), command.steering));
        row.extend(["steer_fl", "steer_fr"].iter().zip(measured.road_wheel_rad).map(|(name, v)| ((*name).into(), v)));
        row.extend(wheels("om", &measured.wheel_rad_s));
        row.extend(motion("gt_", &truth.state));
        row.extend(["gt_steer_fl", "gt_steer_fr"].iter().zip(truth.road_wheel_rad).map(|(name, v)| ((*name).into(), v)));
        row.push(("gt_steer_act".into(), truth.steering));
        row.extend(wheels("gt_om", &truth.wheel_rad_s));
        row.extend(wheels("gt_sink_max", &truth.sinkage_max_m));
        row.extend(wheels("gt_sink_mean", &truth.sinkage_mean_m));
        row.extend(wheels("gt_slip", &truth.slip));
        row.extend(wheels("gt_wheel_z", &truth.wheel_height_m));
        for (axis, name) in ["gt_fx", "gt_fy", "gt_fz"].iter().enumerate() {
            row.extend(wheels(name, &truth.force_n.map(|force| force[axis])));
        }
        if self.columns.is_empty() {
            self.columns = row.iter().map(|(name, _)| (name.clone(), Vec::new())).collect();
        }
        self.columns.iter_mut().zip(row).for_each(|((_, column), (_, value))| column.push(value));
        self.samples += 1;
    }

    /// The drive.
    pub fn finish(self, id: &str, world: &str, split: &str) -> Drive {
        Drive { id: id.into(), world: world.into(), split: split.into(), columns: self.columns }
    }
}

/// Pose, velocity in World and in Body, angular velocity.
fn motion(prefix: &str, state: &[f64; 12]) -> Vec<(String, f64)> {
    let of = |from: usize| -> Vec3 { [state[from], state[from + 1], state[from + 2]] };
    let world = Rotation::from_attitude(of(3)).to_world(of(6));
    let named = [
        (["x", "y", "z"], of(0)),
        (["roll", "pitch", "yaw"], of(3)),
        (["vx", "vy", "vz"], world),
        (["vbx", "vby", "vbz"], of(6)),
        (["wx", "wy", "wz"], of(9)),
    ];
    named.iter().flat_map(|(names, values)| names.iter().zip(values).map(|(name, v)| (format!("{prefix}{name}"), *v))).collect()
}

fn wheels(stem: &str, values: &[f64; 4]) -> Vec<(String, f64)> {
    WHEEL.iter().zip(values).map(|(wheel, v)| (format!("{stem}_{wheel}"), *v)).collect()
}

/// Writes `samples.parquet` and `index.parquet` into a folder, which is made.
///
/// # Errors
/// `PlantError` naming the file that cannot be written; also when the drives do not have the same columns.
pub fn write_set(folder: &Path, drives: &[Drive]) -> Result<(), PlantError> {
    std::fs::create_dir_all(folder).map_err(|source| PlantError::File { path: folder.into(), source })?;
    let names: Vec<&String> = drives.first().map(|d| d.columns.iter().map(|(name, _)| name).collect()).unwrap_or_default();
    if names.is_empty() || drives.iter().any(|d| !d.columns.iter().map(|(name, _)| name).eq(names.iter().copied())) {
        return Err(PlantError::content(folder, "no drives, or drives with different columns"));
    }
    let samples = folder.join("samples.parquet");
    write_samples(&samples, &names, drives).map_err(|e| PlantError::content(&samples, e.to_string()))?;
    let index = folder.join("index.parquet");
    write_index(&index, drives).map_err(|e| PlantError::content(&index, e.to_string()))
}

fn write_samples(path: &Path, names: &[&String], drives: &[Drive]) -> Result<(), ParquetError> {
    let listed: String = names.iter().map(|name| format!("required double {name};\n")).collect();
    let mut file = open(path, &format!("message samples {{ required binary trajectory (UTF8);\n{listed} }}"))?;
    let mut group = file.next_row_group()?;
    let length = |d: &Drive| d.columns[0].1.len();
    let ids: Vec<ByteArray> = drives.iter().flat_map(|d| std::iter::repeat_n(ByteArray::from(d.id.as_str()), length(d))).collect();
    text(&mut group, &ids)?;
    for column in 0..names.len() {
        let values: Vec<f64> = drives.iter().flat_map(|d| d.columns[column].1.iter().copied()).collect();
        number(&mut group, &values)?;
    }
    group.close()?;
    file.close().map(|_| ())
}

fn write_index(path: &Path, drives: &[Drive]) -> Result<(), ParquetError> {
    let mut file = open(
        path,
        "message index { required binary trajectory (UTF8); required binary world (UTF8); required binary split (UTF8);
         required int64 n_samples; required double duration_s; }",
    )?;
    let mut group = file.next_row_group()?;
    let texts = |pick: fn(&Drive) -> &str| -> Vec<ByteArray> { drives.iter().map(|d| ByteArray::from(pick(d))).collect() };
    text(&mut group, &texts(|d| &d.id))?;
    text(&mut group, &texts(|d| &d.world))?;
    text(&mut group, &texts(|d| &d.split))?;
    let counts: Vec<i64> = drives.iter().map(|d| d.columns[0].1.len() as i64).collect();
    let mut column = next(&mut group)?;
    column.typed::<Int64Type>().write_batch(&counts, None, None)?;
    column.close()?;
    number(&mut group, &counts.iter().map(|n| (*n - 1) as f64 * STEP_S).collect::<Vec<_>>())?;
    group.close()?;
    file.close().map(|_| ())
}

fn open(path: &Path, schema: &str) -> Result<SerializedFileWriter<File>, ParquetError> {
    let properties = WriterProperties::builder().set_compression(Compression::ZSTD(ZstdLevel::default())).build();
    SerializedFileWriter::new(File::create(path)?, Arc::new(parse_message_type(schema)?), Arc::new(properties))
}

fn next<'a>(group: &'a mut SerializedRowGroupWriter<'_, File>) -> Result<SerializedColumnWriter<'a>, ParquetError> {
    group.next_column()?.ok_or_else(|| ParquetError::General("fewer columns than the schema names".into()))
}

fn text(group: &mut SerializedRowGroupWriter<'_, File>, values: &[ByteArray]) -> Result<(), ParquetError> {
    let mut column = next(group)?;
    column.typed::<ByteArrayType>().write_batch(values, None, None)?;
    column.close()
}

fn number(group: &mut SerializedRowGroupWriter<'_, File>, values: &[f64]) -> Result<(), ParquetError> {
    let mut column = next(group)?;
    column.typed::<DoubleType>().write_batch(values, None, None)?;
    column.close()
}
