//! JSON files whose errors name file and key.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::error::TrajectoryError;

/// A parsed JSON file.
pub(crate) struct JsonFile {
    path: PathBuf,
    root: Value,
}

impl JsonFile {
    pub(crate) fn read(path: &Path) -> Result<Self, TrajectoryError> {
        let text = std::fs::read(path).map_err(|source| TrajectoryError::Read { path: path.into(), source })?;
        let root = serde_json::from_slice(&text).map_err(|source| TrajectoryError::Json { path: path.into(), source })?;
        Ok(Self { path: path.into(), root })
    }

    pub(crate) fn root(&self) -> &Value {
        &self.root
    }

    pub(crate) fn wrong(&self, key: &str, reason: impl Into<String>) -> TrajectoryError {
        TrajectoryError::Key { path: self.path.clone(), key: key.into(), reason: reason.into() }
    }

    /// The value of a dotted key; a null counts as missing.
    pub(crate) fn get(&self, dotted: &str) -> Option<&Value> {
        dotted.split('.').try_fold(&self.root, |value, key| value.get(key)).filter(|v| !v.is_null())
    }

    /// The first of several names of one thing, with the name that was found.
    pub(crate) fn first<'k>(&self, keys: &[&'k str]) -> Option<(&'k str, &Value)> {
        keys.iter().find_map(|key| self.get(key).map(|value| (*key, value)))
    }

    /// A finite number; `None` when missing.
    pub(crate) fn number(&self, keys: &[&str]) -> Result<Option<f64>, TrajectoryError> {
        self.first(keys).map(|(key, value)| self.finite(key, value)).transpose()
    }

    /// A finite number above 0; `None` when missing.
    pub(crate) fn positive(&self, keys: &[&str]) -> Result<Option<f64>, TrajectoryError> {
        let Some((key, value)) = self.first(keys) else { return Ok(None) };
        let number = self.finite(key, value)?;
        if number > 0.0 { Ok(Some(number)) } else { Err(self.wrong(key, format!("{number} is not positive"))) }
    }

    /// A finite number above 0 that must be there.
    pub(crate) fn required(&self, keys: &[&str]) -> Result<f64, TrajectoryError> {
        self.positive(keys)?.ok_or_else(|| self.missing(keys))
    }

    pub(crate) fn missing(&self, keys: &[&str]) -> TrajectoryError {
        let others = if keys.len() > 1 { format!(" (also read: {})", keys[1..].join(", ")) } else { String::new() };
        self.wrong(keys[0], format!("missing{others}"))
    }

    pub(crate) fn text(&self, key: &str) -> Result<Option<&str>, TrajectoryError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        value.as_str().map(Some).ok_or_else(|| self.wrong(key, format!("expected text, found {value}")))
    }

    pub(crate) fn finite(&self, key: &str, value: &Value) -> Result<f64, TrajectoryError> {
        let number = value.as_f64().filter(|x| x.is_finite());
        number.ok_or_else(|| self.wrong(key, format!("expected a finite number, found {value}")))
    }

    /// An array of exactly N finite numbers.
    pub(crate) fn array<const N: usize>(&self, key: &str, value: &Value) -> Result<[f64; N], TrajectoryError> {
        let wrong = || self.wrong(key, format!("expected {N} numbers, found {value}"));
        let parts = value.as_array().filter(|a| a.len() == N).ok_or_else(wrong)?;
        let mut numbers = [0.0; N];
        for (number, part) in numbers.iter_mut().zip(parts) {
            *number = self.finite(key, part)?;
        }
        Ok(numbers)
    }

    /// N rows of M finite numbers.
    pub(crate) fn matrix<const N: usize, const M: usize>(&self, key: &str, value: &Value) -> Result<[[f64; M]; N], TrajectoryError> {
        let wrong = || self.wrong(key, format!("expected {N} rows of {M} numbers, found {value}"));
        let rows = value.as_array().filter(|a| a.len() == N).ok_or_else(wrong)?;
        let mut matrix = [[0.0; M]; N];
        for (to, row) in matrix.iter_mut().zip(rows) {
            *to = self.array(key, row)?;
        }
        Ok(matrix)
    }
}
