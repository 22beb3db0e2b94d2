//! CSV tables: comma, semicolon or tab, names in the first row.

use std::path::Path;

use crate::error::ImportError;
use crate::log::Log;

/// Largest table that is read, bytes.
const BYTES_MAX: u64 = 4 << 30;

/// What other files begin with, and what to do about them.
const FOREIGN: [(&[u8], &str); 10] = [
    (
        b"PAR1",
        "a Parquet file: write it as CSV, or lay it down as a set (SET/samples.parquet) where its columns are named like those of a data root",
    ),
    (b"\x1f\x8b", "compressed with gzip: unpack it with gunzip"),
    (b"\x28\xb5\x2f\xfd", "compressed with zstd: unpack it with unzstd"),
    (b"PK\x03\x04", "a zip archive or a workbook: unpack it, or save the sheet as CSV"),
    (b"\xff\xfe", "a text in UTF-16: save it as UTF-8"),
    (b"\xfe\xff", "a text in UTF-16: save it as UTF-8"),
    (b"\x89MCAP", "a bag in MCAP: let its name end in .mcap"),
    (b"SQLite format 3", "an SQLite database; a bag of ROS 2 is converted with `ros2 bag convert`"),
    (b"\x89HDF", "an HDF5 file: write it as CSV"),
    (b"#ROSBAG", "a bag of ROS 1: convert it to MCAP of ROS 2"),
];

/// Reads a table. What stands between the names in the first row tells the separator; empty cells, `nan`, `na`, `n/a`, `none` and `null` are missing values.
///
/// # Errors
/// `ImportError::Log` naming the line when a row has another number of cells than the first, names repeat, or there is no row; what the file seems to be where
/// it is no text.
pub fn read_csv(path: &Path) -> Result<Log, ImportError> {
    let size = std::fs::metadata(path).map_err(|source| ImportError::file(path, source))?.len();
    if size > BYTES_MAX {
        return Err(ImportError::log(path, format!("has {size} bytes, at most {BYTES_MAX} are read; split it")));
    }
    let content = std::fs::read(path).map_err(|source| ImportError::file(path, source))?;
    if let Some((_, what)) = FOREIGN.iter().find(|(begin, _)| content.starts_with(begin)) {
        return Err(ImportError::log(path, format!("is no CSV table but seems to be {what}")));
    }
    let content = content.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&content);
    let first = content.split(|b| *b == b'\n').next().unwrap_or_default();
    let count = |separator: u8| first.iter().filter(|b| **b == separator).count();
    let separator = [b',', b';', b'\t'].into_iter().max_by_key(|s| count(*s)).unwrap_or(b',');
    let mut reader = csv::ReaderBuilder::new().delimiter(separator).trim(csv::Trim::All).from_reader(content);
    let wrong = |e: csv::Error| ImportError::log(path, e.to_string());
    let names: Vec<String> = reader.headers().map_err(wrong)?.iter().map(|name| name.trim_start_matches('#').trim().to_string()).collect();
    if let Some(name) = names.iter().enumerate().find(|(i, name)| names[..*i].contains(name)).map(|(_, name)| name) {
        return Err(ImportError::log(path, format!("line 1: two columns are named `{name}`")));
    }
    let mut cells: Vec<Vec<String>> = vec![Vec::new(); names.len()];
    let mut places = Vec::new();
    for record in reader.records() {
        let record = record.map_err(wrong)?;
        places.push(record.position().map_or(0, |p| usize::try_from(p.line()).unwrap_or(usize::MAX)));
        cells.iter_mut().zip(record.iter()).for_each(|(column, cell)| column.push(cell.to_string()));
    }
    if places.is_empty() {
        return Err(ImportError::log(path, "has no rows"));
    }
    let mut log = Log { path: path.into(), rows: places.len(), places, ..Log::default() };
    for (name, cells) in names.into_iter().zip(cells) {
        match cells.iter().map(|cell| number(cell)).collect::<Option<Vec<_>>>() {
            Some(numbers) => log.numbers.push((name, numbers)),
            None => log.texts.push((name, cells)),
        }
    }
    Ok(log)
}

/// A number, a missing one, or `None` for another text.
fn number(cell: &str) -> Option<Option<f64>> {
    if cell.is_empty() || ["nan", "null", "none", "na", "n/a", "#n/a"].contains(&cell.to_ascii_lowercase().as_str()) {
        return Some(None);
    }
    cell.parse::<f64>().ok().map(|v| v.is_finite().then_some(v))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Log, ImportError> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("log.csv");
        std::fs::write(&path, text).expect("written");
        read_csv(&path)
    }

    #[test]
    fn analytic_separators_quotes_and_missing_values() {
        let log = read("\u{feff}t;\"x; east\";run\r\n0;1.5;a\r\n0,1;;b\r\n").expect("readable");
        assert_eq!(log.text("t"), Some(vec!["0".into(), "0,1".into()]), "a decimal comma is no number");
        let log = read("# t,x,run\n0,1.5,a\n0.1,nan,\"b, c\"\n").expect("readable");
        assert_eq!(log.column("x"), Some(&[Some(1.5), None][..]));
        assert_eq!((log.column("t").map(<[_]>::len), log.text("run")), (Some(2), Some(vec!["a".into(), "b, c".into()])));
    }

    #[test]
    fn analytic_damaged_tables_name_the_line() {
        assert!(read("t,x\n0,1\n0.1\n").expect_err("ragged").to_string().contains("line: 3"));
        assert!(read("t,t\n0,1\n").expect_err("twice").to_string().contains("two columns"));
        assert!(read("t,x\n").expect_err("empty").to_string().contains("no rows"));
    }

    #[test]
    fn analytic_words_for_missing_values_are_missing() {
        let log = read("t,x\n0,n/a\n1,N/A\n2,null\n3,#N/A\n4,5\n").expect("readable");
        assert_eq!(log.column("x"), Some(&[None, None, None, None, Some(5.0)][..]));
    }

    /// Goal: a file of another kind is called so. Method: the first bytes of each, and more.
    #[test]
    fn published_files_of_another_kind_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("log.csv");
        for (begin, word) in [
            (&b"PAR1\x15\x00"[..], "Parquet"),
            (b"\x1f\x8b\x08\x00", "gunzip"),
            (b"\x28\xb5\x2f\xfd\x24", "zstd"),
            (b"PK\x03\x04\x14", "workbook"),
            (b"\xff\xfet\x00,\x00", "UTF-16"),
            (b"\xfe\xff\x00t\x00,", "UTF-16"),
            (b"\x89MCAP0\r\n", ".mcap"),
        ] {
            std::fs::write(&path, begin).expect("written");
            let told = read_csv(&path).expect_err("no table").to_string();
            assert!(told.contains("is no CSV table") && told.contains(word), "{word}: {told}");
        }
    }
}
