//! Which column of a log is what.

use crate::error::ImportError;
use crate::log::Log;

/// What a column measures; says which units it may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Time.
    Time,
    /// Position.
    Length,
    /// Attitude, road-wheel angle.
    Angle,
    /// Velocity.
    Speed,
    /// Angular velocity, wheel speed.
    AngularSpeed,
    /// Normalised or of the unit that the vehicle card says.
    Number,
}

/// Columns of a data root that can be imported, and what they measure. `cmd_steer` (normalised), `cmd_road_wheel_angle` and `cmd_yaw_rate` are the second
/// command; the vehicle card says which.
pub const COLUMNS: [(&str, Quantity); 33] = [
    ("t", Quantity::Time),
    ("x", Quantity::Length),
    ("y", Quantity::Length),
    ("z", Quantity::Length),
    ("roll", Quantity::Angle),
    ("pitch", Quantity::Angle),
    ("yaw", Quantity::Angle),
    ("qx", Quantity::Number),
    ("qy", Quantity::Number),
    ("qz", Quantity::Number),
    ("qw", Quantity::Number),
    ("vx", Quantity::Speed),
    ("vy", Quantity::Speed),
    ("vz", Quantity::Speed),
    ("vbx", Quantity::Speed),
    ("vby", Quantity::Speed),
    ("vbz", Quantity::Speed),
    ("wx", Quantity::AngularSpeed),
    ("wy", Quantity::AngularSpeed),
    ("wz", Quantity::AngularSpeed),
    ("cmd_speed", Quantity::Speed),
    ("cmd_steer", Quantity::Number),
    ("cmd_road_wheel_angle", Quantity::Angle),
    ("cmd_yaw_rate", Quantity::AngularSpeed),
    ("om_fl", Quantity::AngularSpeed),
    ("om_fr", Quantity::AngularSpeed),
    ("om_rl", Quantity::AngularSpeed),
    ("om_rr", Quantity::AngularSpeed),
    ("om_l", Quantity::AngularSpeed),
    ("om_r", Quantity::AngularSpeed),
    ("steer_fl", Quantity::Angle),
    ("steer_fr", Quantity::Angle),
    // Not a number: the name of the drive that the row belongs to.
    ("trajectory", Quantity::Number),
];

impl Quantity {
    /// Units and their factors to SI and radians.
    fn units(self) -> &'static [(&'static str, f64)] {
        const DEG: f64 = std::f64::consts::PI / 180.0;
        match self {
            Self::Time => &[("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)],
            Self::Length => &[("m", 1.0), ("cm", 1e-2), ("mm", 1e-3), ("ft", 0.3048)],
            Self::Angle => &[("rad", 1.0), ("deg", DEG)],
            Self::Speed => &[("m/s", 1.0), ("km/h", 1.0 / 3.6), ("mph", 0.447_04), ("ft/s", 0.3048), ("kn", 1852.0 / 3600.0)],
            Self::AngularSpeed => &[("rad/s", 1.0), ("deg/s", DEG), ("rpm", std::f64::consts::TAU / 60.0)],
            Self::Number => &[("1", 1.0), ("%", 1e-2)],
        }
    }
}

/// One line of a mapping: `TARGET=[-]SOURCE[:UNIT]`.
#[derive(Clone, Debug, PartialEq)]
struct Entry {
    target: &'static str,
    source: String,
    factor: f64,
}

/// Which column of a log is what. Columns of a log that are named like those of a data root need no entry.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mapping {
    entries: Vec<Entry>,
}

impl Mapping {
    /// Reads entries `TARGET=[-]SOURCE[:UNIT]`: `yaw=heading:deg`, `cmd_steer=-steering`. Blank entries and those that begin with `#` say nothing, nor does the
    /// byte order mark that a file may begin with.
    ///
    /// # Errors
    /// `ImportError::Mapping` naming the entry: no such target, a target twice, or an entry without `=`.
    pub fn parse<'a>(lines: impl IntoIterator<Item = &'a str>) -> Result<Self, ImportError> {
        let mut entries: Vec<Entry> = Vec::new();
        let lines = lines.into_iter().map(|line| line.trim_start_matches('\u{feff}').trim());
        for line in lines.filter(|line| !line.is_empty() && !line.starts_with('#')) {
            let entry = entry(line)?;
            if entries.iter().any(|held| held.target == entry.target) {
                return Err(ImportError::mapping(line, format!("`{}` is mapped twice", entry.target)));
            }
            entries.push(entry);
        }
        Ok(Self { entries })
    }

    /// Whether an entry names the column of a target.
    pub(crate) fn maps(&self, target: &str) -> bool {
        self.entry(target).is_some()
    }

    fn entry(&self, target: &str) -> Option<&Entry> {
        self.entries.iter().find(|entry| entry.target == target)
    }

    /// Numbers of a target in SI and radians; `None` when the log has no such column. A column that holds something else is refused, mapped or not.
    pub(crate) fn numbers(&self, log: &Log, target: &str) -> Result<Option<Vec<Option<f64>>>, ImportError> {
        let (source, factor) = match self.entry(target) {
            Some(entry) => (entry.source.as_str(), entry.factor),
            None if log.holds(target) => (target, 1.0),
            None => return Ok(None),
        };
        let values = log.column(source).ok_or_else(|| ImportError::log(&log.path, no_numbers(log, source, target)))?;
        // A factor of one leaves every bit.
        Ok(Some(values.iter().map(|v| v.map(|v| if factor == 1.0 { v } else { v * factor })).collect()))
    }

    /// Texts of a target; `None` when the log has no such column.
    pub(crate) fn texts(&self, log: &Log, target: &str) -> Option<Vec<String>> {
        log.text(self.entry(target).map_or(target, |entry| entry.source.as_str()))
    }
}

/// Why a log has no numbers under a name.
fn no_numbers(log: &Log, source: &str, target: &str) -> String {
    let texts = log.text(source).unwrap_or_default();
    if let Some((row, text)) = texts.iter().enumerate().find(|(_, text)| text.parse::<f64>().is_err() && !text.is_empty()) {
        let line = log.places.get(row).map_or(String::new(), |line| format!("line {line}: "));
        return format!("{line}column `{source}` (for `{target}`) holds `{text}`, expected numbers{}", remedy(text));
    }
    let quantity = COLUMNS.iter().find(|(name, _)| *name == target).map(|(_, quantity)| *quantity);
    if let (Some((name, unit)), Some(quantity)) = (source.rsplit_once(':'), quantity)
        && log.holds(name.trim_end())
    {
        return format!("column `{}`: {}", name.trim_end(), no_unit(unit, target, quantity));
    }
    format!("has no column `{source}` (for `{target}`); it has {}", log.names())
}

/// What to do about a cell that is no number.
fn remedy(text: &str) -> &'static str {
    let digits = |text: &str| text.bytes().any(|b| b.is_ascii_digit());
    if text.replace(',', ".").parse::<f64>().is_ok() {
        "; write them with a decimal point"
    } else if digits(text) && text.contains(':') {
        "; write times as seconds, for instance since 1970"
    } else if digits(text) {
        "; write them without units or separators of thousands"
    } else {
        "; leave the cell empty where the value is missing"
    }
}

fn no_unit(unit: &str, target: &str, quantity: Quantity) -> String {
    let units: Vec<&str> = quantity.units().iter().map(|(unit, _)| *unit).collect();
    let is_angle = Quantity::Angle.units().iter().any(|(known, _)| *known == unit.trim());
    let other = if target == "cmd_steer" && is_angle { "; a road-wheel angle is `cmd_road_wheel_angle`" } else { "" };
    format!("`{}` is no unit of `{target}`; allowed are {}{other}", unit.trim(), units.join(", "))
}

fn entry(line: &str) -> Result<Entry, ImportError> {
    let wrong = |reason: String| ImportError::mapping(line, reason);
    let (target, source) =
        line.split_once('=').ok_or_else(|| wrong("expected TARGET=[-]SOURCE[:UNIT], for instance yaw=heading:deg".into()))?;
    let target = target.trim();
    let Some(&(target, quantity)) = COLUMNS.iter().find(|(name, _)| *name == target) else {
        let all: Vec<&str> = COLUMNS.iter().map(|(name, _)| *name).collect();
        return Err(wrong(format!("no target `{target}`; there are {}", all.join(", "))));
    };
    let (sign, source) = source.trim().strip_prefix('-').map_or((1.0, source.trim()), |rest| (-1.0, rest));
    // A colon may be part of a name: only a unit behind the last one is one.
    let unit = source.rsplit_once(':').and_then(|(name, unit)| {
        let factor = quantity.units().iter().find(|(known, _)| *known == unit.trim())?.1;
        Some((name, factor))
    });
    if unit.is_none()
        && let Some((_, unknown)) = source.rsplit_once(':')
        && COLUMNS.iter().flat_map(|(_, q)| q.units()).any(|(known, _)| *known == unknown.trim())
    {
        return Err(wrong(no_unit(unknown, target, quantity)));
    }
    let (source, factor) = unit.unwrap_or((source, 1.0));
    if source.is_empty() {
        return Err(wrong("names no column of the log".into()));
    }
    Ok(Entry { target, source: source.into(), factor: sign * factor })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_units_and_signs() {
        let log = Log {
            path: "log.csv".into(),
            rows: 1,
            numbers: vec![("heading".into(), vec![Some(90.0)]), ("a:b".into(), vec![Some(36.0)]), ("t".into(), vec![Some(2.0)])],
            texts: vec![("run".into(), vec!["one".into()]), ("x".into(), vec!["n/a".into()])],
            places: vec![2],
            ..Log::default()
        };
        let mapping = Mapping::parse(["# comment", "", "yaw = -heading:deg", "cmd_speed=a:b:km/h", "trajectory=run"]).expect("valid");
        let value = |target| mapping.numbers(&log, target).map(|column| column.map(|c| c[0].unwrap_or(f64::NAN)));
        assert_eq!(value("yaw").expect("there"), Some(-std::f64::consts::FRAC_PI_2));
        assert_eq!(value("cmd_speed").expect("there"), Some(10.0));
        assert_eq!(value("t").expect("there"), Some(2.0));
        assert_eq!(value("wz").expect("absent"), None);
        let told = value("x").expect_err("no number").to_string();
        assert!(told.contains("line 2: column `x` (for `x`) holds `n/a`, expected numbers; leave the cell empty"), "{told}");
        assert_eq!(mapping.texts(&log, "trajectory"), Some(vec!["one".to_string()]));
    }

    #[test]
    fn analytic_wrong_entries_say_what_is_allowed() {
        let told = |line: &str| Mapping::parse([line]).expect_err("wrong").to_string();
        assert!(told("heading").contains("TARGET=[-]SOURCE[:UNIT]"));
        assert!(told("heading=yaw").contains("no target `heading`; there are t, x"));
        assert!(told("yaw=heading:km/h").contains("allowed are rad, deg"));
        assert!(told("yaw=").contains("names no column"));
        assert!(Mapping::parse(["yaw=a", "yaw=b"]).is_err());
    }

    /// Goal: a file of an editor that writes byte order marks is one. Method: a mark before the first entry, and before a comment.
    #[test]
    fn regress_a_byte_order_mark_is_no_part_of_an_entry() {
        for first in ["\u{feff}yaw=heading:deg", "\u{feff}# names\nyaw=heading:deg"] {
            assert_eq!(Mapping::parse(first.lines()).expect("valid"), Mapping::parse(["yaw=heading:deg"]).expect("valid"));
        }
    }

    /// Goal: an error of a cell names line and remedy, one of an unknown unit those that there are. Method: a log whose third line holds what is no number.
    #[test]
    fn analytic_what_is_no_number_is_told_with_its_line_and_a_remedy() {
        let told = |text: &str, entries: &[&str]| {
            let log = Log {
                path: "log.csv".into(),
                rows: 2,
                texts: vec![("t".into(), vec!["1.5".into(), text.into()]), ("h:deg".into(), vec![String::new(); 2])],
                places: vec![2, 3],
                ..Log::default()
            };
            Mapping::parse(entries.iter().copied()).expect("valid").numbers(&log, "t").expect_err("no numbers").to_string()
        };
        for (text, remedy) in [
            ("0,1", "decimal point"),
            ("2026-05-01T12:00:00Z", "times as seconds"),
            ("3 m", "without units"),
            ("fault", "leave the cell empty"),
        ] {
            let told = told(text, &[]);
            assert!(told.contains("line 3: column `t`") && told.contains(&format!("`{text}`")) && told.contains(remedy), "{told}");
        }
        assert!(told("1", &["t=t:sec"]).contains("column `t`: `sec` is no unit of `t`; allowed are s, ms, us, ns"));
        assert!(told("1", &["t=stamp:sec"]).contains("has no column `stamp:sec` (for `t`)"));
    }
}
