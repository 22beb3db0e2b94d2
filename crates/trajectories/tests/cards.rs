//! Vehicle cards: the given ones, and what is refused.
#![allow(clippy::unwrap_used)]

mod common;

use std::path::Path;

use common::{SKID_CARD, sample_root, shared};
use nesam_physics::{Control, SecondCommand, Vehicle};
use nesam_trajectories::{DataRoot, TrajectoryError, card_from_json, card_to_json, read_vehicle_card};
use serde_json::{Value, json};

fn read(card: &str) -> Result<Vehicle, TrajectoryError> {
    let dir = tempfile::TempDir::new().unwrap();
    let path = dir.path().join("vehicle_test.json");
    std::fs::write(&path, card).unwrap();
    read_vehicle_card(&path)
}

fn hmmwv_path() -> std::path::PathBuf {
    sample_root().join("vehicle_hmmwv.json")
}

fn hmmwv_json() -> Value {
    serde_json::from_str(&std::fs::read_to_string(hmmwv_path()).unwrap()).unwrap()
}

#[test]
fn published_hmmwv_card() {
    let v = read_vehicle_card(&hmmwv_path()).unwrap();
    assert_eq!((v.mass_kg, v.wheel_radius_m, v.wheel_width_m, v.gravity_m_s2), (2493.56, 0.467, 0.254, 9.81));
    assert_eq!(v.inertia_kg_m2[0], [1445.1, 0.0, -23.6]);
    assert!(!v.inertia_estimated);
    assert_eq!(v.wheel_centre_m[2], [-1.7028, 0.91, -0.1818]);
    assert_eq!(v.second, SecondCommand::SteeringNormalised);
    assert_eq!(v.command_range, [[-2.0, 12.0], [-1.0, 1.0]]);
    assert!(v.admits(&Control { speed_m_s: 3.0, second: 1.0 }) && !v.admits(&Control { speed_m_s: 3.0, second: 1.1 }));
    let table = v.steering.as_ref().unwrap();
    assert_eq!((table.command.len(), table.front_left_rad[8], table.front_right_rad[0]), (9, 0.3636, -0.3637));
    // The card: the wheel rate is roughly 0.6 of the spring rate at the shock; motion ratio 0.8 squared for the damper.
    assert!((v.suspension_n_m[0] - 0.6 * 167071.0).abs() < 1e-6 && (v.suspension_n_s_m[3] - 0.64 * 35025.0).abs() < 1e-6);
    assert_eq!((v.driveline.steering_lag_s, v.driveline.steering_rate_limit_per_s), (0.08, 3.0));
    assert!((v.wheelbase_m - 3.2977).abs() < 1e-9 && (v.track_m - 1.8276).abs() < 1e-9);
    assert_eq!(card_from_json(&card_to_json(&v)).unwrap(), v, "bundling keeps every bit");
}

#[test]
fn property_both_precisions_reach_the_ends_of_the_range() {
    // 0.1 in f32 lies above 0.1 in f64: the service admits it, and so does every command.
    let single = f64::from(0.1f32);
    let v = Vehicle { command_range: [[-0.1, 0.1]; 2], ..read_vehicle_card(&hmmwv_path()).unwrap() };
    assert!(v.admits(&Control { speed_m_s: single, second: -single }) && v.admits(&Control { speed_m_s: 0.1, second: -0.1 }));
    assert!(!v.admits(&Control { speed_m_s: 0.1001, second: 0.0 }) && !v.admits(&Control { speed_m_s: f64::NAN, second: 0.0 }));
}

#[test]
fn published_husky_card() {
    let Some(path) = shared("real/husky/vehicle_husky.json") else { return };
    let v = read_vehicle_card(&path).unwrap();
    assert_eq!((v.mass_kg, v.wheel_radius_m, v.track_m, v.wheelbase_m), (50.0, 0.165, 0.55, 0.512));
    assert_eq!(v.second, SecondCommand::YawRateRadS);
    assert!(v.inertia_estimated && v.steering.is_none());
    assert_eq!(v.wheel_centre_m[1][1], -0.555 / 2.0);
    assert_eq!(card_from_json(&card_to_json(&v)).unwrap(), v, "bundling keeps every bit");
}

#[test]
fn analytic_estimates_of_a_bare_card() {
    let v = read(SKID_CARD).unwrap();
    // A box of 0.82 x 0.6 x 0.384 m and 40 kg.
    let box_zz = 40.0 * (0.82f64.powi(2) + 0.6f64.powi(2)) / 12.0;
    assert!(v.inertia_estimated && (v.inertia_kg_m2[2][2] - box_zz).abs() < 1e-9, "{:?}", v.inertia_kg_m2);
    // Stiff: the weight sinks the body by 10 mm, damping ratio 0.7.
    assert!((v.suspension_n_m.iter().sum::<f64>() * 0.01 - 40.0 * 9.81).abs() < 1e-6);
    let ratio = v.suspension_n_s_m[0] / (2.0 * (v.suspension_n_m[0] * 10.0).sqrt());
    assert!((ratio - 0.7).abs() < 1e-9);
    assert_eq!(v.wheel_centre_m[3], [-0.25, -0.25, -0.04]);
    assert_eq!((v.driveline.speed_gain, v.track_m), (1.0, 0.55));
    assert_eq!(v.command_range[0], [-3.0, 3.0]);
    let limited = read(&SKID_CARD.replace("\"max_wheel_speed_rad_s\": null", "\"max_wheel_speed_rad_s\": 10")).unwrap();
    assert_eq!((limited.command_range[0], limited.driveline.rims.rim_limit_m_s), ([-1.6, 1.6], 1.6));
    assert_eq!(card_from_json(&card_to_json(&v)).unwrap(), v);
    assert_eq!(read(&card_to_json(&v)).unwrap(), v, "a card in the schema of bundles is accepted");
    assert!(!card_to_json(&v).contains("dead_time_s"), "commands that arrive at once are not mentioned");
    let mut late = v;
    late.driveline.rims.dead_time_s = [0.25, 0.375];
    assert_eq!(card_from_json(&card_to_json(&late)).unwrap(), late);
    let refused = card_from_json(&card_to_json(&late).replace("0.375", "0.875")).unwrap_err().to_string();
    assert!(refused.contains("driveline.rims.dead_time_s") && refused.contains("0.875"), "{refused}");
}

#[test]
fn analytic_what_a_card_leaves_out_is_estimated_and_said() {
    // Goal: name, wheel width and wheelbase may be missing. Method: the bare card without each of them; the estimates of the rules, and one note each.
    let opened = |key: &str, drive: &str| {
        let mut card: Value = serde_json::from_str(SKID_CARD).unwrap();
        card.as_object_mut().unwrap().remove(key);
        card["drive"] = json!(drive);
        let root = tempfile::TempDir::new().unwrap();
        std::fs::write(root.path().join("vehicle_test.json"), card.to_string()).unwrap();
        let opened = DataRoot::open(root.path(), None).unwrap();
        (opened.vehicle().clone(), opened.notes())
    };
    let (skid, car) = ("skid_steer", "ackermann, all-wheel drive");
    let cases: [(&str, &str, fn(&Vehicle) -> f64, f64); 3] = [
        ("wheel_width_m", skid, |v| v.wheel_width_m, 0.6 * 0.16),
        ("wheelbase_m", skid, |v| v.wheelbase_m, 0.5),
        ("wheelbase_m", car, |v| v.wheelbase_m, 0.9),
    ];
    for (key, drive, found, expected) in cases {
        let (vehicle, notes) = opened(key, drive);
        assert!((found(&vehicle) - expected).abs() < 1e-9, "{key} {drive}: {vehicle:?}");
        assert!(notes.len() == 1 && notes[0].contains(&format!("no `{key}`")), "{notes:?}");
    }
    let (vehicle, notes) = opened("vehicle", skid);
    assert!(vehicle.name == "test" && notes.len() == 1 && notes[0].contains("called `test`"), "{notes:?}");
    assert_eq!(opened("note", skid).1, Vec::<String>::new(), "nothing that counts is missing");
}

#[test]
fn regress_kinds_of_drives_are_known_by_their_words() {
    for (drive, second) in [
        ("tracked", SecondCommand::YawRateRadS),
        ("differential_drive", SecondCommand::YawRateRadS),
        ("Skid steering", SecondCommand::YawRateRadS),
        ("ackermann", SecondCommand::RoadWheelAngleRad),
        ("car-like", SecondCommand::RoadWheelAngleRad),
    ] {
        assert_eq!(read(&SKID_CARD.replace("skid_steer", drive)).unwrap().second, second, "{drive}");
    }
    for drive in ["hover", "cargo carrier", "car with a differential"] {
        let error = read(&SKID_CARD.replace("skid_steer", drive)).unwrap_err().to_string();
        assert!(error.contains("`drive`") && error.contains(drive) && error.contains("ackermann"), "{error}");
    }
}

#[test]
fn regress_missing_and_bad_keys_are_named() {
    for (pointer, key) in [
        ("/mass_total", "`mass_total`"),
        ("/tyre/radius", "`tyre.radius`"),
        ("/suspension/rear/spring_N_per_m", "`suspension.rear.spring_N_per_m`"),
        ("/steering/command_to_road_wheel_table", "`second`"),
    ] {
        let mut card = hmmwv_json();
        let (parent, name) = pointer.rsplit_once('/').unwrap();
        card.pointer_mut(parent).unwrap().as_object_mut().unwrap().remove(name);
        let error = read(&card.to_string()).unwrap_err().to_string();
        assert!(error.contains("vehicle_test.json") && error.contains(key), "{pointer}: {error}");
    }
    for (pointer, value, key) in [
        ("/mass_total", json!(-1), "`mass_total`"),
        ("/mass_total", json!("heavy"), "`mass_total`"),
        ("/inertia_about_cg/matrix", json!([[1, 0, 0], [0, 1, 0]]), "`inertia_about_cg.matrix`"),
        ("/inertia_about_cg/matrix", json!([[1, 0, 0], [0, -1, 0], [0, 0, 1]]), "`inertia_about_cg.matrix`"),
        ("/inertia_about_cg/matrix", json!([[1, 5, 0], [0, 1, 0], [0, 0, 1]]), "`inertia_about_cg.matrix`"),
        ("/wheel_centres_rel_P_static/0/0", json!(-3.0), "`wheel_centres_rel_P_static`"),
        ("/wheel_centres_rel_P_static/0", json!([1, 2]), "`wheel_centres_rel_P_static`"),
        ("/steering/command_to_road_wheel_table/3/cmd", json!(-2.0), "`steering.command_to_road_wheel_table`"),
        ("/steering/command_to_road_wheel_table/3/fl_rad", json!(null), "`steering.command_to_road_wheel_table[3].fl_rad`"),
        ("/steering/actuator/time_constant_s", json!(-0.1), "`steering.actuator.time_constant_s`"),
        ("/gravity", json!(0), "`gravity`"),
        ("/second", json!("curvature"), "`second`"),
    ] {
        let mut card = hmmwv_json();
        match card.pointer_mut(pointer) {
            Some(place) => *place = value,
            None => card[pointer.trim_start_matches('/')] = value,
        }
        let error = read(&card.to_string()).unwrap_err().to_string();
        assert!(error.contains(key), "{pointer}: {error}");
    }
    let error = read(&SKID_CARD.replace("skid_steer", "hover")).unwrap_err().to_string();
    assert!(error.contains("`drive`") && error.contains("hover"), "{error}");
    assert!(read("{\"vehicle\": ").unwrap_err().to_string().contains("not valid json"));
    assert!(read("[]").is_err() && read("").is_err());
    assert!(matches!(read_vehicle_card(Path::new("no/such/card.json")), Err(TrajectoryError::Read { .. })));
    let bundled = card_to_json(&read(SKID_CARD).unwrap()).replace("\"mass_kg\"", "\"mass\"");
    assert!(matches!(read(&bundled), Err(TrajectoryError::Card { .. })));
}

#[test]
fn analytic_a_card_may_say_that_soil_is_damped() {
    let plain = read(SKID_CARD).unwrap();
    assert!(!card_to_json(&plain).contains("soil_damping"), "cards of soil without damping know nothing of it");
    let damped = Vehicle { soil_damping_pa_s_m: 2e4, ..plain };
    let text = card_to_json(&damped);
    assert_eq!(card_from_json(&text).unwrap(), damped);
    let error = card_from_json(&text.replace("20000.0", "-1.0")).unwrap_err().to_string();
    assert!(error.contains("`soil_damping_pa_s_m` is -1, must not be negative"), "{error}");
}

/// Goal: a range of road-wheel angles ascends. Method: a card commanded by the angle, with each form of the largest one.
#[test]
fn regress_a_largest_road_wheel_angle_is_positive_and_a_number() {
    let with = |angle: Value| {
        let mut card = hmmwv_json();
        card["second"] = json!("road_wheel_angle_rad");
        card["steering"]["max_road_wheel_angle_rad"] = angle;
        read(&card.to_string())
    };
    for (angle, largest) in [(json!(0.5), 0.5), (json!([0.36, 0.38]), 0.38), (json!([0.4]), 0.4), (json!(null), 0.7)] {
        assert_eq!(with(angle.clone()).unwrap().command_range[1], [-largest, largest], "{angle}");
    }
    let key = "steering.max_road_wheel_angle_rad";
    for (angle, at, word) in [
        (json!(-0.5), "", "-0.5 is not positive"),
        (json!(0), "", "0 is not positive"),
        (json!("wide"), "", "finite number"),
        (json!([]), "", "found none"),
        (json!([0.36, "wide"]), "[1]", "finite number"),
        (json!([null, 0.36]), "[0]", "finite number"),
        (json!([0.36, -0.36]), "[1]", "-0.36 is not positive"),
    ] {
        let error = with(angle.clone()).unwrap_err().to_string();
        assert!(error.contains(&format!("`{key}{at}`")) && error.contains(word), "{angle}: {error}");
    }
}

#[test]
fn analytic_stated_ranges_win() {
    let mut card = hmmwv_json();
    card["command_range"] = json!({"speed_m_s": [-1.0, 5.0], "second": [-0.9, 0.9]});
    card["driveline"]["speed_gain"] = json!(0.3);
    let v = read(&card.to_string()).unwrap();
    assert_eq!((v.command_range, v.driveline.speed_gain), ([[-1.0, 5.0], [-0.9, 0.9]], 0.3));
    card["command_range"]["second"] = json!([0.9, -0.9]);
    assert!(read(&card.to_string()).unwrap_err().to_string().contains("`command_range.second`"));
}

/// Goal: a range that is stated counts or is refused. Method: other shapes and other names of the keys; one range alone, and none.
#[test]
fn regress_a_range_of_commands_in_another_shape_is_refused() {
    let with = |range: Value| {
        let mut card = hmmwv_json();
        card["command_range"] = range;
        read(&card.to_string())
    };
    for (range, key) in [
        (json!([[-1.0, 5.0], [-0.9, 0.9]]), "`command_range`"),
        (json!(5.0), "`command_range`"),
        (json!({"speed": [-1.0, 5.0]}), "`command_range.speed`"),
        (json!({"speed_m_s": [-1.0, 5.0], "steering": [-0.9, 0.9]}), "`command_range.steering`"),
    ] {
        let error = with(range.clone()).unwrap_err().to_string();
        assert!(error.contains(key) && error.contains(r#"{"speed_m_s": [min, max], "second": [min, max]}"#), "{range}: {error}");
    }
    for (range, expected) in
        [(json!({"speed_m_s": [-1.0, 5.0]}), [-1.0, 5.0]), (json!({"second": null}), [-2.0, 12.0]), (json!(null), [-2.0, 12.0])]
    {
        assert_eq!(with(range.clone()).unwrap().command_range[0], expected, "{range}");
    }
}

/// Goal: what no vehicle is, is refused by its key, in the schema of bundles and in a data sheet by the same rules; the given cards are none of it. Method: the bundle's card
/// of the car and of the robot with one number spoilt each; some of them panicked or went the other way.
#[test]
fn regress_cards_of_vehicles_that_cannot_be_are_refused() {
    let card = |vehicle: &Vehicle| serde_json::from_str::<Value>(&card_to_json(vehicle)).unwrap();
    let (mut car, mut robot) = (read_vehicle_card(&hmmwv_path()).unwrap(), read(SKID_CARD).unwrap());
    car.driveline.rims.yaw_lag_s = 0.0625; // not the default, so that the card holds it
    robot.driveline.rims.acceleration_limit = [2.0; 2];
    let centres = car.wheel_centre_m;
    let swapped = json!([centres[1], centres[0], centres[3], centres[2]]);
    let ahead = json!([[-0.2, 0.9, -0.1], [-0.2, -0.9, -0.1], [-3.5, 0.9, -0.1], [-3.5, -0.9, -0.1]]);
    for (vehicle, pointer, value) in [
        (&car, "/driveline/speed_integral_limit_m", json!(-1.0)),
        (&car, "/driveline/steering_rate_limit_per_s", json!(-1.0)),
        (&car, "/driveline/steering_lag_s", json!(-1.0)),
        (&car, "/driveline/speed_gain", json!(-0.1)),
        (&car, "/driveline/speed_integral_gain_per_s", json!(-0.1)),
        (&car, "/suspension_n_m", json!([0.0, 1e5, 1e5, 1e5])),
        (&car, "/suspension_n_m", json!([-1e5, -1e5, -1e5, -1e5])),
        (&car, "/suspension_n_s_m", json!([-1e5, -1e5, -1e5, -1e5])),
        (&car, "/inertia_kg_m2", json!([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])),
        (&car, "/inertia_kg_m2", json!([[-100.0, 0.0, 0.0], [0.0, -100.0, 0.0], [0.0, 0.0, -100.0]])),
        (&car, "/wheel_centre_m", swapped),
        (&car, "/wheel_centre_m", ahead.clone()),
        (&car, "/speed_range_m_s", json!([12.0, -2.0])),
        (&car, "/second_range", json!([0.0, 0.0])),
        (&car, "/steering", Value::Null),
        (&robot, "/driveline/rims/yaw_lag_s", json!(-1.0)),
        (&robot, "/driveline/rims/turn_efficiency", json!(0.0)),
        (&robot, "/driveline/rims/speed_gain", json!(0.0)),
        (&robot, "/driveline/rims/yaw_limit_rad_s", json!(-1.0)),
        (&robot, "/driveline/rims/acceleration_limit", json!([-1.0, -1.0])),
    ] {
        let mut spoilt = card(vehicle);
        card_from_json(&spoilt.to_string()).unwrap();
        *spoilt.pointer_mut(pointer).unwrap() = value.clone();
        let error = card_from_json(&spoilt.to_string()).unwrap_err().to_string();
        assert!(error.contains(&format!("`{}", pointer[1..].replace('/', "."))), "{pointer} {value}: {error}");
    }
    // The other dialect, by the same rules.
    let mut sheet = hmmwv_json();
    sheet["wheel_centres_rel_P_static"] = ahead;
    let error = read(&sheet.to_string()).unwrap_err().to_string();
    assert!(error.contains("`wheel_centre_m`"), "{error}");
    let mut sheet = hmmwv_json();
    sheet["driveline"]["steering_rate_limit_per_s"] = json!(0.0);
    sheet["steering"]["actuator"].as_object_mut().unwrap().remove("rate_limit_per_s");
    let error = read(&sheet.to_string()).unwrap_err().to_string();
    assert!(error.contains("`driveline.steering_rate_limit_per_s`"), "{error}");
    let bundles = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles");
    for name in ["hmmwv-nominal", "clearpath-husky"] {
        card_from_json(&std::fs::read_to_string(bundles.join(name).join("vehicle.json")).unwrap()).unwrap();
    }
}

/// Goal: that both axles are taken for driven is said of a car whose card does not say it. Method: the words of cards.
#[test]
fn regress_driven_axles_that_a_card_does_not_state_are_said() {
    let notes = |drive: &str| {
        let root = tempfile::TempDir::new().unwrap();
        std::fs::write(root.path().join("vehicle_test.json"), SKID_CARD.replace("skid_steer", drive)).unwrap();
        DataRoot::open(root.path(), None).unwrap().notes()
    };
    for drive in ["ackermann", "car, rear wheel drive", "car, front-wheel drive"] {
        let said = notes(drive);
        assert!(said.len() == 1 && said[0].contains("which axles are driven: taken for both"), "{drive}: {said:?}");
    }
    for drive in ["skid_steer", "tracked", "car, all wheel drive", "car, 4x4", "car (AWD)"] {
        assert_eq!(notes(drive), Vec::<String>::new(), "{drive}");
    }
    assert_eq!(DataRoot::open(&sample_root(), None).unwrap().notes(), Vec::<String>::new());
}
