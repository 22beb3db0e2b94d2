//! The rows of a set as they were recorded, before anything is brought to the step of the model.

use crate::channels::all;
use crate::data_root::{DataRoot, SAMPLES, rows_by_trajectory};
use crate::error::TrajectoryError;
use crate::table::Table;

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

impl DataRoot {
    /// All drives of a set, row by row in the order of the samples file.
    ///
    /// # Errors
    /// As [`DataRoot::load_set`], of times and positions.
    pub fn recorded(&self, set: &str) -> Result<Vec<Recorded>, TrajectoryError> {
        let table = Table::open(&self.set_dir(set)?.join(SAMPLES))?;
        let [t, x, y] = all(&table, ["t", "x", "y"])?;
        let drive = |(id, rows): (String, Vec<usize>)| {
            let position_m = x.finite(&rows)?.into_iter().zip(y.finite(&rows)?).map(|(x, y)| [x, y]).collect();
            Ok(Recorded { id, time_s: t.finite(&rows)?, position_m })
        };
        rows_by_trajectory(&table)?.into_iter().map(drive).collect()
    }
}
