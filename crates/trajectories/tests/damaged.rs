//! Roots that are damaged, incomplete or unusual: what must load loads, everything else is an error that says where.
#![allow(clippy::unwrap_used)]

mod common;

use common::{Column, Columns, SKID_CARD, circle_columns, column, root_of, set, without, write_index, write_parquet};
use nesam_physics::SecondCommand;
use nesam_trajectories::{DataRoot, SetQuery, Split, SplitFilter, Trajectory, TrajectoryError, VelocitySource, card_to_json};
use parquet::basic::Compression;
use parquet::file::metadata::{FileMetaData, ParquetMetaData, ParquetMetaDataWriter};
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::file::statistics::Statistics;
use tempfile::TempDir;

fn load(root: &TempDir) -> Result<Vec<Trajectory>, TrajectoryError> {
    DataRoot::open(root.path(), None)?.load_set(&SetQuery::all("drive"))
}

fn refusal(columns: &Columns) -> String {
    load(&root_of(columns)).unwrap_err().to_string()
}

fn two_drives() -> Columns {
    circle_columns(&["a", "b"], 40)
}

#[test]
fn analytic_circle_without_index_worlds_and_velocity() {
    let drives = load(&root_of(&two_drives())).unwrap();
    assert_eq!(drives.iter().map(|t| t.id.as_str()).collect::<Vec<_>>(), ["a", "b"]);
    let t = &drives[1];
    assert_eq!((t.split, t.world.as_deref(), t.set.as_str(), t.states.len()), (None, None, "drive", 20));
    assert_eq!(t.measured.velocity_source, VelocitySource::Positions);
    // The first sample knows the encoders only; the others follow the circle: 1 m/s ahead.
    assert!((t.states[0].velocity_m_s[0] - 1.0).abs() < 1e-9);
    assert!(t.states.iter().all(|s| (s.velocity_m_s[0] - 1.0).abs() < 1e-3 && s.velocity_m_s[1].abs() < 0.01));
    assert!(t.states.iter().all(|s| s.angular_velocity_rad_s == [0.0, 0.0, 0.3]));
    // Commands are held: step k of 10 Hz takes the mean of the commands of rows 2 k and 2 k + 1, and what stays keeps every bit.
    assert!(t.controls.iter().enumerate().all(|(k, u)| (u.speed_m_s - 1.000_25 - 0.001 * k as f64).abs() < 1e-12 && u.second == 0.3));
    assert_eq!(t.wheel_speed_rad_s.as_ref().unwrap()[3][0], t.wheel_speed_rad_s.as_ref().unwrap()[3][2]);
    // Without encoders the first sample takes the commanded speed.
    let blind = without(&without(&two_drives(), "om_l"), "om_r");
    let t = &load(&root_of(&blind)).unwrap()[0];
    assert_eq!((t.states[0].velocity_m_s[0], t.wheel_speed_rad_s.is_none()), (1.0, true));
}

#[test]
fn property_later_rows_do_not_change_earlier_samples() {
    let whole = load(&root_of(&circle_columns(&["a"], 40))).unwrap();
    let part = load(&root_of(&circle_columns(&["a"], 21))).unwrap();
    assert_eq!(part[0].states, whole[0].states[..11]);
    // The last command of the shorter log holds on; in the longer one it changes within the step that begins there.
    assert_eq!(part[0].controls[..10], whole[0].controls[..10]);
}

#[test]
fn property_row_groups_codecs_and_number_types_do_not_matter() {
    let reference = load(&root_of(&two_drives())).unwrap();
    for (group, codec) in [(7, Compression::SNAPPY), (40, Compression::ZSTD(Default::default())), (1, Compression::UNCOMPRESSED)] {
        let root = root_of(&two_drives());
        write_parquet(&root.path().join("drive/samples.parquet"), &two_drives(), group, codec);
        assert_eq!(load(&root).unwrap(), reference, "groups of {group}");
    }
    let mut mixed = two_drives();
    *column(&mut mixed, "roll") = Column::Int(vec![0; 80]);
    *column(&mut mixed, "pitch") = Column::Float(vec![0.0; 80]);
    assert_eq!(load(&root_of(&mixed)).unwrap(), reference);
}

#[test]
fn regress_missing_columns_are_named() {
    for name in ["trajectory", "t", "x", "y", "yaw", "cmd_speed", "cmd_yaw_rate"] {
        let error = refusal(&without(&two_drives(), name));
        assert!(error.contains("samples.parquet") && error.contains(&format!("column `{name}`: missing")), "{error}");
    }
}

#[test]
fn regress_heights_roll_and_pitch_may_be_missing() {
    // Goal: a base that knows x, y and yaw alone is as readable as any other. Method: the circle without each of the columns, and with them null in one drive.
    let whole = load(&root_of(&two_drives())).unwrap();
    assert!(whole[0].measured.whole_pose());
    for (name, height, attitude) in [("z", false, [true; 3]), ("roll", true, [false, true, true]), ("pitch", true, [true, false, true])] {
        let root = root_of(&without(&two_drives(), name));
        let opened = DataRoot::open(root.path(), None).unwrap();
        let drives = opened.load_set(&SetQuery::all("drive")).unwrap();
        assert!(drives.iter().all(|d| (d.measured.height, d.measured.attitude) == (height, attitude)), "{name}");
        // The circle is level: but for its height, which becomes zero, nothing else changes.
        for (found, expected) in drives.iter().flat_map(|d| &d.states).zip(whole.iter().flat_map(|d| &d.states)) {
            assert_eq!(found.position_m[2], if height { expected.position_m[2] } else { 0.0 });
            assert_eq!((found.attitude_rad, found.velocity_m_s), (expected.attitude_rad, expected.velocity_m_s), "{name}");
        }
        assert_eq!(opened.notes().len(), 1, "{:?}", opened.notes());
        assert!(opened.notes()[0].starts_with(&format!("set `drive`: {name} not measured in 2 drives")), "{:?}", opened.notes());
    }
    let mut columns = two_drives();
    (40..80).for_each(|row| set(&mut columns, "z", row, None));
    let drives = load(&root_of(&columns)).unwrap();
    assert!(drives[0].measured.height && !drives[1].measured.height && drives[1].states.iter().all(|s| s.position_m[2] == 0.0));
}

#[test]
fn regress_channels_that_are_nan_throughout_are_not_measured() {
    // Goal: a table of floats writes what it has not as NaN, which says what a null says. Method: the second drive of the circle with NaN, and with NaN and nulls in
    // turns, in one channel of each kind, beside the same with nulls; a channel that is NaN in some rows is still an error. A column of floats has no nulls at all.
    let emptied = |name: &str, empty: fn(usize) -> Option<f64>| {
        let mut columns = two_drives();
        columns.extend(["vbx", "vby"].map(|name| (name.to_string(), Column::Double(vec![Some(0.5); 80]))));
        (40..80).for_each(|row| set(&mut columns, name, row, empty(row)));
        load(&root_of(&columns)).unwrap()
    };
    for name in ["z", "pitch", "wz", "om_l", "vby"] {
        let null = emptied(name, |_| None);
        assert_ne!(null[0].measured, null[1].measured, "{name}");
        for empty in [(|_| Some(f64::NAN)) as fn(usize) -> _, |row| (row % 2 == 0).then_some(f64::NAN)] {
            assert_eq!(emptied(name, empty), null, "{name}");
        }
    }
    let mut floats = two_drives();
    *column(&mut floats, "roll") = Column::Float(vec![f32::NAN; 80]);
    assert!(load(&root_of(&floats)).unwrap().iter().all(|drive| drive.measured.attitude == [false, true, true]));
    for row in [40, 57, 79] {
        let mut columns = two_drives();
        (40..80).filter(|other| *other != row).for_each(|row| set(&mut columns, "z", row, Some(f64::NAN)));
        let error = refusal(&columns);
        assert!(error.contains("column `z`") && error.contains("NaN, expected a finite number"), "{error}");
    }
}

#[test]
fn regress_drives_without_a_map_of_their_own_are_loaded_without_one() {
    // Goal: a map that is named and not there is done without, and said. Method: one world with an elevation image, one without a folder, one with a folder
    // alone, and one whose world.json names another image; then a drive that does not know its height over a map that is there.
    let root = root_of(&circle_columns(&["a", "b", "c", "d"], 40));
    let world = |name: &str| root.path().join("worlds").join(name);
    for name in ["w1", "w3", "w4"] {
        std::fs::create_dir_all(world(name)).unwrap();
    }
    std::fs::write(world("w1").join("elevation.png"), "damage is told by whoever needs the map").unwrap();
    std::fs::write(world("w4").join("world.json"), r#"{"elevation": {"file": "heights.png"}}"#).unwrap();
    std::fs::write(world("w4").join("elevation.png"), "not the one").unwrap();
    let index = root.path().join("drive/index.parquet");
    write_index(&index, &[("a", Some("w1"), None), ("b", Some("../w2"), None), ("c", Some("w3"), None), ("d", Some("w4"), None)]);
    let opened = DataRoot::open(root.path(), None).unwrap();
    let drives = opened.load_set(&SetQuery::all("drive")).unwrap();
    assert_eq!(drives.iter().map(|d| d.world.as_deref()).collect::<Vec<_>>(), [Some("w1"), None, None, None]);
    let notes = [opened.contradictions(), opened.notes()].concat().join("\n");
    for said in ["no world `../w2`: 1 drives have no map", "world `w3` has no elevation image", "world `w4` has no elevation image"] {
        assert!(notes.contains(said), "{said}: {notes}");
    }
    assert!(!notes.contains("w1"), "{notes}");
    assert!(opened.world("w1").is_err(), "a map that is there and damaged is an error");

    let flat = without(&circle_columns(&["a"], 40), "z");
    write_parquet(&root.path().join("drive/samples.parquet"), &flat, usize::MAX / 2, Compression::UNCOMPRESSED);
    write_index(&index, &[("a", Some("w1"), None)]);
    assert_eq!(load(&root).unwrap()[0].world, None, "at height zero it would stand in the ground or in the air");
}

#[test]
fn regress_a_root_that_lost_all_its_maps_says_so_like_one_that_lost_one() {
    // Goal: what index, samples and worlds say otherwise of each other is told, however much of it. Method: an index that names a world of a root without
    // `worlds/`, then with an empty one, then six such worlds; and drives that the index does not know.
    let root = root_of(&circle_columns(&["a", "b", "c", "d", "e", "f", "g"], 40));
    let index = root.path().join("drive/index.parquet");
    let told = |rows: &[(&str, Option<&str>, Option<&str>)]| {
        write_index(&index, rows);
        let opened = DataRoot::open(root.path(), None).unwrap();
        assert!(opened.load_set(&SetQuery::all("drive")).unwrap().iter().all(|drive| drive.world.is_none()));
        assert_eq!(opened.notes(), Vec::<String>::new());
        opened.contradictions()
    };
    let known = [("a", Some("w1"), None), ("b", Some("w1"), None), ("c", None, None)];
    for _ in 0..2 {
        let said = told(&known);
        assert_eq!(said.len(), 2, "{said:?}");
        assert!(said[0].contains("4 drives are not in the index: no map, no split"), "{said:?}");
        assert!(said[1].contains("the data root has no world `w1`: 2 drives have no map"), "{said:?}");
        std::fs::create_dir_all(root.path().join("worlds")).unwrap();
    }
    let names = ["w1", "w2", "w3", "w4", "w5", "w6"];
    let each: Vec<_> = ["a", "b", "c", "d", "e", "f"].into_iter().zip(names).map(|(id, world)| (id, Some(world), None)).collect();
    let said = told(&[&each[..], &[("g", None, None)]].concat());
    assert!(said.len() == 1 && said[0].contains("no world `w1`, `w2`, `w3`, `w4` and 2 more: 6 drives have no map"), "{said:?}");
}

#[test]
fn regress_commands_beyond_the_range_name_drive_row_and_limits() {
    // Goal: whoever mends a log knows where. Method: 3.4 m/s in three rows of the second drive, under a card that implies 3 m/s and one that states 3.2 m/s.
    let mut columns = two_drives();
    [70, 71, 72].into_iter().for_each(|row| set(&mut columns, "cmd_speed", row, Some(3.4)));
    let root = root_of(&columns);
    let beyond = |card: &str| {
        std::fs::write(root.path().join("vehicle_test.json"), card).unwrap();
        let opened = DataRoot::open(root.path(), None).unwrap();
        let drives = opened.load_set(&SetQuery::all("drive")).unwrap();
        assert_eq!(opened.beyond_range(&drives[..1]), []);
        opened.beyond_range(&drives)
    };
    let [implied] = &beyond(SKID_CARD)[..] else { panic!("one of the two commands") };
    assert_eq!((implied.axis, implied.drives, implied.trajectory.as_str(), implied.row), (0, 1, "b", Some(70)));
    assert!(implied.implied && implied.range == [-3.0, 3.0]);
    let [stated] = &beyond(&SKID_CARD.replacen('{', r#"{"command_range": {"speed_m_s": [-1.0, 3.2]}, "#, 1))[..] else { panic!("one") };
    let said = stated.to_string();
    assert!(
        !stated.implied && said.contains("drive `b`, row 70 of samples.parquet: speed 3.4 is outside the range of its card, -1.0 to 3.2"),
        "{said}"
    );
}

#[test]
fn regress_bad_values_name_column_and_row() {
    for (name, value, says) in [
        ("x", Some(f64::NAN), "NaN"),
        ("yaw", Some(f64::INFINITY), "inf"),
        ("pitch", None, "null"),
        ("cmd_speed", Some(f64::NAN), "NaN"),
        ("om_l", None, "null"),
        ("wz", Some(f64::NEG_INFINITY), "-inf"),
        ("t", Some(f64::NAN), "NaN"),
    ] {
        let mut columns = two_drives();
        set(&mut columns, name, 57, value);
        let error = refusal(&columns);
        assert!(error.contains(&format!("column `{name}`, row 57")) && error.contains(says), "{error}");
        assert!(error.contains("drive `b`") && error.contains("--trajectories") && error.contains("nesam import"), "{error}");
        // The other drive is not affected, and neither is its reading.
        let root = root_of(&columns);
        let only_a = SetQuery { trajectories: Some(vec!["a".into()]), ..SetQuery::all("drive") };
        assert_eq!(DataRoot::open(root.path(), None).unwrap().load_set(&only_a).unwrap().len(), 1);
    }
    let mut columns = two_drives();
    *column(&mut columns, "z") = Column::Text(vec![Some("high".into()); 80]);
    let error = refusal(&columns);
    assert!(error.contains("column `z`") && error.contains("expected numbers"), "{error}");
    let mut columns = two_drives();
    *column(&mut columns, "trajectory") = Column::Float(vec![1.0; 80]);
    assert!(refusal(&columns).contains("column `trajectory`: expected text"));
    let mut columns = two_drives();
    if let Column::Text(ids) = column(&mut columns, "trajectory") {
        ids[12] = None;
    }
    assert!(refusal(&columns).contains("column `trajectory`, row 12: null"));
}

#[test]
fn regress_time_must_ascend() {
    let mut repeated = two_drives();
    set(&mut repeated, "t", 45, Some(0.2));
    assert!(refusal(&repeated).contains("column `t`, row 45: time stamp is repeated"));
    let mut back = two_drives();
    set(&mut back, "t", 45, Some(0.1));
    assert!(refusal(&back).contains("row 45: time goes backwards"));
    let mut gap = two_drives();
    (60..80).for_each(|row| set(&mut gap, "t", row, Some(3.0 + 0.05 * row as f64)));
    let error = refusal(&gap);
    assert!(error.contains("column `t`, row 59") && error.contains("gap"), "{error}");
}

#[test]
fn regress_time_must_be_in_seconds() {
    // Milliseconds, microseconds and nanoseconds, from the start and since 1970: refused before memory is asked for.
    for factor in [1e3, 1e6, 1e9] {
        for begin in [0.0, 1.7e9] {
            let mut columns = two_drives();
            if let Column::Double(times) = column(&mut columns, "t") {
                times.iter_mut().flatten().for_each(|t| *t = factor * (begin + *t));
            }
            let error = refusal(&columns);
            assert!(error.contains("column `t`, row 0") && error.contains("must be in seconds"), "{factor} {begin}: {error}");
        }
    }
}

#[test]
fn analytic_commands_say_how_fast_a_vehicle_is() {
    // Eight times as fast as the circle, and as the card of the robot, which says 3 m/s at most: the command says that it is no jump.
    let mut columns = two_drives();
    for name in ["x", "y", "cmd_speed"] {
        if let Column::Double(values) = column(&mut columns, name) {
            values.iter_mut().flatten().for_each(|v| *v *= 8.0);
        }
    }
    let last = load(&root_of(&columns)).unwrap()[0].states[19];
    assert!((last.velocity_m_s[0] - 8.0).abs() < 0.1, "{last:?}");
}

/// Goal: a planar velocity is one. Method: the circle with velocities ahead and to the left, in Body and in World, and none upwards; its height rises by 0.1 m/s, which the
/// positions tell.
#[test]
fn regress_a_planar_velocity_is_used() {
    let planar = |names: [&str; 2], of: fn(f64) -> [f64; 2]| {
        let mut columns = without(&circle_columns(&["a"], 60), "z");
        let each = |f: &dyn Fn(f64) -> f64| Column::Double((0..60).map(|k| Some(f(0.05 * k as f64))).collect());
        columns.push(("z".into(), each(&|t| 0.1 * t)));
        columns.push((names[0].into(), each(&|t| of(t)[0])));
        columns.push((names[1].into(), each(&|t| of(t)[1])));
        load(&root_of(&columns)).unwrap().swap_remove(0)
    };
    for drive in [planar(["vbx", "vby"], |_| [1.0, 0.05]), planar(["vx", "vy"], |t| [(0.3 * t).cos(), (0.3 * t).sin()])] {
        assert!(drive.measured.linear_velocity, "{:?}", drive.measured);
        let [ahead, left, up] = drive.states[25].velocity_m_s;
        assert!((ahead - 1.0).abs() < 1e-9 && left.abs() < 0.06 && (up - 0.1).abs() < 0.02, "{ahead} {left} {up}");
    }
}

#[test]
fn property_channels_that_were_not_recorded_may_be_null() {
    let mut columns = two_drives();
    (40..80).for_each(|row| set(&mut columns, "om_l", row, None));
    let drives = load(&root_of(&columns)).unwrap();
    assert!(drives[0].measured.wheel_speed && !drives[1].measured.wheel_speed);
}

/// Goal: columns of nothing but nulls, which may have any type, are read for as many rows as they have. Method: an index whose worlds are null numbers; then
/// one whose drives are, with a footer that speaks of fifty million of them.
#[test]
fn regress_nulls_are_as_many_as_the_file_has() {
    const FORGED: i64 = 50_000_000;
    let root = root_of(&two_drives());
    let index = root.path().join("drive/index.parquet");
    let nulls = || Column::Double(vec![None; 2]);
    let ids = Column::Text(["a", "b"].map(|id| Some(id.to_string())).to_vec());
    write_parquet(&index, &vec![("trajectory".to_string(), ids), ("world".to_string(), nulls())], 2, Compression::SNAPPY);
    assert!(load(&root).unwrap().iter().all(|drive| drive.world.is_none()));

    write_parquet(&index, &vec![("trajectory".to_string(), nulls())], 2, Compression::SNAPPY);
    let honest = load(&root).unwrap_err().to_string();
    assert!(honest.contains("null, expected an id"), "{honest}");
    let metadata = SerializedFileReader::new(std::fs::File::open(&index).unwrap()).unwrap().metadata().clone();
    let group = metadata.row_group(0).clone();
    let all_null = Statistics::double(None, None, None, Some(FORGED as u64), false);
    let column = group.column(0).clone().into_builder().set_statistics(all_null).build().unwrap();
    let group = group.into_builder().set_column_metadata(vec![column]).set_num_rows(FORGED).build().unwrap();
    let schema = metadata.file_metadata().schema_descr_ptr();
    let forged = ParquetMetaData::new(FileMetaData::new(1, FORGED, None, None, schema, None), vec![group]);
    // A footer after the footer: the last one counts.
    let mut bytes = std::fs::read(&index).unwrap();
    ParquetMetaDataWriter::new(&mut bytes, &forged).finish().unwrap();
    std::fs::write(&index, bytes).unwrap();
    let error = load(&root).unwrap_err().to_string();
    assert!(error.contains("column `trajectory`") && error.contains(&format!("rows 0..{FORGED}")), "{error}");
}

#[test]
fn analytic_world_velocity_is_turned_into_body() {
    let mut columns = two_drives();
    let rotated = |f: fn(f64) -> f64| Column::Double((0..80).map(|k| Some(f(0.3 * 0.05 * f64::from(k % 40)))).collect());
    columns.push(("vx".into(), rotated(|yaw| 2.0 * yaw.cos())));
    columns.push(("vy".into(), rotated(|yaw| 2.0 * yaw.sin())));
    columns.push(("vz".into(), rotated(|_| 0.5)));
    let t = &load(&root_of(&columns)).unwrap()[0];
    assert_eq!(t.measured.velocity_source, VelocitySource::World);
    for s in &t.states {
        let [x, y, z] = s.velocity_m_s;
        assert!((x - 2.0).abs() < 1e-9 && y.abs() < 1e-9 && (z - 0.5).abs() < 1e-9);
    }
}

#[test]
fn regress_every_truncation_and_flipped_byte_is_survived() {
    // Goal: no damage of the file stops the program. Every length, and every byte changed in two ways; the file is small on purpose.
    let root = root_of(&circle_columns(&["a"], 8));
    let path = root.path().join("drive/samples.parquet");
    let whole = std::fs::read(&path).unwrap();
    let opened = DataRoot::open(root.path(), None).unwrap();
    for keep in 0..whole.len() {
        std::fs::write(&path, &whole[..keep]).unwrap();
        let error = opened.load_set(&SetQuery::all("drive")).unwrap_err().to_string();
        assert!(error.contains("samples.parquet"), "cut at {keep}: {error}");
    }
    let mut refused = 0;
    for at in 0..whole.len() {
        for mask in [0x01, 0xff] {
            let mut bytes = whole.clone();
            bytes[at] ^= mask;
            std::fs::write(&path, &bytes).unwrap();
            // A flipped bit in a value is another value: only the absence of a crash is asserted here.
            refused += usize::from(opened.load_set(&SetQuery::all("drive")).is_err());
        }
    }
    println!("{refused} of {} single-byte damages were refused", 2 * whole.len());
    assert!(refused > 0);
}

#[test]
fn analytic_index_gives_split_and_world_from_parquet_or_json() {
    let root = root_of(&two_drives());
    let index = root.path().join("drive/index.parquet");
    write_index(&index, &[("b", None, Some("test")), ("a", Some("w1"), Some("train"))]);
    let drives = load(&root).unwrap();
    assert_eq!((drives[0].split, drives[1].split), (Some(Split::Train), Some(Split::Test)));
    assert_eq!(drives[0].world, None, "a root without worlds has no maps");
    std::fs::remove_file(&index).unwrap();
    let json = r#"[{"trajectory":"a","world":"w1","split":"train"},{"trajectory":"b","split":null,"world":null}]"#;
    std::fs::write(root.path().join("drive/index.json"), json).unwrap();
    let drives = load(&root).unwrap();
    assert_eq!((drives[0].split, drives[1].split), (Some(Split::Train), None));
    for (json, says) in [
        ("{}", "expected an array"),
        ("[{\"world\":\"w1\"}]", "row 0: null"),
        ("[{\"trajectory\":7.5}]", "[0].trajectory"),
        ("[{\"trajectory\":\"a\"", "not valid json"),
        ("[{\"trajectory\":\"a\",\"split\":7.5}]", "[0].split"),
        ("[{\"trajectory\":\"a\"},{\"trajectory\":\"a\"}]", "row 1: `a` appears a second time"),
    ] {
        std::fs::write(root.path().join("drive/index.json"), json).unwrap();
        let error = load(&root).unwrap_err().to_string();
        assert!(error.contains("index.json") && error.contains(says), "{json}: {error}");
    }
}

#[test]
fn regress_whole_numbers_are_ids() {
    // Goal: ids that count are ids. Method: the circle with ids 7 and 8 as numbers, in the samples and in either index; one is asked for by its number.
    let mut columns = two_drives();
    *column(&mut columns, "trajectory") = Column::Int([vec![7; 40], vec![8; 40]].concat());
    let root = root_of(&columns);
    assert_eq!(load(&root).unwrap().iter().map(|t| t.id.as_str()).collect::<Vec<_>>(), ["7", "8"]);
    let splits = Column::Text(vec![Some("test".into()), Some("train".into())]);
    let index: Columns = vec![("trajectory".into(), Column::Int(vec![7, 8])), ("split".into(), splits)];
    write_parquet(&root.path().join("drive/index.parquet"), &index, 2, Compression::UNCOMPRESSED);
    assert_eq!(load(&root).unwrap()[1].split, Some(Split::Train));
    std::fs::remove_file(root.path().join("drive/index.parquet")).unwrap();
    std::fs::write(root.path().join("drive/index.json"), r#"[{"trajectory":7,"split":"train"},{"trajectory":8,"split":"test"}]"#).unwrap();
    let only_8 = SetQuery { trajectories: Some(vec!["8".into()]), split: SplitFilter::Test, ..SetQuery::all("drive") };
    assert_eq!(DataRoot::open(root.path(), None).unwrap().load_set(&only_8).unwrap()[0].id, "8");
}

#[test]
fn regress_splits_of_other_names_are_neither_train_nor_test() {
    // Goal: a set with a validation split is readable. Method: one drive in `train`, one in `val`; all are read and noted, `test` is refused by names.
    let root = root_of(&two_drives());
    write_index(&root.path().join("drive/index.parquet"), &[("a", None, Some("train")), ("b", None, Some("val"))]);
    let opened = DataRoot::open(root.path(), None).unwrap();
    let ids = |split| {
        let drives = opened.load_set(&SetQuery { split, ..SetQuery::all("drive") }).unwrap();
        drives.into_iter().map(|t| (t.id, t.split)).collect::<Vec<_>>()
    };
    assert_eq!(ids(SplitFilter::Train), [("a".to_string(), Some(Split::Train))]);
    assert_eq!(opened.notes(), Vec::<String>::new());
    assert_eq!(ids(SplitFilter::All), [("a".to_string(), Some(Split::Train)), ("b".to_string(), None)]);
    assert_eq!(opened.notes(), ["set `drive`: split `val` of 1 drives is neither train nor test: only --split all reads them"]);
    let test = SetQuery { split: SplitFilter::Test, ..SetQuery::all("drive") };
    let error = opened.load_set(&test).unwrap_err().to_string();
    assert!(error.contains("no drive in split test; splits present: train, val"), "{error}");
    let of_val = SetQuery { trajectories: Some(vec!["b".into()]), ..test };
    assert!(opened.load_set(&of_val).unwrap_err().to_string().contains("trajectory `b` is in val, not in split test"));
}

#[test]
fn analytic_a_drive_begins_with_the_turning_of_its_rims() {
    // Goal: without a measured yaw rate the first sample knows what the rims do, not what is commanded. Method: rims that turn with 0.075 m/s to each side of
    // the base of 0.55 m while 3 rad/s are commanded; a card that nobody fitted, a fitted one, and no wheel speeds.
    let mut columns = without(&two_drives(), "wz");
    *column(&mut columns, "cmd_yaw_rate") = Column::Double(vec![Some(3.0); 80]);
    let root = root_of(&columns);
    let first = |root: &TempDir| load(root).unwrap()[0].states[0].angular_velocity_rad_s;
    let turning = 0.15 / 0.55;
    assert!((first(&root)[2] - 0.5 * turning).abs() < 1e-9, "{:?}", first(&root));
    let mut fitted = DataRoot::open(root.path(), None).unwrap().vehicle().clone();
    fitted.driveline.rims.turn_efficiency = 0.4;
    std::fs::write(root.path().join("vehicle_test.json"), card_to_json(&fitted)).unwrap();
    assert!((first(&root)[2] - 0.4 * turning).abs() < 1e-9, "{:?}", first(&root));
    let blind = root_of(&without(&without(&columns, "om_l"), "om_r"));
    assert_eq!(first(&blind), [0.0; 3]);
}

#[test]
fn analytic_implied_ranges_make_room_for_the_commands_of_drives() {
    // Goal: what was driven is admitted where the card does not forbid it. Method: 3.4 m/s under the bare card, which implies 3 m/s, under one that states the
    // range, and under one that states how fast the wheels turn.
    let mut columns = two_drives();
    *column(&mut columns, "cmd_speed") = Column::Double(vec![Some(3.4); 80]);
    let root = root_of(&columns);
    let range = |card: &str| {
        std::fs::write(root.path().join("vehicle_test.json"), card).unwrap();
        let opened = DataRoot::open(root.path(), None).unwrap();
        let seen = opened.vehicle_of(&opened.load_set(&SetQuery::all("drive")).unwrap());
        assert_eq!(seen.command_range[1], opened.vehicle().command_range[1], "the turning stays within what is implied");
        (opened.implied_range(), seen.command_range[0])
    };
    assert_eq!(range(SKID_CARD), ([true; 2], [-3.0, 3.4]));
    let stated = SKID_CARD.replacen('{', r#"{"command_range": {"speed_m_s": [-1.0, 2.0]}, "#, 1);
    assert_eq!(range(&stated), ([false, true], [-1.0, 2.0]));
    let limited = SKID_CARD.replace("\"max_wheel_speed_rad_s\": null", "\"max_wheel_speed_rad_s\": 10");
    assert_eq!(range(&limited), ([false; 2], [-1.6, 1.6]));
}

#[test]
fn regress_columns_say_what_a_card_does_not() {
    // Goal: a card of an unknown kind of drive is enough where the data say what is commanded. Method: the circle under a card of a `hover` drive, with its column of
    // yaw rates, with one of angles, with both and with one that may be either.
    let root = root_of(&two_drives());
    std::fs::write(root.path().join("vehicle_test.json"), SKID_CARD.replace("skid_steer", "hover")).unwrap();
    let open = |names: &[&str]| {
        let mut columns = without(&two_drives(), "cmd_yaw_rate");
        columns.extend(names.iter().map(|name| (name.to_string(), Column::Double(vec![Some(0.3); 80]))));
        write_parquet(&root.path().join("drive/samples.parquet"), &columns, usize::MAX / 2, Compression::UNCOMPRESSED);
        DataRoot::open(root.path(), None)
    };
    for (name, second) in [("cmd_yaw_rate", SecondCommand::YawRateRadS), ("cmd_steer_angle", SecondCommand::RoadWheelAngleRad)] {
        let opened = open(&[name]).unwrap();
        assert_eq!(opened.vehicle().second, second, "{name}");
        let said = format!("column `{name}` of set `drive`");
        assert!(opened.notes().iter().any(|note| note.contains(&said)), "{:?}", opened.notes());
        assert_eq!(opened.load_set(&SetQuery::all("drive")).unwrap()[0].controls[3].second, 0.3);
    }
    for names in [&["cmd_yaw_rate", "cmd_steer_angle"][..], &["cmd_steer"]] {
        let error = open(names).unwrap_err().to_string();
        assert!(error.contains("`hover`") && error.contains("ackermann"), "{error}");
    }
}

#[test]
fn regress_index_and_samples_must_agree() {
    let root = root_of(&two_drives());
    let index = root.path().join("drive/index.parquet");
    write_index(&index, &[("a", None, Some("test")), ("ghost", None, Some("test"))]);
    let error = load(&root).unwrap_err().to_string();
    assert!(error.contains("index.parquet") && error.contains("row 1: `ghost` has no samples"), "{error}");
    let opened = DataRoot::open(root.path(), None).unwrap();
    let only_a = SetQuery { trajectories: Some(vec!["a".into()]), ..SetQuery::all("drive") };
    assert_eq!(opened.load_set(&only_a).unwrap().len(), 1, "other drives may be gone when they are not asked for");
    let those_there = SetQuery { may_lack_drives: true, ..SetQuery::all("drive") };
    assert_eq!(opened.load_set(&those_there).unwrap().len(), 2, "or when whoever asks says so");

    let whole = std::fs::read(&index).unwrap();
    std::fs::write(&index, &whole[..whole.len() / 2]).unwrap();
    assert!(load(&root).unwrap_err().to_string().contains("index.parquet"));
}

#[test]
fn regress_queries_that_match_nothing_say_what_is_there() {
    let root = root_of(&two_drives());
    write_index(&root.path().join("drive/index.parquet"), &[("a", None, Some("test")), ("b", None, Some("test"))]);
    let opened = DataRoot::open(root.path(), None).unwrap();
    let refusal = |query: &SetQuery| opened.load_set(query).unwrap_err().to_string();
    let all = SetQuery::all("drive");
    let train = SetQuery { split: SplitFilter::Train, ..all.clone() };
    assert!(refusal(&train).contains("splits present: test"), "{}", refusal(&train));
    let unknown = SetQuery { trajectories: Some(vec!["c".into()]), ..all.clone() };
    assert!(refusal(&unknown).contains("no trajectory `c`; present: a, b"));
    let wrong_split = SetQuery { trajectories: Some(vec!["a".into()]), ..train };
    assert!(refusal(&wrong_split).contains("trajectory `a` is in test"));
    for set in ["nowhere", "../drive", "", "/etc", "drive/../drive", "worlds"] {
        let error = refusal(&SetQuery { set: set.into(), ..all.clone() });
        assert!(error.contains("present: drive"), "{set}: {error}");
    }
    for dt_s in [0.0, -0.1, f64::NAN, f64::INFINITY] {
        assert!(refusal(&SetQuery { dt_s, ..all.clone() }).contains("step"));
    }
    assert!(refusal(&SetQuery { ground_truth: true, ..all }).contains("column `gt_"));
    assert!(opened.world("w1").unwrap_err().to_string().contains("no world `w1`; present: none"));
    assert!(opened.world("../drive").is_err());

    std::fs::remove_file(root.path().join("drive/index.parquet")).unwrap();
    let no_index = SetQuery { split: SplitFilter::Test, ..SetQuery::all("drive") };
    assert!(refusal(&no_index).contains("has no index"));
}

#[test]
fn regress_a_root_needs_exactly_one_card() {
    let root = root_of(&two_drives());
    let card = root.path().join("vehicle_test.json");
    std::fs::copy(&card, root.path().join("vehicle_other.json")).unwrap();
    let error = DataRoot::open(root.path(), None).unwrap_err().to_string();
    assert!(error.contains("vehicle_other.json, vehicle_test.json") && error.contains("--vehicle"), "{error}");
    assert!(DataRoot::open(root.path(), Some(&card)).is_ok());
    std::fs::remove_file(&card).unwrap();
    std::fs::remove_file(root.path().join("vehicle_other.json")).unwrap();
    assert!(DataRoot::open(root.path(), None).unwrap_err().to_string().contains("--vehicle"));
    assert!(DataRoot::open(&root.path().join("nowhere"), None).is_err());
    let empty = circle_columns(&[], 0);
    let root = root_of(&empty);
    assert!(load(&root).unwrap_err().to_string().contains("no rows"));
}
