//! Where results go.

use std::path::{Path, PathBuf};

use nesam_evaluation::Provenance;
use nesam_model::ModelBundle;

use crate::bundle_path::inside_bundle;
use crate::failure::Failure;
use crate::sources::{Drives, maps_hash};

/// Prints a line of results. A reader that closes the pipe early (`| head`) ends nothing: the files are still written.
pub fn print_line(line: &str) {
    use std::io::Write;
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// `println!` for results, see [`print_line`].
macro_rules! say {
    ($($text:tt)*) => { crate::output::print_line(&format!($($text)*)) };
}
pub(crate) use say;

/// The folder for a command's results, made if needed: `--out`, else `nesam-out/<command>-<set>`. Never inside a bundle.
pub fn out_dir(given: Option<&Path>, command: &str, set: &str) -> Result<PathBuf, Failure> {
    let dir = given.map_or_else(|| Path::new("nesam-out").join(format!("{command}-{}", set.replace('/', "-"))), Path::to_path_buf);
    if inside_bundle(&dir) {
        return Err(Failure::input(format!("--out {} lies in a bundle, which no command may change", dir.display())));
    }
    std::fs::create_dir_all(&dir).map_err(|e| Failure::input(format!("cannot make the folder {}: {e}", dir.display())))?;
    Ok(dir)
}

/// Writes a whole file or none: a neighbour first, then a rename. Folders above it are made.
pub fn write_file(path: &Path, text: &[u8]) -> Result<(), Failure> {
    let fail = |e: std::io::Error| Failure::Failed(format!("cannot write {}: {e}", path.display()));
    if inside_bundle(path.parent().unwrap_or(Path::new("."))) {
        return Err(Failure::input(format!("{} lies in a bundle, which no command may change", path.display())));
    }
    if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(fail)?;
    }
    let name = path.file_name().map_or_else(|| "out".into(), |n| n.to_string_lossy().into_owned());
    let draft = path.with_file_name(format!(".{name}.part"));
    std::fs::write(&draft, text).and_then(|()| std::fs::rename(&draft, path)).map_err(fail)
}

/// The command line as it was typed, fit to be pasted into a shell.
pub fn command_line() -> String {
    let plain = |a: &str| !a.is_empty() && a.chars().all(|c| c.is_ascii_alphanumeric() || "-_./,=:+@%".contains(c));
    let words = std::env::args().skip(1).map(|a| if plain(&a) { a } else { format!("'{}'", a.replace('\'', r"'\''")) });
    std::iter::once("nesam".to_string()).chain(words).collect::<Vec<_>>().join(" ")
}

/// What a result is made from.
pub fn provenance(bundle: Option<&ModelBundle>, drives: &Drives) -> Provenance {
    provenance_of(bundle, &drives.root.hash(), &maps_hash(&drives.maps))
}

/// The same of drives that do not lie in a data root.
pub fn provenance_of(bundle: Option<&ModelBundle>, data_hash: &str, maps_hash: &str) -> Provenance {
    Provenance {
        version: env!("CARGO_PKG_VERSION").into(),
        command: command_line(),
        bundle: bundle.map_or_else(String::new, |b| b.name.clone()),
        bundle_hash: bundle.map_or_else(String::new, |b| b.hash.clone()),
        data_hash: data_hash.into(),
        maps_hash: maps_hash.into(),
    }
}
