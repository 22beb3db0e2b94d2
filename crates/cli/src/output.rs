//! Where results and remarks go.

use std::collections::BTreeSet;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use nesam_evaluation::Provenance;
use nesam_model::ModelBundle;
use rustix::fs::{Access, access};
use serde::Serialize;

use crate::bundle_path::inside_bundle;
use crate::failure::Failure;
use crate::sources::{Drives, maps_hash};

/// Why standard output did not take a line; the first failure that is no reader's choice.
static NOT_PRINTED: OnceLock<String> = OnceLock::new();

/// The name of standard output where a file is asked for.
const STANDARD_OUTPUT: &str = "-";

/// Whether the command line sends a document to standard output, which then has nothing else on it.
fn document_is_printed() -> bool {
    static PRINTED: OnceLock<bool> = OnceLock::new();
    *PRINTED.get_or_init(|| std::env::args().any(|word| word == STANDARD_OUTPUT || word.starts_with("--") && word.ends_with("=-")))
}

/// Prints a line of results; on standard error where `--json -` has the other for itself. A reader that closes the pipe early (`| head`) ends nothing: the files
/// are still written. Any other failure is kept for [`check_printed`].
pub fn print_line(line: &str) {
    if document_is_printed() {
        return note_line(line);
    }
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

/// The same, which can be made and written into. Who writes the first file into it makes it: a command that is refused or fails leaves none.
pub fn out_dir(given: Option<&Path>, command: &str, set: &str) -> Result<PathBuf, Failure> {
    let dir = out_place(given, command, set)?;
    if let Some(above) = nearest(&dir) {
        let refused = |why: String| {
            let (dir, above) = (dir.display(), above.display());
            Failure::input(format!("cannot make the folder {dir} or write into it: {above} {why}; give another with --out DIR"))
        };
        if !above.is_dir() {
            return Err(refused("is not a folder".into()));
        }
        access(above, Access::WRITE_OK).map_err(|error| refused(format!("cannot be written into ({error})")))?;
    }
    Ok(dir)
}

/// Makes a folder and holds it against other runs of the command for as long as what is given lives: two at once would write over one another.
pub fn hold(dir: &Path) -> Result<std::fs::File, Failure> {
    let cannot = |error: std::io::Error| Failure::Failed(format!("{}: {error}", dir.display()));
    std::fs::create_dir_all(dir).map_err(cannot)?;
    let held = std::fs::File::open(dir).map_err(cannot)?;
    match held.try_lock() {
        Err(std::fs::TryLockError::WouldBlock) => {
            Err(Failure::input(format!("another run writes into {} now; give another folder with --out DIR", dir.display())))
        }
        // A file system without locks keeps nobody out.
        _ => Ok(held),
    }
}

/// What is there of a path: itself, or the nearest of what lies above it.
fn nearest(path: &Path) -> Option<&Path> {
    path.ancestors().map(or_here).find(|above| above.exists())
}

/// A folder by a name that the system knows: the one above a plain file has an empty one.
pub fn or_here(folder: &Path) -> &Path {
    if folder.as_os_str().is_empty() { Path::new(".") } else { folder }
}

/// As [`result_files`] for results that each stand alone: without `--out` those that are asked for by name are all that is written, and no folder is made for
/// the others.
pub fn asked_files<const N: usize, const M: usize>(
    out: Option<&Path>,
    command: &str,
    set: &str,
    files: [(&Option<PathBuf>, &str); N],
    beside: [&Option<PathBuf>; M],
) -> Result<[Option<PathBuf>; N], Failure> {
    if out.is_none() && files.iter().any(|(given, _)| given.is_some()) {
        let files = files.map(|(given, _)| given.clone());
        check_files(files.iter().chain(beside).flatten())?;
        return Ok(files);
    }
    result_files(out, command, set, files, beside).map(|files| files.map(Some))
}

/// Where results of these names go: each where it is asked for, else into the command's folder, see [`out_dir`]. Checked before the work, so that none is lost
/// for a place that cannot take it; those that are written `beside` them are checked with them.
pub fn result_files<const N: usize, const M: usize>(
    out: Option<&Path>,
    command: &str,
    set: &str,
    files: [(&Option<PathBuf>, &str); N],
    beside: [&Option<PathBuf>; M],
) -> Result<[PathBuf; N], Failure> {
    let none_needs_it = files.iter().all(|(given, _)| given.is_some());
    let dir = if none_needs_it { out_place(out, command, set)? } else { out_dir(out, command, set)? };
    let files = files.map(|(given, name)| given.clone().unwrap_or_else(|| dir.join(name)));
    check_files(files.iter().chain(beside.into_iter().flatten()))?;
    Ok(files)
}

/// Links followed from one to the next at most, as Linux does.
const LINKS_MAX: usize = 40;

/// Refuses a file that no output may replace: what [`check_place`] refuses, and a file of a data root.
pub fn check_file(path: &Path) -> Result<(), Failure> {
    check_place(path)?;
    let behind = replaceable(path).ok().flatten();
    if behind.is_some_and(|file| is_recorded(&file)) {
        return Err(Failure::input(format!("{} is part of a data root, which no output may replace; give another file", path.display())));
    }
    Ok(())
}

/// Whether a file is there and is one that commands read as data: samples, index, world or card of a data root.
fn is_recorded(file: &Path) -> bool {
    let folder = file.parent().map_or(Path::new("."), or_here);
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    let of_set = ["samples.parquet", "index.parquet", "index.json"].contains(&&*name) && folder.join("samples.parquet").is_file();
    let of_world = folder.join("world.json").is_file();
    let is_card = || name.starts_with("vehicle_") && name.ends_with(".json");
    let has_sets = || {
        folder.join("worlds").is_dir() || nesam_trajectories::DataRoot::open(folder, Some(file)).is_ok_and(|root| !root.sets().is_empty())
    };
    file.is_file() && (of_set || of_world || is_card() && has_sets())
}

/// Refuses a file that no command may write: one in a bundle, one that is a folder, one below a file, one in a folder that takes none. What links lead to
/// counts.
fn check_place(path: &Path) -> Result<(), Failure> {
    let refused = |why: &str| Err(Failure::input(format!("{} {why}", path.display())));
    if path == Path::new(STANDARD_OUTPUT) {
        return Ok(());
    }
    if path.is_dir() {
        return refused("is a folder; give a file");
    }
    let (file, drafted) = match replaceable(path) {
        Err(error) => return refused(&format!("cannot be written: {error}")),
        Ok(Some(file)) => (file, true),
        Ok(None) => (path.to_path_buf(), false),
    };
    if inside_bundle(file.parent().unwrap_or(Path::new("."))) {
        return refused("lies in a bundle, which no command may change");
    }
    match file.parent().and_then(nearest) {
        Some(above) if !above.is_dir() => refused(&format!("cannot be written: {} is not a folder", above.display())),
        Some(above) if drafted => {
            access(above, Access::WRITE_OK).or_else(|error| refused(&format!("cannot be written: {}: {error}", above.display())))
        }
        _ => Ok(()),
    }
}

/// Refuses outputs of a command that cannot be written ([`check_file`]) or share a file.
pub fn check_files<'a>(files: impl Iterator<Item = &'a PathBuf> + Clone) -> Result<(), Failure> {
    files.clone().try_for_each(|file| check_file(file))?;
    check_apart(files)
}

/// Refuses a file that two outputs, or an output and an input, share: the later one would take the place of the other.
pub fn check_apart<'a>(files: impl IntoIterator<Item = &'a PathBuf>) -> Result<(), Failure> {
    let (mut known, mut on_standard_output) = (BTreeSet::new(), 0);
    for file in files {
        on_standard_output += usize::from(file == Path::new(STANDARD_OUTPUT));
        if on_standard_output > 1 {
            return Err(Failure::input("standard output (-) is named twice: one of the two has to be a file"));
        }
        let Ok(Some(place)) = replaceable(file) else { continue };
        let folder = place.parent().map_or(Path::new("."), or_here);
        // A folder that is not there yet is known by its name.
        let folder = folder.canonicalize().or_else(|_| std::path::absolute(folder)).unwrap_or_else(|_| folder.into());
        if !known.insert(folder.join(place.file_name().unwrap_or_default())) {
            return Err(Failure::input(format!("{} is named twice; give each file a place of its own", file.display())));
        }
    }
    Ok(())
}

/// Why nothing is written into the folder of a set that is there.
pub fn set_exists(folder: &Path) -> Failure {
    Failure::input(format!("{} exists; choose another --set or remove it", folder.display()))
}

/// The file behind the links of a path, whose place a whole new one can take; `None` for what is written as it is: a device, a pipe, a file that is open
/// already and named by its number, standard output.
fn replaceable(path: &Path) -> std::io::Result<Option<PathBuf>> {
    if path == Path::new(STANDARD_OUTPUT) || std::fs::metadata(path).is_ok_and(|there| !there.is_file()) {
        return Ok(None);
    }
    let mut file = path.to_path_buf();
    for _ in 0..LINKS_MAX {
        if file.starts_with("/proc") || file.starts_with("/dev/fd") {
            return Ok(None);
        }
        let Ok(behind) = std::fs::read_link(&file) else { return Ok(Some(file)) };
        file = file.parent().unwrap_or(Path::new("")).join(behind);
    }
    Err(std::io::Error::other(format!("more than {LINKS_MAX} links lead on from it")))
}

/// Writes a whole file or none: a neighbour first, then a rename. Folders above it are made. Devices and pipes are written as they are.
pub fn write_file(path: &Path, text: &[u8]) -> Result<(), Failure> {
    if [STANDARD_OUTPUT, "/dev/stdout"].map(Path::new).contains(&path) {
        // Opened anew it would begin at the start of a file that holds the printed lines.
        let mut stdout = std::io::stdout().lock();
        return stdout.write_all(text).and_then(|()| stdout.flush()).map_err(|e| cannot_write(path, &e));
    }
    write_with(path, |draft| std::fs::write(draft, text).map_err(|e| cannot_write(path, &e)))
}

/// Writes a document as JSON, see [`write_file`].
pub fn write_json(path: &Path, document: &impl Serialize) -> Result<(), Failure> {
    write_file(path, json_text(document).as_bytes())
}

/// A document as JSON for people and programs.
pub fn json_text(document: &impl Serialize) -> String {
    serde_json::to_string_pretty(document).expect("numbers and text always serialise; this is a bug") + "\n"
}

/// As [`write_file`] for what is written by a function that is told the neighbour, or the device or pipe itself.
pub fn write_with(path: &Path, write: impl FnOnce(&Path) -> Result<(), Failure>) -> Result<(), Failure> {
    check_place(path)?;
    let Some(file) = replaceable(path).map_err(|e| cannot_write(path, &e))? else {
        return write(if path == Path::new(STANDARD_OUTPUT) { Path::new("/dev/stdout") } else { path });
    };
    if let Some(folder) = file.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(|e| cannot_write(path, &e))?;
    }
    let name = file.file_name().map_or_else(|| "out".into(), |n| n.to_string_lossy().into_owned());
    let draft = file.with_file_name(format!(".{name}.part"));
    let written = write(&draft).and_then(|()| std::fs::rename(&draft, &file).map_err(|e| cannot_write(path, &e)));
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
    shell_line(std::env::args().skip(1))
}

/// A command line of this program with such words behind its name, quoted where a shell wants it.
pub fn shell_line(words: impl Iterator<Item = String>) -> String {
    let plain = |a: &str| !a.is_empty() && a.chars().all(|c| c.is_ascii_alphanumeric() || "-_./,=:+@%…".contains(c));
    let words = words.map(|a| if plain(&a) { a } else { format!("'{}'", a.replace('\'', r"'\''")) });
    std::iter::once("nesam".to_string()).chain(words).collect::<Vec<_>>().join(" ")
}

/// What a result is made from.
pub fn provenance(bundle: Option<&ModelBundle>, drives: &Drives) -> Provenance {
    provenance_of(bundle, &drives.root.hash(), &maps_hash(&drives.maps))
}

/// The same of drives that do not lie in a data root; empty hashes where there are none.
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

/// Heads of the columns of errors by dimension and of the position, each so wide.
pub fn error_heads(width: usize) -> String {
    ["x m", "y m", "z m", "roll °", "pitch °", "yaw °", "pos. m"].map(|name| format!("{name:>width$}")).concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: a link stays one, and what it leads to is replaced whole. Method: a link to a file, one to that link, one to a file that is not there yet, one to
    /// itself.
    #[test]
    fn property_a_link_stays_and_the_file_behind_it_is_written() {
        let here = tempfile::tempdir().unwrap();
        let at = |name: &str| here.path().join(name);
        std::fs::write(at("file"), "old").unwrap();
        for (to, from) in [("file", "link"), ("link", "second"), ("folder/new", "dangling"), ("loop", "loop")] {
            std::os::unix::fs::symlink(to, at(from)).unwrap();
        }
        for (link, file) in [("link", "file"), ("second", "file"), ("dangling", "folder/new")] {
            write_file(&at(link), link.as_bytes()).unwrap();
            assert!(at(link).is_symlink(), "{link}");
            assert_eq!(std::fs::read_to_string(at(file)).unwrap(), link);
        }
        assert!(check_file(&at("loop")).unwrap_err().to_string().contains("links"));
        std::fs::create_dir(at("kept")).unwrap();
        std::fs::write(at("kept/manifest.toml"), "").unwrap();
        std::os::unix::fs::symlink("kept/new", at("into")).unwrap();
        assert!(check_file(&at("into")).unwrap_err().to_string().contains("lies in a bundle"));
        assert!(!here.path().read_dir().unwrap().flatten().any(|e| e.file_name().to_string_lossy().ends_with(".part")));
    }

    /// Goal: no output takes the place of recorded data, and one that is written again is. Method: the files of a data root, and others of their names elsewhere.
    #[test]
    fn property_no_output_replaces_a_file_of_a_data_root() {
        let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/chrono_sample");
        for file in
            ["nominal/samples.parquet", "nominal/index.json", "worlds/w01/world.json", "worlds/w01/elevation.png", "vehicle_hmmwv.json"]
        {
            let refused = check_file(&sample.join(file)).unwrap_err().to_string();
            assert!(refused.contains("part of a data root"), "{refused}");
        }
        assert!(check_file(&sample.join("nominal/report.json")).is_ok(), "beside them there is place");
        let here = tempfile::tempdir().unwrap();
        for name in ["index.json", "vehicle_calibrated.json", "world.png"] {
            std::fs::write(here.path().join(name), "{}").unwrap();
            assert!(check_file(&here.path().join(name)).is_ok(), "{name}");
        }
    }

    /// Goal: what is no file stays what it is, and what it does not take is a failure. Method: a named pipe with a reader, `/dev/full` behind a link.
    #[test]
    fn property_pipes_and_devices_are_written_as_they_are() {
        use std::os::unix::fs::FileTypeExt;
        let here = tempfile::tempdir().unwrap();
        let (pipe, full) = (here.path().join("pipe"), here.path().join("full"));
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || std::fs::read_to_string(pipe).unwrap()
        });
        write_file(&pipe, b"whole").unwrap();
        assert_eq!(reader.join().unwrap(), "whole");
        assert!(std::fs::metadata(&pipe).unwrap().file_type().is_fifo());
        std::os::unix::fs::symlink("/dev/full", &full).unwrap();
        check_file(&full).unwrap();
        assert!(matches!(write_file(&full, b"lost").unwrap_err(), Failure::Failed(why) if why.contains("cannot write")));
        assert!(full.is_symlink());
    }
}
