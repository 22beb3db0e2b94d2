//! Where results and remarks go.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use nesam_evaluation::Provenance;
use nesam_model::ModelBundle;

use crate::bundle_path::inside_bundle;
use crate::failure::Failure;
use crate::sources::{Drives, maps_hash};

/// Why standard output did not take a line; the first failure that is no reader's choice.
static NOT_PRINTED: OnceLock<String> = OnceLock::new();

/// Prints a line of results. A reader that closes the pipe early (`| head`) ends nothing: the files are still written. Any other failure is kept for
/// [`check_printed`].
pub fn print_line(line: &str) {
    if let Err(e) = writeln!(std::io::stdout(), "{line}")
        && e.kind() != ErrorKind::BrokenPipe
    {
        let _ = NOT_PRINTED.set(e.to_string());
    }
}

/// Standard-library printing of results without its panics, see [`print_line`].
macro_rules! say {
    ($($text:tt)*) => { crate::output::print_line(&format!($($text)*)) };
}
pub(crate) use say;

/// Refuses to call a command done of whose results standard output lost a part.
///
/// # Errors
/// Failed work: why it was lost.
pub fn check_printed() -> Result<(), Failure> {
    match NOT_PRINTED.get() {
        None => Ok(()),
        Some(why) => Err(Failure::Failed(format!("cannot write to standard output: {why}; results that were printed are not whole"))),
    }
}

/// Prints a line for whoever watches, on standard error. Where that is full or closed the line is lost, and the work goes on.
pub fn note_line(line: &str) {
    let _ = std::io::stderr().write_all(format!("{line}\n").as_bytes());
}

/// Standard-library printing of remarks without its panics, see [`note_line`].
macro_rules! note {
    ($($text:tt)*) => { crate::output::note_line(&format!($($text)*)) };
}
pub(crate) use note;

/// The folder for a command's results: `--out`, else `nesam-out/<command>-<set>`. Never inside a bundle. It is not made.
pub fn out_place(given: Option<&Path>, command: &str, set: &str) -> Result<PathBuf, Failure> {
    let dir = given.map_or_else(|| Path::new("nesam-out").join(format!("{command}-{}", set.replace('/', "-"))), Path::to_path_buf);
    if inside_bundle(&dir) {
        return Err(Failure::input(format!("--out {} lies in a bundle, which no command may change", dir.display())));
    }
    Ok(dir)
}

/// The same, made if needed.
pub fn out_dir(given: Option<&Path>, command: &str, set: &str) -> Result<PathBuf, Failure> {
    let dir = out_place(given, command, set)?;
    std::fs::create_dir_all(&dir)
        .map_err(|e| Failure::input(format!("cannot make the folder {}: {e}; give another with --out DIR", dir.display())))?;
    Ok(dir)
}

/// Where results of these names go: each where it is asked for, else into the command's folder, which is made only where one needs it. Checked before the
/// work, so that none is lost for a place that cannot take it.
pub fn result_files<const N: usize>(
    out: Option<&Path>,
    command: &str,
    set: &str,
    files: [(&Option<PathBuf>, &str); N],
) -> Result<[PathBuf; N], Failure> {
    let none_needs_it = files.iter().all(|(given, _)| given.is_some());
    let dir = if none_needs_it { out_place(out, command, set)? } else { out_dir(out, command, set)? };
    let files = files.map(|(given, name)| given.clone().unwrap_or_else(|| dir.join(name)));
    files.iter().try_for_each(|file| check_file(file))?;
    Ok(files)
}

/// Refuses a file that no command may write: one in a bundle, one that is a folder, one below a file.
pub fn check_file(path: &Path) -> Result<(), Failure> {
    let refused = |why: &str| Err(Failure::input(format!("{} {why}", path.display())));
    if inside_bundle(path.parent().unwrap_or(Path::new("."))) {
        return refused("lies in a bundle, which no command may change");
    }
    if path.is_dir() {
        return refused("is a folder; give a file");
    }
    match path.ancestors().skip(1).find(|above| above.exists()) {
        Some(above) if !above.is_dir() => refused(&format!("cannot be written: {} is not a folder", above.display())),
        _ => Ok(()),
    }
}

/// Writes a whole file or none: a neighbour first, then a rename. Folders above it are made.
pub fn write_file(path: &Path, text: &[u8]) -> Result<(), Failure> {
    write_with(path, |draft| std::fs::write(draft, text).map_err(|e| cannot_write(path, &e)))
}

/// The same for what is written by a function that is told the neighbour.
pub fn write_with(path: &Path, write: impl FnOnce(&Path) -> Result<(), Failure>) -> Result<(), Failure> {
    check_file(path)?;
    if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(|e| cannot_write(path, &e))?;
    }
    let name = path.file_name().map_or_else(|| "out".into(), |n| n.to_string_lossy().into_owned());
    let draft = path.with_file_name(format!(".{name}.part"));
    let written = write(&draft).and_then(|()| std::fs::rename(&draft, path).map_err(|e| cannot_write(path, &e)));
    if written.is_err() {
        let _ = std::fs::remove_file(&draft);
    }
    written
}

fn cannot_write(path: &Path, error: &std::io::Error) -> Failure {
    Failure::Failed(format!("cannot write {}: {error}", path.display()))
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
