//! A log as named columns.

use std::path::PathBuf;

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

    /// Names of all columns, for errors.
    pub fn names(&self) -> String {
        self.all_names().collect::<Vec<_>>().join(", ")
    }

    fn all_names(&self) -> impl Iterator<Item = &str> {
        self.numbers.iter().map(|(n, _)| n.as_str()).chain(self.texts.iter().map(|(n, _)| n.as_str()))
    }
}
