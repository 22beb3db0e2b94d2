//! Data roots written by the tests themselves, column by column.
#![allow(dead_code, clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::sync::Arc;

use parquet::basic::Compression;
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, FloatType, Int64Type};
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter};
use parquet::schema::parser::parse_message_type;
use tempfile::TempDir;

/// One column; `None` is a null.
#[derive(Clone)]
pub enum Column {
    Double(Vec<Option<f64>>),
    Float(Vec<f32>),
    Int(Vec<i64>),
    Text(Vec<Option<String>>),
}

/// Named columns, in file order.
pub type Columns = Vec<(String, Column)>;

pub fn sample_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/chrono_sample")
}

/// The full data beside the repository; `None` (and a plain message) where it is absent.
pub fn shared(relative: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data").join(relative);
    if !path.exists() {
        eprintln!("skipped: ../shared/data/{relative} is absent");
    }
    path.exists().then_some(path)
}

fn split<T: Clone>(values: &[Option<T>]) -> (Vec<T>, Vec<i16>) {
    (values.iter().flatten().cloned().collect(), values.iter().map(|v| i16::from(v.is_some())).collect())
}

fn write_column(mut writer: SerializedColumnWriter<'_>, column: &Column, rows: std::ops::Range<usize>) {
    match column {
        Column::Double(all) => {
            let (values, levels) = split(&all[rows]);
            writer.typed::<DoubleType>().write_batch(&values, Some(&levels), None).unwrap();
        }
        Column::Float(all) => {
            let levels = vec![1; rows.len()];
            writer.typed::<FloatType>().write_batch(&all[rows], Some(&levels), None).unwrap();
        }
        Column::Int(all) => {
            let levels = vec![1; rows.len()];
            writer.typed::<Int64Type>().write_batch(&all[rows], Some(&levels), None).unwrap();
        }
        Column::Text(all) => {
            let (values, levels) = split(&all[rows]);
            let bytes: Vec<ByteArray> = values.iter().map(|s| ByteArray::from(s.as_str())).collect();
            writer.typed::<ByteArrayType>().write_batch(&bytes, Some(&levels), None).unwrap();
        }
    }
    writer.close().unwrap();
}

/// Writes a Parquet file in row groups of the given size.
pub fn write_parquet(path: &Path, columns: &Columns, group_rows: usize, compression: Compression) {
    let kind = |column: &Column| match column {
        Column::Double(_) => ("double", ""),
        Column::Float(_) => ("float", ""),
        Column::Int(_) => ("int64", ""),
        Column::Text(_) => ("binary", " (UTF8)"),
    };
    let fields: String = columns.iter().map(|(name, c)| format!("optional {} {name}{};\n", kind(c).0, kind(c).1)).collect();
    let schema = Arc::new(parse_message_type(&format!("message schema {{\n{fields}}}")).unwrap());
    let properties = Arc::new(WriterProperties::builder().set_compression(compression).build());
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let mut file = SerializedFileWriter::new(std::fs::File::create(path).unwrap(), schema, properties).unwrap();
    let rows = columns.first().map_or(0, |(_, c)| match c {
        Column::Double(v) => v.len(),
        Column::Float(v) => v.len(),
        Column::Int(v) => v.len(),
        Column::Text(v) => v.len(),
    });
    let mut start = 0;
    while start < rows {
        let end = (start + group_rows).min(rows);
        let mut group = file.next_row_group().unwrap();
        for (_, column) in columns {
            write_column(group.next_column().unwrap().unwrap(), column, start..end);
        }
        group.close().unwrap();
        start = end;
    }
    file.close().unwrap();
}

/// A skid-steer card of the smallest kind.
pub const SKID_CARD: &str = r#"{"vehicle": "test robot", "drive": "skid_steer", "mass_total": 40.0, "wheel_radius_m": 0.16, "wheel_width_m": 0.1,
    "track_m": 0.5, "wheelbase_m": 0.5, "nominal_diff_drive_base_m": 0.55, "wheel_order": ["L", "R"], "max_wheel_speed_rad_s": null}"#;

/// Columns of drives that go round a circle at 1 m/s and 0.3 rad/s, 20 Hz, `n` samples each; positions only, no velocities.
pub fn circle_columns(ids: &[&str], n: usize) -> Columns {
    let each = |f: &dyn Fn(f64) -> f64| Column::Double(ids.iter().flat_map(|_| (0..n).map(|k| Some(f(0.05 * k as f64)))).collect());
    let names = ids.iter().flat_map(|id| std::iter::repeat_n(Some(id.to_string()), n)).collect();
    let (v, w) = (1.0, 0.3);
    let named = |name: &str, column: Column| (name.to_string(), column);
    vec![
        named("trajectory", Column::Text(names)),
        named("t", each(&|t| t)),
        named("x", each(&|t| v / w * (w * t).sin())),
        named("y", each(&|t| v / w * (1.0 - (w * t).cos()))),
        named("z", each(&|_| 0.2)),
        named("roll", each(&|_| 0.0)),
        named("pitch", each(&|_| 0.0)),
        named("yaw", each(&|t| w * t)),
        named("wz", each(&|_| w)),
        named("cmd_speed", each(&|t| v + 0.01 * t)),
        named("cmd_yaw_rate", each(&|_| w)),
        named("om_l", each(&|_| (v - 0.25 * w) / 0.16)),
        named("om_r", each(&|_| (v + 0.25 * w) / 0.16)),
    ]
}

pub fn column<'a>(columns: &'a mut Columns, name: &str) -> &'a mut Column {
    &mut columns.iter_mut().find(|(n, _)| n == name).unwrap().1
}

/// Puts a value into one cell of a column of doubles.
pub fn set(columns: &mut Columns, name: &str, row: usize, value: Option<f64>) {
    match column(columns, name) {
        Column::Double(values) => values[row] = value,
        _ => panic!("{name} is no column of doubles"),
    }
}

pub fn without(columns: &Columns, name: &str) -> Columns {
    columns.iter().filter(|(n, _)| n != name).cloned().collect()
}

/// A root with the skid-steer card and one set `drive` of the given columns, without index and worlds.
pub fn root_of(columns: &Columns) -> TempDir {
    let root = TempDir::new().unwrap();
    std::fs::write(root.path().join("vehicle_test.json"), SKID_CARD).unwrap();
    write_parquet(&root.path().join("drive/samples.parquet"), columns, usize::MAX / 2, Compression::UNCOMPRESSED);
    root
}

/// An index file for `(trajectory, world, split)`.
pub fn write_index(path: &Path, rows: &[(&str, Option<&str>, Option<&str>)]) {
    let text = |f: &dyn Fn(&(&str, Option<&str>, Option<&str>)) -> Option<String>| Column::Text(rows.iter().map(f).collect());
    let columns = vec![
        ("trajectory".to_string(), text(&|r| Some(r.0.to_string()))),
        ("world".to_string(), text(&|r| r.1.map(String::from))),
        ("split".to_string(), text(&|r| r.2.map(String::from))),
    ];
    write_parquet(path, &columns, 2, Compression::SNAPPY);
}

/// Copies a Parquet file of texts, floats and small integers, leaving out every `gt_` column.
pub fn copy_without_truth(from: &Path, to: &Path) {
    use parquet::file::reader::{FileReader, SerializedFileReader};
    use parquet::record::Field;
    let reader = SerializedFileReader::new(std::fs::File::open(from).unwrap()).unwrap();
    let mut columns: Columns = Vec::new();
    for row in reader.get_row_iter(None).unwrap() {
        let row = row.unwrap();
        let fields = row.get_column_iter().filter(|(name, _)| !name.starts_with("gt_"));
        for (i, (name, field)) in fields.enumerate() {
            if columns.len() == i {
                let empty = if matches!(field, Field::Str(_)) { Column::Text(vec![]) } else { Column::Float(vec![]) };
                columns.push((name.clone(), empty));
            }
            match (&mut columns[i].1, field) {
                (Column::Text(values), Field::Str(s)) => values.push(Some(s.clone())),
                (Column::Float(values), Field::Float(x)) => values.push(*x),
                (_, other) => panic!("{name}: unexpected {other:?}"),
            }
        }
    }
    write_parquet(to, &columns, usize::MAX / 2, Compression::UNCOMPRESSED);
}
