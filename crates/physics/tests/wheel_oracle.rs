//! Goal: the wheel computes the forces that published soils and an independent quadrature give.
//! Method: every row of the reference table (two 64-point Gauss rules, plain Python), closed forms, force balance.

use nesam_physics::Soil;
use nesam_physics::terramechanics::{ContactMotion, GaussRule, Support, WheelGeometry, balance_sinkage, wheel_wrench};

fn soil(name: &str) -> Soil<f64> {
    let (k_c, k_phi, n, c, phi_deg, k_shear): (f64, f64, f64, f64, f64, f64) = match name {
        "dry_sand_LLL" => (0.99e3, 1528.43e3, 1.1, 1.04e3, 28.0, 0.025),
        "sandy_loam15_LLL" => (5.27e3, 1515.04e3, 0.7, 1.72e3, 29.0, 0.025),
        "clay38_Thai" => (13.19e3, 692.15e3, 0.5, 4.14e3, 13.0, 0.01),
        "LETE" => (102e3, 5301e3, 0.793, 1.3e3, 31.1, 0.012),
        "ishigami_lunar" => (1.37e3, 8.14e5, 1.0, 800.0, 37.2, 0.036),
        other => panic!("no soil {other}"),
    };
    Soil { k_phi, k_c, n, c, phi: phi_deg.to_radians(), k_shear }
}

fn wheel(radius_m: f64, width_m: f64) -> WheelGeometry {
    WheelGeometry { rule: GaussRule::new(24), ..WheelGeometry::new(radius_m, width_m) }
}

fn oracle(table: &str) -> Vec<serde_json::Value> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/data/oracle/bw_oracle.json");
    let text = std::fs::read_to_string(path).expect("the oracle table is committed");
    let json: serde_json::Value = serde_json::from_str(&text).expect("valid JSON");
    json[table].as_array().expect("a table").clone()
}

fn number(row: &serde_json::Value, key: &str) -> f64 {
    row[key].as_f64().expect("a number")
}

/// Difference as a share of the scale, which is the load: forces near zero have no relative error of their own.
fn close(got: f64, want: f64, scale: f64, tolerance: f64, what: &str) {
    assert!((got - want).abs() <= tolerance * scale, "{what}: got {got}, want {want}");
}

#[test]
fn published_fixed_sinkage_rows_match_the_reference_quadrature() {
    let rows = oracle("fixed_sinkage");
    assert_eq!(rows.len(), 15);
    for row in rows {
        let motion = ContactMotion::from_slip(number(&row, "slip"), 0.0);
        let got =
            wheel_wrench(&wheel(number(&row, "r"), number(&row, "b")), number(&row, "z"), &motion, &soil(row["soil"].as_str().unwrap()));
        let scale = number(&row, "W");
        for (value, key) in
            [(got.normal_n, "W"), (got.drawbar_n(), "DP"), (got.thrust_n, "H"), (got.resistance_n, "R"), (got.torque_n_m, "T")]
        {
            close(value, number(&row, key), scale, 2e-6, &format!("{key} of {row}"));
        }
    }
}

#[test]
fn published_load_balanced_rows_match_the_reference_root() {
    let rows = oracle("load_balanced");
    assert_eq!(rows.len(), 35);
    for row in rows {
        let geometry = wheel(number(&row, "r"), number(&row, "b"));
        let motion = ContactMotion::from_slip(number(&row, "slip"), 0.0);
        let soil = soil(row["soil"].as_str().unwrap());
        let load = number(&row, "W");
        let z = balance_sinkage(&geometry, &Support { preload_n: load, rate_n_m: 0.0 }, &motion, &soil);
        let got = wheel_wrench(&geometry, z, &motion, &soil);
        close(z, number(&row, "z"), number(&row, "z"), 1e-3, &format!("z of {row}"));
        for (value, key) in
            [(got.normal_n, "W"), (got.drawbar_n(), "DP"), (got.thrust_n, "H"), (got.resistance_n, "R"), (got.torque_n_m, "T")]
        {
            close(value, number(&row, key), load, 1e-3, &format!("{key} of {row}"));
        }
    }
}

#[test]
fn analytic_compaction_resistance_equals_the_closed_form() {
    // c = φ = 0, θ_m → 0, θ_2 = 0: R = b (k_c / b + k_φ) z^(n+1) / (n+1), any n.
    for (n, z) in [(0.5, 0.02), (0.793, 0.03), (1.0, 0.06), (1.3, 0.1)] {
        let frictionless = Soil { n, c: 0.0, phi: 0.0, ..soil("LETE") };
        let geometry = WheelGeometry { c1: 1e-9, c2: 0.0, ..wheel(0.47, 0.25) };
        let got = wheel_wrench(&geometry, z, &ContactMotion::from_slip(0.0, 0.0), &frictionless).resistance_n;
        let want = 0.25 * (frictionless.k_c / 0.25 + frictionless.k_phi) * z.powf(n + 1.0) / (n + 1.0);
        close(got, want, want, 1e-6, &format!("n = {n}, z = {z}"));
    }
}

#[test]
fn analytic_five_nodes_stay_within_a_tenth_of_a_percent() {
    for slip in [-0.3, 0.05, 0.4] {
        for (name, z) in [("dry_sand_LLL", 0.12), ("clay38_Thai", 0.05), ("LETE", 0.02)] {
            let motion = ContactMotion::from_slip(slip, 0.1);
            let fine = wheel_wrench(&WheelGeometry { rule: GaussRule::new(48), ..WheelGeometry::new(0.47, 0.25) }, z, &motion, &soil(name));
            let five = wheel_wrench(&WheelGeometry::new(0.47, 0.25), z, &motion, &soil(name));
            for (a, b) in [(fine.normal_n, five.normal_n), (fine.thrust_n, five.thrust_n), (fine.side_n, five.side_n)] {
                close(b, a, fine.normal_n, 1e-3, name);
            }
        }
    }
}

#[test]
fn property_sinkage_grows_with_load_and_softness() {
    let geometry = wheel(0.47, 0.25);
    let motion = ContactMotion::from_slip(0.1, 0.0);
    let sinkage = |load, factor| {
        let base = soil("sandy_loam15_LLL");
        let soft = Soil { k_phi: base.k_phi * factor, k_c: base.k_c * factor, ..base };
        balance_sinkage(&geometry, &Support { preload_n: load, rate_n_m: 0.0 }, &motion, &soft)
    };
    for load in [1000.0, 3000.0, 6000.0, 9000.0] {
        assert!(sinkage(load * 1.2, 1.0) > sinkage(load, 1.0), "load {load}");
        assert!(sinkage(load, 0.7) > sinkage(load, 1.0), "softness at load {load}");
    }
}

#[test]
fn property_drawbar_rises_with_slip_and_side_force_opposes_sliding() {
    let geometry = wheel(0.47, 0.25);
    let at = |slip, tan| wheel_wrench(&geometry, 0.05, &ContactMotion::from_slip(slip, tan), &soil("sandy_loam15_LLL"));
    for slip in [0.0, 0.05, 0.1, 0.2, 0.3] {
        assert!(at(slip + 0.05, 0.0).drawbar_n() > at(slip, 0.0).drawbar_n());
    }
    assert!(at(0.1, 0.2).side_n < 0.0 && at(0.1, -0.2).side_n > 0.0);
    assert!((at(0.1, 0.2).side_n + at(0.1, -0.2).side_n).abs() < 1e-9);
}

#[test]
fn property_unloaded_wheel_carries_next_to_nothing() {
    let geometry = wheel(0.47, 0.25);
    let motion = ContactMotion::from_slip(0.1, 0.0);
    let z = balance_sinkage(&geometry, &Support { preload_n: -5000.0, rate_n_m: 1e5 }, &motion, &soil("LETE"));
    assert!(z < 1e-3, "sinkage {z}");
}
