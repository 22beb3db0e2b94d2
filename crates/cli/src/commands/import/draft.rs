//! The place where a set is written and judged before it is one.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use crate::failure::Failure;
use crate::output::set_exists;

/// A hidden folder in a data root, a data root itself, that holds the new set until it takes its place at once. What is left over of one that was killed has a name of
/// its own: it is in nobody's way, and no command reads it.
#[derive(Clone, Debug)]
pub struct Draft {
    /// The data root that the set is for.
    to: PathBuf,
    /// The hidden folder.
    root: PathBuf,
    /// Folder of the set once it is there.
    folder: PathBuf,
    /// Folders above it that are made for it, from below.
    above: Vec<PathBuf>,
}

impl Draft {
    /// Plans a draft of a set of a data root; nothing is made.
    pub fn new(to: &Path, set: &str) -> Self {
        let unique = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_nanos());
        let folder = to.join(set);
        let above = folder.ancestors().skip(1).take_while(|dir| !dir.as_os_str().is_empty() && !dir.exists()).map(PathBuf::from).collect();
        Self { to: to.into(), root: to.join(format!(".import-{}-{unique}", std::process::id())), folder, above }
    }

    /// The hidden data root.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Folder of the set once it is there.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Makes the hidden data root, which sees the worlds of the other one.
    ///
    /// # Errors
    /// Wrong input where the folder takes nothing.
    pub fn make(&self) -> Result<(), Failure> {
        let failed = |e: std::io::Error| Failure::input(format!("cannot make the folder {}: {e}", self.folder.display()));
        std::fs::create_dir_all(&self.root).map_err(failed)?;
        match self.to.join("worlds").canonicalize() {
            Ok(worlds) => std::os::unix::fs::symlink(worlds, self.root.join("worlds")).map_err(failed),
            Err(_) => Ok(()),
        }
    }

    /// Puts the set in its place, which nobody else may have taken meanwhile.
    ///
    /// # Errors
    /// Wrong input where there is a set or the folder takes nothing.
    pub fn publish(&self, set: &str) -> Result<(), Failure> {
        let failed = |e: std::io::Error| match e.kind() {
            ErrorKind::AlreadyExists | ErrorKind::DirectoryNotEmpty | ErrorKind::NotADirectory => set_exists(&self.folder),
            _ => Failure::input(format!("cannot make the folder {}: {e}", self.folder.display())),
        };
        std::fs::create_dir_all(self.folder.parent().unwrap_or(&self.to)).map_err(failed)?;
        std::fs::rename(self.root.join(set), &self.folder).map_err(failed)
    }

    /// Removes the hidden folder, and of the folders above the set those that were made for it and hold nothing.
    pub fn discard(&self) {
        let _ = std::fs::remove_dir_all(&self.root);
        // Those that were not made yet are none, and those that hold something stay.
        self.above.iter().for_each(|dir| drop(std::fs::remove_dir(dir)));
    }

    /// A failure that names the place that the set is for, and not that of the draft.
    pub fn told_of(&self, failure: Failure) -> Failure {
        let renamed = |text: String| text.replace(&self.root.display().to_string(), &self.to.display().to_string());
        match failure {
            Failure::Input(text) => Failure::Input(renamed(text)),
            Failure::Failed(text) => Failure::Failed(renamed(text)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: a set is there whole or not at all. Method: two drafts of one set, of which the second comes too late; a draft that is left over; one that is discarded.
    #[test]
    fn property_a_draft_takes_its_place_at_once_or_leaves_nothing() {
        let here = tempfile::tempdir().unwrap();
        let root = here.path().join("root");
        let drafts = [0; 3].map(|_| Draft::new(&root, "a/b"));
        for (draft, text) in drafts.iter().zip(["first", "second", "left over"]) {
            draft.make().unwrap();
            std::fs::create_dir_all(draft.root().join("a/b")).unwrap();
            std::fs::write(draft.root().join("a/b/samples.parquet"), text).unwrap();
        }
        assert!(!root.join("a").exists());
        drafts[0].publish("a/b").unwrap();
        drafts[0].discard();
        let late = drafts[1].publish("a/b").unwrap_err().to_string();
        assert!(late.contains("exists; choose another --set"), "{late}");
        drafts[1].discard();
        assert_eq!(std::fs::read_to_string(root.join("a/b/samples.parquet")).unwrap(), "first");
        assert!(drafts[2].root().exists() && !drafts[0].root().exists() && !drafts[1].root().exists());
        let told = drafts[2].told_of(Failure::input(format!("{}/a/b: no", drafts[2].root().display()))).to_string();
        assert_eq!(told, format!("{}/a/b: no", root.display()));
        for set in ["a", "a/b"] {
            let other = Draft::new(&here.path().join("new/root"), set);
            other.make().unwrap();
            other.discard();
            assert!(!here.path().join("new").exists(), "{set}");
        }
    }
}
