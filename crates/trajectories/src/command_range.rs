//! Recorded commands beyond the range of the card.

use std::fmt;

use nesam_physics::Vehicle;

use crate::channels::Channels;
use crate::data_root::{DataRoot, SAMPLES, rows_by_trajectory};
use crate::table::Table;
use crate::trajectory::Trajectory;

/// The two commands, in the order of every array.
const NAMES: [&str; 2] = ["speed", "second command"];

/// How drives leave the range of one of the two commands.
#[derive(Clone, Debug, PartialEq)]
pub struct BeyondRange {
    /// Which of the two: 0 the speed, 1 the second command.
    pub axis: usize,
    /// Drives that do.
    pub drives: usize,
    /// The first of them.
    pub trajectory: String,
    /// Row of its first such command in the samples file, counting from 0.
    pub row: Option<usize>,
    /// That command, as averaged over a step of the drive.
    pub value: f64,
    /// What is admitted.
    pub range: [f64; 2],
    /// Whether the kind of drive implies the range, and the card does not state it.
    pub implied: bool,
}

impl fmt::Display for BeyondRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let row = self.row.map_or(String::new(), |row| format!(", row {row} of {SAMPLES}"));
        let (of, [low, high]) = (if self.implied { "that its card implies" } else { "of its card" }, self.range);
        write!(f, "drive `{}`{row}: {} {} is outside the range {of}, {low:?} to {high:?}", self.trajectory, NAMES[self.axis], self.value)
    }
}

impl DataRoot {
    /// Which of the two commands leave the range of the card in drives of one set, as they were loaded.
    pub fn beyond_range(&self, drives: &[Trajectory]) -> Vec<BeyondRange> {
        let vehicle = self.vehicle();
        let of_axis = |axis: usize| {
            let outside = |drive: &Trajectory| drive.controls.iter().find(|control| !vehicle.admitted(control)[axis]).copied();
            let mut found = drives.iter().filter_map(|drive| outside(drive).map(|control| (drive, control)));
            let (drive, control) = found.next()?;
            let recorded = self.row_beyond(drive, vehicle, axis);
            Some(BeyondRange {
                axis,
                drives: 1 + found.count(),
                trajectory: drive.id.clone(),
                row: recorded.map(|(row, _)| row),
                value: recorded.map_or([control.speed_m_s, control.second][axis], |(_, value)| value),
                range: vehicle.command_range[axis],
                implied: self.implied_range()[axis],
            })
        };
        (0..NAMES.len()).filter_map(of_axis).collect()
    }

    /// The first row of a drive whose command the card does not admit, with that command.
    fn row_beyond(&self, drive: &Trajectory, vehicle: &Vehicle, axis: usize) -> Option<(usize, f64)> {
        let table = Table::open(&self.path().join(&drive.set).join(SAMPLES)).ok()?;
        let command = Channels::read(&table, vehicle.second, false).ok()?.command;
        let (_, rows) = rows_by_trajectory(&table).ok()?.into_iter().find(|(id, _)| *id == drive.id)?;
        let values = command[axis].finite(&rows).ok()?;
        let at = values.iter().position(|value| !vehicle.admits_on(axis, *value))?;
        Some((rows[at], values[at]))
    }
}
