//! ROS 2 bags in MCAP files: odometry, commands and, where it is wanted, another gyro.
//!
//! One row per odometry message and one per command, by time; a gyro reading counts until the next one, for a limited time. A message counts from its stamp; from when it was
//! recorded where it has none, where the stamps of its topic are of another clock, or those of the odometry. Where a clock is set back, the drive is parted.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use nesam_mcap::{ReadError, Reader, Record};
use nesam_ros2::messages::{self, Command, CommandType, Odometry, imu_rates};
use nesam_trajectories::gap_limit_s;

use crate::bag_folder::parts;
use crate::clock::begins_anew;
use crate::commands::usual_step_s;
use crate::error::ImportError;
use crate::log::Log;
use crate::part::Notes;

/// Stamps further from the recorder's clock than this are of another one, ns.
const CLOCKS_APART_NS: u64 = 1_000_000_000;
/// Commands this long before the first odometry say nothing of the drive, ns (chosen: longer than any command holds).
const BEFORE_NS: i64 = 60_000_000_000;
/// Stamps of a part that are this much further from the recorder's clock than those of another were set apart from it, ns.
const SET_APART_NS: u64 = 100_000_000;
/// Stamps that go back this many messages from where the times of recording do are set back with them (chosen).
const TOGETHER: usize = 5;

/// Topics to read; `None` = the only one of a type that fits.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Topics {
    /// nav_msgs/Odometry.
    pub odometry: Option<String>,
    /// geometry_msgs/Twist(Stamped) or ackermann_msgs/AckermannDrive(Stamped).
    pub command: Option<String>,
    /// sensor_msgs/Imu whose angular velocity replaces that of the odometry; `None` = that of the odometry.
    pub imu: Option<String>,
}

/// Names of the types of a topic.
const ODOMETRY: [&str; 1] = [messages::ODOMETRY.name];
const COMMANDS: [&str; 4] = {
    let [a, b, c, d] = CommandType::ALL;
    [a.message().name, b.message().name, c.message().name, d.message().name]
};
const IMU: [&str; 1] = [messages::IMU.name];

/// A message of a topic: its place among those that were read, in the order of the files.
struct Message {
    place: usize,
    recorded_ns: i64,
    bytes: Vec<u8>,
}

/// Messages of a bag: by topic the type and the messages in the order of the files.
type Messages = BTreeMap<String, (String, Vec<Message>)>;

/// Reads a bag, a file or a folder with its parts, as a log with the columns `t x y z qx qy qz qw vbx vby vbz wx wy wz cmd_speed` and `cmd_yaw_rate` or `cmd_road_wheel_angle`.
/// Rows of odometry lack the commands and rows of commands the rest; what is NaN or infinite is missing.
///
/// # Errors
/// `ImportError::Log` when a file is no MCAP file or compressed, a folder is no bag, a topic is missing, ambiguous or of another type, or a message is not readable.
pub fn read_bag(path: &Path, topics: &Topics) -> Result<(Log, Notes), ImportError> {
    let (messages, mut notes) = messages(path)?;
    let pick = |wanted: &Option<String>, types: &[&str], option: &str| choose(path, &messages, wanted.as_deref(), types, option);
    let (_, odometries) = pick(&topics.odometry, &ODOMETRY, "--odometry")?;
    let (kind, commands) = pick(&topics.command, &COMMANDS, "--command")?;
    let gyro = topics.imu.as_ref().map(|_| pick(&topics.imu, &IMU, "--imu")).transpose()?;

    let kind = CommandType::named(kind).expect("a type of COMMANDS; this is a bug");
    let poses = received(path, "odometry", odometries, |bytes| Odometry::read(bytes).map(|pose| (Some(pose.stamp_ns), pose)))?;
    let told = received(path, "command", commands, |bytes| kind.read(bytes).map(|command| (command.stamp_ns, command)))?;
    let told = finite(told, &mut notes);
    let imu = gyro.map_or(&[][..], |(_, messages)| messages);
    let turned = received(path, "imu", imu, |bytes| imu_rates(bytes).map(|(stamp_ns, rates)| (Some(stamp_ns), rates)))?;

    let set_back_at = set_back(&poses);
    if let Some((_, back_s)) = set_back_at.first() {
        let times = set_back_at.len();
        notes.push(format!("the clock of the odometry goes back {times} times, first by {back_s:.2} s: parted there"));
    }
    let begins: Vec<usize> = set_back_at.iter().map(|(at, _)| *at).collect();
    let places: Vec<usize> = begins.iter().map(|at| poses[*at].place).collect();
    let (of_commands, of_imu) = (begins_of(&told, &places), begins_of(&turned, &places));
    let has_gyro = gyro.is_some();
    let apart_ns: Vec<Option<u64>> = (0..=begins.len()).map(|part| apart_ns(part_of(&poses, &begins, part))).collect();
    let least_ns = apart_ns.iter().flatten().min().copied().unwrap_or(0);
    let (mut rows, mut log_begins) = (Vec::new(), Vec::new());
    for part in 0..=begins.len() {
        let (poses, told, turned) = (part_of(&poses, &begins, part), part_of(&told, &of_commands, part), part_of(&turned, &of_imu, part));
        let foreign_clock = apart_ns[part].is_some_and(|ns| ns > CLOCKS_APART_NS || ns - least_ns > SET_APART_NS);
        if foreign_clock {
            notes.push(of_another_clock("odometry"));
        }
        let told = by_instant("commands", told, foreign_clock, &mut notes);
        let turned = by_instant("imu", turned, foreign_clock, &mut notes);
        let poses = by_instant("odometry", poses, foreign_clock, &mut notes);
        log_begins.extend((part > 0).then_some(rows.len()));
        rows.extend(of_one_clock(&poses, &told, has_gyro.then_some(turned.as_slice()), &mut notes));
    }
    let log = log(path, rows, log_begins, kind, &mut notes);
    let told_once = notes.iter().enumerate().filter(|(i, note)| !notes[..*i].contains(note)).map(|(_, note)| note.clone()).collect();
    Ok((log, told_once))
}

/// A message of a topic that is held between its messages.
struct Received<T> {
    place: usize,
    recorded_ns: i64,
    /// `None` where nobody set it.
    stamp_ns: Option<i64>,
    value: T,
}

/// The messages of a topic, read.
fn received<T>(
    path: &Path,
    topic: &str,
    messages: &[Message],
    read: impl Fn(&[u8]) -> Option<(Option<i64>, T)>,
) -> Result<Vec<Received<T>>, ImportError> {
    let one = |(at, message): (usize, &Message)| {
        let unreadable = || ImportError::log(path, format!("{topic} message {at} is not readable as little-endian CDR"));
        let (stamp_ns, value) = read(&message.bytes).ok_or_else(unreadable)?;
        // A stamp of zero is one that nobody set.
        let stamp_ns = stamp_ns.filter(|ns| *ns != 0);
        Ok(Received { place: message.place, recorded_ns: message.recorded_ns, stamp_ns, value })
    };
    messages.iter().enumerate().map(one).collect()
}

/// Commands without those of which a value is no number: the one before holds on, for its time.
fn finite(mut told: Vec<Received<Command>>, notes: &mut Notes) -> Vec<Received<Command>> {
    let all = told.len();
    told.retain(|message| message.value.speed_m_s.is_finite() && message.value.turn.is_finite());
    if told.len() < all {
        notes.push(format!("{} of {all} commands left out that are NaN or infinite", all - told.len()));
    }
    told
}

/// Messages of a topic at which one of its clocks is set back, and by how much, s: that of its stamps or the recorder's.
fn set_back<T>(messages: &[Received<T>]) -> Vec<(usize, f64)> {
    let back = |of: &dyn Fn(&Received<T>) -> i64| -> Vec<(usize, f64)> {
        let Some(first_ns) = messages.first().map(of) else { return Vec::new() };
        let instants_s: Vec<f64> = messages.iter().map(|message| of(message).saturating_sub(first_ns) as f64 * 1e-9).collect();
        begins_anew(&instants_s).into_iter().map(|at| (at, instants_s[at - 1] - instants_s[at])).collect()
    };
    let recorded = back(&|message| message.recorded_ns);
    if messages.iter().any(|message| message.stamp_ns.is_none()) {
        return recorded;
    }
    let mut found = back(&|message| message.stamp_ns.unwrap_or_default());
    // A message that was on its way may have an old stamp and a new time of recording.
    let alone: Vec<_> = recorded.into_iter().filter(|(at, _)| found.iter().all(|(other, _)| other.abs_diff(*at) > TOGETHER)).collect();
    found.extend(alone);
    found.sort_by_key(|(at, _)| *at);
    found
}

/// Messages of another topic at which the parts of the odometry begin, given the places of these: where it is set back itself, as often as the odometry, and else by
/// the order of the files.
fn begins_of<T>(messages: &[Received<T>], places: &[usize]) -> Vec<usize> {
    let own = set_back(messages);
    if own.len() == places.len() {
        return own.iter().map(|(at, _)| *at).collect();
    }
    places.iter().map(|place| messages.partition_point(|message| message.place < *place)).collect()
}

/// The messages of a part.
fn part_of<'a, T>(messages: &'a [Received<T>], begins: &[usize], part: usize) -> &'a [Received<T>] {
    let from = part.checked_sub(1).map_or(0, |before| begins[before]);
    &messages[from..begins.get(part).copied().unwrap_or(messages.len())]
}

/// How far the stamps of messages lie from when they were recorded, in the middle, ns; `None` where none has one.
fn apart_ns<T>(messages: &[Received<T>]) -> Option<u64> {
    let mut apart: Vec<u64> = messages.iter().filter_map(|message| Some(message.recorded_ns.abs_diff(message.stamp_ns?))).collect();
    apart.sort_unstable();
    apart.get(apart.len() / 2).copied()
}

fn of_another_clock(topic: &str) -> String {
    format!("the stamps of the {topic} are of another clock than the recorder's: times of recording are used")
}

/// The messages of a topic in the order of the instants from which they count.
fn by_instant<T: Copy>(topic: &str, messages: &[Received<T>], as_recorded: bool, notes: &mut Notes) -> Vec<(i64, T)> {
    let foreign_clock = !as_recorded && apart_ns(messages).is_some_and(|ns| ns > CLOCKS_APART_NS);
    if foreign_clock {
        notes.push(of_another_clock(topic));
    }
    let by_stamp = !(as_recorded || foreign_clock);
    let instant = |message: &Received<T>| message.stamp_ns.filter(|_| by_stamp).unwrap_or(message.recorded_ns);
    let mut entries: Vec<(i64, T)> = messages.iter().map(|message| (instant(message), message.value)).collect();
    entries.sort_by_key(|(ns, _)| *ns);
    entries
}

/// A row of a bag, at an instant that counts from the first odometry of its part, ns.
struct Row {
    at_ns: i64,
    told: Told,
    /// Angular velocity by the gyro that was chosen, rad/s.
    turned: Option<[f64; 3]>,
}

/// What a row of a bag tells.
enum Told {
    Odometry(Odometry),
    Command(Command),
}

/// The rows of a part in which the clock runs on; `turned` are the readings of another gyro where one was chosen.
fn of_one_clock(poses: &[(i64, Odometry)], commands: &[(i64, Command)], turned: Option<&[(i64, [f64; 3])]>, notes: &mut Notes) -> Vec<Row> {
    let first = poses.first().map_or(0, |(at_ns, _)| *at_ns);
    let of_drive = commands.iter().filter(|(at_ns, _)| *at_ns >= first.saturating_sub(BEFORE_NS));
    let mut rows: Vec<(i64, Told)> = poses.iter().map(|(at_ns, pose)| (*at_ns, Told::Odometry(*pose))).collect();
    rows.extend(of_drive.map(|(at_ns, command)| (*at_ns, Told::Command(*command))));
    rows.sort_by_key(|(at_ns, _)| *at_ns);
    let hold_s =
        turned.map_or(0.0, |turned| gap_limit_s(usual_step_s(turned.iter().map(|(ns, _)| ns.saturating_sub(first) as f64 * 1e-9))));
    let mut silent = 0;
    let row = |(at_ns, told): (i64, Told)| {
        let turned = match (turned, &told) {
            (Some(turned), _) => {
                let last = last(turned, at_ns);
                let held = last.filter(|(ns, _)| at_ns.saturating_sub(*ns) as f64 * 1e-9 <= hold_s);
                silent += usize::from(matches!(told, Told::Odometry(_)) && last.is_some() && held.is_none());
                held.map(|(_, rates)| rates)
            }
            (None, Told::Odometry(pose)) => Some(pose.angular_rad_s),
            (None, Told::Command(_)) => None,
        };
        // Nanoseconds since 1970 have more digits than a float.
        Row { at_ns: at_ns.saturating_sub(first), told, turned }
    };
    let rows = rows.into_iter().map(row).collect();
    if silent > 0 {
        notes.push(format!(
            "the gyro has gaps: {silent} messages of the odometry come more than {hold_s:.2} s after its last reading and have none"
        ));
    }
    rows
}

fn log(path: &Path, rows: Vec<Row>, begins: Vec<usize>, kind: CommandType, notes: &mut Notes) -> Log {
    let mut log = Log { path: path.into(), rows: rows.len(), places: (0..rows.len()).collect(), begins, ..Log::default() };
    let mut broken = vec![false; rows.len()];
    let mut add = |name: &str, of: &dyn Fn(&Row) -> Option<f64>| {
        let finite = |(row, broken): (&Row, &mut bool)| {
            let value = of(row)?;
            *broken |= !value.is_finite();
            value.is_finite().then_some(value)
        };
        log.numbers.push((name.into(), rows.iter().zip(&mut broken).map(finite).collect()));
    };
    let posed = |row: &Row, of: &dyn Fn(&Odometry) -> f64| if let Told::Odometry(pose) = &row.told { Some(of(pose)) } else { None };
    let commanded = |row: &Row, of: &dyn Fn(&Command) -> f64| if let Told::Command(command) = &row.told { Some(of(command)) } else { None };
    add("t", &|row| Some(row.at_ns as f64 * 1e-9));
    for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
        add(name, &|row| posed(row, &|pose| pose.position_m[axis]));
    }
    for (axis, name) in ["qx", "qy", "qz", "qw"].into_iter().enumerate() {
        add(name, &|row| posed(row, &|pose| pose.orientation[axis]));
    }
    for (axis, name) in ["vbx", "vby", "vbz"].into_iter().enumerate() {
        add(name, &|row| posed(row, &|pose| pose.linear_m_s[axis]));
    }
    for (axis, name) in ["wx", "wy", "wz"].into_iter().enumerate() {
        add(name, &|row| row.turned.map(|rates| rates[axis]));
    }
    let second = if kind.is_steered() { "cmd_road_wheel_angle" } else { "cmd_yaw_rate" };
    add("cmd_speed", &|row| commanded(row, &|command| command.speed_m_s));
    add(second, &|row| commanded(row, &|command| command.turn));
    let count = broken.into_iter().filter(|broken| *broken).count();
    if count > 0 {
        notes.push(format!("{count} messages hold values that are NaN or infinite: these count as missing"));
    }
    log
}

/// The last entry at or before an instant; entries ascend in time.
fn last<T: Copy>(entries: &[(i64, T)], at_ns: i64) -> Option<(i64, T)> {
    entries[..entries.partition_point(|(ns, _)| *ns <= at_ns)].last().copied()
}

/// Messages of all parts of a bag, in the order of the files.
fn messages(path: &Path) -> Result<(Messages, Notes), ImportError> {
    let (files, mut notes) = parts(path)?;
    let (mut messages, mut place) = (Messages::new(), 0);
    for file in &files {
        if add_messages(file, &mut messages, &mut place)? == Ending::CutOff {
            let what = if files.len() > 1 { file.display().to_string() } else { "the bag".into() };
            notes.push(format!("{what} was cut off: what is whole of it is used"));
        }
    }
    Ok((messages, notes))
}

/// How a file of a bag ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    Whole,
    CutOff,
}

/// Adds the messages of a file, the next of which is at `place`; ids of schemas and channels count within it.
fn add_messages(path: &Path, messages: &mut Messages, place: &mut usize) -> Result<Ending, ImportError> {
    let file = File::open(path).map_err(|source| ImportError::file(path, source))?;
    let mut reader = Reader::new(BufReader::new(file));
    let (mut types, mut channels) = (BTreeMap::new(), BTreeMap::new());
    loop {
        match reader.next_record() {
            Ok(Some(Record::Schema { id, name, .. })) => drop(types.insert(id, name)),
            Ok(Some(Record::Channel { id, schema_id, topic, .. })) => {
                let name = types.get(&schema_id).cloned().unwrap_or_default();
                messages.entry(topic.clone()).or_insert((name, Vec::new()));
                channels.insert(id, topic);
            }
            Ok(Some(Record::Message { channel_id, log_time_ns, data, .. })) => {
                let held = channels.get(&channel_id).and_then(|topic| messages.get_mut(topic));
                // What is not needed is not kept: bags hold images.
                if let Some((_, kept)) =
                    held.filter(|(name, _)| [&ODOMETRY[..], &COMMANDS, &IMU].iter().any(|kind| kind.contains(&name.as_str())))
                {
                    kept.push(Message { place: *place, recorded_ns: i64::try_from(log_time_ns).unwrap_or(i64::MAX), bytes: data });
                    *place += 1;
                }
            }
            Ok(Some(_)) => {}
            Ok(None) => return Ok(Ending::Whole),
            Err(ReadError::CutOff) => return Ok(Ending::CutOff),
            Err(error) => return Err(ImportError::log(path, error.to_string())),
        }
    }
}

/// Type and messages of a topic.
fn choose<'a>(
    path: &Path,
    messages: &'a Messages,
    wanted: Option<&str>,
    types: &[&str],
    option: &str,
) -> Result<(&'a str, &'a [Message]), ImportError> {
    let fit: Vec<&String> =
        messages.iter().filter(|(_, (name, kept))| types.contains(&name.as_str()) && !kept.is_empty()).map(|(t, _)| t).collect();
    let listed = |topics: &[&String]| topics.iter().map(|t| t.as_str()).collect::<Vec<_>>().join(", ");
    let topic = match (wanted, fit.as_slice()) {
        (Some(wanted), _) => fit.iter().find(|topic| topic.as_str() == wanted).copied().ok_or_else(|| {
            let reason = format!("{option} {wanted}: no such topic with messages of {}; there are {}", types.join(" or "), listed(&fit));
            ImportError::log(path, reason)
        })?,
        (None, [only]) => *only,
        (None, []) => {
            let all: Vec<String> = messages.iter().map(|(topic, (name, _))| format!("{topic} ({name})")).collect();
            return Err(ImportError::log(path, format!("holds no {}; it has {}", types.join(" or "), all.join(", "))));
        }
        (None, several) => {
            return Err(ImportError::log(path, format!("has several topics of that type ({}); choose one with {option}", listed(several))));
        }
    };
    let (name, kept) = &messages[topic];
    Ok((name, kept))
}

#[cfg(test)]
mod tests;
