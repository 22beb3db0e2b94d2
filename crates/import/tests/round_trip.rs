//! Goal: what is imported is what was driven. Method: recorded drives of an external simulator are written as tables of other tools, imported, and read
//! again as drives.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use nesam_import::{Drive, FrameConvention, ImportError, Mapping, Notes, Options, Topics, drives, read_bag, read_csv, write_set};
use nesam_trajectories::{DataRoot, SetQuery, Trajectory};

fn sample() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/chrono_sample")
}

fn recorded() -> Vec<Trajectory> {
    DataRoot::open(&sample(), None).expect("the sample").load_set(&SetQuery::all("nominal")).expect("drives").into_iter().take(2).collect()
}

/// Imports a table and reads it as a data root does.
fn imported(table: &str, options: &Options) -> Vec<Trajectory> {
    let folder = tempfile::tempdir().expect("a folder");
    let root = folder.path();
    std::fs::write(root.join("log.csv"), table).expect("written");
    std::fs::copy(sample().join("vehicle_hmmwv.json"), root.join("vehicle_hmmwv.json")).expect("copied");
    let (drives, _) = drives(&read_csv(&root.join("log.csv")).expect("a table"), options).expect("drives");
    write_set(&root.join("mine"), &drives, None, Some("test")).expect("written");
    DataRoot::open(root, None).expect("a root").load_set(&SetQuery::all("mine")).expect("drives")
}

/// The drives of a table, and what was said.
fn read(table: &str, options: &Options) -> Result<(Vec<Drive>, Notes), ImportError> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("log.csv");
    std::fs::write(&path, table).expect("written");
    drives(&read_csv(&path).expect("a table"), options)
}

/// A column of a drive.
fn column<'a>(drive: &'a Drive, name: &str) -> Option<&'a [f64]> {
    drive.columns.iter().find(|(held, _)| held == name).map(|(_, values)| values.as_slice())
}

fn flat(lines: &[&str]) -> Options {
    Options { flat: true, ..options(lines, FrameConvention::EnuFlu) }
}

fn options(lines: &[&str], frame: FrameConvention) -> Options {
    Options { mapping: Mapping::parse(lines.iter().copied()).expect("a mapping"), frame, name: "log".into(), ..Options::default() }
}

#[test]
fn chrono_a_table_with_our_names_gives_the_same_bits() {
    let recorded = recorded();
    let mut table =
        "trajectory,t,x,y,z,roll,pitch,yaw,vbx,vby,vbz,wx,wy,wz,cmd_speed,cmd_steer,om_fl,om_fr,om_rl,om_rr,steer_fl,steer_fr\n"
            .to_string();
    for drive in &recorded {
        for (k, state) in drive.states.iter().enumerate() {
            let wheels = drive.wheel_speed_rad_s.as_ref().expect("measured")[k];
            let angles = drive.road_wheel_angle_rad.as_ref().expect("measured")[k];
            let command = [drive.controls[k].speed_m_s, drive.controls[k].second];
            let values = [&[drive.time_s[k]][..], &state.to_array(), &command, &wheels, &angles].concat();
            let cells: Vec<String> = values.iter().map(f64::to_string).collect();
            let _ = writeln!(table, "{},{}", drive.id, cells.join(","));
        }
    }
    for (read, drive) in imported(&table, &options(&[], FrameConvention::EnuFlu)).iter().zip(&recorded) {
        assert_eq!((&read.id, read.states == drive.states, read.controls == drive.controls), (&drive.id, true, true));
        assert!(read.wheel_speed_rad_s == drive.wheel_speed_rad_s && read.road_wheel_angle_rad == drive.road_wheel_angle_rad);
        assert_eq!(read.measured, drive.measured);
    }
}

/// A bag whose commands were recorded a microsecond from the odometry: they are those of its rows, to the bit.
#[test]
fn chrono_commands_of_a_bag_that_come_with_the_odometry_keep_every_bit() {
    let root = DataRoot::open(&sample(), None).expect("the sample");
    let recorded = root.load_set(&SetQuery::all("nominal")).expect("drives").into_iter().find(|drive| drive.id == "n0005").expect("there");
    for command in ["/truck/ackermann_cmd", "/truck/cmd_vel"] {
        let topics = Topics { command: Some(command.into()), odometry: Some("/truck/odom".into()), ..Topics::default() };
        let (log, _) = read_bag(&sample().join("../ros2/n0005"), &topics).expect("a bag");
        let (found, notes) = drives(&log, &options(&[], FrameConvention::EnuFlu)).expect("a drive");
        let commanded = column(&found[0], "cmd_speed").expect("there");
        assert!(commanded.len() == 101 && !notes.iter().any(|note| note.contains("commands change")), "{command}: {notes:?}");
        assert!(commanded.iter().zip(&recorded.controls).all(|(told, control)| *told == control.speed_m_s), "{command}: {commanded:?}");
    }
}

#[test]
fn chrono_other_units_axes_and_names_give_the_same_drive() {
    let recorded = &recorded()[0];
    let mut table = "stamp;north;east;down;bank;elevation;heading;u;v;w;p;q;r;target speed;rudder\n".to_string();
    for (k, state) in recorded.states.iter().enumerate() {
        let ([x, y, z], [roll, pitch, yaw]) = (state.position_m, state.attitude_rad.map(f64::to_degrees));
        let (v, w) = (state.velocity_m_s, state.angular_velocity_rad_s.map(f64::to_degrees));
        let heading = (90.0 - yaw).rem_euclid(360.0);
        let stamp_ms = 1.7e12 + (1e3 * recorded.time_s[k]).round();
        let command = recorded.controls[k];
        let _ = writeln!(
            table,
            "{stamp_ms};{y};{x};{};{roll};{};{heading};{};{};{};{};{};{};{};{}",
            -z,
            -pitch,
            3.6 * v[0],
            -3.6 * v[1],
            -3.6 * v[2],
            w[0],
            -w[1],
            -w[2],
            3.6 * command.speed_m_s,
            -command.second
        );
    }
    let lines = [
        "t=stamp:ms",
        "x=north",
        "y=east",
        "z=down",
        "roll=bank:deg",
        "pitch=elevation:deg",
        "yaw=heading:deg",
        "vbx=u:km/h",
        "vby=v:km/h",
        "vbz=w:km/h",
        "wx=p:deg/s",
        "wy=q:deg/s",
        "wz=r:deg/s",
        "cmd_speed=target speed:km/h",
        "cmd_steer=rudder",
    ];
    let read = &imported(&table, &options(&lines, FrameConvention::NedFrd))[0];
    assert_eq!(read.states.len(), recorded.states.len());
    for (a, b) in read.states.iter().zip(&recorded.states) {
        for (i, (a, b)) in a.to_array().into_iter().zip(b.to_array()).enumerate() {
            assert!((a - b).abs() < 1e-9, "state entry {i}: {a} {b}");
        }
    }
    for (a, b) in read.controls.iter().zip(&recorded.controls) {
        assert!((a.speed_m_s - b.speed_m_s).abs() < 1e-12 && (a.second - b.second).abs() < 1e-12);
    }
}

#[test]
fn analytic_gaps_part_drives_and_what_is_left_out_is_told() {
    let mut table = "t,x,y,yaw,cmd_speed,cmd_steer,wz\n".to_string();
    for k in (0..30).chain(60..90) {
        let t = 0.1 * f64::from(k);
        let (speed, rate) = (if k % 5 == 0 { "2" } else { "" }, if k == 7 { "nan" } else { "0.1" });
        let _ = writeln!(table, "{t},{},0,0,{speed},0,{rate}", 2.0 * t);
    }
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("log.csv");
    std::fs::write(&path, &table).expect("written");
    let log = read_csv(&path).expect("a table");
    let strict = options(&[], FrameConvention::EnuFlu);
    let told = drives(&log, &strict).expect_err("no height").to_string();
    assert!(told.contains("no column `z`") && told.contains("--flat"), "{told}");
    let (found, notes) = drives(&log, &Options { flat: true, ..strict.clone() }).expect("two drives");
    assert_eq!(found.iter().map(|d| (d.id.as_str(), d.time_s().len())).collect::<Vec<_>>(), [("log-1", 29), ("log-2", 30)]);
    assert!(notes.iter().any(|n| n.contains("1 of 60 rows left out") && n.contains("wz 1")), "{notes:?}");

    std::fs::write(&path, table.replace("\n0.1,", "\n-0.1,")).expect("written");
    let told = drives(&read_csv(&path).expect("a table"), &Options { flat: true, ..strict }).expect_err("backwards").to_string();
    assert!(told.contains("line 3: time goes backwards"), "{told}");
}

#[test]
fn regress_what_a_log_lacks_is_not_measured_in_the_set() {
    // Goal: zeros that nobody measured are not written. Method: a level log in two frames, once with roll; the set is read as a data root does.
    for (frame, name, attitude) in
        [(FrameConvention::EnuFlu, "bank", [false, false, true]), (FrameConvention::NedFrd, "roll", [true, false, true])]
    {
        let mut table = format!("t,x,y,yaw,cmd_speed,cmd_steer,{name}\n");
        for k in 0..30 {
            let _ = writeln!(table, "{},{},0,0.5,1,0,0.1", 0.1 * f64::from(k), 0.1 * f64::from(k));
        }
        let read = &imported(&table, &Options { flat: true, ..options(&[], frame) })[0];
        assert!(!read.measured.height && read.measured.attitude == attitude, "{:?}", read.measured);
        let roll = if attitude[0] { 0.1 } else { 0.0 };
        assert!(read.states.iter().all(|s| s.position_m[2] == 0.0 && s.attitude_rad[0] == roll && s.attitude_rad[1] == 0.0));
    }
}

#[test]
fn analytic_a_drive_begins_with_its_own_first_command() {
    // Two drives in one table, row by row in turn, then one after the other; the second is told nothing for its first half second.
    let row = |name: &str, k: i32| {
        let command = if name == "b" && k < 5 { ",".to_string() } else { format!("{},0.1", if name == "a" { 1.0 } else { 2.0 }) };
        format!("{name},{},{},0,0,{command}\n", 0.1 * f64::from(k), 0.1 * f64::from(k))
    };
    let head = "trajectory,t,x,y,yaw,cmd_speed,cmd_steer\n";
    let in_turn: String = (0..30).flat_map(|k| [row("a", k), row("b", k)]).collect();
    let one_by_one: String = (0..60).map(|i| row(if i < 30 { "a" } else { "b" }, i % 30)).collect();
    for rows in [in_turn, one_by_one] {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("log.csv");
        std::fs::write(&path, format!("{head}{rows}")).expect("written");
        let flat = Options { flat: true, ..options(&[], FrameConvention::EnuFlu) };
        let (found, notes) = drives(&read_csv(&path).expect("a table"), &flat).expect("two drives");
        assert_eq!(found.iter().map(|d| (d.id.as_str(), d.time_s().len())).collect::<Vec<_>>(), [("a", 30), ("b", 25)]);
        assert!(notes.iter().any(|n| n.contains("5 of 60 rows left out") && n.contains("cmd_speed 5")), "{notes:?}");
        let speeds = &found[1].columns.iter().find(|(name, _)| name == "cmd_speed").expect("there").1;
        assert!(speeds.iter().all(|speed| *speed == 2.0), "{speeds:?}");
    }
}

#[test]
fn analytic_time_stamps_that_are_no_seconds_are_refused() {
    let mut table = "t,x,y,yaw,cmd_speed,cmd_steer\n".to_string();
    for k in 0..30u64 {
        let _ = writeln!(table, "{},{},0,0,1,0", 1_700_000_000_000_000_000 + k * 100_000_000, 0.1 * k as f64);
    }
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("log.csv");
    std::fs::write(&path, table).expect("written");
    let flat = |lines: &[&str]| Options { flat: true, ..options(lines, FrameConvention::EnuFlu) };
    let log = read_csv(&path).expect("a table");
    let told = drives(&log, &flat(&[])).expect_err("nanoseconds").to_string();
    assert!(told.contains("`t`") && told.contains("--column t=COLUMN:ns"), "{told}");
    assert_eq!(drives(&log, &flat(&["t=t:ns"])).expect("a drive").0[0].time_s().len(), 30);
}

/// Goal: a table that a recorder of two topics writes is read as what was driven. Method: poses and wheel speeds at 10 Hz in rows of their own, commands that count
/// up in rows 5 ms before, at and after them; the share of the row that is another command's is 5 %.
#[test]
fn regress_a_table_of_two_topics_keeps_its_channels_and_the_time_of_its_commands() {
    for (late_s, share) in [(-0.005, 0.05), (0.0, 0.0), (0.005, -0.05)] {
        let mut rows: Vec<(f64, String)> = Vec::new();
        for k in 0..50 {
            let t = 0.1 * f64::from(k);
            rows.push((t, format!("{t},{k},0,0,,,5,5,5,5\n")));
            rows.push((t + late_s, format!("{},,,,{k},0.1,,,,\n", t + late_s)));
        }
        rows.sort_by(|a, b| a.0.total_cmp(&b.0));
        let head = "t,x,y,yaw,cmd_speed,cmd_steer,om_fl,om_fr,om_rl,om_rr\n".to_string();
        let table = rows.iter().fold(head, |table, (_, row)| table + row);
        let (found, notes) = read(&table, &flat(&[])).expect("a drive");
        assert_eq!((found.len(), found[0].time_s().len()), (1, 50), "{notes:?}");
        assert_eq!(column(&found[0], "om_rr"), Some(&[5.0; 50][..]), "{notes:?}");
        for (k, speed) in column(&found[0], "cmd_speed").expect("there").iter().enumerate().take(49).skip(1) {
            assert!((speed - k as f64 - share).abs() < 1e-6, "{late_s} s: {speed} in row {k}");
        }
        assert!(notes.iter().any(|n| n.contains("50 rows have commands and no pose")), "{notes:?}");
        assert!(!notes.iter().any(|n| n.contains("left out")), "{notes:?}");
    }
}

/// Goal: what one drive lacks costs no other, and no drive goes without a word. Method: five drives; one lacks a wheel speed, one yaws, one commands.
#[test]
fn regress_what_a_drive_lacks_is_decided_by_drive_and_named() {
    let mut table = "trajectory,t,x,y,yaw,cmd_speed,cmd_steer,om_l,om_r\n".to_string();
    for name in ["a", "wheel", "pose", "mute", "e"] {
        for k in 0..30 {
            let t = 0.1 * f64::from(k);
            let of = |lacking: &str, value: &'static str| if name == lacking { "" } else { value };
            let _ = writeln!(table, "{name},{t},{t},0,{},{},0,3,{}", of("pose", "0.1"), of("mute", "1"), of("wheel", "3"));
        }
    }
    let (found, notes) = read(&table, &flat(&[])).expect("drives");
    let lengths: Vec<(&str, usize)> = found.iter().map(|d| (d.id.as_str(), d.time_s().len())).collect();
    assert_eq!(lengths, [("a", 30), ("wheel", 30), ("e", 30)], "{notes:?}");
    assert!(column(&found[0], "om_r").is_some() && column(&found[1], "om_r").is_none());
    for expected in [
        "om_r not used in wheel: missing in 30 of 30 rows",
        "60 of 150 rows left out for missing values (yaw 30, cmd_speed 30)",
        "pose: left out, none of its 30 rows has all that is needed (yaw 30)",
        "mute: left out, none of its 30 rows has all that is needed (cmd_speed 30)",
    ] {
        assert!(notes.iter().any(|n| n == expected), "{expected}: {notes:?}");
    }
}

#[test]
fn regress_commands_do_not_hold_across_a_gap() {
    // 3 s with commands, 60 s of nothing, 3 s whose first second has none.
    let mut table = "t,x,y,yaw,cmd_speed,cmd_steer\n".to_string();
    for k in (0..30).chain(630..660) {
        let command = if (630..640).contains(&k) { "," } else { "2,0" };
        let _ = writeln!(table, "{},{},0,0,{command}", 0.1 * f64::from(k), 0.2 * f64::from(k));
    }
    let (found, notes) = read(&table, &flat(&[])).expect("two drives");
    assert_eq!(found.iter().map(|d| (d.id.as_str(), d.time_s().len())).collect::<Vec<_>>(), [("log-1", 30), ("log-2", 20)], "{notes:?}");
    for expected in [
        "10 of 60 rows left out for missing values (cmd_speed 10, cmd_steer 10)",
        "log: 10 rows left out whose last command is older than 0.50 s; write it into rows for which it held",
        "log: parted at 1 gaps of more than 0.50 s, 61.10 s in all",
    ] {
        assert!(notes.iter().any(|n| n == expected), "{expected}: {notes:?}");
    }
}

/// Goal: of two attitudes in a log the mapped one counts, else the quaternion, and that is said. Method: angles that say yaw 1 and roll 0.3, and a quaternion of a yaw of
/// half a turn less a right angle.
#[test]
fn regress_a_mapped_attitude_counts_before_one_that_is_not() {
    let table = |angles: &str| {
        let mut table = format!("t,x,y,z,{angles},qx,qy,qz,qw,cmd_speed,cmd_steer\n");
        let values = angles.replace("yaw", "1").replace("roll", "0.3").replace("pitch", "0");
        for k in 0..30 {
            let half = std::f64::consts::FRAC_1_SQRT_2;
            let _ = writeln!(table, "{},0,0,0,{values},0,0,{half},{half},1,0", 0.1 * f64::from(k));
        }
        table
    };
    let strict = |lines: &[&str]| options(lines, FrameConvention::EnuFlu);
    let yaw = |angles: &str, lines: &[&str]| {
        let (found, notes) = read(&table(angles), &strict(lines)).expect("a drive");
        (column(&found[0], "yaw").expect("there")[0], notes.join("; "))
    };
    let quaternion = ["qx=qx", "qy=qy", "qz=qz", "qw=qw"];
    for (angles, lines) in [("yaw", &[][..]), ("yaw", &quaternion), ("roll,pitch,yaw", &[]), ("roll,pitch,yaw", &quaternion)] {
        let (yaw, said) = yaw(angles, lines);
        assert!((yaw - std::f64::consts::FRAC_PI_2).abs() < 1e-12, "{angles} {lines:?}: {yaw}");
        assert!(said.contains(&format!("attitude of the quaternion qx, qy, qz, qw; {} not used", angles.replace(',', ", "))), "{said}");
    }
    let (of_angles, said) = yaw("roll,pitch,yaw", &["yaw=yaw"]);
    assert!(of_angles == 1.0 && said.contains("attitude of roll, pitch, yaw, which the mapping names; qx, qy, qz, qw not used"), "{said}");
    let told = read(&table("yaw"), &strict(&["yaw=yaw"])).expect_err("no roll").to_string();
    assert!(told.contains("no column `roll` (the quaternion has it") && !told.contains("--flat"), "{told}");
    let cut = table("roll,pitch,yaw").replace(",qw,", ",other,");
    let (found, notes) = read(&cut, &strict(&[])).expect("a drive");
    assert!(column(&found[0], "yaw").is_some_and(|yaw| yaw[0] == 1.0));
    assert!(notes.iter().any(|n| n == "qx, qy, qz not used: qx, qy, qz, qw are needed together"), "{notes:?}");
}

#[test]
fn regress_planar_velocities_are_used_and_half_a_pair_is_told() {
    for (names, frame, expected) in [
        (["vbx", "vby"], FrameConvention::EnuFlu, [1.0, 0.2]),
        (["vbx", "vby"], FrameConvention::NedFrd, [1.0, -0.2]),
        (["vx", "vy"], FrameConvention::EnuFlu, [1.0, 0.2]),
        (["vx", "vy"], FrameConvention::NedFrd, [0.2, 1.0]),
    ] {
        let mut table = format!("t,x,y,yaw,cmd_speed,cmd_steer,{},om_l\n", names.join(","));
        for k in 0..30 {
            let _ = writeln!(table, "{},{},0,0,1,0,1,0.2,5", 0.1 * f64::from(k), 0.1 * f64::from(k));
        }
        let (found, notes) = read(&table, &Options { flat: true, ..options(&[], frame) }).expect("a drive");
        for (name, value) in names.into_iter().zip(expected) {
            assert_eq!(column(&found[0], name).map(|v| v[0]), Some(value), "{name}: {notes:?}");
        }
        assert!(column(&found[0], "vbz").is_none() && column(&found[0], "vz").is_none() && column(&found[0], "om_l").is_none());
        assert!(notes.iter().any(|n| n == "om_l not used: om_l, om_r are needed together"), "{notes:?}");
        assert!(!notes.iter().any(|n| n.starts_with('v')), "{notes:?}");
    }
}

/// Goal: a log whose clock is set back or begins anew loses nothing but the second in between, and no two recordings are made one. Method: 3 s and 4 s at 10 Hz that both
/// begin at zero, with commands in rows of their own; the same with stamps since 1970 before and since the start after; one late row, which is disorder.
#[test]
fn regress_a_table_is_parted_where_its_clock_is_set_back() {
    let rows = |from_s: f64, count: usize, x: f64| -> Vec<String> {
        let row = |k: usize| {
            let t = from_s + 0.1 * k as f64;
            [format!("{t:.2},{},0,0,,\n", x + 0.1 * k as f64), format!("{:.2},,,,{x},0\n", t + 0.05)]
        };
        (0..count).flat_map(row).collect()
    };
    let table = |rows: &[String]| "t,x,y,yaw,cmd_speed,cmd_steer\n".to_string() + &rows.concat();
    for from_s in [0.0, 1.7e9] {
        let (found, notes) = read(&table(&[rows(from_s, 30, 1.0), rows(0.0, 40, 2.0)].concat()), &flat(&[])).expect("two drives");
        let drives: Vec<(&str, usize, f64)> = found.iter().map(|d| (d.id.as_str(), d.time_s().len(), d.time_s()[0])).collect();
        // No command is known at the first row of either.
        assert_eq!(drives, [("log-1", 30, 0.0), ("log-2", 40, 0.0)], "{notes:?}");
        for (drive, speed) in found.iter().zip([1.0, 2.0]) {
            assert!(column(drive, "cmd_speed").is_some_and(|told| told.iter().all(|v| *v == speed)), "{drive:?}");
        }
        assert!(notes.iter().any(|n| n.starts_with("log: time goes back 1 times, first in line 62 by ")), "{notes:?}");
    }
    let mut late = rows(0.0, 30, 1.0);
    late[40] = late[40].replacen("2.00,", "0.55,", 1);
    let told = read(&table(&late), &flat(&[])).expect_err("disorder").to_string();
    assert!(told.contains("line 42: time goes backwards, 0.55 s after 1.9 s") && told.contains("sort the log"), "{told}");
}

/// Goal: a quaternion that is none is called so. Method: one of twice the length, which is left out, and one of 1.5 times, of which the direction counts.
#[test]
fn regress_a_quaternion_that_is_not_of_unit_length_is_told() {
    let table = |length: f64| {
        let mut table = "t,x,y,z,qx,qy,qz,qw,cmd_speed,cmd_steer\n".to_string();
        for k in 0..30 {
            let half = length * std::f64::consts::FRAC_1_SQRT_2;
            let _ = writeln!(table, "{},0,0,0,0,0,{half},{half},1,0", 0.1 * f64::from(k));
        }
        table
    };
    let strict = options(&[], FrameConvention::EnuFlu);
    let said = read(&table(2.1), &strict).expect_err("none").to_string();
    assert!(said.contains("the quaternion is not of unit length in 30 of 30 rows (2.10 in the middle)"), "{said}");
    let (found, notes) = read(&table(1.5), &strict).expect("a drive");
    assert!(column(&found[0], "yaw").is_some_and(|yaw| (yaw[0] - std::f64::consts::FRAC_PI_2).abs() < 1e-12));
    assert!(notes.iter().any(|n| n.contains("not of unit length in 30 of 30 rows (1.50")), "{notes:?}");
    assert!(read(&table(1.001), &strict).expect("a drive").1.is_empty());
}

/// Goal: a log of another point of the vehicle gives the drive of the reference point. Method: a recorded drive as it would be measured 1.65 m behind, 0.2 m to the left and
/// 0.6 m below its reference point, with velocities of Body, in axes of aviation, with velocities of World; without a gyro velocities are left out and positions are not.
#[test]
fn chrono_a_log_of_another_point_gives_the_drive_of_the_reference_point() {
    let recorded = &recorded()[0];
    let reference_m = [1.65, -0.2, 0.6];
    let measured: Vec<_> = recorded.states.iter().map(|state| state.at_point(reference_m.map(|m: f64| -m))).collect();
    let table = |head: &str, row: &dyn Fn(&nesam_physics::VehicleState<f64>) -> Vec<f64>| {
        let mut table = format!("t,cmd_speed,cmd_steer,{head}\n");
        for ((t, state), command) in recorded.time_s.iter().zip(&measured).zip(&recorded.controls) {
            let cells: Vec<String> = row(state).iter().map(f64::to_string).collect();
            let _ = writeln!(table, "{t},{},{},{}", command.speed_m_s, command.second, cells.join(","));
        }
        table
    };
    let close = |read: &Trajectory, entries: std::ops::Range<usize>| {
        for (k, (a, b)) in read.states.iter().zip(&recorded.states).enumerate() {
            for i in entries.clone() {
                let (a, b) = (a.to_array()[i], b.to_array()[i]);
                assert!((a - b).abs() < 1e-9, "state entry {i} of sample {k}: {a} {b}");
            }
        }
    };
    let at = |frame: FrameConvention, reference_m: [f64; 3]| Options { reference_m, ..options(&[], frame) };
    let body = table("x,y,z,roll,pitch,yaw,vbx,vby,vbz,wx,wy,wz", &|state| state.to_array().to_vec());
    close(&imported(&body, &at(FrameConvention::EnuFlu, reference_m))[0], 0..12);
    let aviation = table("y,x,z,roll,pitch,yaw,vbx,vby,vbz,wx,wy,wz", &|state| {
        let [x, y, z, roll, pitch, yaw, u, v, w, p, q, r] = state.to_array();
        vec![x, y, -z, roll, -pitch, std::f64::consts::FRAC_PI_2 - yaw, u, -v, -w, p, -q, -r]
    });
    close(&imported(&aviation, &at(FrameConvention::NedFrd, [1.65, 0.2, -0.6]))[0], 0..12);
    let world = table("x,y,z,roll,pitch,yaw,vx,vy,vz,wx,wy,wz", &|state| {
        let mut row = state.to_array();
        let velocity = nesam_physics::vec3::in_world(&state.attitude_rad, state.velocity_m_s);
        row[6..9].copy_from_slice(&velocity);
        row.to_vec()
    });
    close(&imported(&world, &at(FrameConvention::EnuFlu, reference_m))[0], 0..12);
    let no_gyro = table("x,y,z,roll,pitch,yaw,vbx,vby,vbz", &|state| state.to_array()[..9].to_vec());
    let options = at(FrameConvention::EnuFlu, reference_m);
    close(&imported(&no_gyro, &options)[0], 0..6);
    let (drives, notes) = read(&no_gyro, &options).expect("a drive");
    assert!(column(&drives[0], "vbx").is_none() && notes.iter().any(|note| note.contains("has no yaw rate `wz`")), "{notes:?}");
}

/// Goal: of rows with one time stamp pose and command are of the same row, and rows of two vehicles are none of one. Method: rows that come twice, the second time with
/// another command and 0.2 m away; the same with a vehicle 5 m away; a clock of whole seconds at 2 m/s.
#[test]
fn regress_rows_that_repeat_a_time_stamp_are_left_out_whole() {
    let table = |row: &dyn Fn(u32) -> String| (0..200).fold("t,x,y,yaw,cmd_speed,cmd_yaw_rate\n".to_string(), |rows, k| rows + &row(k));
    let twice = |way_m: f64| {
        let row = |k: u32| {
            let (t, x) = (0.1 * f64::from(k), 0.2 * f64::from(k));
            format!("{t},{x},0,0,1,0\n{t},{},0,0,2,0\n", x + way_m)
        };
        read(&table(&row), &flat(&[]))
    };
    let (drives, notes) = twice(0.2).expect("a drive");
    assert!(notes.iter().any(|note| note == "200 rows left out that repeat a time stamp"), "{notes:?}");
    assert!(column(&drives[0], "cmd_speed").expect("there").iter().all(|told| *told == 1.0) && drives[0].time_s().len() == 200);
    let told = twice(5.0).expect_err("two vehicles").to_string();
    assert!(told.contains("199 of 400 rows repeat a time stamp at another place, first in line 3, 5.0 m apart: two vehicles"), "{told}");
    let coarse = read(&table(&|k| format!("{},{},0,0,1,0\n", k / 10, 0.2 * f64::from(k))), &flat(&[]));
    assert!(coarse.is_ok_and(|(drives, _)| drives[0].time_s().len() == 20));
}
