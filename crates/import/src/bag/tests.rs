use nesam_mcap::Writer;

use super::*;
use crate::part::{Drive, Options, drives};

/// A message that begins with a header: stamp, texts, doubles.
fn stamped(stamp_ns: i64, texts: &[&str], values: &[f64]) -> Vec<u8> {
    let mut body: Vec<u8> = [((stamp_ns / 1_000_000_000) as i32).to_le_bytes(), ((stamp_ns % 1_000_000_000) as i32).to_le_bytes()].concat();
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

/// A bag with topics of odometry, stamped commands and a gyro.
fn with_topics(path: &Path) -> (Writer<File>, [u16; 3]) {
    let mut writer = writer(path);
    let topics = [("nav_msgs/msg/Odometry", "/odom"), ("geometry_msgs/msg/TwistStamped", "/cmd_vel"), ("sensor_msgs/msg/Imu", "/imu")];
    let channels = topics.map(|(message, topic)| channel(&mut writer, message, topic));
    (writer, channels)
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
    let (mut writer, [odometry, twist, gyro]) = with_topics(&path);
    let begin = 1_700_000_000_000_000_000_i64;
    for i in 0..40_i64 {
        let at = begin + i * 50_000_000;
        let mut write = |channel, recorded_ns: i64, bytes: Vec<u8>| writer.write(channel, 0, recorded_ns as u64, &bytes).expect("written");
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
    for (commands_hz, late_ns, expected) in
        [(10, 5_000_000, [0.0, 0.95, 9.95]), (10, -5_000_000, [0.05, 1.05, 10.05]), (10, 0, [0.0, 1.0, 10.0]), (50, 0, [2.0, 7.0, 52.0])]
    {
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
            assert!((speeds[row] - expected).abs() < 1e-6, "{commands_hz} Hz, {late_ns} ns: {} for {expected} in row {row}", speeds[row]);
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

/// A bag of six seconds at 20 Hz: odometry, commands at its stamps, and readings of a gyro, as counts.
fn with_gyro(odometry_x: impl Fn(i64) -> f64, commanded: impl Fn(i64) -> f64, gyro: impl Fn(i64) -> Option<f64>) -> (Vec<Drive>, Notes) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.mcap");
    let (mut writer, [odometry, twist, imu]) = with_topics(&path);
    for i in 0..120_i64 {
        let at = 1_700_000_000_000_000_000 + i * 50_000_000;
        let mut write = |channel, bytes: Vec<u8>| writer.write(channel, 0, at as u64, &bytes).expect("written");
        write(odometry, odometry_bytes(at, odometry_x(i), 1.0));
        write(twist, stamped(at, &["base_link"], &[commanded(i), 0.0, 0.0, 0.0, 0.0, 0.5]));
        if let Some(rate) = gyro(i) {
            let mut rates = [0.0; 37];
            rates[15] = rate;
            write(imu, stamped(at, &["imu"], &rates));
        }
    }
    writer.finish().expect("finished");
    let (log, notes) = read_bag(&path, &Topics { imu: Some("/imu".into()), ..Topics::default() }).expect("readable");
    let (drives, more) = drives(&log, &Options { name: "run".into(), ..Options::default() }).expect("a drive");
    (drives, [notes, more].concat())
}

fn column<'a>(drive: &'a Drive, name: &str) -> Option<&'a [f64]> {
    drive.columns.iter().find(|(held, _)| held == name).map(|(_, values)| values.as_slice())
}

/// Goal: the last reading of a gyro is not that of ever after. Method: a gyro that counts up; one that stops at the half, and one that is silent for a second.
#[test]
fn regress_a_gyro_that_stops_is_not_held() {
    let read = |silent: std::ops::Range<i64>| with_gyro(|i| 0.05 * i as f64, |_| 1.0, |i| (!silent.contains(&i)).then_some(i as f64));
    // Ten rows are half a second.
    let (drives, notes) = read(60..120);
    assert!(notes.iter().any(|note| note.contains("the gyro has gaps: 50 messages")), "{notes:?}");
    assert!(notes.iter().any(|note| note.contains("wz not used: missing in 50 of 120 rows")), "{notes:?}");
    assert_eq!((drives.len(), drives[0].time_s().len(), column(&drives[0], "wz")), (1, 120, None));
    let (drives, notes) = read(50..70);
    assert!(notes.iter().any(|note| note.contains("the gyro has gaps: 10 messages")), "{notes:?}");
    for drive in &drives {
        let rates = column(drive, "wz").expect("kept");
        assert!(rates.iter().zip(drive.time_s()).all(|(rate, t)| (rate - 20.0 * t).abs() <= 10.0 + 1e-6), "{rates:?}");
    }
    assert_eq!(drives.iter().map(|drive| drive.time_s().len()).sum::<usize>(), 110);
}

/// Goal: a value that is no number is missing, as in a table, and told. Method: one NaN among the positions, one infinite rate, one NaN command.
#[test]
fn regress_values_that_are_no_numbers_are_missing() {
    let at = |place: i64, wrong: f64, else_value: f64, i: i64| if i == place { wrong } else { else_value };
    let (drives, notes) =
        with_gyro(|i| at(20, f64::NAN, 0.05 * i as f64, i), |i| at(60, f64::NAN, 1.0, i), |i| Some(at(90, f64::INFINITY, 0.5, i)));
    assert_eq!((drives.len(), drives[0].time_s().len()), (1, 118));
    assert!(drives[0].columns.iter().all(|(_, values)| values.iter().all(|value| value.is_finite())));
    for expected in
        ["1 of 120 commands left out that are NaN", "hold values that are NaN or infinite", "2 of 120 rows left out for missing values"]
    {
        assert!(notes.iter().any(|note| note.contains(expected)), "{expected}: {notes:?}");
    }
}
