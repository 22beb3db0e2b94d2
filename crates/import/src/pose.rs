//! Position and attitude of a log.

use nesam_physics::vec3::attitude_of_quaternion;

use crate::error::ImportError;
use crate::log::Log;
use crate::part::{Channel, Notes, Options, absent, incomplete, required, turned};

const ANGLES: [&str; 3] = ["roll", "pitch", "yaw"];
const QUATERNION: [&str; 4] = ["qx", "qy", "qz", "qw"];

/// Deviation from unit length of a quaternion that rounding does not make, and share of such rows that is told (chosen).
const LENGTH_OFF: f64 = 0.05;

/// A column of a log; `None` = it has no such column.
type Found = Option<Vec<Option<f64>>>;

/// Position and attitude in the conventions of a data root, without heights, roll and pitch that a flat log lacks.
pub(crate) fn pose(log: &Log, options: &Options, notes: &mut Notes) -> Result<Vec<Channel>, ImportError> {
    let height = options.mapping.numbers(log, "z")?;
    let mut lacking: Vec<&str> = if height.is_none() { vec!["z"] } else { Vec::new() };
    let position = [required(log, options, "x", "")?, required(log, options, "y", "")?, or_flat(log, options, height, "z", FLAT)?];
    let attitude = attitude(log, options, &mut lacking, notes)?;
    if !lacking.is_empty() {
        notes.push(format!("no {} in the set, as --flat allows: taken for zero, on level ground, and not scored", lacking.join(", ")));
    }
    let position = turned(position, |v| options.frame.world(v));
    let attitude = turned(attitude, |v| options.frame.attitude(v));
    let all = ["x", "y", "z"].into_iter().zip(position).chain(ANGLES.into_iter().zip(attitude));
    Ok(all.filter(|(name, _)| !lacking.contains(name)).map(|(name, values)| (name.into(), values)).collect())
}

/// Advice for a column that a flat log may lack.
const FLAT: &str = " (with --flat it may be missing and is taken for zero)";

fn or_flat(log: &Log, options: &Options, found: Found, target: &str, hint: &str) -> Result<Vec<Option<f64>>, ImportError> {
    match found {
        Some(values) => Ok(values),
        None if options.flat => Ok(vec![Some(0.0); log.rows]),
        None => Err(absent(log, target, hint)),
    }
}

/// Roll, pitch and yaw, in the axes of the log. Where it has both, columns that are mapped count before those that are not, and a quaternion before angles.
fn attitude(log: &Log, options: &Options, lacking: &mut Vec<&str>, notes: &mut Notes) -> Result<[Vec<Option<f64>>; 3], ImportError> {
    let columns = |names: &[&str]| names.iter().map(|name| options.mapping.numbers(log, name)).collect::<Result<Vec<Found>, _>>();
    let (angles, quaternion) = (columns(&ANGLES)?, columns(&QUATERNION)?);
    let some_mapped = |names: &[&str]| names.iter().any(|name| options.mapping.maps(name));
    let (there, parts) = (there(&ANGLES, &angles), there(&QUATERNION, &quaternion));
    let whole = parts.len() == QUATERNION.len();
    let has_yaw = there.contains(&"yaw");
    if whole && (!has_yaw || some_mapped(&QUATERNION) || !some_mapped(&ANGLES)) {
        if !there.is_empty() {
            notes.push(format!("attitude of the quaternion {}; {} not used", QUATERNION.join(", "), there.join(", ")));
        }
        let quaternion: Vec<_> = quaternion.into_iter().flatten().collect();
        notes.extend(of_wrong_length(&quaternion));
        return Ok(of_quaternion(log.rows, &quaternion));
    }
    if whole {
        notes.push(format!("attitude of {}, which the mapping names; {} not used", there.join(", "), QUATERNION.join(", ")));
    } else if !parts.is_empty() && has_yaw {
        notes.push(incomplete(&parts, &QUATERNION));
    }
    let hint = if whole { " (the quaternion has it: without the mapping of angles it is used)" } else { FLAT };
    let yaw = required(log, options, "yaw", " nor a quaternion `qx` to `qw`")?;
    lacking.extend(ANGLES.into_iter().filter(|name| !there.contains(name)));
    let [roll, pitch, _] = <[Found; 3]>::try_from(angles).expect("one column for each angle; this is a bug");
    Ok([or_flat(log, options, roll, "roll", hint)?, or_flat(log, options, pitch, "pitch", hint)?, yaw])
}

/// Which of some columns a log has.
fn there<'a>(names: &[&'a str], columns: &[Found]) -> Vec<&'a str> {
    names.iter().zip(columns).filter(|(_, column)| column.is_some()).map(|(name, _)| *name).collect()
}

/// Says of the columns of a quaternion that it is none of unit length in more than a row here and there.
fn of_wrong_length(columns: &[Vec<Option<f64>>]) -> Option<String> {
    let length = |row: usize| columns.iter().map(|column| column[row].map(|v| v * v)).sum::<Option<f64>>().map(f64::sqrt);
    let mut all: Vec<f64> = (0..columns.first()?.len()).filter_map(length).collect();
    all.sort_by(f64::total_cmp);
    let off = all.iter().filter(|length| (**length - 1.0).abs() > LENGTH_OFF).count();
    (off as f64 > LENGTH_OFF * all.len() as f64).then(|| {
        let (rows, middle) = (all.len(), all[all.len() / 2]);
        format!(
            "the quaternion is not of unit length in {off} of {rows} rows ({middle:.2} in the middle): rows below 0.5 and from 2 on are left out, the others are scaled to one; \
             see the columns that `qx` to `qw` are read from, and their scale"
        )
    })
}

/// Roll, pitch and yaw of the columns of a quaternion.
fn of_quaternion(rows: usize, columns: &[Vec<Option<f64>>]) -> [Vec<Option<f64>>; 3] {
    let of_row = |row: usize| attitude_of_quaternion([columns[0][row]?, columns[1][row]?, columns[2][row]?, columns[3][row]?]);
    let angles: Vec<Option<[f64; 3]>> = (0..rows).map(of_row).collect();
    std::array::from_fn(|axis| angles.iter().map(|angles| angles.map(|a| a[axis])).collect())
}
