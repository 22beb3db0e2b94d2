//! The rows of a set as they were recorded, before anything is brought to the step of the model.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use parquet::errors::ParquetError;
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::Field;
use parquet::schema::types::Type;

use crate::error::ImportError;

/// Columns that are read; the first is the drive.
const COLUMNS: [&str; 4] = ["trajectory", "t", "x", "y"];

/// When and where a drive was measured.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Recorded {
    /// Name of the drive.
    pub id: String,
    /// Time stamps, s.
    pub time_s: Vec<f64>,
    /// Horizontal positions, m.
    pub position_m: Vec<[f64; 2]>,
}

/// Reads the drives of a samples file that a data root has already read without an error.
///
/// # Errors
/// `ImportError` when the file cannot be read or lacks drives, times or positions.
pub fn read_recorded(samples: &Path) -> Result<Vec<Recorded>, ImportError> {
    let file = File::open(samples).map_err(|source| ImportError::file(samples, source))?;
    rows(file).map_err(|error| ImportError::log(samples, error.to_string()))
}

fn rows(file: File) -> Result<Vec<Recorded>, ParquetError> {
    let reader = SerializedFileReader::new(file)?;
    let schema = reader.metadata().file_metadata().schema();
    let fields: Vec<Arc<Type>> = schema.get_fields().iter().filter(|field| COLUMNS.contains(&field.name())).cloned().collect();
    let projection = Type::group_type_builder(schema.name()).with_fields(fields).build()?;
    let mut drives: Vec<Recorded> = Vec::new();
    for row in reader.get_row_iter(Some(projection))? {
        let row = row?;
        let field = |name: &str| {
            let found = row.get_column_iter().find(|(held, _)| *held == name).map(|(_, field)| field);
            found.ok_or_else(|| ParquetError::General(format!("has no column `{name}`")))
        };
        let [id, t, x, y] = COLUMNS;
        let id = match field(id)? {
            Field::Str(id) => id.clone(),
            other => other.to_string(),
        };
        let [t, x, y] = [number(field(t)?), number(field(x)?), number(field(y)?)];
        let at = drives.iter().rposition(|drive| drive.id == id).unwrap_or_else(|| {
            drives.push(Recorded { id, ..Recorded::default() });
            drives.len() - 1
        });
        drives[at].time_s.push(t);
        drives[at].position_m.push([x, y]);
    }
    Ok(drives)
}

/// A number; NaN for what is none.
fn number(field: &Field) -> f64 {
    match field {
        Field::Double(value) => *value,
        Field::Float(value) => f64::from(*value),
        Field::Int(value) => f64::from(*value),
        Field::Long(value) => *value as f64,
        _ => f64::NAN,
    }
}
