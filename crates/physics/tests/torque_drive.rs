//! Goal: a car whose hubs are under torque moves as Newton demands of that torque, whatever the soil does with it.
//! Method: closed forms of the hub torques (r F + moment of the pressure), limits of grip, couplings and friction at single wheels.

mod common;

use common::{Drive, loam, mud};
use nesam_physics::effects::{Effect, WheelDrag};
use nesam_physics::step::StepOutput;
use nesam_physics::terramechanics::ContactLaw;
use nesam_physics::{Soil, TorqueDrive, Vehicle};
use nesam_test_vehicles::torque_truck;

/// Soil on which wheels sink two centimetres and hold.
fn firm() -> Soil<f64> {
    Soil { k_phi: 1.2e7, k_c: 1e5, n: 1.0, c: 2e4, phi: 0.6, k_shear: 0.005 }
}

/// The car with a torque that nothing changes: no feedback of speed, flat curve, no engine drag, open differentials.
fn constant_torque(demand_m_s: f64) -> Vehicle {
    let car = torque_truck();
    let torque = car.driveline.torque.map(|t| TorqueDrive { holding_demand_m_s: demand_m_s, closed_n_m: 0.0, curve: [1.0; 5], ..t });
    let mut driveline = car.driveline.clone();
    (driveline.speed_gain, driveline.speed_integral_gain_per_s, driveline.side_coupling_n_m_s) = (0.0, 0.0, 0.0);
    // Far beyond every demand, so that its smooth limit does nothing.
    driveline.overspeed_limit_m_s = 1e3;
    Vehicle { driveline: nesam_physics::Driveline { torque, ..driveline }, ..car }
}

/// The last step and the acceleration over the last second of `seconds`, m/s².
fn driven(vehicle: Vehicle, soil: Soil<f64>, start_m_s: f64, seconds: usize, second: f64) -> (Drive, StepOutput<f64>, f64) {
    let mut drive = Drive::new(vehicle, start_m_s);
    drive.soil = soil;
    let mut step = None;
    let mut before = 0.0;
    for k in 0..10 * seconds {
        if k == 10 * (seconds - 1) {
            before = drive.state.velocity_m_s[0];
        }
        step = Some(drive.step(2.5, second));
    }
    let gained = drive.state.velocity_m_s[0] - before;
    (drive, step.expect("at least one step"), gained)
}

/// Moment of a pressure k z^n under a wheel about its axle over the radius, N: b k (z^(n+2) / (n+2) + (r - z) z^(n+1) / (n+1)) / r (`contact_law.rs`).
fn compaction_n(vehicle: &Vehicle, soil: &Soil<f64>, sinkage_m: f64) -> f64 {
    let (r, b, z, n) = (vehicle.wheel_radius_m, vehicle.wheel_width_m, sinkage_m, soil.n);
    b * (soil.k_c / b + soil.k_phi) * (z.powf(n + 2.0) / (n + 2.0) + (r - z) * z.powf(n + 1.0) / (n + 1.0)) / r
}

#[test]
fn analytic_firm_ground_turns_torque_into_acceleration() {
    for law in [ContactLaw::WongReece, ContactLaw::SoilContactModel] {
        let vehicle = Vehicle { contact_law: law, ..constant_torque(0.6) };
        let torque_n_m = 0.6 * 4570.0;
        let (_, step, gained) = driven(vehicle.clone(), firm(), 2.0, 3, 0.0);
        let lost: f64 = step.contacts.iter().map(|c| compaction_n(&vehicle, &firm(), c.sinkage_m)).sum();
        let want = (torque_n_m / vehicle.wheel_radius_m - lost) / vehicle.mass_kg;
        // Wong and Reece's stress has its maximum ahead of the bottom, so that it takes a little less.
        let off_n = (gained - want).abs() * vehicle.mass_kg;
        assert!(off_n < 0.08 * lost, "{law:?}: {gained} m/s², torque less compaction of {lost} N gives {want}");
    }
}

#[test]
fn analytic_compaction_is_what_soft_ground_takes_of_the_torque() {
    let vehicle = constant_torque(1.0);
    let soft = Soil { k_phi: 1.5e6, k_c: 5e3, n: 0.9, c: 3e3, phi: 0.5, k_shear: 0.015 };
    let (_, step, gained) = driven(vehicle.clone(), soft, 1.5, 2, 0.0);
    let lost: f64 = step.contacts.iter().map(|c| compaction_n(&vehicle, &soft, c.sinkage_m)).sum();
    let want = (4570.0 / vehicle.wheel_radius_m - lost) / vehicle.mass_kg;
    assert!(lost > 2000.0, "the soil is soft: {lost} N");
    assert!((gained - want).abs() < 0.12, "{gained} m/s², closed form {want}");
}

#[test]
fn analytic_pressure_ahead_of_the_axles_lifts_the_front() {
    // Moments about the reference point at a steady speed: what the front carries less is the weight times the lead of the pressure over the wheelbase.
    let mut car = torque_truck();
    car.driveline.side_coupling_n_m_s = 0.0;
    let soft = Soil { k_phi: 1.0e6, k_c: 5e3, n: 0.9, c: 4e3, phi: 0.6, k_shear: 0.015 };
    let ahead_m = |soil_damping_pa_s_m: f64| {
        let vehicle = Vehicle { soil_damping_pa_s_m, ..car.clone() };
        let (_, step, gained) = driven(vehicle.clone(), soft, 2.0, 20, 0.0);
        assert!(gained.abs() < 0.01, "damping {soil_damping_pa_s_m} is not steady: {gained} m/s²");
        let weight: f64 = step.contacts.iter().map(|c| c.normal_n).sum();
        let ahead: f64 = (0..4).map(|i| -vehicle.wheel_centre_m[i][0] * step.contacts[i].normal_n / weight).sum();
        let lead: f64 = step.contacts.iter().map(|c| compaction_n(&vehicle, &soft, c.sinkage_m) * vehicle.wheel_radius_m / weight).sum();
        (ahead, lead)
    };
    // Hardly any damping, so that the moment of the static pressure is all there is.
    let (ahead, lead) = ahead_m(1e-3);
    assert!(lead > 0.07 && (ahead / lead - 1.0).abs() < 0.2, "{ahead} m by the loads, {lead} m by the pressure");
    let (damped, _) = ahead_m(2e4);
    assert!(damped > ahead, "damping presses at the front of the contact: {damped} m for {ahead} m");
    let (unled, _) = ahead_m(0.0);
    assert!(unled.abs() < 5e-3, "without damping forces act below the axle: {unled} m");
}

#[test]
fn analytic_grip_limits_what_a_large_torque_does() {
    let vehicle = constant_torque(20.0);
    let loose = Soil { c: 0.0, phi: 0.35, ..firm() };
    let (_, step, gained) = driven(vehicle.clone(), loose, 2.0, 2, 0.0);
    let grip = 0.35f64.tan() * vehicle.gravity_m_s2;
    assert!(gained < grip && gained > 0.7 * grip, "{gained} m/s² of at most {grip}");
    assert!(step.contacts.iter().all(|c| c.overspeed_m_s > 0.3), "wheels spin: {:?}", step.contacts.map(|c| c.overspeed_m_s));
}

#[test]
fn analytic_friction_at_a_wheel_slows_by_its_torque_and_turns() {
    let free = constant_torque(0.6);
    let drag = Effect::WheelDrag(WheelDrag { wheel: 3, torque_n_m: 600.0 });
    let (plain, _, fast) = driven(free.clone(), firm(), 2.0, 2, 0.0);
    let (dragged, step, slow) = driven(free.with_effects(&[drag]), firm(), 2.0, 2, 0.0);
    let want = 600.0 / free.wheel_radius_m / free.mass_kg;
    assert!(((fast - slow) / want - 1.0).abs() < 0.08, "slower by {} m/s², torque over radius and mass {want}", fast - slow);
    assert!(dragged.state.attitude_rad[2] < -0.002 && plain.state.attitude_rad[2].abs() < 1e-6, "right wheel turns right");
    assert!(step.contacts[3].overspeed_m_s < step.contacts[2].overspeed_m_s, "the dragged rim turns slower");
}

#[test]
fn analytic_couplings_resist_a_turn_by_their_moment() {
    // Rims of a turn differ; what the coupling passes, k per difference of speeds, is 2 k / R² times the difference of the rims between the forces of both.
    let open = constant_torque(0.6);
    let mut coupled = open.clone();
    coupled.driveline.side_coupling_n_m_s = 220.0;
    let forces = |vehicle: &Vehicle| {
        let (mut drive, ..) = driven(open.clone(), firm(), 2.0, 2, 0.4);
        drive.model = nesam_physics::step::StepModel::new(vehicle, 0.001, 1);
        let rate = drive.state.angular_velocity_rad_s[2];
        let step = drive.step(2.5, 0.4);
        let rims: [f64; 4] = core::array::from_fn(|i| step.contacts[i].overspeed_m_s - rate * open.wheel_centre_m[i][1]);
        [2, 3].map(|rear| (step.contacts[rear].forward_n, rims[rear]))
    };
    let (without, with) = (forces(&open), forces(&coupled));
    let resisted_n = (with[0].0 - without[0].0) - (with[1].0 - without[1].0);
    let want = 2.0 * 220.0 / (open.wheel_radius_m * open.wheel_radius_m) * (with[1].1 - with[0].1);
    assert!(want > 300.0 && (resisted_n / want - 1.0).abs() < 0.05, "{resisted_n} N, coupling gives {want} N: {with:?}");
}

#[test]
fn analytic_couplings_hand_torque_from_rims_that_turn_faster() {
    // Straight ahead with a dragging wheel and soft ground: over-speeds differ, and each hub takes T / 4 - drag - 2 k (ω - ω̄) to its contact.
    for (coupling, soil) in [(250.0, firm()), (250.0, loam()), (2500.0, loam())] {
        let mut car = constant_torque(1.0);
        car.driveline.side_coupling_n_m_s = coupling;
        let drag = Effect::WheelDrag(WheelDrag { wheel: 3, torque_n_m: 600.0 });
        let car = car.with_effects(&[drag]);
        let (drive, step, _) = driven(car.clone(), soil, 2.0, 1, 0.0);
        let radius = car.wheel_radius_m;
        let side = |i: usize| drive.state.angular_velocity_rad_s[2] * car.wheel_centre_m[i][1];
        let rim: [f64; 4] = core::array::from_fn(|i| drive.state.velocity_m_s[0] - side(i) + step.contacts[i].overspeed_m_s);
        let mean = rim.iter().sum::<f64>() / 4.0;
        for (i, contact) in step.contacts.iter().enumerate() {
            let at_rim_n = contact.forward_n + compaction_n(&car, &soil, contact.sinkage_m);
            let own_n = 4570.0 / 4.0 / radius - if i == 3 { 600.0 / radius } else { 0.0 };
            let handed_n = -2.0 * coupling / (radius * radius) * (rim[i] - mean);
            assert!((at_rim_n - own_n - handed_n).abs() < 120.0, "{coupling}, wheel {i}: {at_rim_n} N of {own_n} and {handed_n}");
        }
        let handed = 600.0 / radius - (step.contacts[2].forward_n - step.contacts[3].forward_n);
        assert!(handed > 100.0, "the dragged wheel is helped by its partner: {handed} N");
    }
}

#[test]
fn property_a_parked_car_stays_on_a_slope_and_rolls_back_slowly_at_most() {
    let mut drive = Drive::new(torque_truck(), 0.0);
    drive.soil = firm();
    drive.slope = [0.1, 0.0];
    (0..100).for_each(|_| {
        drive.step(0.0, 0.0);
    });
    assert!(drive.state.velocity_m_s[0].abs() < 0.3, "{} m/s", drive.state.velocity_m_s[0]);
}

#[test]
fn property_a_slope_slows_the_car_until_the_integral_answers() {
    let speed_at = |steps: usize| {
        let mut drive = Drive::new(torque_truck(), 2.5);
        drive.soil = firm();
        drive.slope = [0.12, 0.0];
        (0..steps).for_each(|_| {
            drive.step(2.5, 0.0);
        });
        drive.state.velocity_m_s[0]
    };
    let (early, late) = (speed_at(10), speed_at(60));
    assert!(early < 2.5 && late > 2.0, "after 1 s {early}, after 6 s {late} m/s");
}

/// Goal: brakes stop a car and do not drive it. Method: from 3 m/s to a command of none or next to none, on loam and in mud, flat and up and down a slope of 10 %, where
/// what the speed control holds creeps; then told to go backwards.
#[test]
fn property_brakes_stop_a_car_and_do_not_drive_it() {
    for (soil, slope) in [loam(), mud()].into_iter().flat_map(|soil| [0.0, 0.1, -0.1].map(|slope| (soil, slope))) {
        let mut drive = Drive::new(torque_truck(), 3.0);
        (drive.soil, drive.slope) = (soil, [slope, 0.0]);
        (0..20).for_each(|_| _ = drive.step(3.0, 0.0));
        for k in 0..120 {
            drive.step(if k % 2 == 0 { 0.0 } else { -1e-6 }, 0.0);
            let forward_m_s = drive.state.velocity_m_s[0];
            let held = if slope == 0.0 { 0.005 } else { 0.07 };
            assert!(
                forward_m_s > -held && (k < 100 || forward_m_s < held),
                "{forward_m_s} m/s {k} steps after the command, slope {slope}, {soil:?}"
            );
        }
        (0..60).for_each(|_| _ = drive.step(-1.0, 0.0));
        assert!(drive.state.velocity_m_s[0] < -0.5, "told to go backwards: {:?}, slope {slope}, {soil:?}", drive.state.velocity_m_s);
    }
}
