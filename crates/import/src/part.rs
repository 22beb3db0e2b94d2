//! Drives from a log: channels, conventions, gaps.

use nesam_trajectories::{STEP_MAX_S, gap_limit_s};

use crate::clock::begins_anew;
use crate::commands::{Span, Told, usual_step_s};
use crate::error::ImportError;
use crate::frame::FrameConvention;
use crate::left_out::LeftOut;
use crate::log::Log;
use crate::mapping::Mapping;
use crate::pose::pose;
use crate::reference::move_to_reference;

/// Shorter drives hold no prediction and are left out, s.
const DRIVE_MIN_S: f64 = 1.0;
/// A channel that is missing in a larger share of a drive's rows is left out; else the rows are.
const MISSING_SHARE: f64 = 0.2;
/// Times beyond this count from an epoch and are made to count from the start of the log, s.
const EPOCH_S: f64 = 1e6;
/// Rows that repeat a time stamp further than this from the row that is kept, and from where it goes, are elsewhere, m (chosen).
const ELSEWHERE_M: f64 = 0.5;
/// Share and number of rows, from which on such ones are those of another vehicle (chosen).
const ELSEWHERE: (f64, usize) = (0.01, 10);
/// Names of the second command.
const SECOND: [&str; 3] = ["cmd_steer", "cmd_road_wheel_angle", "cmd_yaw_rate"];
/// Channels that are used together or not at all; of velocities the third may be missing.
const GROUPS: [&[&str]; 8] = [
    &["vbx", "vby", "vbz"],
    &["vx", "vy", "vz"],
    &["wx"],
    &["wy"],
    &["wz"],
    &["om_fl", "om_fr", "om_rl", "om_rr"],
    &["steer_fl", "steer_fr"],
    &["om_l", "om_r"],
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
    /// Where the reference point of the vehicle card lies in the body axes of the log, from the point whose pose it tells, m.
    pub reference_m: [f64; 3],
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

/// A channel before rows are chosen.
pub(crate) type Channel = (String, Vec<Option<f64>>);

/// Channels of a log by what a row must have of them.
struct Channels {
    time: Vec<Option<f64>>,
    /// All in each row.
    pose: Vec<Channel>,
    /// Some in some rows.
    commands: Vec<Channel>,
    /// Those that most rows of a drive have.
    measured: Vec<Channel>,
}

/// A row that becomes a sample, and the time until the next one.
#[derive(Clone, Copy)]
struct Row {
    row: usize,
    span: Span,
}

/// Makes drives of a log.
///
/// # Errors
/// `ImportError::Log` naming the channel that is missing, the line at which rows are out of order, or time stamps that count no seconds.
pub fn drives(log: &Log, options: &Options) -> Result<(Vec<Drive>, Notes), ImportError> {
    let mut notes = Notes::new();
    let mut channels = Channels {
        time: time(log, options, &mut notes)?,
        pose: pose(log, options, &mut notes)?,
        commands: commands(log, options)?,
        measured: measured(log, options, &mut notes)?,
    };
    if options.reference_m != [0.0; 3] {
        move_to_reference(options.frame.body(options.reference_m), &mut channels.pose, &mut channels.measured, &mut notes);
    }
    let names = options.mapping.texts(log, "trajectory");
    let (mut drives, mut left_out, mut of_drives) = (Vec::new(), LeftOut::default(), Notes::new());
    let all = by_name(log.rows, names.as_deref(), &options.name);
    for (name, rows) in &all {
        let of_one = of_one_name(log, &mut channels, name, rows, &mut left_out, &mut of_drives)?;
        drives.extend(of_one);
    }
    notes.extend(left_out.notes(all.len()));
    notes.extend(of_drives);
    if drives.is_empty() {
        return Err(ImportError::log(&log.path, format!("holds no drive of at least {DRIVE_MIN_S} s; {}", notes.join("; "))));
    }
    Ok((drives, notes))
}

/// The drives of the rows of one name: between gaps, and where its clock is set back.
fn of_one_name(
    log: &Log,
    channels: &mut Channels,
    name: &str,
    rows: &[usize],
    left_out: &mut LeftOut,
    notes: &mut Notes,
) -> Result<Vec<Drive>, ImportError> {
    let mut parts: Vec<Vec<(String, Vec<f64>)>> = Vec::new();
    for run in runs(log, channels, name, rows, notes) {
        count_from_own_begin(&mut channels.time, run, name, notes);
        parts.extend(of_one_run(log, channels, name, run, left_out, notes)?);
    }
    let several = parts.len() > 1;
    let mut drives = Vec::new();
    for (i, columns) in parts.into_iter().enumerate() {
        let id = if several { format!("{name}-{}", i + 1) } else { name.to_string() };
        let drive = Drive { id, columns };
        let length_s = drive.time_s().last().copied().unwrap_or(0.0) - drive.time_s().first().copied().unwrap_or(0.0);
        if length_s < DRIVE_MIN_S {
            notes.push(format!("{}: left out, {length_s:.2} s long, at least {DRIVE_MIN_S} s are of use", drive.id));
        } else {
            drives.push(drive);
        }
    }
    Ok(drives)
}

/// The columns of the drives between the gaps of rows in which the clock runs on.
fn of_one_run(
    log: &Log,
    channels: &Channels,
    name: &str,
    rows: &[usize],
    left_out: &mut LeftOut,
    notes: &mut Notes,
) -> Result<Vec<Vec<(String, Vec<f64>)>>, ImportError> {
    let mut lacking = LeftOut::default();
    let posed = posed(channels, rows, &mut lacking);
    let (posed, repeated) = ascending(log, channels, posed, notes)?;
    let told_in: Vec<usize> = rows.iter().copied().filter(|row| repeated.binary_search(row).is_err()).collect();
    let told: Vec<Told> = channels.commands.iter().map(|(_, values)| Told::new(at_instants(&channels.time, values, &told_in))).collect();
    let commanded = commanded(channels, &told, posed, name, &mut lacking, notes);
    let measured = kept(&channels.measured, &commanded, name, &mut lacking);
    let whole: Vec<Row> = commanded.into_iter().filter(|row| has_all(&measured, row.row, &mut lacking)).collect();
    if whole.is_empty() {
        notes.push(format!("{name}: left out, none of its {} rows has all that is needed ({})", rows.len(), lacking.lacks()));
    }
    left_out.add(lacking);
    let parts = at_gaps(log, &whole, name, notes)?;
    Ok(parts.iter().map(|part| columns(channels, &told, &measured, part)).collect())
}

/// Rows of one name between which its clock runs on, in the order of the file. Rows with a pose tell it: those with commands alone may stand after all of them.
fn runs<'a>(log: &Log, channels: &Channels, name: &str, rows: &'a [usize], notes: &mut Notes) -> Vec<&'a [usize]> {
    let at = |i: usize| channels.time[rows[i]].unwrap_or(f64::NAN);
    let is_posed = |i: &usize| channels.time[rows[*i]].is_some() && channels.pose.iter().all(|(_, values)| values[rows[*i]].is_some());
    let posed: Vec<usize> = (0..rows.len()).filter(is_posed).collect();
    // A set-back that the reader of the log told of is none of its own.
    let mut begins: Vec<usize> = log.begins.iter().map(|begin| rows.partition_point(|row| row < begin)).collect();
    let mut set_back: Vec<(usize, f64)> = Vec::new();
    for known in posed.chunk_by(|a, b| !begins.iter().any(|begin| a < begin && begin <= b)) {
        for k in begins_anew(&known.iter().map(|i| at(*i)).collect::<Vec<_>>()) {
            let (before, after) = (known[k - 1], known[k]);
            // Commands in between are of the clock that they are closer to.
            let is_new = |i: &usize| (at(*i) - at(after)).abs() < (at(*i) - at(before)).abs();
            set_back.push(((before + 1..after).find(is_new).unwrap_or(after), at(before) - at(after)));
        }
    }
    if let Some((first, back_s)) = set_back.first() {
        let (times, line) = (set_back.len(), log.places[rows[*first]]);
        let what = format!("time goes back {times} times, first in line {line} by {back_s:.2} s");
        notes.push(format!("{name}: {what}: parted there, as where a clock is set back or a recording begins again"));
    }
    begins.extend(set_back.iter().map(|(begin, _)| *begin));
    begins.extend([0, rows.len()]);
    begins.sort_unstable();
    begins.windows(2).map(|run| &rows[run[0]..run[1]]).filter(|run| !run.is_empty()).collect()
}

/// Times of rows that still count from an epoch are made to count from the first of them.
fn count_from_own_begin(time: &mut [Option<f64>], rows: &[usize], name: &str, notes: &mut Notes) {
    let Some(first_s) = rows.iter().filter_map(|row| time[*row]).reduce(f64::min).filter(|first_s| first_s.abs() >= EPOCH_S) else {
        return;
    };
    notes.push(format!("{name}: time counts from {first_s:.3} s where its clock runs on from there"));
    rows.iter().for_each(|row| time[*row] = time[*row].map(|t| t - first_s));
}

/// The rows that have a pose. Those that have none and a command are of another topic.
fn posed(channels: &Channels, rows: &[usize], left_out: &mut LeftOut) -> Vec<usize> {
    let has = |some: &[Channel], row: usize| some.iter().any(|(_, values)| values[row].is_some());
    let mut posed = Vec::new();
    for row in rows.iter().copied() {
        let timed = channels.time[row].is_some();
        if timed && !has(&channels.pose, row) && has(&channels.commands, row) {
            left_out.commands_alone += 1;
            continue;
        }
        left_out.count(1);
        let lacking: Vec<&str> = channels.pose.iter().filter(|(_, values)| values[row].is_none()).map(|(name, _)| name.as_str()).collect();
        if timed && lacking.is_empty() {
            posed.push(row);
        } else {
            left_out.row(lacking.into_iter().chain((!timed).then_some("t")));
        }
    }
    posed
}

/// Values of a channel in some rows, with their instants, s.
fn at_instants(time: &[Option<f64>], values: &[Option<f64>], rows: &[usize]) -> Vec<(f64, f64)> {
    rows.iter().filter_map(|row| time[*row].zip(values[*row])).collect()
}

/// The rows whose commands are known until the next row.
fn commanded(channels: &Channels, told: &[Told], rows: Vec<Row>, name: &str, left_out: &mut LeftOut, notes: &mut Notes) -> Vec<Row> {
    let (mut changing, mut silent) = (0, 0);
    let mut commanded = Vec::with_capacity(rows.len());
    for row in rows {
        let unknown: Vec<usize> = (0..told.len()).filter(|i| !told[*i].is_known(row.span)).collect();
        if unknown.is_empty() {
            changing += usize::from(told.iter().any(|t| t.over(row.span).is_some_and(|mean| mean.changes)));
            commanded.push(row);
        } else {
            silent += usize::from(unknown.iter().all(|i| told[*i].last(row.span.from_s).is_some()));
            left_out.row(unknown.iter().map(|i| channels.commands[*i].0.as_str()));
        }
    }
    if changing > 0 {
        notes
            .push(format!("{name}: commands change between rows; {changing} of {} rows have the mean until the next row", commanded.len()));
    }
    if silent > 0 {
        let hold_s = told.iter().map(|t| t.hold_s).fold(f64::INFINITY, f64::min);
        notes.push(format!(
            "{name}: {silent} rows left out whose last command is older than {hold_s:.2} s; write it into rows for which it held"
        ));
    }
    commanded
}

/// Measured channels that a drive has, by the rows that have all else.
fn kept<'a>(measured: &'a [Channel], rows: &[Row], drive: &str, left_out: &mut LeftOut) -> Vec<&'a Channel> {
    let mut keep = |(name, values): &&Channel| {
        let missing = rows.iter().filter(|row| values[row.row].is_none()).count();
        let keep = missing as f64 <= MISSING_SHARE * rows.len() as f64;
        if !keep {
            left_out.channel(name, drive, missing, rows.len());
        }
        keep
    };
    measured.iter().filter(|channel| keep(channel)).collect()
}

/// Whether a row has all of some channels.
fn has_all(channels: &[&Channel], row: usize, left_out: &mut LeftOut) -> bool {
    let lacking: Vec<&str> = channels.iter().filter(|(_, values)| values[row].is_none()).map(|(name, _)| name.as_str()).collect();
    if !lacking.is_empty() {
        left_out.row(lacking.iter().copied());
    }
    lacking.is_empty()
}

/// The columns of a drive in rows that have all of them. A command counts until the next row that is left.
fn columns(channels: &Channels, told: &[Told], measured: &[&Channel], rows: &[Row]) -> Vec<(String, Vec<f64>)> {
    let pick = |(name, values): &Channel| (name.clone(), rows.iter().map(|row| values[row.row].unwrap_or(f64::NAN)).collect());
    let until = |i: usize| rows.get(i + 1).map_or(rows[i].span, |next| Span { from_s: rows[i].span.from_s, to_s: next.span.from_s });
    let command = |((name, _), told): (&Channel, &Told)| {
        (name.clone(), (0..rows.len()).map(|i| told.over(until(i)).map_or(f64::NAN, |mean| mean.value)).collect())
    };
    let time = ("t".to_string(), rows.iter().map(|row| row.span.from_s).collect());
    let commands = channels.commands.iter().zip(told).map(command);
    let measured = measured.iter().map(|channel| pick(channel));
    std::iter::once(time).chain(channels.pose.iter().map(pick)).chain(commands).chain(measured).collect()
}

pub(crate) fn absent(log: &Log, target: &str, hint: &str) -> ImportError {
    ImportError::log(
        &log.path,
        format!("has no column `{target}`{hint}; name it with --column {target}=COLUMN:UNIT. It has {}", log.names()),
    )
}

pub(crate) fn required(log: &Log, options: &Options, target: &str, hint: &str) -> Result<Vec<Option<f64>>, ImportError> {
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

/// Three channels through a change of axes; a row that lacks one lacks all.
pub(crate) fn turned(channels: [Vec<Option<f64>>; 3], turn: impl Fn([f64; 3]) -> [f64; 3]) -> [Vec<Option<f64>>; 3] {
    let [x, y, z] = &channels;
    let rows: Vec<Option<[f64; 3]>> = (0..x.len()).map(|row| Some(turn([x[row]?, y[row]?, z[row]?]))).collect();
    std::array::from_fn(|axis| rows.iter().map(|v| v.map(|v| v[axis])).collect())
}

/// Commands as they were told.
fn commands(log: &Log, options: &Options) -> Result<Vec<Channel>, ImportError> {
    let mut channels = vec![("cmd_speed".to_string(), required(log, options, "cmd_speed", " (commanded speed)")?)];
    for name in SECOND {
        if let Some(values) = options.mapping.numbers(log, name)? {
            let about_up = values.into_iter().map(|v| v.map(|v| options.frame.about_up(v))).collect();
            channels.push((name.into(), about_up));
        }
    }
    if channels.len() == 1 {
        return Err(absent(log, "cmd_steer", " (nor cmd_road_wheel_angle or cmd_yaw_rate; the vehicle card says which)"));
    }
    Ok(channels)
}

/// Measured motion and wheels.
fn measured(log: &Log, options: &Options, notes: &mut Notes) -> Result<Vec<Channel>, ImportError> {
    let groups = GROUPS.iter().map(|group| of_group(log, options, group, notes)).collect::<Result<Vec<_>, _>>()?;
    Ok(groups.into_iter().flatten().collect())
}

/// Channels that are used together or not at all.
fn of_group(log: &Log, options: &Options, group: &[&str], notes: &mut Notes) -> Result<Vec<Channel>, ImportError> {
    let mut found = group.iter().map(|name| options.mapping.numbers(log, name)).collect::<Result<Vec<_>, _>>()?;
    let there: Vec<&str> = group.iter().zip(&found).filter(|(_, values)| values.is_some()).map(|(name, _)| *name).collect();
    // A planar velocity says nothing of the third axis: zero for the change of axes, which leaves it to itself.
    let planar = group[0].starts_with('v') && there == group[..2];
    if planar {
        found[2] = Some(vec![Some(0.0); log.rows]);
    } else if !there.is_empty() && there.len() < group.len() {
        notes.push(incomplete(&there, group));
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
    let used = if planar { there.len() } else { group.len() };
    Ok(group.iter().map(|name| (*name).to_string()).zip(values).take(used).collect())
}

/// Says which columns are of no use without others.
pub(crate) fn incomplete(there: &[&str], needed: &[&str]) -> String {
    format!("{} not used: {} are needed together", there.join(", "), needed.join(", "))
}

/// Rows of each drive, in the order of their first rows.
fn by_name(rows: usize, names: Option<&[String]>, default: &str) -> Vec<(String, Vec<usize>)> {
    let mut drives: Vec<(String, Vec<usize>)> = Vec::new();
    for row in 0..rows {
        let name = names.map_or(default, |names| names[row].as_str());
        match drives.iter_mut().rev().find(|(held, _)| held == name) {
            Some((_, held)) => held.push(row),
            None => drives.push((name.into(), vec![row])),
        }
    }
    drives
}

/// The rows without those that repeat a time stamp, each until the next one, and those that do.
fn ascending(log: &Log, channels: &Channels, rows: Vec<usize>, notes: &mut Notes) -> Result<(Vec<Row>, Vec<usize>), ImportError> {
    let at = |row: usize| channels.time[row].unwrap_or(f64::NAN);
    let mut kept: Vec<usize> = Vec::with_capacity(rows.len());
    // With their places among those that are kept.
    let mut repeated: Vec<(usize, usize)> = Vec::new();
    for row in rows {
        match kept.last() {
            Some(last) if at(row) == at(*last) => repeated.push((row, kept.len() - 1)),
            Some(last) if at(row) < at(*last) => {
                let reason = format!(
                    "line {}: time goes backwards, {} s after {} s, and does not go on from there: rows are out of order; sort the log, or name the drives with --column trajectory=COLUMN",
                    log.places[row],
                    at(row),
                    at(*last)
                );
                return Err(ImportError::log(&log.path, reason));
            }
            _ => kept.push(row),
        }
    }
    if let Some(reason) = two_in_one(log, channels, &kept, &repeated) {
        return Err(ImportError::log(&log.path, reason));
    }
    if !repeated.is_empty() {
        notes.push(format!("{} rows left out that repeat a time stamp", repeated.len()));
    }
    let usual_s = usual_step_s(kept.iter().map(|row| at(*row)));
    let limit_s = gap_limit_s(usual_s);
    // Before a gap, and at the end, a row counts for as long as usual.
    let lasts_s = if usual_s > 0.0 { usual_s } else { limit_s };
    let until_s = |i: usize| kept.get(i + 1).map(|next| at(*next)).filter(|next_s| next_s - at(kept[i]) <= limit_s);
    let span = |i: usize| Span { from_s: at(kept[i]), to_s: until_s(i).unwrap_or(at(kept[i]) + lasts_s) };
    let rows = (0..kept.len()).map(|i| Row { row: kept[i], span: span(i) }).collect();
    Ok((rows, repeated.into_iter().map(|(row, _)| row).collect()))
}

/// Says of rows that repeat a time stamp, given with the places of the kept ones that they repeat, that they are not of the same vehicle.
fn two_in_one(log: &Log, channels: &Channels, kept: &[usize], repeated: &[(usize, usize)]) -> Option<String> {
    let place_m = |row: usize| [0, 1].map(|axis| channels.pose[axis].1[row].unwrap_or(f64::NAN));
    let way_m = |a: usize, b: usize| {
        let ([ax, ay], [bx, by]) = (place_m(a), place_m(b));
        (bx - ax).hypot(by - ay)
    };
    // Where a clock is coarse or stands still, rows lie on the way to the next one that is kept.
    let elsewhere = |(row, at): &(usize, usize)| {
        let (apart_m, next_m) = (way_m(kept[*at], *row), way_m(kept[*at], *kept.get(at + 1)?));
        (apart_m > next_m + ELSEWHERE_M).then_some((*row, apart_m))
    };
    let found: Vec<(usize, f64)> = repeated.iter().filter_map(elsewhere).collect();
    let all = kept.len() + repeated.len();
    let (row, apart_m) = *found.first().filter(|_| found.len() >= ELSEWHERE.1 && found.len() as f64 > ELSEWHERE.0 * all as f64)?;
    Some(format!(
        "{} of {all} rows repeat a time stamp at another place, first in line {}, {apart_m:.1} m apart: two vehicles or two publishers in one log? \
         name the vehicles with --column trajectory=COLUMN, or leave one of them out",
        found.len(),
        log.places[row]
    ))
}

/// Parts of a drive between gaps.
fn at_gaps(log: &Log, rows: &[Row], name: &str, notes: &mut Notes) -> Result<Vec<Vec<Row>>, ImportError> {
    let usual_s = usual_step_s(rows.iter().map(|row| row.span.from_s));
    if usual_s > STEP_MAX_S {
        let what = format!("samples lie {usual_s} s apart in `t`, at most {STEP_MAX_S} s are usual");
        let advice = "where its unit is not the second, name it: --column t=COLUMN:ns, or ms, us";
        return Err(ImportError::log(&log.path, format!("{what}; {advice}")));
    }
    let limit_s = gap_limit_s(usual_s);
    let is_gap = |a: &Row, b: &Row| b.span.from_s - a.span.from_s > limit_s;
    let gaps_s: Vec<f64> = rows.windows(2).filter(|pair| is_gap(&pair[0], &pair[1])).map(|p| p[1].span.from_s - p[0].span.from_s).collect();
    if !gaps_s.is_empty() {
        let (count, sum_s) = (gaps_s.len(), gaps_s.iter().sum::<f64>());
        notes.push(format!("{name}: parted at {count} gaps of more than {limit_s:.2} s, {sum_s:.2} s in all"));
    }
    Ok(rows.chunk_by(|a, b| !is_gap(a, b)).map(<[Row]>::to_vec).collect())
}
