//! Goal: a log of one's own becomes a set that every command reads, and what is odd in it is told. Method: the real binary on the example of the book.
#![allow(clippy::unwrap_used)]

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use common::{nesam, repository, said, sample};

fn example() -> PathBuf {
    repository().join("docs/example/run.csv")
}

fn card() -> PathBuf {
    sample().join("vehicle_hmmwv.json")
}

/// Imports the example with further arguments; exit code and all that was said.
fn import(folder: &Path, set: &str, more: &[&str]) -> (Option<i32>, String) {
    import_of(folder, &example(), &card(), set, more)
}

/// The same with another log and card.
fn import_of(folder: &Path, log: &Path, card: &Path, set: &str, more: &[&str]) -> (Option<i32>, String) {
    let (log, card) = (log.to_string_lossy().into_owned(), card.to_string_lossy().into_owned());
    let args = [&["import", &log, "--to", "root", "--set", set, "--vehicle", &card][..], more].concat();
    let output = nesam(&args, folder);
    (output.status.code(), said(&output))
}

#[test]
fn service_an_imported_log_is_a_set() {
    let folder = tempfile::tempdir().unwrap();
    let (code, said) = import(folder.path(), "mine/first", &["--split", "test"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("run: 11.9 s, 120 samples, 10.0 Hz") && !said.contains("doubt"), "{said}");
    let page = std::fs::read_to_string(folder.path().join("root/mine/first/import.html")).unwrap();
    assert!(page.matches("<svg class=\"plot\"").count() == 3 && said.contains("wrote root/mine/first/import.html"), "{said}");
    let check = nesam(&["check", "root"], folder.path());
    let said = String::from_utf8_lossy(&check.stdout).into_owned();
    assert!(check.status.success() && said.contains("set mine/first: 1 drives, 120 samples") && said.contains("sound"), "{said}");
    let (code, said) = import(folder.path(), "mine/first", &[]);
    assert!(code == Some(2) && said.contains("exists; choose another --set"), "{said}");
}

#[test]
fn service_wrong_conventions_raise_doubts_and_wrong_mappings_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (i, (column, doubt)) in [
        ("yaw=-yaw", "yaw rate against the change of yaw"),
        ("vbx=vbx:km/h", "m/s that were divided by 3.6"),
        ("cmd_steer=-cmd_steer", "steering to the left is positive"),
        ("pitch=-pitch", "nose points down"),
        ("wz=wz:deg/s", "radians that were taken for degrees"),
    ]
    .into_iter()
    .enumerate()
    {
        let (code, said) = import(folder.path(), &format!("set{i}"), &["--column", column]);
        assert!(code == Some(0) && said.contains("doubt:") && said.contains(doubt), "{column} should raise `{doubt}`: {said}");
    }
    for (column, word) in [
        ("yaw=heading", "has no column `heading` (for `yaw`); it has t, x, y"),
        ("yaw=yaw:m", "allowed are rad, deg"),
        ("up=z", "no target `up`"),
    ] {
        let (code, said) = import(folder.path(), "refused", &["--column", column]);
        assert!(code == Some(2) && said.contains(word), "{column} should say `{word}`: {said}");
    }
    assert!(!folder.path().join("root/refused").exists(), "what was refused leaves nothing behind");
}

/// Goal: a log of another point of the vehicle is moved, and said to be. Method: one of a rear axle; points that are none.
#[test]
fn service_a_log_of_the_rear_axle_is_moved_to_the_reference_point() {
    let folder = tempfile::tempdir().unwrap();
    let (code, said) = import(folder.path(), "rear", &["--reference", "1.65,0,-0.1"]);
    assert!(code == Some(0) && said.contains("positions and velocities moved to the reference point, 1.65 m ahead"), "{said}");
    for (point, word) in [("1.65", "expected three lengths"), ("1,2,x", "`x` is no number"), ("1650,0,0", "lies within 20 m")] {
        let (code, said) = import(folder.path(), "refused", &["--reference", point]);
        assert!(code == Some(2) && said.contains(word), "{point} should say `{word}`: {said}");
    }
}

#[test]
fn service_time_stamps_in_nanoseconds_are_refused_without_their_unit() {
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(example()).unwrap();
    let in_ns = |line: &str| match line.split_once(',') {
        Some((t, rest)) if t != "t" => format!("{:.0},{rest}\n", 1e9 * (1.7e9 + t.parse::<f64>().unwrap())),
        _ => format!("{line}\n"),
    };
    let log = folder.path().join("log.csv");
    std::fs::write(&log, text.lines().map(in_ns).collect::<String>()).unwrap();
    let (code, said) = import_of(folder.path(), &log, &card(), "mine/first", &[]);
    assert!(code == Some(2) && said.contains("--column t=COLUMN:ns"), "{said}");
    assert!(!folder.path().join("root").exists(), "what was refused leaves nothing behind");
    let (code, said) = import_of(folder.path(), &log, &card(), "mine/first", &["--column", "t=t:ns"]);
    assert!(code == Some(0) && said.contains("120 samples, 10.0 Hz"), "{said}");
}

/// Goal: what `import` doubts in the rows of a log, `check` does too. Method: the example with every second row, and with every position repeated twice more at 30 Hz.
#[test]
fn regress_what_is_measured_too_seldom_is_doubted_by_import_and_check() {
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(example()).unwrap();
    let (head, rows): (&str, Vec<&str>) = (text.lines().next().unwrap(), text.lines().skip(1).collect());
    let column = |name: &str| head.split(',').position(|held| held == name).unwrap();
    let [x, y] = [column("x"), column("y")];
    let every_second: String = rows.iter().step_by(2).map(|row| format!("{row}\n")).collect();
    let held = |i: usize, row: &str| {
        let held: Vec<&str> = rows[i / 3 * 3].split(',').collect();
        let cells = row.split(',').enumerate().map(|(at, cell)| if at == x || at == y { held[at] } else { cell });
        cells.collect::<Vec<_>>().join(",") + "\n"
    };
    let held: String = rows.iter().enumerate().map(|(i, row)| held(i, row)).collect();
    for (set, rows, doubt) in [
        ("seldom", every_second, "1 of 1 drives are measured more seldom than the model steps, `log` at 5.0 Hz"),
        ("held", held, "positions come at 3.3 Hz in rows at 10.0 Hz in `log`"),
    ] {
        let log = folder.path().join("log.csv");
        std::fs::write(&log, format!("{head}\n{rows}")).unwrap();
        let (code, said) = import_of(folder.path(), &log, &card(), set, &[]);
        assert!(code == Some(0) && said.contains(&format!("doubt: {doubt}")), "{said}");
        let check = nesam(&["check", "root"], folder.path());
        let said = String::from_utf8_lossy(&check.stdout).into_owned();
        assert!(check.status.success() && said.contains(&format!("doubt: set {set}: {doubt}")), "{said}");
    }
}

#[test]
fn service_folders_are_bags_or_refused_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    std::fs::create_dir(&bag).unwrap();
    let (code, said) = import_of(folder.path(), &bag, &card(), "first", &[]);
    assert!(code == Some(2) && said.contains("neither metadata.yaml nor MCAP files"), "{said}");
    std::fs::write(bag.join("metadata.yaml"), "rosbag2_bagfile_information:\n  relative_file_paths:\n    - bag_0.db3\n").unwrap();
    std::fs::write(bag.join("bag_0.db3"), "SQLite format 3").unwrap();
    for log in [bag.clone(), bag.join("bag_0.db3")] {
        let (code, said) = import_of(folder.path(), &log, &card(), "first", &[]);
        assert!(code == Some(2) && said.contains("ros2 bag convert -i") && said.contains("storage_id: mcap"), "{said}");
    }
    assert!(!folder.path().join("root").exists(), "what was refused leaves nothing behind");
}

#[test]
fn regress_a_flat_log_is_a_set_whose_heights_are_not_scored() {
    // Goal: what a log lacks, every command does without. Method: the example without z, roll and pitch, imported and scored.
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(example()).unwrap();
    let head: Vec<&str> = text.lines().next().unwrap().split(',').collect();
    let kept: Vec<usize> = (0..head.len()).filter(|i| !["z", "roll", "pitch"].contains(&head[*i])).collect();
    let row = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        kept.iter().map(|i| cells[*i]).collect::<Vec<_>>().join(",") + "\n"
    };
    let log = folder.path().join("level.csv");
    std::fs::write(&log, text.lines().map(row).collect::<String>()).unwrap();
    let (code, said) = import_of(folder.path(), &log, &card(), "level", &["--flat"]);
    assert!(code == Some(0) && said.contains("no z, roll, pitch in the set"), "{said}");
    let args = ["evaluate", "--data", "root", "--set", "level", "--models", "constant_velocity", "--json", "scores.json"];
    let output = nesam(&args, folder.path());
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success() && told.contains("note: set `level`: z, roll, pitch not measured in 1 drives"), "{told}");
    let json: serde_json::Value = serde_json::from_slice(&std::fs::read(folder.path().join("scores.json")).unwrap()).unwrap();
    let scores = &json["models"]["constant_velocity"]["mae_mean"];
    assert!(scores["z_m"].is_null() && scores["roll_deg"].is_null() && scores["x_m"].is_f64() && scores["yaw_deg"].is_f64(), "{scores}");
}

#[test]
fn service_a_card_that_does_not_fit_is_not_kept_and_a_second_one_does_not_count() {
    let folder = tempfile::tempdir().unwrap();
    let of_another = repository().join("deploy/bundles/clearpath-husky/vehicle.json");
    let (code, said) = import_of(folder.path(), &example(), &of_another, "first", &[]);
    assert!(code == Some(2) && said.contains("cmd_yaw_rate"), "{said}");
    assert!(!folder.path().join("root").exists(), "what was refused leaves nothing behind");
    let (code, said) = import(folder.path(), "first", &[]);
    assert!(code == Some(0) && !said.contains("counts"), "{said}");
    let (code, said) = import_of(folder.path(), &example(), &of_another, "second", &[]);
    assert!(code == Some(0) && said.contains("vehicle_hmmwv.json counts, the card of the data root"), "{said}");
}

/// Goal: measured road-wheel angles in another unit or with another sign are doubted, whatever the clock of the log. Method: the log of the car that pulls to the left
/// as it is, with angles in degrees, negated and taken for degrees, at its stamps and at others, between which angles are interpolated.
#[test]
fn chrono_wrong_road_wheel_angles_are_doubted() {
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(repository().join("docs/example/pulls-left.csv")).unwrap();
    let head: Vec<&str> = text.lines().next().unwrap().split(',').collect();
    let log = |name: &str, seconds: f64, angle: f64| {
        let row = |line: &str| {
            let cell = |(name, cell): (&&str, &str)| match *name {
                "t" => format!("{:.4}", seconds * cell.parse::<f64>().unwrap()),
                "steer_fl" | "steer_fr" => (angle * cell.parse::<f64>().unwrap()).to_string(),
                _ => cell.to_string(),
            };
            head.iter().zip(line.split(',')).map(cell).collect::<Vec<_>>().join(",") + "\n"
        };
        let rows: String = text.lines().skip(1).map(row).collect();
        std::fs::write(folder.path().join(name), head.join(",") + "\n" + &rows).unwrap();
        folder.path().join(name)
    };
    for (i, (angle, more, doubt)) in [
        (1.0, &[][..], None),
        (180.0 / std::f64::consts::PI, &[], Some("degrees instead of radians")),
        (-1.0, &[], Some("angles to the left are positive")),
        (1.0, &["--column", "steer_fl=steer_fl:deg", "--column", "steer_fr=steer_fr:deg"], Some("radians that were taken for degrees")),
    ]
    .into_iter()
    .enumerate()
    {
        for (j, seconds) in [1.0, 1.003].into_iter().enumerate() {
            let log = log("log.csv", seconds, angle);
            let set = format!("s{i}{j}");
            let (code, said) = import_of(folder.path(), &log, &card(), &set, more);
            let doubts: Vec<&str> = said.lines().filter(|line| line.contains("doubt:")).collect();
            assert!(code == Some(0) && doubts.len() == usize::from(doubt.is_some()), "{set}: {said}");
            assert!(doubt.is_none_or(|doubt| said.contains("road-wheel angle against") && said.contains(doubt)), "{set}: {said}");
        }
    }
}

/// Goal: an import that is interrupted leaves nothing, and what a killed one leaves is in nobody's way. Method: Ctrl-C once its hidden folder is there; a hidden folder
/// with half a set before the next import.
#[test]
fn service_an_interrupted_import_leaves_nothing_and_left_overs_block_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let row = |i: usize| format!("{:.1},{:.2},0,0,{:.4},1,0\n", 0.1 * i as f64, 0.1 * i as f64, 1e-4 * (i % 7919) as f64);
    let rows: String = (0..1_200_000).map(row).collect();
    std::fs::write(folder.path().join("long.csv"), "t,x,y,yaw,wz,cmd_speed,cmd_steer\n".to_string() + &rows).unwrap();
    let card_path = card().display().to_string();
    let args = ["import", "long.csv", "--flat", "--to", "root", "--set", "a/b", "--vehicle", &card_path];
    let mut begun = Command::new(env!("CARGO_BIN_EXE_nesam"));
    begun.args(args).current_dir(folder.path()).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut begun = begun.spawn().unwrap();
    while !folder.path().join("root").exists() && begun.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    assert!(Command::new("kill").args(["-INT", &begun.id().to_string()]).status().unwrap().success());
    let output = begun.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("interrupted: nothing was imported"), "{:?}: {said}", output.status);
    assert!(!folder.path().join("root").exists(), "what was interrupted leaves nothing behind");

    let left_over = folder.path().join("root/.import-1-1/a/b");
    std::fs::create_dir_all(&left_over).unwrap();
    std::fs::write(left_over.join("samples.parquet"), "PAR1").unwrap();
    let (code, said) = import(folder.path(), "a/b", &["--html", "root/a/b/plots.html"]);
    assert!(code == Some(0) && said.contains("wrote root/a/b/plots.html"), "{said}");
    assert!(folder.path().join("root/a/b/plots.html").is_file());
    let (code, said) = import(folder.path(), "c", &["--column", "cmd_steer=-cmd_steer"]);
    assert!(code == Some(0) && !said.contains(".import-"), "{said}");
    let check = nesam(&["check", "root"], folder.path());
    let said = String::from_utf8_lossy(&check.stdout).into_owned();
    assert!(check.status.success() && said.contains("set a/b: 1 drives") && !said.contains(".import-"), "{said}");
    let visible = std::fs::read_dir(folder.path().join("root")).unwrap().flatten().map(|e| e.file_name().to_string_lossy().into_owned());
    let mut visible: Vec<String> = visible.collect();
    visible.sort();
    assert_eq!(visible, [".import-1-1", "a", "c", "vehicle_hmmwv.json"]);
}

/// Goal: what makes no log is told as what it is. Method: an empty file, a Parquet file, a cell that is no number, a unit that is none, each with what is said.
#[test]
fn service_what_is_no_log_is_told_as_what_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(example()).unwrap();
    let comma = text.replacen("\n0.1,", "\n\"0,1\",", 1);
    assert_ne!(text, comma);
    for (name, content, more, word) in [
        ("empty.mcap", "", &[][..], "is empty"),
        ("set.csv", "PAR1", &[], "seems to be a Parquet file"),
        ("comma.csv", &comma, &[], "line 3: column `t` (for `t`) holds `0,1`, expected numbers; write them with a decimal point"),
        ("unit.csv", &text, &["--column", "yaw=yaw:degrees"], "`degrees` is no unit of `yaw`; allowed are rad, deg"),
    ] {
        let log = folder.path().join(name);
        std::fs::write(&log, content).unwrap();
        let (code, said) = import_of(folder.path(), &log, &card(), "s", more);
        assert!(code == Some(2) && said.contains(word), "{name} should say `{word}`: {said}");
    }
    assert!(!folder.path().join("root").exists(), "what was refused leaves nothing behind");
}
