//! ROS 2 bags in MCAP files: odometry, commands and, where it is wanted, another gyro.
//!
//! One row per odometry message and one per command, by time; a gyro reading counts until the next one. A message counts from its stamp; from when it was
//! recorded where it has none, where the stamps of its topic are of another clock, or those of the odometry. Where a clock is set back, the drive is parted.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use nesam_mcap::{ReadError, Reader, Record};
use nesam_ros2::messages::{self, Command, CommandType, Odometry, imu_rates};

use crate::bag_folder::parts;
use crate::clock::begins_anew;
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
/// Rows of odometry lack the commands and rows of commands the rest.
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
        rows.extend(of_one_clock(&poses, &told, has_gyro.then_some(turned.as_slice())));
    }
    let told_once = notes.iter().enumerate().filter(|(i, note)| !notes[..*i].contains(note)).map(|(_, note)| note.clone()).collect();
    Ok((log(path, rows, log_begins, kind), told_once))
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
fn of_one_clock(poses: &[(i64, Odometry)], commands: &[(i64, Command)], turned: Option<&[(i64, [f64; 3])]>) -> Vec<Row> {
    let first = poses.first().map_or(0, |(at_ns, _)| *at_ns);
    let of_drive = commands.iter().filter(|(at_ns, _)| *at_ns >= first.saturating_sub(BEFORE_NS));
    let mut rows: Vec<(i64, Told)> = poses.iter().map(|(at_ns, pose)| (*at_ns, Told::Odometry(*pose))).collect();
    rows.extend(of_drive.map(|(at_ns, command)| (*at_ns, Told::Command(*command))));
    rows.sort_by_key(|(at_ns, _)| *at_ns);
    let row = |(at_ns, told): (i64, Told)| {
        let turned = match (turned, &told) {
            (Some(turned), _) => held(turned, at_ns),
            (None, Told::Odometry(pose)) => Some(pose.angular_rad_s),
            (None, Told::Command(_)) => None,
        };
        // Nanoseconds since 1970 have more digits than a float.
        Row { at_ns: at_ns.saturating_sub(first), told, turned }
    };
    rows.into_iter().map(row).collect()
}

fn log(path: &Path, rows: Vec<Row>, begins: Vec<usize>, kind: CommandType) -> Log {
    let mut log = Log { path: path.into(), rows: rows.len(), places: (0..rows.len()).collect(), begins, ..Log::default() };
    let mut add = |name: &str, of: &dyn Fn(&Row) -> Option<f64>| log.numbers.push((name.into(), rows.iter().map(of).collect()));
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
    log
}

/// The last entry at or before an instant; entries ascend in time.
fn held<T: Copy>(entries: &[(i64, T)], at_ns: i64) -> Option<T> {
    entries[..entries.partition_point(|(ns, _)| *ns <= at_ns)].last().map(|(_, value)| *value)
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
mod tests {
    use nesam_mcap::Writer;

    use super::*;
    use crate::part::{Options, drives};

    /// A message that begins with a header: stamp, texts, doubles.
    fn stamped(stamp_ns: i64, texts: &[&str], values: &[f64]) -> Vec<u8> {
        let mut body: Vec<u8> =
            [((stamp_ns / 1_000_000_000) as i32).to_le_bytes(), ((stamp_ns % 1_000_000_000) as i32).to_le_bytes()].concat();
        for text in texts {
            body.resize(body.len().next_multiple_of(4), 0);
            body.extend((text.len() as u32 + 1).to_le_bytes());
            body.extend(text.as_bytes());
            body.push(0);
        }
        body.resize(body.len().next_multiple_of(8), 0);
        values.iter().for_each(|v| body.extend(v.to_le_bytes()));
        [vec![0, 1, 0, 0], body].concat()
    }

    fn odometry_bytes(stamp_ns: i64, x: f64, speed: f64) -> Vec<u8> {
        let mut values = vec![0.0; 85];
        (values[0], values[6], values[43]) = (x, 1.0, speed);
        stamped(stamp_ns, &["odom", "base_link"], &values)
    }

    fn writer(path: &Path) -> Writer<File> {
        Writer::create(File::create(path).expect("made"), "ros2", "test").expect("made")
    }

    /// A topic of messages of this type.
    fn channel(writer: &mut Writer<File>, message: &str, topic: &str) -> u16 {
        let schema = writer.add_schema(message, "ros2msg", b"").expect("added");
        writer.add_channel(schema, topic, "cdr").expect("added")
    }

    fn bag(path: &Path, commands: &[&str]) {
        part(path, commands, 0..40);
    }

    /// Twentieths of a second of a bag.
    fn part(path: &Path, commands: &[&str], instants: std::ops::Range<i64>) {
        let mut writer = writer(path);
        let odometry = writer.add_schema("nav_msgs/msg/Odometry", "ros2msg", b"").expect("added");
        let twist = writer.add_schema("geometry_msgs/msg/Twist", "ros2msg", b"").expect("added");
        let odometry = writer.add_channel(odometry, "/odom", "cdr").expect("added");
        let commands: Vec<u16> = commands.iter().map(|topic| writer.add_channel(twist, topic, "cdr").expect("added")).collect();
        let begin = 1_700_000_000_000_000_000_i64;
        for i in instants {
            let at = begin + i * 50_000_000;
            for channel in commands.iter().filter(|_| i % 10 == 1) {
                let values: Vec<u8> = [1.0 + i as f64, 0.0, 0.0, 0.0, 0.0, 0.5].iter().flat_map(|v: &f64| v.to_le_bytes()).collect();
                writer.write(*channel, 0, (at - 1000) as u64, &[vec![0, 1, 0, 0], values].concat()).expect("written");
            }
            writer.write(odometry, 0, (at + 2_000_000) as u64, &odometry_bytes(at, 0.1 * i as f64, 2.0)).expect("written");
        }
        writer.finish().expect("finished");
    }

    #[test]
    fn analytic_a_bag_becomes_a_drive() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        bag(&path, &["/cmd_vel"]);
        let (log, notes) = read_bag(&path, &Topics::default()).expect("readable");
        assert!(notes.is_empty(), "{notes:?}");
        let (drives, notes) = drives(&log, &Options { name: "run".into(), ..Options::default() }).expect("a drive");
        assert!(notes.iter().any(|note| note.contains("1 of 40 rows left out")), "before the first command: {notes:?}");
        let column = |name: &str| &drives[0].columns.iter().find(|(held, _)| held == name).expect("there").1;
        assert!((column("t")[0] - 0.05).abs() < 1e-12);
        assert_eq!((column("t").len(), column("x")[1], column("vbx")[0]), (39, 0.2, 2.0));
        assert_eq!((column("cmd_speed")[0], column("cmd_speed")[9], column("cmd_speed")[10]), (2.0, 2.0, 12.0), "held until the next");
        assert_eq!((column("cmd_yaw_rate")[0], column("yaw")[0]), (0.5, 0.0));
    }

    #[test]
    fn analytic_parts_in_a_folder_are_one_bag() {
        // Goal: a recording that was split is read as if it were not. Method: two parts of 2 s whose channels have other ids, named against their order.
        let folder = tempfile::tempdir().expect("a folder");
        let (whole, split) = (folder.path().join("whole.mcap"), folder.path().join("split"));
        part(&whole, &["/cmd_vel"], 0..80);
        std::fs::create_dir(&split).expect("made");
        part(&split.join("b.mcap"), &["/cmd_vel"], 0..40);
        part(&split.join("a.mcap"), &["/joy_vel", "/cmd_vel"], 40..80);
        std::fs::write(split.join("metadata.yaml"), "relative_file_paths:\n  - b.mcap\n  - a.mcap\n  - c.mcap\n").expect("written");
        let topics = Topics { command: Some("/cmd_vel".into()), ..Topics::default() };
        let (one, _) = read_bag(&whole, &topics).expect("readable");
        let (two, notes) = read_bag(&split, &topics).expect("readable");
        assert_eq!((one.rows, &one.numbers), (80 + 8, &two.numbers), "odometry and commands");
        assert!(notes.len() == 1 && notes[0].contains("c.mcap"), "{notes:?}");
    }

    /// Goal: what was measured or told at an instant counts from it. Method: odometry and stamped commands of one clock, commands recorded 0.4 s late, a gyro
    /// whose clock began when it was switched on.
    #[test]
    fn analytic_messages_count_from_their_stamps_unless_they_are_of_another_clock() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        let mut writer = writer(&path);
        let mut channel = |name: &str, topic: &str| channel(&mut writer, name, topic);
        let odometry = channel("nav_msgs/msg/Odometry", "/odom");
        let twist = channel("geometry_msgs/msg/TwistStamped", "/cmd_vel");
        let gyro = channel("sensor_msgs/msg/Imu", "/imu");
        let begin = 1_700_000_000_000_000_000_i64;
        for i in 0..40_i64 {
            let at = begin + i * 50_000_000;
            let mut write =
                |channel, recorded_ns: i64, bytes: Vec<u8>| writer.write(channel, 0, recorded_ns as u64, &bytes).expect("written");
            write(odometry, at + 2_000_000, odometry_bytes(at, 0.1 * i as f64, 2.0));
            if i % 10 == 0 {
                write(twist, at + 400_000_000, stamped(at, &["base_link"], &[1.0 + i as f64, 0.0, 0.0, 0.0, 0.0, 0.5]));
            }
            let mut rates = [0.0; 37];
            rates[15] = i as f64;
            write(gyro, at + 1_000_000, stamped(5_000_000_000 + i * 50_000_000, &["imu"], &rates));
        }
        writer.finish().expect("finished");
        let (log, notes) = read_bag(&path, &Topics { imu: Some("/imu".into()), ..Topics::default() }).expect("readable");
        assert_eq!(notes, [of_another_clock("imu")]);
        let (drives, notes) = drives(&log, &Options { name: "run".into(), ..Options::default() }).expect("a drive");
        // The reading of a row is recorded 1 ms after the stamp of its odometry: the one before counts, and the first row has none.
        assert!(notes.iter().any(|note| note.contains("1 of 40 rows left out") && note.contains("wz 1")), "{notes:?}");
        let column = |name: &str| &drives[0].columns.iter().find(|(held, _)| held == name).expect("there").1;
        let (commanded, turned) = (column("cmd_speed"), column("wz"));
        assert_eq!((commanded[0], commanded[8], commanded[9], commanded[38]), (1.0, 1.0, 11.0, 31.0));
        assert_eq!((turned[0], turned[38]), (0.0, 38.0));
    }

    /// Goal: a command counts from its instant, wherever it lies between messages of the odometry. Method: odometry at 10 Hz, commands that count up at 10 Hz 5 ms
    /// late, 5 ms early and at the same stamps, and at 50 Hz; the last command comes two seconds before the end.
    #[test]
    fn regress_commands_between_messages_of_the_odometry_are_averaged() {
        for (commands_hz, late_ns, expected) in [
            (10, 5_000_000, [0.0, 0.95, 9.95]),
            (10, -5_000_000, [0.05, 1.05, 10.05]),
            (10, 0, [0.0, 1.0, 10.0]),
            (50, 0, [2.0, 7.0, 52.0]),
        ] {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("run.mcap");
            let mut writer = writer(&path);
            let mut channel = |name: &str, topic: &str| channel(&mut writer, name, topic);
            let (odometry, twist) = (channel("nav_msgs/msg/Odometry", "/odom"), channel("geometry_msgs/msg/TwistStamped", "/cmd_vel"));
            let begin = 1_700_000_000_000_000_000_i64;
            for k in 0..50 {
                let at = begin + k * 100_000_000;
                writer.write(odometry, 0, at as u64, &odometry_bytes(at, 0.1 * k as f64, 1.0)).expect("written");
            }
            for k in 0..3 * commands_hz {
                let at = begin + late_ns + k * 1_000_000_000 / commands_hz;
                let bytes = stamped(at, &["base_link"], &[k as f64, 0.0, 0.0, 0.0, 0.0, 0.5]);
                writer.write(twist, 0, at as u64, &bytes).expect("written");
            }
            writer.finish().expect("finished");
            let (log, _) = read_bag(&path, &Topics::default()).expect("readable");
            let (drives, notes) = drives(&log, &Options { name: "run".into(), ..Options::default() }).expect("a drive");
            let speeds = &drives[0].columns.iter().find(|(name, _)| name == "cmd_speed").expect("there").1;
            for (row, expected) in [0, 1, 10].into_iter().zip(expected) {
                assert!(
                    (speeds[row] - expected).abs() < 1e-6,
                    "{commands_hz} Hz, {late_ns} ns: {} for {expected} in row {row}",
                    speeds[row]
                );
            }
            assert!(notes.iter().any(|note| note.contains("older than 0.50 s")) && speeds.len() < 36, "{} rows: {notes:?}", speeds.len());
            assert_eq!(notes.iter().any(|note| note.contains("commands change between rows")), commands_hz != 10 || late_ns != 0);
        }
    }

    /// Goal: a recording whose clock is set back is parted there, whichever clock it is. Method: 20 s at 50 Hz with commands at 10 Hz that change at the half, where the
    /// clocks of stamps and recorder fall back by 0.4, 5 and 9.993 s or begin at zero again, and the stamps alone by 0.807 and 5 s; odometry is recorded 2 ms after its stamp, so that one
    /// message comes with the old stamp. Nothing is parted where one message is recorded a second late.
    #[test]
    fn regress_a_bag_is_parted_where_a_clock_is_set_back() {
        let read = |stamp_s: &dyn Fn(i64) -> f64, recorded_s: &dyn Fn(i64) -> f64| {
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("run.mcap");
            let mut writer = writer(&path);
            let mut channel = |name: &str, topic: &str| channel(&mut writer, name, topic);
            let (odometry, twist) = (channel("nav_msgs/msg/Odometry", "/odom"), channel("geometry_msgs/msg/Twist", "/cmd_vel"));
            let ns = |seconds: f64| (1e9 * seconds).round() as i64;
            for i in 0..1000_i64 {
                let (stamp_ns, recorded_ns) = (ns(stamp_s(i)), ns(recorded_s(i)));
                writer.write(odometry, 0, recorded_ns as u64, &odometry_bytes(stamp_ns, 0.02 * i as f64, 1.0)).expect("written");
                if i % 5 == 0 {
                    let speed = if i < 500 { 1.0 } else { 2.0 };
                    let values: Vec<u8> = [speed, 0.0, 0.0, 0.0, 0.0, 0.5].iter().flat_map(|v: &f64| v.to_le_bytes()).collect();
                    writer.write(twist, 0, recorded_ns as u64 + 1000, &[vec![0, 1, 0, 0], values].concat()).expect("written");
                }
            }
            writer.finish().expect("finished");
            let (log, notes) = read_bag(&path, &Topics::default()).expect("readable");
            let (drives, more) = drives(&log, &Options { name: "run".into(), ..Options::default() }).expect("drives");
            (drives, [notes, more].concat())
        };
        let at = |i: i64| 1.0e9 + 0.02 * i as f64;
        let mut told = Vec::new();
        for back_s in [0.4, 5.0, 9.993] {
            let clock = move |i: i64, begin: i64| at(i) - if i >= begin { back_s } else { 0.0 };
            told.push(read(&|i| clock(i, 501), &|i| clock(i, 500) + 0.002));
        }
        told.push(read(&|i| 5.0 + 0.02 * (i % 500) as f64, &|i| 5.002 + 0.02 * (i % 500) as f64));
        for back_s in [0.807, 5.0] {
            told.push(read(&|i| at(i) - if i >= 500 { back_s } else { 0.0 }, &|i| at(i) + 0.002));
        }
        for (drives, notes) in &told {
            let lengths: Vec<(&str, bool)> = drives.iter().map(|d| (d.id.as_str(), (490..=501).contains(&d.time_s().len()))).collect();
            assert_eq!(lengths, [("run-1", true), ("run-2", true)], "{notes:?}");
            for (drive, speed) in drives.iter().zip([1.0, 2.0]) {
                let of = |name: &str| &drive.columns.iter().find(|(held, _)| held == name).expect("there").1;
                let steps = of("x").windows(2).zip(of("t").windows(2));
                assert!(steps.into_iter().all(|(x, t)| (x[1] - x[0] - 0.02).abs() < 1e-9 && t[1] > t[0]), "{notes:?}");
                assert!(of("cmd_speed").iter().skip(10).all(|told| *told == speed), "{notes:?}");
            }
            assert!(notes.iter().any(|note| note.contains("the clock of the odometry goes back 1 times")), "{notes:?}");
        }
        let (drives, notes) = read(&at, &|i| at(i) + if i == 700 { -1.0 } else { 0.002 });
        assert!(drives.len() == 1 && !notes.iter().any(|note| note.contains("goes back")), "{notes:?}");
    }

    #[test]
    fn analytic_ambiguous_and_missing_topics_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("run.mcap");
        bag(&path, &["/cmd_vel", "/joy_vel"]);
        let told = |topics: Topics| read_bag(&path, &topics).expect_err("ambiguous").to_string();
        assert!(told(Topics::default()).contains("several topics of that type (/cmd_vel, /joy_vel); choose one with --command"));
        let other = Topics { command: Some("/x".into()), ..Topics::default() };
        assert!(told(other).contains("there are /cmd_vel, /joy_vel"));
        assert!(read_bag(&path, &Topics { command: Some("/joy_vel".into()), ..Topics::default() }).is_ok());
        std::fs::write(&path, b"SQLite format 3").expect("written");
        assert!(told(Topics::default()).contains("not an MCAP file"));
    }
}
