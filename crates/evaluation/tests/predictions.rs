//! Goal: the errors in the JSON are those that anybody computes from the predictions file. Method: a synthetic drive on a circle with a
//! slow change of speed, predicted by constant velocity; the Parquet file is read back with another reader and the mean errors are
//! recomputed from it and from the drive alone.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use nesam_evaluation::{
    Evaluation, Inputs, ModelName, ModelScore, PATH_FLOOR_M, Provenance, Resamples, Truth, WindowPredictor, all_windows, path_median_m,
    predict_all, report, score, slices, write_predictions,
};
use nesam_model::{ModelBundle, Predictor, Variant};
use nesam_physics::{Control, VehicleState};
use nesam_trajectories::{GroundTruth, MeasuredChannels, Trajectory};
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::RowAccessor;

fn drive(id: &str, samples: usize, radius_m: f64) -> Trajectory {
    let mut yaw = 3.0_f64;
    let (mut x, mut y) = (1.0, -2.0);
    let states = (0..samples)
        .map(|i| {
            let speed = 2.0 + (0.05 * i as f64).sin();
            let mut s = VehicleState::zero();
            s.position_m = [x, y, 0.01 * i as f64];
            s.attitude_rad[2] = nesam_physics::wrap_angle(yaw);
            s.velocity_m_s[0] = speed;
            s.angular_velocity_rad_s[2] = speed / radius_m;
            x += 0.1 * speed * yaw.cos();
            y += 0.1 * speed * yaw.sin();
            yaw += 0.1 * speed / radius_m;
            s
        })
        .collect();
    Trajectory {
        id: id.into(),
        set: "synthetic".into(),
        world: None,
        split: None,
        dt_s: 0.1,
        time_s: (0..samples).map(|i| 0.1 * i as f64).collect(),
        states,
        controls: vec![Control { speed_m_s: 2.0, second: 0.0 }; samples],
        wheel_speed_rad_s: None,
        road_wheel_angle_rad: None,
        measured: MeasuredChannels::POSE_AND_TWIST,
        truth: None,
    }
}

#[test]
fn analytic_errors_recomputed_from_the_predictions_file_are_those_of_the_json() {
    let drives = [drive("a", 120, 9.0), drive("b", 90, -15.0), drive("c", 100, 30.0)];
    let windows = all_windows(&drives, 32, 32, Truth::Measured).unwrap();
    assert_eq!(windows.len(), 7 + 4 + 5);
    let models = [(ModelName::ConstantVelocity, WindowPredictor::ConstantVelocity)];
    let paths = predict_all(&models, &windows, &[None, None, None], &|_| {}).unwrap();
    let resamples = Resamples::draw(3, 1000, 5);
    let scores = vec![score(&paths[0], &windows, Truth::Measured, &resamples)];
    let evaluation = Evaluation {
        set: "synthetic",
        split: "all",
        horizon_steps: 32,
        history_steps: 32,
        dt_s: 0.1,
        windows: windows.len(),
        trajectories: drives.len(),
        path_m_median: path_median_m(&windows, Truth::Measured),
        truth: Truth::Measured,
        inputs: "commands",
        seed: 5,
        resamples: &resamples,
        models: &scores,
        slices: &slices(&windows, &[None, None, None], 0.4, &Default::default()),
        provenance: &Provenance::default(),
    };
    let json: serde_json::Value = serde_json::from_str(&evaluation.to_json()).unwrap();
    assert_eq!(json["schema"], "nesam.evaluate/1");
    assert_eq!((&json["path_floor_m"], &json["windows_below_path_floor"]), (&PATH_FLOOR_M.into(), &0.into()));
    for key in ["set", "split", "horizon_steps", "dt_s", "windows", "path_m_median", "models"] {
        assert!(!json[key].is_null(), "key `{key}` of the contract");
    }
    let model = &json["models"]["constant_velocity"];
    assert_eq!(model["parameters"], 0);
    assert_eq!(model["windows"], 16);
    // Whoever reads a model by its name finds it, scored or not.
    for name in ModelName::ALL.into_iter().filter(|name| !name.is_switch()) {
        let there = json["models"].get(name.as_str());
        assert_eq!(there.map(|model| !model.is_null()), Some(name == ModelName::ConstantVelocity), "{name}");
    }

    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("p.parquet");
    write_predictions(&file, &paths.iter().map(|p| (p.name.as_str(), p)).collect::<Vec<_>>(), &windows).unwrap();
    let reader = SerializedFileReader::new(File::open(&file).unwrap()).unwrap();
    let (mut x_sum, mut yaw_final, mut rows) = (0.0, 0.0, 0usize);
    for row in reader.get_row_iter(None).unwrap() {
        let row = row.unwrap();
        assert_eq!(row.get_string(0).unwrap(), "constant_velocity");
        let truth = drives.iter().find(|d| d.id == *row.get_string(1).unwrap()).unwrap();
        let k = usize::try_from(row.get_int(3).unwrap()).unwrap();
        let t0 = row.get_double(2).unwrap();
        assert!(t0.to_string().len() <= 4, "a start on the grid of 0.1 s: {t0}");
        let at = (t0 / 0.1).round() as usize + k;
        x_sum += (row.get_double(4).unwrap() - truth.states[at].position_m[0]).abs();
        if k == 32 {
            let difference = row.get_double(9).unwrap() - truth.states[at].attitude_rad[2];
            yaw_final += difference.sin().atan2(difference.cos()).to_degrees().abs();
        }
        rows += 1;
    }
    assert_eq!(rows, 16 * 32);
    let close = |found: f64, key: &serde_json::Value| (found - key.as_f64().unwrap()).abs() < 1e-9;
    assert!(close(x_sum / 512.0, &model["mae_mean"]["x_m"]), "{model}");
    assert!(close(yaw_final / 16.0, &model["mae_final"]["yaw_deg"]), "{model}");

    let html = report::evaluation_page(&evaluation, &paths, &windows);
    assert!(html.contains("constant_velocity") && html.matches("<svg class=\"plot\"").count() >= 8);
}

#[test]
fn regress_what_a_drive_does_not_measure_is_null() {
    // Goal: zeros that stand for heights and pitches are not scored, and the drives that measure them are. Method: both drives lack them, then the second alone: the
    // errors in z and pitch are then those of the first by itself, over the horizon too, without an interval, which one drive has none of.
    let scored = |drives: &[Trajectory]| {
        let windows = all_windows(drives, 32, 32, Truth::Measured).unwrap();
        let models = [(ModelName::ConstantVelocity, WindowPredictor::ConstantVelocity)];
        let paths = predict_all(&models, &windows, &vec![None; drives.len()], &|_| {}).unwrap();
        score(&paths[0], &windows, Truth::Measured, &Resamples::draw(drives.len(), 1000, 5))
    };
    let whole = [drive("a", 120, 9.0), drive("b", 90, -15.0)];
    let lacking = |lack: [bool; 2]| {
        let mut drives = whole.clone();
        for drive in drives.iter_mut().zip(lack).filter_map(|(drive, lacks)| lacks.then_some(drive)) {
            drive.measured = MeasuredChannels { height: false, attitude: [true, false, true], ..MeasuredChannels::POSE_AND_TWIST };
        }
        scored(&drives)
    };
    let alone = scored(&whole[..1]);
    for (lack, known) in [([true, true], false), ([false, true], true)] {
        let found = lacking(lack);
        let json = serde_json::to_value(&found.summary).unwrap();
        for (block, interval) in [(&json["mae_mean"], false), (&json["mae_final"], false), (&json["ci95"]["mae_mean"], true)] {
            for key in ["x_m", "y_m", "roll_deg", "yaw_deg"] {
                assert!(!block[key].is_null(), "{key}: {block}");
            }
            for key in ["z_m", "pitch_deg"] {
                assert_eq!(!block[key].is_null(), known && !interval, "{key}: {block}");
            }
        }
        assert!(json["position_m"]["mean"].is_f64());
        for d in [2, 4] {
            assert_eq!(found.curves[d], alone.curves[d].clone().filter(|_| known));
        }
        let of_one = |score: &ModelScore| [score.summary.tree.mae_mean.z_m, score.summary.tree.mae_final.pitch_deg];
        assert_eq!(of_one(&found), if known { of_one(&alone) } else { [None; 2] });
    }
}

/// Goal: the driven path is that of the truth that errors are measured against. Method: straight drives of 2 m/s whose measured poses lie 1.5 m to the left, with their
/// noise-free twins, and one drive that stands, whose windows are too short for an error over path and are counted as such.
#[test]
fn regress_the_driven_path_begins_where_the_truth_does() {
    let straight = |id: &str, speed_m_s: f64, left_m: f64| {
        let mut drive = drive(id, 66, 9.0);
        let states: Vec<VehicleState<f64>> =
            (0..66).map(|i| VehicleState { position_m: [0.1 * speed_m_s * f64::from(i), 0.0, 0.0], ..VehicleState::zero() }).collect();
        drive.states = states.iter().map(|s| VehicleState { position_m: [s.position_m[0], left_m, 0.0], ..*s }).collect();
        drive.truth = Some(GroundTruth { states, ..GroundTruth::default() });
        drive
    };
    let drives = [straight("a", 2.0, 1.5), straight("stands", 0.0, 0.0)];
    let windows = all_windows(&drives, 32, 32, Truth::Gt).unwrap();
    assert_eq!(windows.iter().map(|window| window.drive).collect::<Vec<_>>(), [0, 1]);
    assert_eq!((windows[0].true_start(Truth::Gt)[1], windows[0].true_start(Truth::Measured)[1]), (0.0, 1.5));
    let models = [(ModelName::ConstantVelocity, WindowPredictor::ConstantVelocity)];
    let paths = predict_all(&models, &windows, &[None, None], &|_| {}).unwrap();
    for truth in [Truth::Gt, Truth::Measured] {
        let scored = score(&paths[0], &windows, truth, &Resamples::draw(2, 1000, 5)).errors;
        assert!((scored.path_m[0] - 6.4).abs() < 1e-9 && scored.path_m[1] == 0.0, "{truth:?}: {:?}", scored.path_m);
        assert_eq!(scored.below_path_floor(), 1);
        assert!((path_median_m(&windows, truth) - 3.2).abs() < 1e-9);
    }
}

/// Goal: errors do not depend on where the origin lies. Method: the shipped bundle on a drive and on the same drive at UTM coordinates, where f32 is rounded to
/// half a metre; f64 is to a nanometre, which the network's f32 may carry to a few micrometres.
#[test]
fn regress_predictions_far_from_the_origin_are_those_near_it() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles/hmmwv-nominal");
    let predictor = Arc::new(Predictor::new(Arc::new(ModelBundle::load(&dir).unwrap())).unwrap());
    let origin = [431_000.0, 4_583_000.0];
    let (near, mut far) = (drive("near", 80, 9.0), drive("far", 80, 9.0));
    for state in &mut far.states {
        state.position_m[0] += origin[0];
        state.position_m[1] += origin[1];
    }
    let drives = [near, far];
    let windows = all_windows(&drives, 32, 32, Truth::Measured).unwrap();
    let model = WindowPredictor::Nesam { predictor, variant: Variant::Full, inputs: Inputs::Commands };
    let [near, far] = [0, 1].map(|drive| {
        let window = windows.iter().find(|window| window.drive == drive).unwrap();
        model.predict(window, None).unwrap().poses
    });
    assert_eq!((near.len(), far.len()), (32, 32));
    for (near, far) in near.iter().zip(&far) {
        for d in 0..2 {
            assert!((far[d] - origin[d] - near[d]).abs() < 1e-4, "{far:?} for {near:?}");
        }
    }
}

#[test]
fn property_refusals_name_what_was_wrong() {
    let drives = [drive("short", 20, 9.0)];
    let none = all_windows(&drives, 32, 32, Truth::Measured).unwrap_err().to_string();
    assert!(none.contains("32 steps") && none.contains("20 samples"), "{none}");
    let gt = all_windows(&drives, 5, 1, Truth::Gt).unwrap_err().to_string();
    assert!(gt.contains("`short`") && gt.contains("ground-truth"), "{gt}");
    let vehicle = Arc::new(nesam_vehicle());
    let kinematic = WindowPredictor::new(ModelName::Kinematic, None, &vehicle, None, Inputs::Commands).unwrap_err().to_string();
    assert!(kinematic.contains("never fitted"), "{kinematic}");
    assert!("nesma".parse::<ModelName>().unwrap_err().to_string().contains("choose from nesam"));
}

fn nesam_vehicle() -> nesam_physics::Vehicle {
    nesam_physics::Vehicle {
        name: "any".into(),
        mass_kg: 1.0,
        inertia_kg_m2: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        inertia_estimated: true,
        wheel_centre_m: [[0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, 0.5, 0.0], [-0.5, -0.5, 0.0]],
        wheel_radius_m: 0.2,
        wheel_width_m: 0.1,
        suspension_n_m: [1.0; 4],
        suspension_n_s_m: [1.0; 4],
        second: nesam_physics::SecondCommand::YawRateRadS,
        command_range: [[-1.0, 1.0], [-1.0, 1.0]],
        steering: None,
        track_m: 1.0,
        wheelbase_m: 1.0,
        driveline: nesam_physics::Driveline {
            steering_lag_s: 0.0,
            steering_rate_limit_per_s: 1.0,
            speed_gain: 0.0,
            speed_integral_gain_per_s: 0.0,
            speed_integral_leak_s: 1.0,
            speed_integral_limit_m: 1.0,
            overspeed_limit_m_s: 1.0,
            rims: Default::default(),
            side_coupling_n_m_s: 0.0,
            torque: None,
        },
        gravity_m_s2: 9.81,
        contact_law: Default::default(),
        soil_damping_pa_s_m: 0.0,
        effects: Default::default(),
    }
}
