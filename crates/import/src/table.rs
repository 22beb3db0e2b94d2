//! CSV tables: comma, semicolon or tab, names in the first row.

use std::path::Path;

use crate::error::ImportError;
use crate::log::Log;

/// Largest table that is read, bytes.
const BYTES_MAX: u64 = 4 << 30;

/// Reads a table. What stands between the names in the first row tells the separator; empty cells, `nan` and `null` are missing values.
///
/// # Errors
/// `ImportError::Log` naming the line when a row has another number of cells than the first, names repeat, or there is no row.
pub fn read_csv(path: &Path) -> Result<Log, ImportError> {
    let size = std::fs::metadata(path).map_err(|source| ImportError::file(path, source))?.len();
    if size > BYTES_MAX {
        return Err(ImportError::log(path, format!("has {size} bytes, at most {BYTES_MAX} are read; split it")));
    }
    let content = std::fs::read(path).map_err(|source| ImportError::file(path, source))?;
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
    if cell.is_empty() || ["nan", "null", "none", "na"].contains(&cell.to_ascii_lowercase().as_str()) {
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
}
