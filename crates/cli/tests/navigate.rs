//! Goal: laps, on the built-in plant and on simulators of others, as a person drives them. Method: the real binary with small plans, also on a bicycle behind the plant
//! protocol, which ends its laps early.
#![allow(clippy::unwrap_used)]

#[path = "../../navigation/tests/common/bicycle.rs"]
mod bicycle;
mod common;

use std::path::Path;
use std::process::{Command, Output};

use bicycle::{Habits, RIGHT, bicycle, bicycle_with};
use common::{bundle, copy_folder, nesam, refused, repository, sample, stderr};
use serde_json::Value;

/// Drives laps with small plans; `more` has a plant.
fn navigate(folder: &Path, root: &Path, more: &[&str]) -> Output {
    let bundle = bundle("hmmwv-nominal");
    let worlds: &[&str] = if more.contains(&"--worlds") { &[] } else { &["--worlds", "w01"] };
    let quick = ["--candidates", "4", "--horizon", "10", "--plan-every", "10", "--out", "laps"];
    let mut command = Command::new(env!("CARGO_BIN_EXE_nesam"));
    command.current_dir(folder).arg("navigate").arg("--data").arg(root).arg("--bundle").arg(bundle).args(worlds).args(quick).args(more);
    command.output().expect("the binary runs")
}

fn json(file: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}

/// A plant whose laps end half a second after their beginning.
fn plant(name: Option<&'static str>) -> String {
    bicycle(move |request, steps, mut reply| {
        if let (Some(name), true) = (name, request["type"] == "reset") {
            reply["plant"] = name.into();
        }
        if steps == 30 {
            reply["ended"] = "the test is over".into();
        }
        vec![reply.to_string()]
    })
}

const KINEMATIC: [&str; 4] = ["--configurations", "kinematic", "--runs", "1"];

/// Goal: laps are taken from earlier commands where the plant is the one that drove them, wherever it listens, and nowhere else. Method: plants of one name, of
/// another and of none.
#[test]
fn service_laps_are_taken_on_the_same_plant_alone() {
    let folder = tempfile::tempdir().unwrap();
    let taken = |address: &str, more: &[&str]| {
        let output = navigate(folder.path(), &sample(), &[&KINEMATIC[..], &["--plant", address], more].concat());
        let said = stderr(&output);
        assert!(output.status.success(), "{said}");
        (said.contains("1 laps taken from laps"), said)
    };
    let first = plant(Some("one"));
    assert!(!taken(&first, &[]).0 && taken(&first, &[]).0 && taken(&plant(Some("one")), &[]).0);
    let (other, said) = taken(&plant(Some("two")), &[]);
    assert!(!other && said.contains("driven with other settings"), "{said}");
    let unnamed = plant(None);
    let (before, said) = taken(&unnamed, &[]);
    assert!(!before && said.contains("--resume") && said.contains("scored by `state`"), "{said}");
    assert!(!taken(&unnamed, &[]).0 && taken(&unnamed, &["--resume"]).0);
    // A file that is torn, or that of another lap, is said to be so.
    let file = std::fs::read_dir(folder.path().join("laps")).unwrap().next().unwrap().unwrap().path();
    let whole = std::fs::read_to_string(&file).unwrap();
    for (other, reason) in
        [(&whole[..whole.len() / 2], "cannot be read"), (&whole.replace("\"start\": 0", "\"start\": 1"), "is another lap")]
    {
        std::fs::write(&file, other).unwrap();
        let (other, said) = taken(&unnamed, &["--resume"]);
        assert!(!other && said.contains(reason) && said.contains("driven again"), "{said}");
    }
    // Nor is a lap of another plant one of the built-in.
    let built_in = navigate(folder.path(), &sample(), &KINEMATIC);
    assert!(built_in.status.success() && !stderr(&built_in).contains("taken from"), "{}", stderr(&built_in));
}

/// Goal: a simulator that was started anew on the way costs one lap twice. Method: a plant that once says so, twenty steps into its first lap.
#[test]
fn service_a_lap_that_was_lost_is_driven_again() {
    let folder = tempfile::tempdir().unwrap();
    let mut forgets = true;
    let address = bicycle(move |_, steps, mut reply| {
        if steps == 45 && std::mem::take(&mut forgets) {
            reply["error"] = "reset comes first".into();
        }
        if steps == 60 {
            reply["ended"] = "the test is over".into();
        }
        vec![reply.to_string()]
    });
    let output = navigate(folder.path(), &sample(), &[&KINEMATIC[..], &["--plant", &address, "--json", "laps.json"]].concat());
    assert!(output.status.success() && stderr(&output).contains("it is driven once again"), "{}", stderr(&output));
    let lap = &json(&folder.path().join("laps.json"))["each"][0]["lap"];
    assert!(lap["end"] == "the test is over" && lap["scored"] == "state" && lap["completed"] == false, "{lap}");
}

/// Goal: laps that were driven before a simulator failed are kept, told of, and gone on from. Method: it fails at its second `reset`.
#[test]
fn service_laps_before_a_failure_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let mut resets = 0;
    let address = bicycle(move |request, steps, mut reply| {
        resets += usize::from(request["type"] == "reset");
        if resets == 2 {
            reply["error"] = "no licence".into();
        }
        if steps == 30 {
            reply["ended"] = "the test is over".into();
        }
        vec![reply.to_string()]
    });
    let asked = ["--configurations", "kinematic", "--runs", "2", "--plant", &address, "--json", "laps.json", "--html", "laps.html"];
    let output = navigate(folder.path(), &sample(), &asked);
    let said = stderr(&output);
    assert!(output.status.code() == Some(1) && said.contains("no licence"), "{said}");
    assert!(said.contains("1 laps are kept in laps: the same command with --resume goes on after them"), "{said}");
    let laps = json(&folder.path().join("laps.json"));
    assert!(laps["runs"] == 1 && laps["provenance"]["ended early"] == "1 of 2 laps", "{laps}");
    assert!(folder.path().join("laps.html").exists());
    let again = navigate(folder.path(), &sample(), &[&asked[..], &["--resume"]].concat());
    assert!(again.status.success() && stderr(&again).contains("1 laps taken from laps"), "{}", stderr(&again));
    assert_eq!(json(&folder.path().join("laps.json"))["runs"], 2);
}

/// Goal: a data root without true soil serves another simulator. Method: one world of the sample without its `gt_` files; the oracle is left out, or refused where
/// it is asked for.
#[test]
fn service_a_root_without_true_soil_serves_another_simulator() {
    let (folder, root) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let world = root.path().join("worlds/w01");
    std::fs::create_dir_all(&world).unwrap();
    for file in ["elevation.png", "semantic.png", "world.json"] {
        std::fs::copy(sample().join("worlds/w01").join(file), world.join(file)).unwrap();
    }
    std::fs::copy(sample().join("vehicle_hmmwv.json"), root.path().join("vehicle_hmmwv.json")).unwrap();
    // The built-in one drives on true soil.
    let refused = navigate(folder.path(), root.path(), &["--runs", "1"]);
    assert!(refused.status.code() == Some(2) && stderr(&refused).contains("--worlds w01"), "{}", stderr(&refused));
    assert!(stderr(&refused).contains("gt_soil.json") && stderr(&refused).contains("--plant"), "{}", stderr(&refused));
    let mut anywhere = Command::new(env!("CARGO_BIN_EXE_nesam"));
    let refused = anywhere.current_dir(folder.path()).args(["navigate", "--runs", "1", "--data"]).arg(root.path()).output().unwrap();
    assert!(refused.status.code() == Some(2) && stderr(&refused).contains("no world with true soil"), "{}", stderr(&refused));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is left of what was refused");
    let address = plant(None);
    let refused = navigate(folder.path(), root.path(), &["--plant", &address, "--runs", "1", "--configurations", "fixed,oracle"]);
    assert!(refused.status.code() == Some(2) && stderr(&refused).contains("gt_soil.json"), "{}", stderr(&refused));
    let output = navigate(folder.path(), root.path(), &["--plant", &address, "--runs", "1", "--json", "laps.json"]);
    assert!(output.status.success() && stderr(&output).contains("oracle is left out"), "{}", stderr(&output));
    let laps = json(&folder.path().join("laps.json"));
    let driven: Vec<[&str; 2]> =
        laps["each"].as_array().unwrap().iter().map(|run| ["configuration", "soil"].map(|key| run[key].as_str().unwrap())).collect();
    assert_eq!(driven, [["fixed", "unknown"], ["adapted", "unknown"], ["kinematic", "unknown"]]);
    assert_eq!(laps["configurations"]["fixed"]["by_soil"]["unknown"]["runs"], 1);
    assert!(laps["runs"] == 1 && laps["laps"] == 3, "laps of each configuration, and all: {laps}");
    // Every figure can be computed again from the file of its lap.
    for run in laps["each"].as_array().unwrap() {
        let lap = &json(&folder.path().join(run["file"].as_str().unwrap()))["run"]["lap"];
        let [path, lean] = ["path", "lean"].map(|key| lap[key].as_array().unwrap().len());
        assert!(path == lean + 1 && lap["hausdorff_m"] == run["lap"]["hausdorff_m"], "{path} {lean}");
    }
    assert!(laps["configurations"]["fixed"]["time_s"]["sd"].is_null(), "no lap was completed");
}

#[test]
fn service_options_of_another_simulator_without_one_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (asked, word) in [
        (&["--resume"][..], "--plant"),
        (&["--plant-timeout", "5"][..], "--plant"),
        (&["--plant", "localhost:5599", "--plant-timeout", "0"][..], "--plant-timeout 0"),
        (&["--plant", "localhost", "--configurations", "kinematic"][..], "plant localhost"),
        (&["--configurations", "fixed,kinematic,fixed"][..], "--configurations has `fixed` twice"),
        (&["--worlds", "w01,w05,w01"][..], "--worlds has `w01` twice"),
    ] {
        let output = navigate(folder.path(), &sample(), asked);
        assert!(output.status.code() == Some(2) && stderr(&output).contains(word), "{asked:?}: {}", stderr(&output));
    }
}

/// Goal: who sees a table of laps that failed learns why, and what may be wrong with the plant. Method: plants whose laps are lost, blocked, of steps of half their
/// time, and with the steering to the other side.
#[test]
fn regress_why_laps_were_not_completed_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let said = |address: &str| {
        let output = navigate(folder.path(), &sample(), &[&KINEMATIC[..], &["--plant", address]].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        (String::from_utf8_lossy(&output.stdout).into_owned(), stderr(&output))
    };
    let (table, notes) = said(&bicycle(|_, steps, mut reply| {
        if steps == 59 {
            reply["state"][6] = Value::Null;
        }
        vec![reply.to_string()]
    }));
    assert!(table.contains("not completed by kinematic: plant_lost 1 (at 3.3 s)"), "{table}");
    assert!(notes.contains("warning: every lap of kinematic is lost"), "{notes}");
    let (table, notes) = said(&bicycle(|_, _, mut reply| {
        reply["ended"] = "spawn\u{1b}[31m\nblocked".into();
        vec![reply.to_string()]
    }));
    assert!(table.contains(r"not completed by kinematic: spawn\u{1b}[31m\nblocked 1 (before the lap began)"), "{table}");
    assert!(notes.contains("the answer to the first `reset` did not say which plant it is"), "{notes}");
    let (_, notes) = said(&bicycle_with(Habits { step_s: 0.05, ..RIGHT }, |_, _, reply| vec![reply.to_string()]));
    assert!(
        notes.contains("move 0.50 times as far as its velocities say: does a step take 0.1 s") && !notes.contains("in Body"),
        "{notes}"
    );
    let (_, notes) = said(&bicycle_with(Habits { left: -1.0, ..RIGHT }, |_, _, reply| vec![reply.to_string()]));
    assert!(notes.contains("turns right where it is told to turn left"), "{notes}");
}

/// The bundle itself in the place of one with effects: the same laps, so what differs in other laps is the effects.
#[test]
fn service_laps_with_a_diagnosed_bundle_differ_by_its_effects_alone() {
    let folder = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
    let quick = ["--worlds", "w01", "--runs", "1", "--candidates", "4", "--horizon", "10", "--plan-every", "10", "--out", "laps"];
    let asked = |more: &[&'static str]| [&["navigate", "--data", &root, "--bundle", &bundle][..], &quick, more].concat();
    refused(&asked(&["--configurations", "diagnosed"]), folder.path(), &["--diagnosed"]);
    let with: Vec<&str> = [asked(&["--configurations", "adapted,diagnosed", "--json", "laps.json"]), vec!["--diagnosed", &bundle]].concat();
    let output = nesam(&with, folder.path());
    assert!(output.status.success(), "{}", stderr(&output));
    let laps: Value = serde_json::from_slice(&std::fs::read(folder.path().join("laps.json")).unwrap()).unwrap();
    let of = |i: usize| (laps["each"][i]["configuration"].as_str().unwrap().to_string(), laps["each"][i]["lap"].clone());
    let ((first, adapted), (second, diagnosed)) = (of(0), of(1));
    assert_eq!((first.as_str(), second.as_str()), ("adapted", "diagnosed"));
    assert!(adapted["measurements"]["APPLIED"].as_u64() > Some(50) && adapted == diagnosed, "{adapted} {diagnosed}");
}

/// A copy of one world of the sample with a vehicle card.
fn root_of_a_world(card: &Path, name: &str) -> tempfile::TempDir {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&sample().join("worlds/w01"), &root.path().join("worlds/w01"));
    std::fs::copy(card, root.path().join(name)).unwrap();
    root
}

/// Goal: laps are taken from an earlier run only where card and true soil are what they were. Method: both files, one after the other, with one byte more.
#[test]
fn service_laps_are_driven_again_where_card_or_soil_changed() {
    let root = root_of_a_world(&sample().join("vehicle_hmmwv.json"), "vehicle_hmmwv.json");
    let bundle = bundle("hmmwv-nominal");
    let drive = || {
        let quick = ["--runs", "1", "--candidates", "4", "--horizon", "10", "--plan-every", "10", "--out", "laps"];
        let asked = ["navigate", "--data", ".", "--bundle", &bundle, "--worlds", "w01", "--configurations", "kinematic"];
        let output = nesam(&[&asked[..], &quick].concat(), root.path());
        assert!(output.status.success(), "{}", stderr(&output));
        stderr(&output).contains("driven with other settings")
    };
    assert!(!drive() && !drive(), "the same laps");
    for file in ["worlds/w01/gt_soil.json", "vehicle_hmmwv.json"] {
        let text = std::fs::read_to_string(root.path().join(file)).unwrap();
        std::fs::write(root.path().join(file), text + "\n").unwrap();
        assert!(drive(), "{file}");
    }
}

/// Goal: nobody drives laps of one vehicle with the model of another without being told. Method: the car's bundle on the card of a skid-steer robot, which the
/// built-in plant is not.
#[test]
fn service_laps_of_another_vehicle_than_that_of_the_bundle_are_told() {
    let root = root_of_a_world(&repository().join("deploy/bundles/clearpath-husky/vehicle.json"), "vehicle_husky.json");
    let bundle = bundle("hmmwv-nominal");
    let asked =
        |more: &[&'static str]| [&["navigate", "--data", ".", "--bundle", &bundle, "--worlds", "w01", "--runs", "1"][..], more].concat();
    let moved = "was trained for `HMMWV";
    refused(&asked(&["--speed", "3.5"]), root.path(), &[moved, "--speed 3.5 is not 0.5 to 3 m/s"]);
    let words = [moved, "no kinematic model fitted for `Clearpath Husky"];
    refused(&asked(&["--configurations", "kinematic"]), root.path(), &words);
    let advice = ["no kinematic model", "use --configurations fixed,adapted"];
    refused(&asked(&["--configurations", "fixed,kinematic,adapted"]), root.path(), &advice);
    refused(&asked(&[]), root.path(), &[moved, "kinematic is left out", "vehicle_husky.json"]);
}
