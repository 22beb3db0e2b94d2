//! A log as named columns.

use std::path::PathBuf;

use crate::error::ImportError;

/// A log. All columns have one entry per row; `None` = the row has no such value.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Log {
    /// File it comes from.
    pub path: PathBuf,
    /// Number of rows.
    pub rows: usize,
    /// Columns of numbers, in the order of the file.
    pub numbers: Vec<(String, Vec<Option<f64>>)>,
    /// Columns of which some value is no number.
    pub texts: Vec<(String, Vec<String>)>,
    /// Where in the file each row is, for errors: line or message.
    pub places: Vec<usize>,
    /// Rows at which something else begins by what the reader of the file knows: drives are parted there.
    pub begins: Vec<usize>,
}

impl Log {
    /// Numbers under a name.
    pub fn column(&self, name: &str) -> Option<&[Option<f64>]> {
        self.numbers.iter().find(|(held, _)| held == name).map(|(_, values)| values.as_slice())
    }

    /// Values under a name as text.
    pub fn text(&self, name: &str) -> Option<Vec<String>> {
        let texts = self.texts.iter().find(|(held, _)| held == name).map(|(_, values)| values.clone());
        texts.or_else(|| Some(self.column(name)?.iter().map(|v| v.map_or(String::new(), |v| v.to_string())).collect()))
    }

    /// Whether it has a column of this name, of numbers or not.
    pub fn holds(&self, name: &str) -> bool {
        self.all_names().any(|held| held == name)
    }

    /// Forgets columns.
    ///
    /// # Errors
    /// `ImportError::Log` for a name that it does not have.
    pub fn leave_out(&mut self, names: &[String]) -> Result<(), ImportError> {
        if let Some(unknown) = names.iter().find(|name| !self.holds(name)) {
            let reason = format!("has no column or channel `{unknown}` to leave out; there are {}", self.names());
            return Err(ImportError::log(&self.path, reason));
        }
        self.numbers.retain(|(held, _)| !names.contains(held));
        self.texts.retain(|(held, _)| !names.contains(held));
        Ok(())
    }

    /// Names of all columns, for errors.
    pub fn names(&self) -> String {
        self.all_names().collect::<Vec<_>>().join(", ")
    }

    fn all_names(&self) -> impl Iterator<Item = &str> {
        self.numbers.iter().map(|(n, _)| n.as_str()).chain(self.texts.iter().map(|(n, _)| n.as_str()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_what_is_left_out_was_never_there() {
        let numbers = ["t", "vbx", "vby"].map(|name| (name.to_string(), vec![Some(0.0)])).to_vec();
        let mut log = Log { rows: 1, numbers, texts: vec![("note".into(), vec!["a".into()])], ..Log::default() };
        let refused = log.leave_out(&["vbx".into(), "vbz".into()]).unwrap_err().to_string();
        assert!(refused.contains("`vbz`") && refused.contains("t, vbx, vby, note") && log.holds("vbx"), "{refused}");
        log.leave_out(&["vbx".into(), "note".into()]).unwrap();
        assert_eq!(log.names(), "t, vby");
    }
}
