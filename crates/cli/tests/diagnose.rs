//! Goal: what a person hears of a diagnosis beside its verdict, or in its place. Method: the real binary on logs that are imported, one of them with a column of another
//! sign, and on drives of the plant.
#![allow(clippy::unwrap_used)]

mod common;

use std::path::Path;
use std::sync::Arc;

use common::{bundle, copy_folder, nesam, refused, repository, sample, stderr, stdout};
use nesam_plant::{Command as Told, DriveRecorder, Ground, HiddenEffects, Plant, PlantVehicle, Sensors, write_set};
use serde_json::Value;

fn imported(log: &str, set: &str, folder: &Path, more: &[&str]) {
    let card = sample().join("vehicle_hmmwv.json").display().to_string();
    let output = nesam(&[&["import", log, "--to", "mine", "--set", set, "--vehicle", &card], more].concat(), folder);
    assert!(output.status.success(), "{}", stderr(&output));
}

/// Asserts that a diagnosis of a set of `mine` ends with exit code 2 and says this.
fn not_diagnosed(set: &str, folder: &Path, more: &[&str], words: &[&str]) {
    let bundle = bundle("hmmwv-nominal");
    refused(&[&["diagnose", "--data", "mine", "--bundle", &bundle, "--set", set], more].concat(), folder, words);
}

/// Goal: what is printed of doubts in the drives is what the JSON has, and what `nesam check` doubts. Method: the log of the book, with its gyro and one wheel read with the other sign;
/// as it is, nothing is doubted.
#[test]
fn chrono_doubts_are_printed_as_the_json_has_them() {
    let here = tempfile::tempdir().unwrap();
    let log = std::fs::read_to_string(repository().join("docs/example/pulls-left.csv")).unwrap();
    let mut lines = log.lines().map(|line| line.split(',').map(String::from).collect::<Vec<_>>());
    let header = lines.next().unwrap();
    let turned: Vec<usize> = ["wz", "om_rl"].map(|name| header.iter().position(|column| column == name).unwrap()).into();
    let rows = lines.map(|mut row| {
        turned.iter().for_each(|column| row[*column] = (-row[*column].parse::<f64>().unwrap()).to_string());
        row.join(",")
    });
    let changed: Vec<String> = std::iter::once(header.join(",")).chain(rows).collect();
    std::fs::write(here.path().join("turned.csv"), changed.join("\n") + "\n").unwrap();
    std::fs::write(here.path().join("sound.csv"), &log).unwrap();
    copy_folder(&sample().join("worlds/w25"), &here.path().join("mine/worlds/w25"));
    let bundle = bundle("hmmwv-nominal");
    for (set, doubted) in [("turned", true), ("sound", false)] {
        imported(&format!("{set}.csv"), set, here.path(), &["--world", "w25"]);
        let output = nesam(&["diagnose", "--data", "mine", "--set", set, "--bundle", &bundle, "--no-controls", "--out", set], here.path());
        let said = stdout(&output);
        assert!(output.status.success(), "{said}{}", stderr(&output));
        let json: Value = serde_json::from_slice(&std::fs::read(here.path().join(set).join("diagnose.json")).unwrap()).unwrap();
        let doubts: Vec<&str> = json["doubts"].as_array().unwrap().iter().map(|doubt| doubt.as_str().unwrap()).collect();
        let end = " (`nesam check` tells more; a claim may be wrong by it)";
        let printed: Vec<&str> =
            said.lines().filter_map(|line| line.strip_prefix("doubt: ")).map(|line| line.strip_suffix(end).expect(line)).collect();
        assert_eq!(printed, doubts);
        assert_eq!(!doubts.is_empty(), doubted, "{doubts:?}");
        // Where a bundle is, if one was written, is printed too.
        let bundle = json["bundle"].as_str();
        assert!(doubted || bundle == Some("sound/bundle"), "{json}");
        assert_eq!(said.lines().find_map(|line| line.strip_prefix("bundle with what is claimed: ")), bundle, "{said}");
        let html = std::fs::read_to_string(here.path().join(set).join("diagnose.html")).unwrap();
        let check = stdout(&nesam(&["check", "mine"], here.path()));
        for doubt in doubts {
            let what = doubt.split(". ").next().unwrap();
            assert!(check.contains(&format!("doubt: set {set}: {what}; ")), "{what}: {check}");
            assert!(html.contains(what.split(['<', '>', '&', '\'', '"']).next().unwrap()), "{what}");
        }
        if doubted {
            let all = printed.join("\n");
            assert!(all.contains("yaw rate") && all.contains("rim speed of RL"), "the gyro and the wheel: {all}");
        }
    }
}

/// Goal: a drive that was left out is no unknown one. Method: two drives of the plant, one of five samples, which is named to fit on.
#[test]
fn service_a_drive_that_is_too_short_to_fit_on_is_told_as_such() {
    let here = tempfile::tempdir().unwrap();
    let root = here.path().join("mine");
    let vehicle = Arc::new(PlantVehicle::of_root(&sample()).unwrap());
    let ground = Arc::new(Ground::read(&sample().join("worlds/w01")).unwrap());
    let effects = HiddenEffects::default();
    let drive = |id: &str, samples: usize| {
        let mut plant = Plant::at_rest(Arc::clone(&vehicle), Arc::clone(&ground), effects, 0.0, 0.0, 0.0);
        let (mut sensors, mut recorder) = (Sensors::new(1, &effects), DriveRecorder::default());
        let told = Told { speed_m_s: 2.0, steering: 0.0 };
        for _ in 0..samples {
            let truth = plant.truth();
            recorder.sample(&sensors.read(&truth), &truth, told);
            plant.advance(told);
        }
        recorder.finish(id, "w01", "test")
    };
    write_set(&root.join("plant"), &[drive("long", 30), drive("brief", 5)]).unwrap();
    std::fs::copy(sample().join("vehicle_hmmwv.json"), root.join("vehicle_hmmwv.json")).unwrap();
    let short = ["--fit-on brief: the drive is too short to be judged, 0.4 s (5 samples of 0.1 s)", "0.8 s (9 samples) or more"];
    for ids in ["brief", "long,brief"] {
        not_diagnosed("plant", here.path(), &["--fit-on", ids], &short);
    }
    not_diagnosed("plant", here.path(), &["--fit-on", "other"], &["no drive `other` to fit on"]);
}

/// Goal: a vehicle that stands is no vehicle with a large drag. Method: eight logs of 6 s of one pose to the bit, under commands and under none.
#[test]
fn service_drives_in_which_nothing_moves_are_told_as_such() {
    let here = tempfile::tempdir().unwrap();
    for (set, speed_m_s) in [("held", 2.0), ("parked", 0.0)] {
        let row = |drive: usize, k: usize| format!("{:.1},1,2,0.6,0,0,0.3,{speed_m_s},0\n", 30.0 * drive as f64 + 0.1 * k as f64);
        let rows: String = (0..8).flat_map(|drive| (0..60).map(move |k| row(drive, k))).collect();
        std::fs::write(here.path().join(format!("{set}.csv")), format!("t,x,y,z,roll,pitch,yaw,cmd_speed,cmd_steer\n{rows}")).unwrap();
        imported(&format!("{set}.csv"), set, here.path(), &[]);
    }
    for reference in ["bundle", "physics"] {
        let asked = ["--reference", reference];
        let held = [
            "the vehicle never moved (0.00 m at most) in the 8 drives to fit on",
            "up to 2.00 m/s was commanded",
            "give drives in which it moves",
        ];
        not_diagnosed("held", here.path(), &asked, &held);
        not_diagnosed(
            "parked",
            here.path(),
            &asked,
            &["nothing was commanded and nothing moved", "record drives in which the vehicle is driven"],
        );
    }
    assert!(!here.path().join("nesam-out/diagnose-held/diagnose.json").exists());
}

/// Goal: on drives of an external simulator the shipped bundle names the steering offset they have, sizes it, writes a bundle that has it, and
/// finds nothing in drives without an effect. Method: the command on two drives of each; the truth is 0.12.
#[test]
fn chrono_diagnose_names_a_steering_offset_and_nothing_without_one() {
    let here = tempfile::tempdir().unwrap();
    let root = sample().display().to_string();
    let shipped = bundle("hmmwv-nominal");
    let run = |set: &str, out: &str| -> Value {
        let output = nesam(&["diagnose", "--data", &root, "--set", set, "--bundle", &shipped, "--out", out], here.path());
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        serde_json::from_slice(&std::fs::read(here.path().join(out).join("diagnose.json")).unwrap()).unwrap()
    };
    let found = run("effect_open/steer_offset", "steer");
    assert_eq!((found["schema"].as_str(), found["verdict"].as_str()), (Some("nesam.diagnose/1"), Some("explained")), "{}", found["reason"]);
    let effect = &found["effects"][0];
    assert_eq!(effect["id"], "steering_offset");
    let second = &effect["parameters"][0];
    assert!((second["value"].as_f64().unwrap() - 0.12).abs() < 0.012, "{second}");
    assert_eq!(second["ci95"].as_array().unwrap().len(), 2);
    let rivals: f64 = effect["rivals"].as_array().unwrap().iter().map(|r| r["weight"].as_f64().unwrap()).sum();
    assert!((effect["weight"].as_f64().unwrap() + rivals - 1.0).abs() < 1e-9);
    let position = |stage: &str| found[stage]["position_m"]["mean"].as_f64().unwrap();
    assert!(position("after") < 0.8 * position("before") && position("after") < 0.8 * position("soil_only"));
    let patched = ["predict", "--data", &root, "--set", "nominal", "--bundle", "steer/bundle", "--horizon", "5", "--out", "p.json"];
    let predicted = nesam(&patched, here.path());
    assert_eq!(predicted.status.code(), Some(0), "{}", stderr(&predicted));

    let nothing = run("effect_open/null_open", "null");
    assert_eq!(nothing["verdict"], "none", "{}", nothing["reason"]);
    assert!(nothing["effects"].as_array().unwrap().is_empty() && nothing["bundle"].is_null());
}

/// A bias of the gyro in three drives of the plant: found, sized, and written down with what was hidden.
#[test]
fn service_bench_plant_scores_what_a_diagnosis_makes_of_a_hidden_effect() {
    let folder = tempfile::tempdir().unwrap();
    refused(&["bench", "plant", "--worlds", "w01", "--effects", "ghosts"], folder.path(), &["ghosts", "gyro_bias"]);
    let hidden = ["--effects", "gyro_bias", "--doses", "1", "--drives", "3", "--nulls", "0", "--json", "plant.json"];
    let output = nesam(&[&["bench", "plant", "--worlds", "w01,w05,w16"][..], &hidden].concat(), folder.path());
    assert!(output.status.success(), "{}", stderr(&output));
    let read: Value = serde_json::from_slice(&std::fs::read(folder.path().join("plant.json")).unwrap()).unwrap();
    let run = &read["runs"][0];
    let (size, estimate) = (run["size"].as_f64().unwrap(), run["estimate"].as_f64().unwrap());
    assert_eq!(run["named"][0][0], "gyro_bias", "{run}");
    assert!((estimate / size - 1.0).abs() < 0.15, "{estimate} of {size}");
}
