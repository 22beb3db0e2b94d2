//! What an import left out of a log, summed up over its drives.

use crate::part::Notes;

/// Rows and channels that were left out, and rows that tell no pose.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct LeftOut {
    /// Rows that were meant to be samples.
    rows: usize,
    /// Those of them that lack something.
    lacking_rows: usize,
    /// By channel, how many rows lack it.
    lacking: Vec<(String, usize)>,
    /// Rows with commands and no pose.
    pub(crate) commands_alone: usize,
    /// Channels, the drive that goes without, and in how many of its rows they are missing.
    channels: Vec<(String, String, usize, usize)>,
}

impl LeftOut {
    /// Counts rows that were meant to be samples.
    pub(crate) fn count(&mut self, rows: usize) {
        self.rows += rows;
    }

    /// A row is left out, for channels that it lacks.
    pub(crate) fn row<'a>(&mut self, channels: impl Iterator<Item = &'a str>) {
        self.lacking_rows += 1;
        channels.for_each(|channel| self.lack(channel, 1));
    }

    fn lack(&mut self, channel: &str, rows: usize) {
        match self.lacking.iter_mut().find(|(name, _)| name == channel) {
            Some((_, count)) => *count += rows,
            None => self.lacking.push((channel.into(), rows)),
        }
    }

    /// A drive goes without a channel that is missing in some of its rows.
    pub(crate) fn channel(&mut self, name: &str, drive: &str, missing: usize, rows: usize) {
        self.channels.push((name.into(), drive.into(), missing, rows));
    }

    /// What rows lack: `x 3, wz 1`.
    pub(crate) fn lacks(&self) -> String {
        self.lacking.iter().map(|(name, count)| format!("{name} {count}")).collect::<Vec<_>>().join(", ")
    }

    /// Adds what was left out of another drive.
    pub(crate) fn add(&mut self, other: Self) {
        self.rows += other.rows;
        self.lacking_rows += other.lacking_rows;
        self.commands_alone += other.commands_alone;
        self.channels.extend(other.channels);
        other.lacking.iter().for_each(|(channel, rows)| self.lack(channel, *rows));
    }

    /// One sentence for each thing, in a log of so many drives.
    pub(crate) fn notes(&self, drives: usize) -> Notes {
        let mut notes = Notes::new();
        let mut told: Vec<&str> = Vec::new();
        for (name, ..) in &self.channels {
            if told.contains(&name.as_str()) {
                continue;
            }
            told.push(name);
            let of: Vec<_> = self.channels.iter().filter(|(other, ..)| other == name).collect();
            let (missing, rows) = of.iter().fold((0, 0), |sum, (_, _, missing, rows)| (sum.0 + missing, sum.1 + rows));
            let without: Vec<&str> = of.iter().map(|(_, drive, ..)| drive.as_str()).collect();
            let place = if of.len() == drives { String::new() } else { format!(" in {}", without.join(", ")) };
            notes.push(format!("{name} not used{place}: missing in {missing} of {rows} rows"));
        }
        if self.commands_alone > 0 {
            notes.push(format!("{} rows have commands and no pose: they count for the rows before and after them", self.commands_alone));
        }
        if self.lacking_rows > 0 {
            notes.push(format!("{} of {} rows left out for missing values ({})", self.lacking_rows, self.rows, self.lacks()));
        }
        notes
    }
}
