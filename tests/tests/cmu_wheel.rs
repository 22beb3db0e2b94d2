//! Goal: state how well one wheel of the physics predicts a measured one, on 378 tests that nobody here tuned anything to.
//! Method: the single-wheel tests of C. Pavlov, Carnegie Mellon University (MIT licence; repository robomechanics/3d-terramechanics):
//! r = 58 mm, b = 50 mm, travel 10 mm/s, rim 0 to 100 mm/s, slip angle 0 to 90°, smooth rim and 5 mm grousers, three repeats of each.
//! The soil is the authors' own (plate and repose tests), the contact angles are Ishigami's defaults; nothing is fitted.
//!
//! `cargo test --release -p nesam-tests --test cmu_wheel -- --nocapture` prints the figures of `docs/validation.md`.
//! The measurements are not part of the repository; without them these tests say so and pass.

use nesam_physics::Soil;
use nesam_physics::terramechanics::{
    ContactLaw, GaussRule, Support, WheelGeometry, WheelMotion, WheelWrench, balance_sinkage, wheel_wrench,
};
use nesam_tests::repository;

/// Unit weight of the authors' soil, N/m³.
const UNIT_WEIGHT_N_M3: f64 = 13e3;
/// The law knows ratios of speeds only; speeds are raised out of the range in which the physics regularises a creeping wheel.
const SPEED_SCALE: f64 = 1e3;

/// One steady state. Force along the heading of the wheel (drawbar), to the side that resists sliding, and normal.
struct Trial {
    smooth: bool,
    slip_angle_deg: i32,
    travel_m_s: f64,
    rim_m_s: f64,
    slip_angle_rad: f64,
    drawbar_n: f64,
    side_n: f64,
    normal_n: f64,
    sinkage_m: f64,
}

/// Drawbar, side force, normal force and sinkage that the model gives for one trial.
struct Prediction {
    drawbar_n: f64,
    side_n: f64,
    normal_n: f64,
    sinkage_m: f64,
}

fn trials() -> Option<Vec<Trial>> {
    let path = repository().join("../shared/data/real/cmu_single_wheel/steady_state.csv");
    let Ok(text) = std::fs::read_to_string(&path) else {
        println!("skipped: the measured single-wheel tests are not beside this repository");
        return None;
    };
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let column = |name: &str| header.iter().position(|h| *h == name).unwrap_or_else(|| panic!("no column {name}"));
    let wheel = column("wheel");
    let [travel, rim, set, measured] = ["v_travel", "v_wheel_rim", "beta_set_deg", "beta_meas_deg"].map(column);
    let [drawbar, side, normal, sinkage] = ["Fx_drawbar_N", "Fy_side_N", "Fz_normal_N", "sinkage_m"].map(column);
    let parse = |line: &str| {
        let fields: Vec<&str> = line.split(',').collect();
        let number = |i: usize| -> f64 { fields[i].parse().unwrap_or_else(|_| panic!("`{}` in `{line}`", fields[i])) };
        Trial {
            smooth: fields[wheel] == "smooth",
            slip_angle_deg: number(set) as i32,
            travel_m_s: number(travel),
            rim_m_s: number(rim),
            slip_angle_rad: number(measured).to_radians(),
            drawbar_n: number(drawbar),
            side_n: number(side),
            normal_n: number(normal),
            sinkage_m: number(sinkage),
        }
    };
    Some(lines.filter(|line| !line.is_empty()).map(parse).collect())
}

/// The authors' soil: k = 8000 kN/m^(n+2), which is k_c / b + k_φ, n = 1.46, c = 1 kPa, φ = 29°, K = 21 mm.
fn soil() -> Soil<f64> {
    Soil { k_phi: 8e6, k_c: 0.0, n: 1.46, c: 1e3, phi: 29f64.to_radians(), k_shear: 0.021 }
}

/// How the model is asked.
#[derive(Clone, Copy, PartialEq)]
enum Sinkage {
    /// Sinkage from the balance with the measured normal force.
    Balanced,
    /// Measured sinkage, up to the 0.9 r at which the contact geometry ends (77 trials lie deeper); forces as they come.
    Measured,
    /// Measured sinkage; forces scaled to the measured normal force, as the step of the vehicle does with a learned sinkage.
    MeasuredAtLoad,
}

/// A model of the wheel and how it is asked.
#[derive(Clone, Copy)]
struct Model {
    law: ContactLaw,
    bulldozing: bool,
    how: Sinkage,
}

impl Model {
    fn new(how: Sinkage, bulldozing: bool) -> Self {
        Self { law: ContactLaw::WongReece, bulldozing, how }
    }
}

fn predict(trial: &Trial, model: Model) -> Prediction {
    let how = model.how;
    let side_soil_unit_weight_n_m3 = model.bulldozing.then_some(UNIT_WEIGHT_N_M3);
    let plain = WheelGeometry::new(0.058, 0.05).with_law(model.law);
    let wheel = WheelGeometry { rule: GaussRule::new(24), side_soil_unit_weight_n_m3, ..plain };
    let (sin, cos) = trial.slip_angle_rad.sin_cos();
    // The wheel slides to the right, so that its side force is to the left and positive, as in the measurements.
    let motion = WheelMotion {
        rim_speed_m_s: SPEED_SCALE * trial.rim_m_s,
        forward_m_s: SPEED_SCALE * trial.travel_m_s * cos,
        left_m_s: -SPEED_SCALE * trial.travel_m_s * sin,
    };
    let (direction, contact) = motion.contact();
    let support = Support { preload_n: trial.normal_n, rate_n_m: 0.0 };
    let sinkage_m = match how {
        Sinkage::Balanced => balance_sinkage(&wheel, &support, &contact, &soil()),
        _ => trial.sinkage_m,
    };
    let wrench: WheelWrench<f64> = wheel_wrench(&wheel, sinkage_m, &contact, &soil());
    let share = if how == Sinkage::MeasuredAtLoad { trial.normal_n / wrench.normal_n } else { 1.0 };
    Prediction {
        drawbar_n: share * direction * wrench.drawbar_n(),
        side_n: share * wrench.side_n,
        normal_n: share * wrench.normal_n,
        sinkage_m,
    }
}

/// Root mean squares over trials: drawbar N, side force N, normal force N, sinkage mm.
fn rmse<'a>(trials: impl Iterator<Item = &'a Trial>, model: Model) -> [f64; 4] {
    let (mut sum, mut count) = ([0.0; 4], 0.0);
    for trial in trials {
        let p = predict(trial, model);
        let errors =
            [p.drawbar_n - trial.drawbar_n, p.side_n - trial.side_n, p.normal_n - trial.normal_n, 1e3 * (p.sinkage_m - trial.sinkage_m)];
        for (s, e) in sum.iter_mut().zip(errors) {
            *s += e * e;
        }
        count += 1.0;
    }
    sum.map(|s| (s / count).sqrt())
}

/// Size of the measurements themselves: the error of a model that predicts nothing.
fn size(trials: &[Trial]) -> [f64; 4] {
    let mean = |f: fn(&Trial) -> f64| (trials.iter().map(|t| f(t).powi(2)).sum::<f64>() / trials.len() as f64).sqrt();
    [mean(|t| t.drawbar_n), mean(|t| t.side_n), mean(|t| t.normal_n), mean(|t| 1e3 * t.sinkage_m)]
}

fn row(label: &str, [drawbar, side, normal, sinkage]: [f64; 4]) {
    println!("  {label:<22} drawbar {drawbar:6.2} N   side {side:6.2} N   normal {normal:6.2} N   sinkage {sinkage:6.2} mm");
}

/// Trials that belong to a row of the printed tables.
type Group = (String, Box<dyn Fn(&Trial) -> bool>);

fn groups() -> Vec<Group> {
    let mut groups: Vec<Group> = vec![
        ("all".into(), Box::new(|_| true)),
        ("smooth".into(), Box::new(|t| t.smooth)),
        ("grousers".into(), Box::new(|t| !t.smooth)),
        ("driven (rim >= travel)".into(), Box::new(|t| t.rim_m_s >= 0.98 * t.travel_m_s)),
        ("braked".into(), Box::new(|t| t.rim_m_s < 0.98 * t.travel_m_s && t.rim_m_s > 1e-4)),
        ("locked".into(), Box::new(|t| t.rim_m_s <= 1e-4)),
        ("sinkage < 0.5 r".into(), Box::new(|t| t.sinkage_m < 0.029)),
    ];
    for angle in [0, 15, 30, 45, 60, 75, 90] {
        groups.push((format!("slip angle {angle} deg"), Box::new(move |t| t.slip_angle_deg == angle)));
    }
    groups
}

fn print_tables(trials: &[Trial]) {
    println!("{} trials; scatter of repeats: drawbar 0.4 N, side 0.5 N, sinkage 0.6 mm", trials.len());
    row("size of the data", size(trials));
    for (how, name) in [
        (Sinkage::Balanced, "sinkage from the load balance"),
        (Sinkage::Measured, "forces at the measured sinkage"),
        (Sinkage::MeasuredAtLoad, "forces at the measured sinkage and load"),
    ] {
        for (law, bulldozing) in [(ContactLaw::WongReece, false), (ContactLaw::WongReece, true), (ContactLaw::SoilContactModel, false)] {
            println!("RMSE of {law:?}, {name}, {} side bulldozing", if bulldozing { "with" } else { "without" });
            for (label, member) in groups() {
                row(&label, rmse(trials.iter().filter(|t| member(t)), Model { law, bulldozing, how }));
            }
        }
    }
}

/// Pins an overall RMSE to one part in a thousand: the arithmetic is deterministic but for the mathematical library of the machine.
fn pinned(what: &str, got: f64, want: f64) {
    assert!((got - want).abs() <= 1e-3 * want, "{what}: RMSE {got}, pinned {want}");
}

#[test]
fn regress_measured_wheel_from_the_load_balance() {
    let Some(trials) = trials() else { return };
    assert_eq!(trials.len(), 378);
    print_tables(&trials);
    let [drawbar, side, _, sinkage] = rmse(trials.iter(), Model::new(Sinkage::Balanced, false));
    pinned("drawbar", drawbar, 6.33578);
    pinned("side", side, 19.43646);
    pinned("sinkage", sinkage, 24.42244);
    let [_, side, _, _] = rmse(trials.iter(), Model::new(Sinkage::Balanced, true));
    pinned("side with bulldozing", side, 17.95807);
    let other = Model { law: ContactLaw::SoilContactModel, ..Model::new(Sinkage::Balanced, false) };
    let [drawbar, side, _, sinkage] = rmse(trials.iter(), other);
    pinned("drawbar, soil contact model", drawbar, 11.69005);
    pinned("side, soil contact model", side, 19.93);
    pinned("sinkage, soil contact model", sinkage, 31.07);
}

#[test]
fn regress_measured_wheel_at_the_measured_sinkage() {
    let Some(trials) = trials() else { return };
    let [drawbar, side, ..] = rmse(trials.iter(), Model::new(Sinkage::Measured, false));
    pinned("drawbar", drawbar, 29.72131);
    pinned("side", side, 12.39189);
    let [_, side, ..] = rmse(trials.iter(), Model::new(Sinkage::Measured, true));
    pinned("side with bulldozing", side, 14.15828);
}

#[test]
fn regress_measured_wheel_at_the_measured_sinkage_and_load() {
    let Some(trials) = trials() else { return };
    let [drawbar, side, ..] = rmse(trials.iter(), Model::new(Sinkage::MeasuredAtLoad, false));
    pinned("drawbar", drawbar, 7.97421);
    pinned("side", side, 18.93615);
    let [_, side, ..] = rmse(trials.iter(), Model::new(Sinkage::MeasuredAtLoad, true));
    pinned("side with bulldozing", side, 18.08530);
}

#[test]
fn property_load_balance_carries_the_measured_load() {
    let Some(trials) = trials() else { return };
    for trial in &trials {
        let carried = predict(trial, Model::new(Sinkage::Balanced, false)).normal_n;
        assert!((carried / trial.normal_n - 1.0).abs() < 0.02, "carries {carried} of {} N", trial.normal_n);
    }
}
