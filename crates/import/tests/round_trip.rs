//! Goal: what is imported is what was driven. Method: recorded drives of an external simulator are written as tables of other tools, imported, and read
//! again as drives.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use nesam_import::{FrameConvention, Mapping, Options, drives, read_csv, write_set};
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

fn options(lines: &[&str], frame: FrameConvention) -> Options {
    Options { mapping: Mapping::parse(lines.iter().copied()).expect("a mapping"), frame, flat: false, name: "log".into() }
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
