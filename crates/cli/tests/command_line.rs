//! Goal: what a person meets at the command line. Method: the real binary on the committed sample, or on a copy of it that is damaged on
//! purpose; exit codes and the words of the messages are the contract.
#![allow(clippy::unwrap_used)]

mod common;

use std::path::Path;

use common::{bundle, copy_folder, nesam, refused, repository, said, sample, stderr, stdout, tiny_bundle};
use serde_json::Value;

/// A set of the sample with index rows, and its first drive.
fn some_set() -> (String, Vec<Value>) {
    for set in ["nominal", "ood_soil", "effect_open/payload"] {
        if let Ok(text) = std::fs::read_to_string(sample().join(set).join("index.json")) {
            return (set.into(), serde_json::from_str(&text).unwrap());
        }
    }
    panic!("the committed sample has no set with an index.json");
}

/// A copy of the sample with the index of `set` rewritten by `edit`.
fn edited_root(set: &str, edit: impl Fn(&mut Vec<Value>)) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    copy_folder(&sample(), dir.path());
    let folder = dir.path().join(set);
    let _ = std::fs::remove_file(folder.join("index.parquet"));
    let mut rows: Vec<Value> = serde_json::from_str(&std::fs::read_to_string(folder.join("index.json")).unwrap()).unwrap();
    edit(&mut rows);
    std::fs::write(folder.join("index.json"), serde_json::to_string(&rows).unwrap()).unwrap();
    dir
}

#[test]
fn service_help_teaches_every_command_and_version_is_printed() {
    let here = tempfile::tempdir().unwrap();
    let help = nesam(&["--help"], here.path());
    assert_eq!(help.status.code(), Some(0));
    for word in ["serve", "demo", "calibrate", "train", "evaluate", "predict", "inspect", "check", "Examples:", "Exit codes"] {
        assert!(stdout(&help).contains(word), "help should show `{word}`");
    }
    let version = nesam(&["--version"], here.path());
    assert_eq!(version.status.code(), Some(0));
    assert!(stdout(&version).starts_with(&format!("nesam {}", env!("CARGO_PKG_VERSION"))));
    refused(&[], here.path(), &["no command", "Usage"]);
    refused(&["evaluat"], here.path(), &["unrecognized"]);
}

#[test]
fn chrono_constant_velocity_is_scored_and_written() {
    let here = tempfile::tempdir().unwrap();
    let (set, _) = some_set();
    let root = sample().display().to_string();
    let args = [
        "evaluate",
        "--data",
        &root,
        "--set",
        &set,
        "--models",
        "constant_velocity",
        "--json",
        "e.json",
        "--html",
        "e.html",
        "--predictions",
        "p.parquet",
        "--seed",
        "3",
    ];
    let output = nesam(&args, here.path());
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(stdout(&output).contains("constant_velocity"));
    let first = std::fs::read(here.path().join("e.json")).unwrap();
    let json: Value = serde_json::from_slice(&first).unwrap();
    assert_eq!(json["schema"], "nesam.evaluate/1");
    assert_eq!(json["set"].as_str(), Some(set.as_str()));
    let error = json["models"]["constant_velocity"]["position_m"]["final"].as_f64().unwrap();
    assert!(error > 0.05 && error < 10.0, "3.2 s of constant velocity: {error} m");
    assert!(json["provenance"]["command"].as_str().unwrap().starts_with("nesam evaluate"));
    assert!(!json["provenance"]["data_hash"].as_str().unwrap().is_empty());
    assert!(std::fs::read_to_string(here.path().join("e.html")).unwrap().contains("<svg"));
    assert!(std::fs::metadata(here.path().join("p.parquet")).unwrap().len() > 1000);

    nesam(&args, here.path());
    assert_eq!(first, std::fs::read(here.path().join("e.json")).unwrap(), "the same command gives the same bytes");
}

#[test]
fn chrono_wrong_input_is_refused_with_exit_code_2() {
    let here = tempfile::tempdir().unwrap();
    let (set, rows) = some_set();
    let root = sample().display().to_string();
    let base = ["evaluate", "--data", &root, "--models", "constant_velocity"];
    let with = |more: &[&str], words: &[&str]| refused(&[&base[..], more].concat(), here.path(), words);
    with(&["--set", "no_such_set"], &["no_such_set", &set]);
    with(&["--set", &set, "--trajectories", "x9999"], &["x9999"]);
    with(&["--set", &set, "--inputs", "tracks"], &["--inputs", "commands, wheels"]);
    with(&["--set", &set, "--start", "smooth"], &["--start", "measured, gt"]);
    with(&["--set", &set, "--horizon", "0"], &["--horizon", "at least 1"]);
    with(&["--set", &set, "--horizon", "5000"], &["5000 steps", "longest drive"]);
    with(&["--set", &set, "--dt", "0"], &["--dt"]);
    let nowhere = here.path().to_str().unwrap();
    with(&["--set", &set, "--models", "tal_elev", "--baselines", nowhere], &["tal_elev", "nesam train --model"]);
    with(&["--set", &set, "--baselines", "no/such/folder"], &["--baselines no/such/folder is not a folder"]);
    with(&["--set", &set, "--resamples", "10"], &["--resamples", "1000"]);
    refused(&["evaluate", "--data", "no/such/root"], here.path(), &["no/such/root", "not a folder"]);
    let id = rows[0]["trajectory"].as_str().unwrap();
    let outside = ["predict", "--data", &root, "--set", &set, "--trajectory", id, "--at", "1e6"];
    refused(&outside, here.path(), &["--at", id]);
}

#[test]
fn chrono_a_missing_split_names_the_splits_that_are_there() {
    let (set, _) = some_set();
    let root = edited_root(&set, |rows| rows.iter_mut().for_each(|r| r["split"] = Value::String("test".into())));
    let data = root.path().display().to_string();
    let args = ["evaluate", "--data", &data, "--set", &set, "--split", "train", "--models", "constant_velocity"];
    refused(&args, root.path(), &["train", "test"]);
}

#[test]
fn chrono_a_damaged_file_is_named() {
    let (set, _) = some_set();
    let dir = tempfile::tempdir().unwrap();
    copy_folder(&sample(), dir.path());
    let file = dir.path().join(&set).join("samples.parquet");
    let bytes = std::fs::read(&file).unwrap();
    std::fs::write(&file, &bytes[..bytes.len() / 2]).unwrap();
    let data = dir.path().display().to_string();
    refused(&["evaluate", "--data", &data, "--set", &set, "--models", "constant_velocity"], dir.path(), &["samples.parquet"]);
    let check = nesam(&["check", &data], dir.path());
    assert_eq!(check.status.code(), Some(2));
    assert!(stdout(&check).contains("samples.parquet"), "{}", stdout(&check));
}

/// Goal: true soil that cannot be read is not taken for none. Method: `gt_soil.json` of every world torn in the middle.
#[test]
fn service_true_soil_that_is_damaged_is_named() {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&sample(), root.path());
    for world in std::fs::read_dir(root.path().join("worlds")).unwrap().flatten() {
        let file = world.path().join("gt_soil.json");
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::write(&file, &text[..text.len() / 2]).unwrap();
    }
    let data = root.path().display().to_string();
    refused(&["inside", "--data", &data, "--set", "nominal"], root.path(), &["gt_soil.json", "not valid json"]);
}

#[test]
fn chrono_the_sample_is_sound() {
    let data = sample().display().to_string();
    let check = nesam(&["check", &data], Path::new("."));
    assert_eq!(check.status.code(), Some(0), "{}", stdout(&check));
    let inspect = nesam(&["inspect", &data], Path::new("."));
    assert_eq!(inspect.status.code(), Some(0), "{}", stderr(&inspect));
    assert!(stdout(&inspect).contains("mass_kg"));
}

/// Goal: commands that no service would take are told wherever drives are read. Method: the sample under a card that states a narrower range of steering, then under one that
/// leaves the range of the speed to its kind of drive, which the drives exceed by their unit.
#[test]
fn service_commands_beyond_the_range_of_the_card_are_told() {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&sample(), root.path());
    let card = root.path().join("vehicle_hmmwv.json");
    let text = std::fs::read_to_string(&card).unwrap();
    std::fs::write(&card, text.replacen('{', r#"{"command_range": {"second": [-0.2, 0.2]},"#, 1)).unwrap();
    let data = root.path().display().to_string();
    let scored = nesam(&["evaluate", "--data", &data, "--set", "nominal", "--models", "constant_velocity"], root.path());
    assert!(scored.status.success(), "{}", stderr(&scored));
    for told in ["6 drives command beyond the range that the card states", "drive `n0001`, row", "-0.2 to 0.2", "command_range"] {
        assert!(stderr(&scored).contains(told), "{told}: {}", stderr(&scored));
    }
    let check = nesam(&["check", &data], root.path());
    assert!(
        check.status.success() && stdout(&check).contains("doubt: set nominal: 6 drives command beyond the range"),
        "{}",
        stdout(&check)
    );
    let mut log = String::from("t,x,y,z,roll,pitch,yaw,cmd_speed,cmd_steer\n");
    (0..100).for_each(|i| log += &format!("{:.1},{:.2},0,0.6,0,0,0,13.0,0\n", 0.1 * f64::from(i), 1.3 * f64::from(i)));
    std::fs::write(root.path().join("fast.csv"), log).unwrap();
    let plain = sample().join("vehicle_hmmwv.json").display().to_string();
    assert!(nesam(&["import", "fast.csv", "--to", "mine", "--set", "fast", "--vehicle", &plain], root.path()).status.success());
    let scored = nesam(&["evaluate", "--data", "mine", "--models", "constant_velocity"], root.path());
    assert!(scored.status.success(), "{}", stderr(&scored));
    assert!(
        stderr(&scored).contains("note: set `fast`: 1 drives command beyond a range that the card does not state"),
        "{}",
        stderr(&scored)
    );
    let check = nesam(&["check", "mine"], root.path());
    assert!(check.status.success() && stdout(&check).contains("doubt: set fast: 1 drives command beyond"), "{}", stdout(&check));
}

/// Goal: a root that lost its maps says so, wherever it is read. Method: the sample without `worlds/`, and one row less in an index.
#[test]
fn service_a_root_that_lost_its_maps_says_so() {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&sample(), root.path());
    std::fs::remove_dir_all(root.path().join("worlds")).unwrap();
    let index = root.path().join("nominal/index.json");
    let mut rows: Vec<Value> = serde_json::from_str(&std::fs::read_to_string(&index).unwrap()).unwrap();
    rows.remove(0);
    // The Parquet index would count before this one.
    std::fs::remove_file(root.path().join("nominal/index.parquet")).unwrap();
    std::fs::write(&index, Value::Array(rows).to_string()).unwrap();
    let data = root.path().display().to_string();
    let scored = nesam(&["evaluate", "--data", &data, "--set", "nominal", "--models", "constant_velocity"], root.path());
    assert!(scored.status.success(), "{}", stderr(&scored));
    for told in
        ["note: set `nominal`: the data root has no world `w", "note: set `nominal`: 1 drives are not in the index: no map, no split"]
    {
        assert!(stderr(&scored).contains(told), "{told}: {}", stderr(&scored));
    }
    let check = nesam(&["check", &data], root.path());
    for told in ["doubt: set `nominal`: the data root has no world `w", "doubt: set `nominal`: 1 drives are not in the index"] {
        assert!(check.status.success() && stdout(&check).contains(told), "{told}: {}", stdout(&check));
    }
}

#[test]
fn service_a_root_without_samples_says_what_makes_a_set() {
    let here = tempfile::tempdir().unwrap();
    std::fs::copy(sample().join("vehicle_hmmwv.json"), here.path().join("vehicle_hmmwv.json")).unwrap();
    std::fs::create_dir(here.path().join("first")).unwrap();
    std::fs::write(here.path().join("first/index.json"), "[]").unwrap();
    let check = nesam(&["check", "."], here.path());
    let said = stdout(&check);
    assert!(check.status.code() == Some(2) && said.contains("no folder with samples.parquet") && !said.contains("index"), "{said}");
}

#[test]
fn service_bench_names_the_one_option_that_is_at_fault() {
    let here = tempfile::tempdir().unwrap();
    for (args, words) in [
        (["predict", "--queries", "0"], "--queries must be 1 to 1000000, not 0"),
        (["predict", "--samples", "0"], "--samples must be 1 to 262144, not 0"),
        (["predict", "--horizon", "33"], "--horizon must be 1 to 32, not 33"),
        (["wire", "--horizon", "33"], "--horizon must be 1 to 32, not 33"),
        (["wire", "--samples", "100000"], "--samples must be 1 to"),
        (["wire", "--queries", "0"], "--queries must be 1 to 1000000, not 0"),
        (["consistency", "--border", "30"], "--border must be 0 to 29, not 30"),
    ] {
        refused(&[&["bench"][..], &args].concat(), here.path(), &[words]);
    }
    refused(&["bench", "plant", "--worlds", "w01", "--drives", "1"], here.path(), &["--drives must be at least 2, not 1"]);
    // Whoever does not know the sets learns them, from a wrong name as from the help.
    refused(&["bench", "discovery", "--sets", "null,payload"], here.path(), &["'payload'", "possible values", "actuator", "null_noise"]);
    let help = nesam(&["bench", "discovery", "--help"], here.path());
    assert!(stdout(&help).contains("actuator, sensor, map, outside, force_twin"), "{}", stdout(&help));
}

/// Goal: a drive of 2 s is predicted without options, as far as it goes, and commands of one's own say how many steps there are; what a query of it costs is measured
/// too. Method: the first 20 samples of the log of the book.
#[test]
fn service_predict_takes_what_a_short_drive_allows() {
    let here = tempfile::tempdir().unwrap();
    let log = std::fs::read_to_string(repository().join("docs/example/run.csv")).unwrap();
    let short: Vec<&str> = log.lines().take(21).collect();
    std::fs::write(here.path().join("short.csv"), short.join("\n") + "\n").unwrap();
    let (card, bundle) = (sample().join("vehicle_hmmwv.json").display().to_string(), bundle("hmmwv-nominal"));
    let imported = nesam(&["import", "short.csv", "--to", "root", "--set", "short", "--vehicle", &card], here.path());
    assert_eq!(imported.status.code(), Some(0), "{}", stderr(&imported));
    let base = ["predict", "--data", "root", "--bundle", &bundle];
    let steps = |more: &[&str]| {
        let output = nesam(&[&base[..], more].concat(), here.path());
        assert_eq!(output.status.code(), Some(0), "{more:?}: {}", stderr(&output));
        let json: Value = serde_json::from_str(&stdout(&output)).unwrap();
        (json["steps"].as_array().unwrap().len(), stderr(&output))
    };
    assert_eq!(steps(&[]).0, 19);
    assert_eq!(steps(&["--horizon", "5"]).0, 5);
    let told = |rows: usize| std::fs::write(here.path().join("c.csv"), format!("speed_m_s,second\n{}", "2,0.1\n".repeat(rows))).unwrap();
    told(7);
    let (count, said) = steps(&["--controls", "c.csv"]);
    assert!(count == 7 && !said.contains("note:"), "{count}: {said}");
    let (count, said) = steps(&["--controls", "c.csv", "--horizon", "3"]);
    assert!(count == 3 && said.contains("note: the first 3 of 7 commands"), "{count}: {said}");
    told(33);
    refused(&[&base[..], &["--controls", "c.csv"]].concat(), here.path(), &["33 steps exceed the model's 32"]);
    let bench = ["bench", "predict", "--data", "root", "--bundle", &bundle, "--samples", "2", "--horizon", "4", "--queries", "3"];
    let output = nesam(&[&bench[..], &["--json", "bench.json"]].concat(), here.path());
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(
        stderr(&output).contains("note: no drive has 40 samples: queries start with less than 32 steps of history"),
        "{}",
        stderr(&output)
    );
    let json: Value = serde_json::from_str(&std::fs::read_to_string(here.path().join("bench.json")).unwrap()).unwrap();
    assert!(json["p50_ms"].as_f64().is_some_and(|ms| ms > 0.0), "{json}");
}

#[test]
fn chrono_a_card_that_says_otherwise_than_the_bundle_is_told() {
    let root = tempfile::tempdir().unwrap();
    copy_folder(&sample(), root.path());
    let bundle = bundle("hmmwv-nominal");
    let said = || {
        let output = nesam(&["predict", "--data", ".", "--set", "nominal", "--bundle", &bundle, "--horizon", "2"], root.path());
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        stderr(&output)
    };
    assert!(!said().contains("note:"), "{}", said());
    let card = root.path().join("vehicle_hmmwv.json");
    let heavier = std::fs::read_to_string(&card).unwrap().replace("\"mass_total\": 2493.56", "\"mass_total\": 2992.27");
    std::fs::write(&card, heavier).unwrap();
    assert!(said().contains("has another mass than the card of bundle hmmwv-nominal, which counts"), "{}", said());
}

#[test]
fn service_a_missing_or_foreign_bundle_is_refused() {
    let here = tempfile::tempdir().unwrap();
    let (set, _) = some_set();
    let root = sample().display().to_string();
    let folder = here.path().display().to_string();
    refused(
        &["evaluate", "--data", &root, "--set", &set, "--bundle", "no/such/bundle"],
        here.path(),
        &["no/such/bundle", "does not exist"],
    );
    refused(&["evaluate", "--data", &root, "--set", &set, "--bundle", &folder], here.path(), &["not a bundle", "manifest.toml"]);
    std::fs::write(here.path().join("manifest.toml"), "format = \"something else\"\n").unwrap();
    refused(&["inspect", &folder], here.path(), &["manifest.toml"]);
    let out = format!("{folder}/results");
    let inside = ["evaluate", "--data", &root, "--set", &set, "--models", "constant_velocity", "--out", &out];
    refused(&inside, here.path(), &["lies in a bundle"]);
}

/// Goal: a run that starts from a bundle goes on with its vehicle and scales, and says whose child it is. Method: two steps from the bundle of two steps.
#[test]
fn chrono_a_run_starts_from_a_bundle_and_from_none_of_another_form() {
    let here = tempfile::tempdir().unwrap();
    let root = sample().display().to_string();
    copy_folder(tiny_bundle(), &here.path().join("start"));
    let tiny = ["--epochs", "1", "--batches", "2", "--batch-size", "4", "--from", "start", "--out", "made"];
    let run = |more: &[&'static str]| [&["train", "--data", root.as_str(), "--set", "nominal"], &tiny[..], more].concat();
    let trained = nesam(&run(&["--sustained=0.2", "--soil-prior=0.05"]), here.path());
    assert_eq!(trained.status.code(), Some(0), "{}", stderr(&trained));
    let text = |bundle: &str, file: &str| std::fs::read_to_string(here.path().join(bundle).join(file)).unwrap();
    // What stands in for unseen ground is what the new weights make of the drives.
    let scales = |bundle: &str| text(bundle, "normalization.toml").split_once("[stand_in]").unwrap().0.to_string();
    assert_eq!(scales("made/bundle"), scales("start"));
    // What was calibrated, to the last bit but one that reading decimals may cost.
    let limit = |bundle: &str| {
        serde_json::from_str::<Value>(&text(bundle, "vehicle.json")).unwrap()["driveline"]["overspeed_limit_m_s"].as_f64().unwrap()
    };
    assert!((limit("made/bundle") / limit("start") - 1.0).abs() < 1e-14);
    let manifest = text("made/bundle", "manifest.toml");
    assert!(manifest.contains("nesam train --data … --set nominal --epochs 1") && manifest.contains("--from … --out …"), "{manifest}");
    // The same again, elsewhere and in two goes, is the same bundle to the byte.
    let elsewhere = tempfile::tempdir().unwrap();
    copy_folder(tiny_bundle(), &elsewhere.path().join("start"));
    for more in [&["--sustained=0.2", "--soil-prior=0.05"][..], &["--sustained=0.2", "--soil-prior=0.05", "--resume"]] {
        let again = nesam(&run(more), elsewhere.path());
        assert_eq!(again.status.code(), Some(0), "{}", stderr(&again));
        assert_eq!(std::fs::read_to_string(elsewhere.path().join("made/bundle/manifest.toml")).unwrap(), manifest);
    }
    let inspected = nesam(&["inspect", "start"], here.path());
    let parent = manifest.lines().find_map(|line| line.strip_prefix("parent = \"")).unwrap();
    assert!(stdout(&inspected).contains(&parent[..12]), "{parent} is not in {}", stdout(&inspected));
    let weights = |bundle: &str| std::fs::read(here.path().join(bundle).join("weights.safetensors")).unwrap();
    assert_ne!(weights("made/bundle"), weights("start"));
    refused(&run(&["--model", "transformer"]), here.path(), &["--from start", "not a transformer"]);
    refused(&run(&["--sustained=-1"]), here.path(), &["--sustained"]);
    refused(&run(&["--soil-prior=nan"]), here.path(), &["--soil-prior"]);
    refused(&run(&["--device", "gpu"]), here.path(), &["`gpu` is no device", "cuda:1"]);
    refused(&run(&["--device", "cuda"]), here.path(), &["device cuda:0", "--features nesam/cuda"]);
    refused(&run(&["--dt", "0.2"]), here.path(), &["--from start", "0.1 s", "0.2 s"]);
    let root = tempfile::tempdir().unwrap();
    copy_folder(&sample(), root.path());
    let card = root.path().join("vehicle_hmmwv.json");
    std::fs::write(&card, std::fs::read_to_string(&card).unwrap().replace("HMMWV (", "Another (")).unwrap();
    let elsewhere = root.path().display().to_string();
    let other = ["train", "--data", &elsewhere, "--set", "nominal", "--from", "start"];
    refused(&other, here.path(), &["--from", "HMMWV", "Another"]);
    refused(&["train", "--model", "transformer", "--sustained=0.2"], here.path(), &["--sustained", "transformer"]);
    refused(&["train", "--model", "transformer", "--soil-prior=0.2"], here.path(), &["--soil-prior", "transformer"]);
    for horizon in ["0", "34"] {
        refused(&["train", "--horizon", horizon], here.path(), &[&format!("--horizon must be 1 to 32, not {horizon}")]);
    }
}

/// Goal: train → inspect → predict → evaluate hold together, and a damaged bundle is refused by name. Method: a bundle of two training
/// steps (its errors mean nothing), then one flipped byte.
#[test]
fn chrono_a_bundle_made_in_seconds_predicts_and_a_damaged_one_is_refused() {
    let here = tempfile::tempdir().unwrap();
    let root = sample().display().to_string();
    copy_folder(tiny_bundle(), &here.path().join("bundle"));
    let bundle = "bundle";
    assert_eq!(nesam(&["check", bundle], here.path()).status.code(), Some(0));

    let start = ["--data", &root, "--set", "nominal", "--bundle", bundle];
    let predicted = nesam(&[&["predict"], &start[..], &["--horizon", "5", "--out", "p.json"]].concat(), here.path());
    assert_eq!(predicted.status.code(), Some(0), "{}", stderr(&predicted));
    let json: Value = serde_json::from_slice(&std::fs::read(here.path().join("p.json")).unwrap()).unwrap();
    assert_eq!(json["steps"].as_array().unwrap().len(), 5);
    assert_eq!(json["provenance"]["bundle_hash"].as_str().unwrap().len(), 64);
    let id = json["trajectory"].as_str().unwrap();
    let scored = nesam(&[&["evaluate"], &start[..], &["--trajectories", id, "--json", "e.json"]].concat(), here.path());
    assert_eq!(scored.status.code(), Some(0), "{}", stderr(&scored));
    let json: Value = serde_json::from_slice(&std::fs::read(here.path().join("e.json")).unwrap()).unwrap();
    for name in ["nesam", "nesam_no_residual", "nesam_zero_sinkage", "kinematic", "constant_velocity"] {
        assert!(json["models"][name]["mae_mean"]["z_m"].is_number(), "{name}");
        assert!(json["models"][name]["ci95"]["mae_mean"]["z_m"].is_null(), "one drive has no interval");
    }

    refused(&[&["predict"], &start[..], &["--horizon", "33"]].concat(), here.path(), &["33", "32"]);
    refused(&[&["evaluate"], &start[..], &["--horizon", "33"]].concat(), here.path(), &["33", "32"]);
    refused(&[&["evaluate"], &start[..], &["--dt", "0.05"]].concat(), here.path(), &["--dt 0.05"]);
    std::fs::write(here.path().join("c.csv"), "speed_m_s,second\n2,0.1\n2,NaN\n").unwrap();
    refused(&[&["predict"], &start[..], &["--controls", "c.csv"]].concat(), here.path(), &["c.csv", "line 3"]);

    let weights = here.path().join(bundle).join("weights.safetensors");
    let mut bytes = std::fs::read(&weights).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&weights, bytes).unwrap();
    refused(&[&["predict"], &start[..]].concat(), here.path(), &["weights.safetensors", "SHA-256"]);
    let check = nesam(&["check", bundle], here.path());
    assert!(check.status.code() == Some(2) && stdout(&check).contains("weights.safetensors"), "{}", stdout(&check));
}

/// Goal: a bundle of another step predicts drives in its own step and in no other. Method: the bundle of two training steps, told that it steps by 0.05 s.
#[test]
fn chrono_a_bundle_of_another_step_reads_drives_in_its_own() {
    let here = tempfile::tempdir().unwrap();
    let root = sample().display().to_string();
    let mut bundle = nesam_model::ModelBundle::load(tiny_bundle()).unwrap();
    bundle.normalization.dt_s = 0.05;
    bundle.save(&here.path().join("finer")).unwrap();
    let start = ["predict", "--data", &root, "--set", "nominal", "--bundle", "finer", "--horizon", "5", "--out", "p.json"];
    refused(&start, here.path(), &["steps of 0.05 s", "--dt 0.1"]);
    let scored = ["evaluate", "--data", &root, "--set", "nominal", "--bundle", "finer", "--horizon", "5"];
    refused(&scored, here.path(), &["steps of 0.05 s", "--dt 0.1"]);
    let predicted = nesam(&[&start[..], &["--dt", "0.05"]].concat(), here.path());
    assert_eq!(predicted.status.code(), Some(0), "{}", stderr(&predicted));
}

/// Goal: a card can be checked before there is any log. Method: the card of the sample as it is, in tonnes, and without its wheels.
#[test]
fn service_a_vehicle_card_is_checked_by_itself() {
    let sample = std::fs::read_to_string(repository().join("tests/data/chrono_sample/vehicle_hmmwv.json")).unwrap();
    let here = tempfile::tempdir().unwrap();
    let check = |text: &str| {
        std::fs::write(here.path().join("card.json"), text).unwrap();
        let output = nesam(&["check", "card.json"], here.path());
        (output.status.code(), said(&output))
    };
    let (code, sound) = check(&sample);
    assert!(code == Some(0) && sound.contains("(vehicle card)") && sound.contains("sound"), "{sound}");
    let card: Value = serde_json::from_str(&sample).unwrap();
    let mut tonnes = card.clone();
    tonnes["mass_total"] = (card["mass_total"].as_f64().unwrap() / 1000.0).into();
    let (code, doubted) = check(&tonnes.to_string());
    assert!(code == Some(0) && doubted.contains("doubt: card of") && doubted.contains("kg"), "{doubted}");
    let (code, refused) = check("{}");
    assert!(code == Some(2) && refused.contains("missing"), "{refused}");
}
