//! Goal: the soil contact model is the law that its nodes obey, marched through the contact one by one.
//! Method: closed forms where the soil has no strength; a column of soil that the wheel rolls over, in small steps of time.

use nesam_physics::Soil;
use nesam_physics::terramechanics::{
    ContactLaw, ContactMotion, GaussRule, Support, WheelGeometry, WheelMotion, balance_sinkage, wheel_wrench,
};

const RADIUS_M: f64 = 0.467;
const WIDTH_M: f64 = 0.254;

fn wheel(order: usize) -> WheelGeometry {
    let plain = WheelGeometry::new(RADIUS_M, WIDTH_M).with_law(ContactLaw::SoilContactModel);
    WheelGeometry { recovery: 0.0, rule: GaussRule::new(order), ..plain }
}

fn clay() -> Soil<f64> {
    Soil { k_phi: 1.2e6, k_c: 8e3, n: 0.8, c: 4e3, phi: 0.4, k_shear: 0.015 }
}

#[test]
fn analytic_soil_without_strength_carries_and_brakes_as_the_closed_forms_say() {
    for (n, z) in [(0.6, 0.02), (1.0, 0.05), (1.2, 0.1)] {
        let soft = Soil { n, c: 0.0, phi: 0.0, ..clay() };
        let modulus = soft.k_c / WIDTH_M + soft.k_phi;
        let got = wheel_wrench(&wheel(24), z, &ContactMotion::from_slip(0.1, 0.05), &soft);
        // Moment of the pressure about the axle: b ∫ p x dx with x dx = -(d + r - z) dd.
        let moment = WIDTH_M * modulus * (z.powf(n + 2.0) / (n + 2.0) + (RADIUS_M - z) * z.powf(n + 1.0) / (n + 1.0));
        assert!((got.torque_n_m / moment - 1.0).abs() < 1e-5, "n = {n}: torque {} N m, closed form {moment}", got.torque_n_m);
        assert!(got.drawbar_n().abs() < 1e-9 && got.side_n.abs() < 1e-9, "n = {n}: pressure alone pushes along the ground");
        if n == 1.0 {
            let entry = (1.0 - z / RADIUS_M).acos();
            let load = WIDTH_M * modulus * 0.5 * RADIUS_M * RADIUS_M * (entry - entry.sin() * entry.cos());
            assert!((got.normal_n / load - 1.0).abs() < 1e-5, "load {} N, closed form {load}", got.normal_n);
        }
    }
}

#[test]
fn analytic_damping_carries_and_brakes_as_the_closed_forms_say() {
    let soft = Soil { c: 0.0, phi: 0.0, ..clay() };
    let damped = WheelGeometry { soil_damping_pa_s_m: 2e4, ..wheel(24) };
    for (z, pressing_m_s) in [(0.02, 3.0), (0.1, 2.5), (0.2, 1.0)] {
        let still = ContactMotion::from_slip(0.1, 0.05);
        let moving = ContactMotion { pressing_m_s, ..still };
        let [slow, fast] = [still, moving].map(|motion| wheel_wrench(&damped, z, &motion, &soft));
        assert_eq!(slow.normal_n, wheel_wrench(&wheel(24), z, &moving, &soft).normal_n, "at rest and without damping");
        // Pressure d u sin θ: load b r d u ∫ sin θ cos θ dθ, moment b r² d u ∫ sin² θ cos θ dθ.
        let sin = ((2.0 * RADIUS_M - z) * z).sqrt() / RADIUS_M;
        let viscous = WIDTH_M * RADIUS_M * 2e4 * pressing_m_s;
        let (load, moment) = (viscous * sin.powi(2) / 2.0, viscous * RADIUS_M * sin.powi(3) / 3.0);
        assert!(
            ((fast.normal_n - slow.normal_n) / load - 1.0).abs() < 1e-6,
            "z {z}: {} N, closed form {load}",
            fast.normal_n - slow.normal_n
        );
        let braked = fast.torque_n_m - slow.torque_n_m;
        assert!((braked / moment - 1.0).abs() < 1e-6, "z {z}: {braked} N m, closed form {moment}");
        assert!(fast.drawbar_n().abs() < 1e-9, "pressure alone pushes along the ground");
    }
}

#[test]
fn property_soil_that_is_pressed_fast_still_carries_the_load() {
    let soils = [clay(), Soil { k_phi: 1.3e5, n: 0.8, c: 1700.0, phi: 0.14, ..clay() }, Soil { k_phi: 2e7, n: 0.6, ..clay() }];
    let mut shallower: f64 = 1.0;
    for (soil, damping, speed) in
        soils.iter().flat_map(|soil| [1e4, 2e4, 5e4].map(|d| (soil, d))).flat_map(|(soil, d)| [0.3, 1.5, 4.0].map(|v| (soil, d, v)))
    {
        let damped = WheelGeometry::new(RADIUS_M, WIDTH_M).with_law(ContactLaw::SoilContactModel).on_damped_soil(damping);
        let motion = WheelMotion { rim_speed_m_s: 1.1 * speed, forward_m_s: speed, left_m_s: 0.1 }.contact().1;
        let support = Support { preload_n: 9000.0, rate_n_m: 2e4 };
        let [z, slow] = [&damped, &WheelGeometry { soil_damping_pa_s_m: 0.0, ..damped.clone() }]
            .map(|wheel| balance_sinkage(wheel, &support, &motion, soil));
        let carried = wheel_wrench(&damped, z, &motion, soil).normal_n;
        let pressed = support.preload_n - support.rate_n_m * z;
        assert!((carried / pressed - 1.0).abs() < 1e-4, "d {damping}, {speed} m/s: carries {carried} N of {pressed}");
        assert!(z < slow, "d {damping}, {speed} m/s: {z} m, slowly {slow} m");
        shallower = shallower.min(z / slow);
    }
    assert!(shallower < 0.6, "soft soil under a fast wheel: {shallower}");
}

#[test]
fn property_a_wheel_about_to_lift_off_carries_what_presses_it() {
    let wheel = WheelGeometry::new(RADIUS_M, WIDTH_M).with_law(ContactLaw::SoilContactModel);
    let soils = [clay(), Soil { k_phi: 1.3e5, n: 0.8, c: 1700.0, phi: 0.14, ..clay() }, Soil { k_phi: 1.2e7, n: 0.9, ..clay() }];
    let motion = WheelMotion { rim_speed_m_s: 2.2, forward_m_s: 2.0, left_m_s: 0.1 }.contact().1;
    let mut furthest = [0.0f64; 2];
    for (soil, preload_n) in soils.iter().flat_map(|soil| [-2000.0, -200.0, -20.0, 0.0, 20.0, 200.0, 2000.0].map(|n| (soil, n))) {
        let support = Support { preload_n, rate_n_m: 2.5e5 };
        let single = |x: f64| x as f32;
        let support_f32 = Support { preload_n: single(preload_n), rate_n_m: 2.5e5 };
        let z_f32 = balance_sinkage(&wheel, &support_f32, &motion.map(single), &Soil::from_array(soil.to_array().map(single)));
        for (z, furthest) in [balance_sinkage(&wheel, &support, &motion, soil), f64::from(z_f32)].into_iter().zip(&mut furthest) {
            let pressed = support.preload_n - support.rate_n_m * z;
            let pressed = 0.5 * (pressed + (pressed * pressed + 4.0).sqrt());
            *furthest = furthest.max((wheel_wrench(&wheel, z, &motion, soil).normal_n - pressed).abs());
        }
    }
    // A quarter of a newton is the least that a contact carries.
    assert!(furthest.iter().all(|newtons| *newtons < 0.3), "off by {furthest:?} N in f64 and f32");
}

/// Thrust and side force of columns of soil that a wheel rolls over, each sheared by what has slid past it (the law of the nodes).
fn marched(z: f64, slip: f64, tan_slip_angle: f64, soil: &Soil<f64>) -> [f64; 2] {
    let (rim, travel) = (1.0, if slip >= 0.0 { 1.0 - slip } else { 1.0 / (1.0 + slip) });
    let entry = (1.0 - z / RADIUS_M).acos();
    let modulus = soil.k_c / WIDTH_M + soil.k_phi;
    let steps = 20_000;
    let dt = entry * RADIUS_M / rim / f64::from(steps);
    let (mut slid, mut force) = (0.0, [0.0; 2]);
    for k in 0..steps {
        let angle = entry * (1.0 - (f64::from(k) + 0.5) / f64::from(steps));
        let (ahead, aside) = (rim * angle.cos() - travel, travel * tan_slip_angle);
        let speed = ahead.hypot(aside);
        slid += 0.5 * speed * dt;
        let pressure = modulus * (RADIUS_M * angle.cos() - RADIUS_M + z).powf(soil.n);
        let shear = (soil.c + pressure * soil.phi.tan()) * (1.0 - (-slid / soil.k_shear).exp());
        slid += 0.5 * speed * dt;
        let area = WIDTH_M * RADIUS_M * angle.cos() * entry / f64::from(steps);
        force[0] += shear * ahead / speed * area;
        force[1] -= shear * aside / speed * area;
    }
    force
}

#[test]
fn analytic_forces_are_those_of_columns_of_soil_marched_through_the_contact() {
    let soil = clay();
    // Sliding that keeps its direction: displacement and path are the same length, and the closed form is the law of the nodes.
    for (slip, tan, tolerance) in [(0.4, 0.0, 0.01), (-0.4, 0.0, 0.01), (0.25, 0.0, 0.02), (0.4, 0.3, 0.02), (0.05, 0.3, 0.06)] {
        let got = wheel_wrench(&wheel(24), 0.05, &ContactMotion::from_slip(slip, tan), &soil);
        let want = marched(0.05, slip, tan, &soil);
        for (got, want) in [(got.drawbar_n(), want[0]), (got.side_n, want[1])] {
            let scale = want.abs().max(0.05 * 6000.0);
            assert!((got - want).abs() < tolerance * scale, "slip {slip}, tan {tan}: {got:.1} N, marched {want:.1} N");
        }
    }
}

#[test]
fn analytic_five_nodes_stay_within_a_percent_of_the_load() {
    for slip in [-0.3, 0.0, 0.05, 0.4] {
        let motion = ContactMotion::from_slip(slip, 0.1);
        let [fine, five] = [48, 5].map(|order| wheel_wrench(&wheel(order), 0.06, &motion, &clay()));
        for (a, b) in [(fine.normal_n, five.normal_n), (fine.thrust_n, five.thrust_n), (fine.side_n, five.side_n)] {
            assert!((a - b).abs() < 0.01 * fine.normal_n, "slip {slip}: {b:.1} N with five nodes, {a:.1} N with 48");
        }
    }
}

#[test]
fn property_a_wheel_that_rolls_freely_is_braked_and_traction_grows_with_slip() {
    let drawbar = |slip: f64| wheel_wrench(&wheel(5), 0.05, &ContactMotion::from_slip(slip, 0.0), &clay()).drawbar_n();
    assert!(drawbar(0.0) < 0.0, "the front of the contact slides forwards");
    for pair in [-0.5, -0.2, 0.0, 0.1, 0.2, 0.35].windows(2) {
        assert!(drawbar(pair[0]) < drawbar(pair[1]), "{} N at {}, {} N at {}", drawbar(pair[0]), pair[0], drawbar(pair[1]), pair[1]);
    }
    let side = |tan: f64| wheel_wrench(&wheel(5), 0.05, &ContactMotion::from_slip(0.1, tan), &clay()).side_n;
    assert!(side(0.2) < 0.0 && (side(0.2) + side(-0.2)).abs() < 1e-9, "the side force opposes sliding, alike on both sides");
}
