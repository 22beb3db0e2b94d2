//! The index of a set: world and split of each trajectory.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::error::TrajectoryError;
use crate::json::JsonFile;
use crate::table::Table;
use crate::trajectory::Split;

/// What the index says of one trajectory.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Entry {
    pub(crate) world: Option<String>,
    /// Name of its split, whatever it is.
    pub(crate) split_name: Option<String>,
    /// Row in the index file, counting from 0.
    pub(crate) row: usize,
}

/// The index of a set; empty where the set has none.
#[derive(Debug, Default)]
pub(crate) struct Index {
    /// File it came from; `None` = the set has no index.
    pub(crate) path: Option<PathBuf>,
    /// Trajectory ids in file order.
    pub(crate) order: Vec<String>,
    pub(crate) entries: HashMap<String, Entry>,
}

impl Entry {
    /// The split; `None` too where its name is neither train nor test.
    pub(crate) fn split(&self) -> Option<Split> {
        match self.split_name.as_deref()? {
            "train" => Some(Split::Train),
            "test" => Some(Split::Test),
            _ => None,
        }
    }
}

impl Index {
    /// Reads `index.parquet`, else `index.json`, else nothing.
    pub(crate) fn read(set_dir: &Path) -> Result<Self, TrajectoryError> {
        let (parquet, json) = (set_dir.join("index.parquet"), set_dir.join("index.json"));
        if parquet.exists() {
            Self::from_parquet(&parquet)
        } else if json.exists() {
            Self::from_json(&json)
        } else {
            Ok(Self::default())
        }
    }

    /// Whether the set has an index.
    pub(crate) fn exists(&self) -> bool {
        self.path.is_some()
    }

    fn from_parquet(path: &Path) -> Result<Self, TrajectoryError> {
        let table = Table::open(path)?;
        let optional = |name: &str| if table.has(name) { table.texts(name).map(Some) } else { Ok(None) };
        let (ids, worlds, splits) = (table.texts("trajectory")?, optional("world")?, optional("split")?);
        let mut index = Self { path: Some(path.into()), ..Self::default() };
        for row in 0..table.rows() {
            let at = |column: &Option<Vec<Option<std::sync::Arc<str>>>>| {
                column.as_ref().and_then(|values| values[row].as_ref().map(|s| s.to_string()))
            };
            let id = ids[row].as_ref().map(|s| s.to_string());
            index.push(path, row, id, at(&worlds), at(&splits))?;
        }
        Ok(index)
    }

    fn from_json(path: &Path) -> Result<Self, TrajectoryError> {
        let file = JsonFile::read(path)?;
        let rows = file.root().as_array().ok_or_else(|| file.wrong(".", "expected an array of trajectories"))?;
        let mut index = Self { path: Some(path.into()), ..Self::default() };
        for (row, entry) in rows.iter().enumerate() {
            let text = |key: &str| match entry.get(key) {
                None | Some(Value::Null) => Ok(None),
                Some(Value::String(s)) => Ok(Some(s.clone())),
                Some(Value::Number(n)) if n.is_i64() || n.is_u64() => Ok(Some(n.to_string())),
                Some(other) => Err(file.wrong(&format!("[{row}].{key}"), format!("expected text or a whole number, found {other}"))),
            };
            index.push(path, row, text("trajectory")?, text("world")?, text("split")?)?;
        }
        Ok(index)
    }

    fn push(
        &mut self,
        path: &Path,
        row: usize,
        id: Option<String>,
        world: Option<String>,
        split_name: Option<String>,
    ) -> Result<(), TrajectoryError> {
        let wrong = |column: &str, reason: String| TrajectoryError::cell(path, column, row, reason);
        let id = id.ok_or_else(|| wrong("trajectory", "null, expected an id".into()))?;
        if self.entries.insert(id.clone(), Entry { world, split_name, row }).is_some() {
            return Err(wrong("trajectory", format!("`{id}` appears a second time")));
        }
        self.order.push(id);
        Ok(())
    }
}
