//! Goal: the card of a vehicle can be fitted to its logs, and used. Method: the real binary on the committed sample.
#![allow(clippy::unwrap_used)]

mod common;

use common::{bundle, nesam, repository, said, sample};
use nesam_model::ModelBundle;
use nesam_physics::SOIL_NAMES;
use serde_json::Value;

/// Goal: the fit is that of training, it is scored on drives that it did not see, and card and bundle can be passed on. Method: the two drives of the train split.
#[test]
fn chrono_a_card_is_fitted_as_training_does_and_helps_on_other_drives() {
    let here = tempfile::tempdir().unwrap();
    let (data, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
    let set = ["--data", data.as_str(), "--set", "nominal", "--split", "train"];
    let calibrated = nesam(&[&["calibrate"], &set[..], &["--bundle", &bundle, "--out", "fit"]].concat(), here.path());
    assert_eq!(calibrated.status.code(), Some(0), "{}", said(&calibrated));
    let json: Value = serde_json::from_slice(&std::fs::read(here.path().join("fit/calibrate.json")).unwrap()).unwrap();
    for (key, value) in [("schema", "nesam.calibrate/1"), ("set", "nominal"), ("split", "train")] {
        assert_eq!(json[key], value);
    }
    assert!(json["held_out"] == true && json["trajectories"].as_array().unwrap().len() == 2, "{json}");
    // The data sheet says nothing of the drive line and takes another contact law: what is fitted on one drive helps on the other.
    let error = |stage: &str| json[stage]["position_m"].as_f64().unwrap();
    assert!(error("after") < error("before") && json["after"]["tilt_deg"].is_f64(), "{json}");
    // Beside it stands what a planner without terramechanics would have, and whether the physics turns as the vehicle does.
    assert!(
        json["kinematic"]["position_m"].is_f64() && said(&calibrated).contains("a kinematic fit, which knows no soil: position"),
        "{json}"
    );
    assert!(["before", "after", "kinematic"].iter().all(|stage| (0.5..1.5).contains(&json[stage]["turning"].as_f64().unwrap())), "{json}");
    let parameters = json["parameters"].as_array().unwrap();
    assert!(parameters.iter().any(|p| p["name"] == "driveline.steering_lag_s" && p["card"] != p["fitted"]), "{json}");
    assert!(json["provenance"]["command"].as_str().unwrap().starts_with("nesam calibrate"));
    assert!(json["soil"].is_null(), "its map tells of the ground: {json}");

    let args = ["--from", bundle.as_str(), "--recalibrate", "--epochs", "0", "--no-mirror", "--out", "trained"];
    let trained = nesam(&[&["train"], &set[..], &args[..]].concat(), here.path());
    assert_eq!(trained.status.code(), Some(0), "{}", said(&trained));
    let text = |file: &str| std::fs::read_to_string(here.path().join(file)).unwrap().trim().to_string();
    let card = text("fit/vehicle_calibrated.json");
    assert_eq!(card, text("trained/bundle/vehicle.json"));
    assert_eq!(card, text("fit/bundle/vehicle.json"));
    assert!(!here.path().join("fit/bundle/reference.json").exists(), "it was measured with the old card");

    let inspected = nesam(&["inspect", "fit/bundle"], here.path());
    assert!(inspected.status.success() && said(&inspected).contains("nesam calibrate"), "{}", said(&inspected));
    let checked = nesam(&["check", "--vehicle", "fit/vehicle_calibrated.json", &data], here.path());
    assert!(checked.status.success(), "{}", said(&checked));
}

#[test]
fn chrono_a_single_drive_is_scored_on_itself_and_says_so() {
    let here = tempfile::tempdir().unwrap();
    let (data, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
    let args = ["calibrate", "--data", &data, "--set", "nominal", "--trajectories", "n0001", "--out", "fit", "--json", "c.json"];
    let output = nesam(&args, here.path());
    assert!(output.status.success() && said(&output).contains("the drive that the card was fitted on"), "{}", said(&output));
    let json: Value = serde_json::from_slice(&std::fs::read(here.path().join("c.json")).unwrap()).unwrap();
    assert!(json["held_out"] == false && json["bundle"].is_null(), "{json}");
    let second = ["calibrate", "--data", &data, "--set", "nominal", "--dt", "0.2", "--bundle", &bundle];
    for (args, words) in [(&second[..], "it steps by 0.1 s"), (&["calibrate", "--set", "nowhere"][..], "no set `nowhere`")] {
        let output = nesam(args, here.path());
        assert!(output.status.code() == Some(2) && said(&output).contains(words), "{}", said(&output));
    }
}

/// Goal: a bundle stands on the ground that its card was fitted on. Method: a log without a map; the soil that is told against the one that a bundle assumes.
#[test]
fn property_a_bundle_keeps_the_ground_of_its_card() {
    let here = tempfile::tempdir().unwrap();
    let (log, card) = (repository().join("docs/example/run.csv"), sample().join("vehicle_hmmwv.json"));
    let [log, card] = [log, card].map(|path| path.display().to_string());
    let imported = nesam(&["import", &log, "--to", "mine", "--set", "first", "--vehicle", &card], here.path());
    assert!(imported.status.success(), "{}", said(&imported));
    let fitted =
        nesam(&["calibrate", "--data", "mine", "--set", "first", "--bundle", &bundle("hmmwv-nominal"), "--out", "fit"], here.path());
    assert!(fitted.status.success() && said(&fitted).contains("on hard ground, pose of the symbolic model"), "{}", said(&fitted));
    let json: Value = serde_json::from_slice(&std::fs::read(here.path().join("fit/calibrate.json")).unwrap()).unwrap();
    let kept = ModelBundle::load(&here.path().join("fit/bundle")).unwrap().default_soil();
    for (name, value) in SOIL_NAMES.iter().zip(kept) {
        let told = json["soil"][name].as_f64().unwrap();
        assert!(f64::abs(told / value - 1.0) < 1e-9, "{name}: {told}, the bundle has {value}");
    }
}

/// Goal: a number that the fit could only bring to the end of its range is told, in words and in the JSON. Method: a drive of the sample on a card whose springs are a twentieth of the
/// true ones, of which a fit makes three times as much at most; on the card as it is, springs are told by the drives.
#[test]
fn chrono_a_number_that_ends_at_its_range_is_told() {
    let here = tempfile::tempdir().unwrap();
    let mut card: Value = serde_json::from_slice(&std::fs::read(sample().join("vehicle_hmmwv.json")).unwrap()).unwrap();
    for axle in ["front", "rear"] {
        let spring = &mut card["suspension"][axle]["spring_N_per_m"];
        *spring = (spring.as_f64().unwrap() / 20.0).into();
    }
    std::fs::write(here.path().join("soft.json"), card.to_string()).unwrap();
    let data = sample().display().to_string();
    let fitted = |more: &[&str], out: &str| {
        let args = ["calibrate", "--data", &data, "--set", "nominal", "--trajectories", "n0001", "--out", out];
        let output = nesam(&[&args[..], more].concat(), here.path());
        assert!(output.status.success(), "{}", said(&output));
        let json: Value = serde_json::from_slice(&std::fs::read(here.path().join(out).join("calibrate.json")).unwrap()).unwrap();
        (String::from_utf8_lossy(&output.stderr).into_owned(), json["at_ends"].as_array().unwrap().clone())
    };
    let warned = |errors: &str| errors.lines().filter(|line| line.starts_with("warning: ")).count();
    let (errors, ends) = fitted(&["--vehicle", "soft.json"], "soft");
    assert_eq!(warned(&errors), ends.len(), "{errors}");
    for axle in ["front", "rear"] {
        let name = format!("suspension_n_m of the {axle} axle");
        let line = errors.lines().find(|line| line.starts_with(&format!("warning: {name} ends at "))).expect(&errors);
        assert!(line.contains("N/m: it may be more, the data do not tell it, or the card is wrong about something else"), "{line}");
        let end = ends.iter().find(|end| end["name"] == name.as_str()).unwrap();
        assert!(end["unit"] == "N/m" && end["value"] == end["range"][1], "{end}");
        assert!((end["range"][1].as_f64().unwrap() / end["range"][0].as_f64().unwrap() - 9.0).abs() < 1e-9, "{end}");
    }
    let (errors, ends) = fitted(&[], "sheet");
    assert_eq!(warned(&errors), ends.len(), "{errors}");
    assert!(!ends.iter().any(|end| end["name"].as_str().unwrap().starts_with("suspension_n_m ")), "{ends:?}");
}
