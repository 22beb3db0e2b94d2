//! The committed sample of the Chrono drives, against what its description says.
#![allow(clippy::unwrap_used)]

mod common;

use common::{sample_root, shared};
use nesam_physics::wrap_angle;
use nesam_trajectories::{DataRoot, SetQuery, SoilTruth, Split, SplitFilter, VelocitySource, read_ground_truth_soil, windows};

fn sample() -> DataRoot {
    DataRoot::open(&sample_root(), None).unwrap()
}

#[test]
fn chrono_sets_splits_and_worlds() {
    let root = sample();
    assert_eq!(root.sets(), ["effect_open/null_open", "effect_open/steer_offset", "nominal", "ood_soil"]);
    let load = |split| root.load_set(&SetQuery { split, ..SetQuery::all("nominal") }).unwrap();
    let (train, test, all) = (load(SplitFilter::Train), load(SplitFilter::Test), load(SplitFilter::All));
    assert_eq!((train.len(), test.len(), all.len()), (2, 4, 6));
    assert!(train.iter().all(|t| t.split == Some(Split::Train) && t.world.as_deref() == Some("w01")));
    assert!(test.iter().all(|t| t.split == Some(Split::Test)));
    for t in &all {
        assert_eq!((t.time_s.len(), t.states.len(), t.controls.len()), (251, 251, 251));
        assert!(t.time_s.iter().enumerate().all(|(k, time)| (time - 0.1 * k as f64).abs() < 1e-9));
        assert_eq!(windows(t.states.len(), 32, 32).len(), 24);
        assert_eq!(t.measured.velocity_source, VelocitySource::Body);
        assert_eq!(t.measured.angular_velocity, [true; 3]);
        assert!(t.wheel_speed_rad_s.is_some() && t.road_wheel_angle_rad.is_some() && t.truth.is_none());
        assert!(t.controls.iter().all(|u| root.vehicle().admits(u)));
        let map = root.world(t.world.as_deref().unwrap()).unwrap();
        assert!(t.states.iter().all(|s| map.ground(s.position_m[0], s.position_m[1]).is_some()));
    }
    assert_eq!(root.load_set(&SetQuery::all("effect_open/steer_offset")).unwrap().len(), 2);
    assert_eq!(root.load_set(&SetQuery::all("ood_soil")).unwrap()[0].time_s.len(), 501);
}

#[test]
fn chrono_measured_channels_are_consistent() {
    // DATA.md: noise 0.015 m in x and y, 0.02 m in z, 0.1 deg, 0.025 m/s, 0.002 rad/s; the twins differ from the channels by just that.
    let root = sample();
    let drives = root.load_set(&SetQuery { ground_truth: true, ..SetQuery::all("nominal") }).unwrap();
    let sigma = [0.015, 0.015, 0.02, 1.745e-3, 1.745e-3, 1.745e-3, 0.025, 0.025, 0.025, 0.002, 0.002, 0.002];
    let mut square = [0.0; 12];
    let mut count = 0.0;
    for t in &drives {
        let truth = t.truth.as_ref().unwrap();
        for (measured, twin) in t.states.iter().zip(&truth.states) {
            let (a, b) = (measured.to_array(), twin.to_array());
            for i in 0..12 {
                let d = if (3..6).contains(&i) { wrap_angle(a[i] - b[i]) } else { a[i] - b[i] };
                square[i] += d * d;
            }
            count += 1.0;
        }
    }
    for i in 0..12 {
        // 1506 samples: the standard deviation is known to 2 %; the body velocity also carries the attitude noise at 4 m/s.
        let rms = (square[i] / count).sqrt();
        assert!((rms / sigma[i] - 1.0).abs() < 0.12, "channel {i}: {rms} against {}", sigma[i]);
    }
}

#[test]
fn chrono_ground_truth_carries_the_weight() {
    // DATA.md: mean sum of gt_fz is the weight (24462 N), sinkage a few centimetres, regions are rows of gt_soil.json.
    let root = sample();
    let drives = root.load_set(&SetQuery { ground_truth: true, ..SetQuery::all("nominal") }).unwrap();
    let truths: Vec<_> = drives.iter().map(|t| t.truth.as_ref().unwrap()).collect();
    let forces: Vec<f64> = truths.iter().flat_map(|t| t.wheel_force_n.iter().map(|w| w.iter().map(|f| f[2]).sum())).collect();
    let mean = forces.iter().sum::<f64>() / forces.len() as f64;
    assert!((mean / 24462.0 - 1.0).abs() < 0.03, "{mean}");
    for (t, truth) in drives.iter().zip(truths) {
        let dir = root.world_dir(t.world.as_deref().unwrap());
        let soil = read_ground_truth_soil(&dir).unwrap();
        let map = root.world(t.world.as_deref().unwrap()).unwrap();
        assert!(truth.region.iter().flatten().all(|id| soil.soil(*id).is_some()));
        assert!(soil.regions.iter().all(|r| (0.1..0.8).contains(&r.soil.phi)), "friction angles are in rad");
        let regions = SoilTruth::read_regions(&dir, map.geometry()).unwrap();
        assert!(regions.iter().all(|id| soil.soil(usize::from(*id)).is_some()));
        // The region image at the wheel gives the logged id (DATA.md: 99.7 %): this checks the flip of the image, too.
        let wheel = root.vehicle().wheel_centre_m[0];
        let hits = truth.states.iter().zip(&truth.region).filter(|(s, region)| {
            let (sin, cos) = s.attitude_rad[2].sin_cos();
            let [x, y] = [s.position_m[0] + cos * wheel[0] - sin * wheel[1], s.position_m[1] + sin * wheel[0] + cos * wheel[1]];
            let [u, v] = map.geometry().to_grid(x, y).map(|c| c.round() as usize);
            usize::from(regions[v * map.geometry().width + u]) == region[0]
        });
        let share = hits.count() as f64 / truth.region.len() as f64;
        assert!(share > 0.95, "{}: {share}", t.id);
        assert!(truth.sinkage_mean_m.iter().flatten().all(|z| (0.0..0.5).contains(z)));
    }
}

#[test]
fn property_ground_truth_columns_change_nothing() {
    // The same set written again without any gt_ column (and without the gt_ files) gives identical trajectories.
    let dir = tempfile::TempDir::new().unwrap();
    let set = dir.path().join("nominal");
    std::fs::create_dir_all(&set).unwrap();
    std::fs::copy(sample_root().join("vehicle_hmmwv.json"), dir.path().join("vehicle_hmmwv.json")).unwrap();
    std::fs::copy(sample_root().join("nominal/index.json"), set.join("index.json")).unwrap();
    common::copy_without_truth(&sample_root().join("nominal/samples.parquet"), &set.join("samples.parquet"));
    for world in ["w01", "w05", "w16"] {
        let to = dir.path().join("worlds").join(world);
        std::fs::create_dir_all(&to).unwrap();
        for file in ["world.json", "elevation.png", "semantic.png"] {
            std::fs::copy(sample_root().join("worlds").join(world).join(file), to.join(file)).unwrap();
        }
    }
    let bare = DataRoot::open(dir.path(), None).unwrap();
    let query = SetQuery::all("nominal");
    assert_eq!(bare.load_set(&query).unwrap(), sample().load_set(&query).unwrap());
    assert_eq!(bare.world("w05").unwrap().hash(), sample().world("w05").unwrap().hash());
    let error = bare.load_set(&SetQuery { ground_truth: true, ..query }).unwrap_err().to_string();
    assert!(error.contains("column `gt_"), "{error}");
}

#[test]
fn property_hash_names_the_files_that_were_read() {
    let (a, b) = (sample(), sample());
    let empty = a.hash();
    a.load_set(&SetQuery::all("nominal")).unwrap();
    let one = a.hash();
    assert_ne!(one, empty);
    a.load_set(&SetQuery::all("ood_soil")).unwrap();
    b.load_set(&SetQuery::all("ood_soil")).unwrap();
    assert_ne!(a.hash(), one);
    b.load_set(&SetQuery::all("nominal")).unwrap();
    assert_eq!(a.hash(), b.hash(), "the order of reading does not matter");
}

#[test]
fn chrono_full_data_loads() {
    let Some(path) = shared("chrono") else { return };
    let root = DataRoot::open(&path, None).unwrap();
    let start = std::time::Instant::now();
    let train = root.load_set(&SetQuery { split: SplitFilter::Train, ..SetQuery::all("nominal") }).unwrap();
    println!("nominal/train: {} drives in {} ms", train.len(), start.elapsed().as_millis());
    let test = root.load_set(&SetQuery { split: SplitFilter::Test, ..SetQuery::all("nominal") }).unwrap();
    assert_eq!((train.len(), test.len()), (300, 108));
    assert!(train.iter().chain(&test).all(|t| !windows(t.states.len(), 32, 32).is_empty()));
    for set in root.sets() {
        let drives = root.load_set(&SetQuery { ground_truth: true, ..SetQuery::all(set) }).unwrap();
        assert!(drives.iter().all(|t| t.truth.is_some()));
    }
}

#[test]
fn chrono_husky_windows_have_twenty_samples() {
    let Some(path) = shared("real/husky") else { return };
    let root = DataRoot::open(&path, None).unwrap();
    let drives = root.load_set(&SetQuery::all("drive")).unwrap();
    assert_eq!(drives.len(), 603);
    let mut error = 0.0;
    for t in &drives {
        assert_eq!((t.states.len(), t.world.as_deref()), (20, None));
        assert!((t.time_s[19] - 1.9).abs() < 1e-6);
        assert_eq!(t.measured.angular_velocity, [false, false, true]);
        assert!(!t.measured.linear_velocity && t.measured.wheel_speed && !t.measured.road_wheel_angle);
        assert_eq!(windows(t.states.len(), 19, 1), [0]);
        assert!(t.controls.iter().all(|u| root.vehicle().admits(u)), "{:?}", t.controls[0]);
        let v = t.states[19].velocity_m_s;
        assert!(v.iter().all(|v| v.abs() < 2.5), "{v:?}");
        error += v[2].abs() / 603.0;
    }
    assert!(error < 0.1, "flat ground: vertical speed {error}");
}
