//! Drives from a log: channels, conventions, gaps.

use std::collections::HashMap;

use nesam_physics::vec3::attitude_of_quaternion;
use nesam_trajectories::{STEP_MAX_S, gap_limit_s};

use crate::error::ImportError;
use crate::frame::FrameConvention;
use crate::log::Log;
use crate::mapping::Mapping;

/// Shorter drives hold no prediction and are left out, s.
const DRIVE_MIN_S: f64 = 1.0;
/// A channel that is missing in a larger share of the rows is left out; else the rows are.
const MISSING_SHARE: f64 = 0.2;
/// Times beyond this count from an epoch and are made to count from the start of the log, s.
const EPOCH_S: f64 = 1e6;
/// Names of the second command.
const SECOND: [&str; 3] = ["cmd_steer", "cmd_road_wheel_angle", "cmd_yaw_rate"];
/// Channels that are used together or not at all.
const GROUPS: [&[&str]; 7] = [
    &["vbx", "vby", "vbz"],
    &["vx", "vy", "vz"],
    &["wx"],
    &["wy"],
    &["wz"],
    &["om_fl", "om_fr", "om_rl", "om_rr"],
    &["steer_fl", "steer_fr"],
];

/// How to read a log.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Options {
    /// Which column is what.
    pub mapping: Mapping,
    /// Axes of the log.
    pub frame: FrameConvention,
    /// The log may lack heights, roll and pitch: the drives then lack them too, and readers take them for zero and as not measured.
    pub flat: bool,
    /// Name of the drives where the log has none.
    pub name: String,
}

/// A drive in the conventions of a data root.
#[derive(Clone, Debug, PartialEq)]
pub struct Drive {
    /// Name.
    pub id: String,
    /// Columns of equal length, `t` first.
    pub columns: Vec<(String, Vec<f64>)>,
}

impl Drive {
    /// Time stamps, s.
    pub fn time_s(&self) -> &[f64] {
        self.columns.first().map_or(&[], |(_, t)| t)
    }
}

/// What an import did besides copying, one sentence each.
pub type Notes = Vec<String>;

/// Channels before rows are chosen.
type Channel = (String, Vec<Option<f64>>);

/// Makes drives of a log.
///
/// # Errors
/// `ImportError::Log` naming the channel that is missing, the line at which time goes backwards, or time stamps that count no seconds.
pub fn drives(log: &Log, options: &Options) -> Result<(Vec<Drive>, Notes), ImportError> {
    let mut notes = Notes::new();
    let names = options.mapping.texts(log, "trajectory");
    let mut channels = vec![("t".to_string(), time(log, options, &mut notes)?)];
    channels.extend(pose(log, options, &mut notes)?);
    channels.extend(commands(log, options, names.as_deref())?);
    let needed = channels.len();
    for group in GROUPS {
        channels.extend(motion(log, options, group, &mut notes)?);
    }
    channels.extend(sides(log, options)?);
    let whole = leave_out(&mut channels, needed, log.rows, &mut notes);
    let mut drives = Vec::new();
    for (name, rows) in by_name(&whole, names.as_deref(), &options.name) {
        let rows = ascending(log, &channels[0].1, rows, &mut notes)?;
        let parts = at_gaps(log, &channels[0].1, &rows)?;
        let several = parts.len() > 1;
        for (i, part) in parts.into_iter().enumerate() {
            let id = if several { format!("{name}-{}", i + 1) } else { name.clone() };
            let pick = |(name, values): &Channel| (name.clone(), part.iter().map(|row| values[*row].unwrap_or(f64::NAN)).collect());
            let drive = Drive { id, columns: channels.iter().map(pick).collect() };
            let length_s = drive.time_s().last().copied().unwrap_or(0.0) - drive.time_s().first().copied().unwrap_or(0.0);
            if length_s < DRIVE_MIN_S {
                notes.push(format!("{}: left out, {length_s:.2} s long, at least {DRIVE_MIN_S} s are of use", drive.id));
            } else {
                drives.push(drive);
            }
        }
    }
    if drives.is_empty() {
        return Err(ImportError::log(&log.path, format!("holds no drive of at least {DRIVE_MIN_S} s; {}", notes.join("; "))));
    }
    Ok((drives, notes))
}

fn absent(log: &Log, target: &str, hint: &str) -> ImportError {
    ImportError::log(
        &log.path,
        format!("has no column `{target}`{hint}; name it with --column {target}=COLUMN:UNIT. It has {}", log.names()),
    )
}

fn required(log: &Log, options: &Options, target: &str, hint: &str) -> Result<Vec<Option<f64>>, ImportError> {
    options.mapping.numbers(log, target)?.ok_or_else(|| absent(log, target, hint))
}

fn time(log: &Log, options: &Options, notes: &mut Notes) -> Result<Vec<Option<f64>>, ImportError> {
    let stamps = required(log, options, "t", " (time)")?;
    let Some(first) = stamps.iter().flatten().copied().reduce(f64::min) else {
        return Err(ImportError::log(&log.path, "column of time stamps is empty"));
    };
    if first.abs() < EPOCH_S {
        return Ok(stamps);
    }
    notes.push(format!("time counts from the first stamp, {first:.3} s"));
    Ok(stamps.into_iter().map(|t| t.map(|t| t - first)).collect())
}

/// Position and attitude in the conventions of a data root.
fn pose(log: &Log, options: &Options, notes: &mut Notes) -> Result<Vec<Channel>, ImportError> {
    let zero = || vec![Some(0.0); log.rows];
    let or_flat = |found: Option<Vec<Option<f64>>>, target: &str| match found {
        Some(values) => Ok(values),
        None if options.flat => Ok(zero()),
        None => Err(absent(log, target, " (with --flat it may be missing and is taken for zero)")),
    };
    let number = |target: &str| options.mapping.numbers(log, target);
    let position = [required(log, options, "x", "")?, required(log, options, "y", "")?, or_flat(number("z")?, "z")?];
    let quaternion = [number("qx")?, number("qy")?, number("qz")?, number("qw")?];
    let attitude = if let (None, [Some(x), Some(y), Some(z), Some(w)]) = (number("yaw")?, &quaternion) {
        let of_row = |row: usize| attitude_of_quaternion([x[row]?, y[row]?, z[row]?, w[row]?]);
        let rows: Vec<Option<[f64; 3]>> = (0..log.rows).map(of_row).collect();
        std::array::from_fn(|axis| rows.iter().map(|angles| angles.map(|a| a[axis])).collect())
    } else {
        let yaw = required(log, options, "yaw", " nor a quaternion `qx` to `qw`")?;
        [or_flat(number("roll")?, "roll")?, or_flat(number("pitch")?, "pitch")?, yaw]
    };
    let of_quaternion = number("yaw")?.is_none();
    let given = [number("z")?.is_some(), of_quaternion || number("roll")?.is_some(), of_quaternion || number("pitch")?.is_some()];
    let lacking: Vec<&str> = ["z", "roll", "pitch"].into_iter().zip(given).filter(|(_, given)| !given).map(|(name, _)| name).collect();
    if !lacking.is_empty() {
        notes.push(format!("no {} in the set, as --flat allows: taken for zero, on level ground, and not scored", lacking.join(", ")));
    }
    let position = turned(position, |v| options.frame.world(v));
    let attitude = turned(attitude, |v| options.frame.attitude(v));
    let all = named(&["x", "y", "z"], position).chain(named(&["roll", "pitch", "yaw"], attitude));
    Ok(all.filter(|(name, _)| !lacking.contains(&name.as_str())).collect())
}

fn named<const N: usize>(names: &[&str; N], values: [Vec<Option<f64>>; N]) -> impl Iterator<Item = Channel> {
    names.map(String::from).into_iter().zip(values)
}

/// Three channels through a change of axes; a row that lacks one lacks all.
fn turned(channels: [Vec<Option<f64>>; 3], turn: impl Fn([f64; 3]) -> [f64; 3]) -> [Vec<Option<f64>>; 3] {
    let [x, y, z] = &channels;
    let rows: Vec<Option<[f64; 3]>> = (0..x.len()).map(|row| Some(turn([x[row]?, y[row]?, z[row]?]))).collect();
    std::array::from_fn(|axis| rows.iter().map(|v| v.map(|v| v[axis])).collect())
}

/// Commands; each holds until the next of its drive.
fn commands(log: &Log, options: &Options, names: Option<&[String]>) -> Result<Vec<Channel>, ImportError> {
    let hold = |values: Vec<Option<f64>>| {
        let mut last: HashMap<&str, f64> = HashMap::new();
        let held = |(row, value): (usize, Option<f64>)| {
            let name = names.map_or("", |names| names[row].as_str());
            if let Some(value) = value {
                last.insert(name, value);
            }
            last.get(name).copied()
        };
        values.into_iter().enumerate().map(held).collect::<Vec<_>>()
    };
    let mut channels = vec![("cmd_speed".to_string(), hold(required(log, options, "cmd_speed", " (commanded speed)")?))];
    for name in SECOND {
        if let Some(values) = options.mapping.numbers(log, name)? {
            let about_up = hold(values).into_iter().map(|v| v.map(|v| options.frame.about_up(v))).collect();
            channels.push((name.into(), about_up));
        }
    }
    if channels.len() == 1 {
        return Err(absent(log, "cmd_steer", " (nor cmd_road_wheel_angle or cmd_yaw_rate; the vehicle card says which)"));
    }
    Ok(channels)
}

/// Measured motion and wheels: channels that are used together or not at all.
fn motion(log: &Log, options: &Options, group: &[&str], notes: &mut Notes) -> Result<Vec<Channel>, ImportError> {
    let found = group.iter().map(|name| options.mapping.numbers(log, name)).collect::<Result<Vec<_>, _>>()?;
    let there: Vec<&str> = group.iter().zip(&found).filter(|(_, values)| values.is_some()).map(|(name, _)| *name).collect();
    if !there.is_empty() && there.len() < group.len() {
        notes.push(format!("{} not used: {} are needed together", there.join(", "), group.join(", ")));
    }
    let Some(values) = found.into_iter().collect::<Option<Vec<_>>>() else { return Ok(Vec::new()) };
    let values: Vec<Vec<Option<f64>>> = match (group[0], <[Vec<Option<f64>>; 3]>::try_from(values)) {
        ("vx", Ok(vector)) => turned(vector, |v| options.frame.world(v)).into(),
        ("vbx", Ok(vector)) => turned(vector, |v| options.frame.body(v)).into(),
        (_, Ok(vector)) => vector.into(),
        ("wy" | "wz" | "steer_fl", Err(values)) => {
            values.into_iter().map(|c| c.into_iter().map(|v| v.map(|v| options.frame.about_up(v))).collect()).collect()
        }
        (_, Err(values)) => values,
    };
    Ok(group.iter().map(|name| (*name).to_string()).zip(values).collect())
}

/// Wheel speeds of a vehicle whose sides are coupled.
fn sides(log: &Log, options: &Options) -> Result<Vec<Channel>, ImportError> {
    let found = [options.mapping.numbers(log, "om_l")?, options.mapping.numbers(log, "om_r")?];
    let [Some(left), Some(right)] = found else { return Ok(Vec::new()) };
    Ok(vec![("om_l".into(), left), ("om_r".into(), right)])
}

/// Drops channels that are mostly missing; gives the rows that have all others.
fn leave_out(channels: &mut Vec<Channel>, needed: usize, rows: usize, notes: &mut Notes) -> Vec<usize> {
    let missing = |values: &[Option<f64>]| values.iter().filter(|v| v.is_none()).count();
    let mut at = 0;
    channels.retain(|(name, values)| {
        at += 1;
        let keep = at <= needed || missing(values) as f64 <= MISSING_SHARE * rows as f64;
        if !keep {
            notes.push(format!("{name} not used: missing in {} of {rows} rows", missing(values)));
        }
        keep
    });
    let whole: Vec<usize> = (0..rows).filter(|row| channels.iter().all(|(_, values)| values[*row].is_some())).collect();
    if whole.len() < rows {
        let lacking: Vec<String> =
            channels.iter().filter(|(_, v)| missing(v) > 0).map(|(name, v)| format!("{name} {}", missing(v))).collect();
        notes.push(format!("{} of {rows} rows left out for missing values ({})", rows - whole.len(), lacking.join(", ")));
    }
    whole
}

/// Rows of each drive, in the order of their first rows.
fn by_name(rows: &[usize], names: Option<&[String]>, default: &str) -> Vec<(String, Vec<usize>)> {
    let mut drives: Vec<(String, Vec<usize>)> = Vec::new();
    for row in rows {
        let name = names.map_or(default, |names| names[*row].as_str());
        match drives.iter_mut().rev().find(|(held, _)| held == name) {
            Some((_, held)) => held.push(*row),
            None => drives.push((name.into(), vec![*row])),
        }
    }
    drives
}

/// The rows without those that repeat a time stamp.
fn ascending(log: &Log, time: &[Option<f64>], rows: Vec<usize>, notes: &mut Notes) -> Result<Vec<usize>, ImportError> {
    let at = |row: usize| time[row].unwrap_or(f64::NAN);
    let mut kept: Vec<usize> = Vec::with_capacity(rows.len());
    let mut repeated = 0;
    for row in rows {
        match kept.last() {
            Some(last) if at(row) == at(*last) => repeated += 1,
            Some(last) if at(row) < at(*last) => {
                let reason = format!(
                    "line {}: time goes backwards, {} s after {} s; sort the log, or name the drives with --column trajectory=COLUMN",
                    log.places[row],
                    at(row),
                    at(*last)
                );
                return Err(ImportError::log(&log.path, reason));
            }
            _ => kept.push(row),
        }
    }
    if repeated > 0 {
        notes.push(format!("{repeated} rows left out that repeat a time stamp"));
    }
    Ok(kept)
}

/// Parts of a drive between gaps.
fn at_gaps(log: &Log, time: &[Option<f64>], rows: &[usize]) -> Result<Vec<Vec<usize>>, ImportError> {
    let step = |pair: &[usize]| time[pair[1]].zip(time[pair[0]]).map_or(f64::NAN, |(b, a)| b - a);
    let mut steps: Vec<f64> = rows.windows(2).map(step).collect();
    steps.sort_by(f64::total_cmp);
    let median_s = steps.get(steps.len() / 2).copied().unwrap_or(0.0);
    if median_s > STEP_MAX_S {
        let what = format!("samples lie {median_s} s apart in `t`, at most {STEP_MAX_S} s are usual");
        let advice = "where its unit is not the second, name it: --column t=COLUMN:ns, or ms, us";
        return Err(ImportError::log(&log.path, format!("{what}; {advice}")));
    }
    let limit_s = gap_limit_s(median_s);
    let mut parts: Vec<Vec<usize>> = Vec::new();
    for (i, row) in rows.iter().enumerate() {
        if i == 0 || step(&rows[i - 1..=i]) > limit_s {
            parts.push(Vec::new());
        }
        parts.last_mut().expect("a part was begun; this is a bug").push(*row);
    }
    Ok(parts)
}
