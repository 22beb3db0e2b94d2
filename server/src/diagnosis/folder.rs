//! Folders of diagnoses: one each, removed unless it has a report, and the oldest when there are too many.

use std::io;
use std::path::{Path, PathBuf};

/// Beginning of the name of every folder; then come the time and the session.
const NAMED: &str = "diagnosis-";
/// The report that a finished diagnosis has.
pub(super) const REPORT: &str = "diagnose.json";

/// The folder of one diagnosis. Dropping it removes the folder with everything in it, unless it was kept.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
    kept: bool,
}

impl Folder {
    /// Makes the folder of a diagnosis that begins at this time.
    ///
    /// # Errors
    /// What the system says.
    pub fn make(directory: &Path, unix_ns: i64, session: &str) -> io::Result<Self> {
        std::fs::create_dir_all(directory)?;
        // Nineteen digits of ns until the year 2286: names in order are times in order.
        let path = directory.join(format!("{NAMED}{unix_ns:019}-{session}"));
        std::fs::create_dir(&path)?;
        Ok(Self { path, kept: false })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its name: that of the diagnosis.
    pub fn name(&self) -> String {
        self.path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
    }

    /// Leaves the folder where it is and removes the oldest finished ones beyond `kept_max`. What cannot be removed stays.
    pub fn keep(mut self, kept_max: usize) {
        self.kept = true;
        let Some(directory) = self.path.parent() else { return };
        let finished = finished(directory);
        for old in &finished[..finished.len().saturating_sub(kept_max)] {
            if let Err(error) = std::fs::remove_dir_all(old) {
                tracing::warn!(folder = %old.display(), %error, "an old diagnosis cannot be removed");
            }
        }
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        if !self.kept {
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// The folders that have a report, the oldest first.
fn finished(directory: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path());
    let named = |path: &PathBuf| path.file_name().and_then(|name| name.to_str()).is_some_and(|name| name.starts_with(NAMED));
    let mut folders: Vec<PathBuf> = entries.filter(|path| named(path) && path.join(REPORT).is_file()).collect();
    folders.sort();
    folders
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: a diagnosis that was ended leaves nothing, finished ones are kept up to the limit, and nothing else in the folder is touched. Method: more of each
    /// than the limit, and a stranger with the same contents.
    #[test]
    fn property_only_the_newest_finished_diagnoses_stay() {
        let here = tempfile::tempdir().unwrap();
        let directory = here.path().join("made/if/needed");
        let finish = |unix_ns: i64| {
            let folder = Folder::make(&directory, unix_ns, "s").unwrap();
            std::fs::write(folder.path().join(REPORT), "{}").unwrap();
            folder.keep(2);
        };
        drop(Folder::make(&directory, 5, "s").unwrap());
        std::fs::create_dir(directory.join("other")).unwrap();
        std::fs::write(directory.join("other").join(REPORT), "{}").unwrap();
        [999, 1000, 1001].into_iter().for_each(finish);
        let running = Folder::make(&directory, 7, "s").unwrap();
        finish(1002);
        let mut left: Vec<String> =
            std::fs::read_dir(&directory).unwrap().map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned()).collect();
        left.sort();
        let named = |unix_ns: i64| format!("{NAMED}{unix_ns:019}-s");
        assert_eq!(left, [named(7), named(1001), named(1002), "other".into()]);
        assert_eq!(running.name(), named(7));
        // The same one twice at the same time does not exist.
        assert!(Folder::make(&directory, 7, "s").is_err());
    }
}
