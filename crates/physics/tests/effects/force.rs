//! Goal: bodies and wheels obey mechanics under each force effect. Method: closed forms in free space, statics on level and sloping ground, forces of one
//! sub-step.

use nesam_physics::driveline::measured_wheels;
use nesam_physics::effects::*;
use nesam_physics::step::{StepInput, StepModel, WheelContact};
use nesam_physics::{Control, Vehicle, VehicleState};
use nesam_test_vehicles::{robot, torque_truck, truck};

use crate::common::Drive;
use crate::settle;

/// Centre of mass of the truck over the ground where it stands, m.
const HEIGHT_M: f64 = 0.58;

/// The truck without weight, high over the ground, moving at a speed and heading; fine sub-steps.
fn in_space(effects: &[Effect], speed: f64, yaw: f64, seconds: usize) -> Drive {
    let vehicle = Vehicle { gravity_m_s2: 0.0, ..truck() }.with_effects(effects);
    let mut drive = Drive::new(vehicle.clone(), speed);
    drive.model = StepModel::new(&vehicle, 0.1, 40);
    drive.state.position_m[2] += 50.0;
    drive.state.attitude_rad[2] = yaw;
    (0..10 * seconds).for_each(|_| {
        drive.step(speed, 0.0);
    });
    drive
}

/// The state after a second there.
pub fn in_free_space(effects: &[Effect], speed: f64) -> VehicleState<f64> {
    in_space(effects, speed, 0.0, 1).state
}

/// Contacts at the first instant of a step from the same motion.
pub fn first_contacts(effects: &[Effect], speed: f64, second: f64, left_m_s: f64) -> [WheelContact<f64>; 4] {
    let (mut drive, _) = settle(&[], 2.0, 0.0, 40);
    let vehicle = truck().with_effects(effects);
    drive.model = StepModel::new(&vehicle, 0.05, 1);
    drive.state.velocity_m_s[1] = left_m_s;
    let (input, _) = drive.input(&Control { speed_m_s: speed, second });
    drive.model.step(&input).contacts
}

fn world_velocity(state: &VehicleState<f64>) -> [f64; 2] {
    let (sin, cos) = state.attitude_rad[2].sin_cos();
    let v = state.velocity_m_s;
    [cos * v[0] - sin * v[1], sin * v[0] + cos * v[1]]
}

#[test]
fn analytic_linear_drag_coasts_down_exponentially() {
    let v = in_space(&[Effect::LinearDrag(LinearDrag { n_s_m: 400.0 })], 4.0, 0.0, 5).state.velocity_m_s[0];
    let want = 4.0 * (-400.0 * 5.0 / 2493.56f64).exp();
    assert!((v / want - 1.0).abs() < 1e-3, "{v} {want}");
}

#[test]
fn analytic_quadratic_drag_coasts_down_hyperbolically() {
    let v = in_space(&[Effect::QuadraticDrag(QuadraticDrag { n_s2_m2: 100.0 })], 4.0, 0.0, 5).state.velocity_m_s[0];
    let want = 4.0 / (1.0 + 100.0 * 4.0 * 5.0 / 2493.56);
    assert!((v / want - 1.0).abs() < 1e-3, "{v} {want}");
}

#[test]
fn analytic_wind_pushes_in_world_whatever_the_heading() {
    for yaw in [0.0, 0.8, 2.5, -1.7] {
        let drive = in_space(&[Effect::Wind(Wind { fx_n: 500.0, fy_n: -300.0 })], 0.0, yaw, 2);
        let v = world_velocity(&drive.state);
        for (got, force) in v.iter().zip([500.0, -300.0]) {
            assert!((got - force * 2.0 / 2493.56).abs() < 1e-3, "yaw {yaw}: {v:?}");
        }
    }
}

#[test]
fn analytic_tow_is_balanced_by_the_tread_and_pitches_by_its_moment() {
    let towed = in_space(&[Effect::Tow(Tow { force_n: 800.0, z_m: 0.5 })], 0.0, 0.0, 1).state;
    assert!((towed.velocity_m_s[0] + 800.0 / 2493.56).abs() < 2e-3, "{}", towed.velocity_m_s[0]);
    // r × F with r = (0, 0, z) and F = (-T, 0, 0) points along -y: the nose goes up.
    // The floor under the damping of a tread acts in the air too: a few per cent of so slow a motion.
    assert!((towed.angular_velocity_rad_s[1] + 400.0 / 4121.7).abs() < 4e-3, "{}", towed.angular_velocity_rad_s[1]);
    let forward = |effects: &[Effect]| -> f64 {
        let (mut drive, _) = settle(effects, 2.0, 0.0, 120);
        drive.step(2.0, 0.0).contacts.iter().map(|c| c.forward_n).sum()
    };
    let pull = forward(&[Effect::Tow(Tow { force_n: 800.0, z_m: 0.0 })]) - forward(&[]);
    assert!((pull / 800.0 - 1.0).abs() < 0.02, "drawbar pull {pull}");
}

/// Goal: a base that resists turning by Wong's moment, and only one that skid-steers. Method: a robot that spins in the air, where nothing else resists: C W L / 4 over its
/// inertia in a fine step, either way round and with either sign; then a car.
#[test]
fn analytic_turning_resistance_slows_a_spinning_base_by_its_moment() {
    let slowed = |vehicle: &Vehicle, coefficient: f64, spin: f64| {
        let rate = |effects: &[Effect]| {
            let mut drive = Drive::new(vehicle.with_effects(effects), 0.0);
            drive.model = StepModel::new(&vehicle.with_effects(effects), 0.1, 40);
            drive.state.position_m[2] += 50.0;
            drive.state.angular_velocity_rad_s[2] = spin;
            drive.step(0.0, 0.0);
            drive.state.angular_velocity_rad_s[2]
        };
        rate(&[Effect::TurningResistance(TurningResistance { coefficient })]) - rate(&[])
    };
    // The tread's floor of damping acts in the air too.
    let want = 0.1 * 50.0 * 9.81 * 0.512 / 4.0 / 3.6 * 0.1;
    for (coefficient, spin, sign) in [(0.1, 2.0, -1.0), (0.1, -2.0, 1.0), (-0.1, 2.0, 1.0)] {
        let found = slowed(&robot(), coefficient, spin);
        assert!((found / (sign * want) - 1.0).abs() < 0.05, "{coefficient} {spin}: {found} {want}");
    }
    assert_eq!(slowed(&truck(), 0.1, 2.0), 0.0);
}

#[test]
fn analytic_centre_of_mass_loads_axles_and_sides_by_the_lever_rule() {
    let weight = 2493.56 * 9.81;
    let (_, loads) = settle(&[Effect::CgForward(CgForward { metres: 0.2 })], 0.0, 0.0, 100);
    let front = weight * (1.7028 + 0.2) / (1.5949 + 1.7028);
    assert!(((loads[0] + loads[1]) / front - 1.0).abs() < 0.02, "front axle {} {front}", loads[0] + loads[1]);
    let (drive, loads) = settle(&[Effect::CgLateral(CgLateral { metres: 0.1 })], 0.0, 0.0, 100);
    let difference = loads[0] + loads[2] - loads[1] - loads[3];
    // The body leans to the heavier side over wheels that stand fast, and its centre of mass over theirs with it.
    let over_wheels_m = -truck().wheel_centre_m[0][2];
    let want = 2.0 * weight * (0.1 - over_wheels_m * drive.state.attitude_rad[0].sin()) / 1.8276;
    assert!((difference / want - 1.0).abs() < 0.005, "left - right {difference} {want}");
}

#[test]
fn analytic_a_higher_centre_of_mass_moves_load_down_a_side_slope() {
    let angle = 0.1f64;
    let lower_minus_upper = |effects: &[Effect]| {
        let mut drive = Drive::new(truck().with_effects(effects), 1.0);
        drive.slope = [0.0, angle.tan()];
        drive.state.attitude_rad[0] = angle;
        let mut loads = [0.0; 4];
        (0..100).for_each(|_| loads = drive.step(1.0, 0.0).contacts.map(|c| c.normal_n));
        (loads[1] + loads[3] - loads[0] - loads[2], drive.state.attitude_rad[0].sin())
    };
    let [(high, leaning), (low, less)] = [vec![Effect::CgHeight(CgHeight { metres: 0.3 })], vec![]].map(|e| lower_minus_upper(&e));
    let want = 2.0 * 2493.56 * 9.81 * ((HEIGHT_M + 0.3) * leaning - HEIGHT_M * less) / 1.8276;
    assert!(((high - low) / want - 1.0).abs() < 0.05, "{high} {low} {want}");
}

#[test]
fn analytic_rolling_resistance_is_a_share_of_the_load() {
    let [with, without] = [vec![Effect::RollingResistance(RollingResistance { coefficient: 0.03 })], vec![]]
        .map(|effects| first_contacts(&effects, 2.0, 0.0, 0.0));
    for (a, b) in with.iter().zip(&without) {
        assert!((a.forward_n - b.forward_n + 0.03 * b.normal_n).abs() < 0.01 * 0.03 * b.normal_n, "{} {}", a.forward_n, b.forward_n);
    }
}

#[test]
fn analytic_smaller_front_wheels_lower_the_nose_and_larger_rims_drive_faster() {
    let pitch = |effects: &[Effect]| settle(effects, 0.0, 0.0, 100).0.state.attitude_rad[1];
    let lower = pitch(&[Effect::TyreRadiusFront(TyreRadiusFront { relative: -0.05 })]) - pitch(&[]);
    let want = 0.05 * 0.467 / (1.5949 + 1.7028);
    assert!((lower / want - 1.0).abs() < 0.15, "{lower} {want}");
    let speed = |effects: &[Effect], command: f64| {
        let mut drive = Drive::new(robot().with_effects(effects), command);
        (0..80).for_each(|_| {
            drive.step(command, 0.0);
        });
        drive.state.velocity_m_s[0]
    };
    let both = [Effect::TyreRadiusFront(TyreRadiusFront { relative: 0.05 }), Effect::TyreRadiusRear(TyreRadiusRear { relative: 0.05 })];
    let all = [Effect::TyreRadius(TyreRadius { relative: 0.05 })];
    assert_eq!(truck().with_effects(&all).effects, truck().with_effects(&both).effects);
    let ratio = speed(&all, 0.8) / speed(&[], 1.05 * 0.8);
    // Larger wheels slip and sink a little less, too.
    assert!((ratio - 1.0).abs() < 0.025, "{ratio}");
}

#[test]
fn analytic_stiffness_against_roll_and_pitch_divides_the_lean_on_hard_ground() {
    let lean = |effects: &[Effect], load: Effect, axis: usize| {
        let tilt = |effects: &[Effect]| {
            let mut drive = Drive::new(truck().with_effects(effects), 0.0);
            (drive.soil.k_phi, drive.soil.k_c) = (5e8, 0.0);
            (0..100).for_each(|_| {
                drive.step(0.0, 0.0);
            });
            drive.state.attitude_rad[axis]
        };
        let with: Vec<Effect> = effects.iter().copied().chain([load]).collect();
        tilt(&with) - tilt(effects)
    };
    let load = Effect::CgLateral(CgLateral { metres: 0.2 });
    let ratio = lean(&[Effect::RollStiffness(RollStiffness { relative: 0.5 })], load, 0) / lean(&[], load, 0);
    assert!((ratio - 1.0 / 1.5).abs() < 0.03, "roll {ratio}");
    let load = Effect::CgForward(CgForward { metres: 0.3 });
    let ratio = lean(&[Effect::PitchStiffness(PitchStiffness { relative: 0.5 })], load, 1) / lean(&[], load, 1);
    // Springs of 107 and 236 kN/m do not pitch about the middle, so heave takes part.
    assert!((0.6..0.85).contains(&ratio), "pitch {ratio}");
}

#[test]
fn analytic_a_friction_cap_holds_at_every_wheel() {
    let mut drive = Drive::new(truck().with_effects(&[Effect::FrictionCap(FrictionCap { mu: 0.08 })]), 2.0);
    drive.slope = [0.1, 0.05];
    for k in 0..30 {
        for contact in drive.step(3.0, if k < 15 { 0.8 } else { -0.8 }).contacts {
            assert!(contact.forward_n.hypot(contact.left_n) <= 0.08 * contact.normal_n + 1e-9);
        }
    }
    let bits = |effects: &[Effect]| settle(effects, 2.0, 0.3, 20).0.state.to_array().map(f64::to_bits);
    assert_eq!(bits(&[Effect::FrictionCap(FrictionCap { mu: 3.0 })]), bits(&[]), "a cap that is not reached changes no bit");
}

/// In a slide, M (Δv / h + ω × v) of a sub-step is what the wheels are left with. Within a third: forces change with the velocity on the way.
#[test]
fn analytic_a_friction_cap_bounds_what_moves_the_body() {
    let (mu, h, turn_rad_s) = (0.03, 0.05, 0.6);
    let (mut drive, _) = settle(&[], 2.0, 0.0, 40);
    drive.model = StepModel::new(&truck().with_effects(&[Effect::FrictionCap(FrictionCap { mu })]), h, 1);
    let velocity_m_s = [6.0, -2.0, 0.0];
    (drive.state.velocity_m_s, drive.state.angular_velocity_rad_s) = (velocity_m_s, [0.0, 0.0, turn_rad_s]);
    let (input, _) = drive.input(&Control { speed_m_s: 6.0, second: 0.0 });
    let output = drive.model.step(&input);
    let gained = output.increment.velocity_m_s;
    let ahead = gained[0] / h - turn_rad_s * velocity_m_s[1];
    let left = gained[1] / h + turn_rad_s * velocity_m_s[0];
    let (force, load) = (truck().mass_kg * ahead.hypot(left), output.contacts.iter().map(|c| c.normal_n).sum::<f64>());
    assert!(force < 1.3 * mu * load, "{force} N at a load of {load} N");
}

#[test]
fn analytic_a_free_form_is_its_wrench_inside_its_region_and_held_outside() {
    let mut form = FreeForm { speed_low_m_s: 1.0, speed_high_m_s: 3.0, angle_max_rad: 0.4, slope_max: 0.2, ..FreeForm::default() };
    form.wrench[0] = [-100.0, 50.0, 0.0, 1000.0];
    form.wrench[5] = [20.0, 0.0, 500.0, 0.0];
    let [force, moment]: [[f64; 3]; 2] = form.at(2.5, 0.2, 0.1, 0.0);
    assert!((force[0] - (-100.0 + 25.0 + 100.0)).abs() < 1e-9 && (moment[2] - 120.0).abs() < 1e-9, "{force:?} {moment:?}");
    assert_eq!(form.at(9.0, 2.0, 5.0, 0.0), form.at(3.0, 0.4, 0.2, 0.0));
    // In free space a constant force accelerates the mass, over a second.
    form.wrench = [[0.0; 4]; 6];
    form.wrench[0][0] = -500.0;
    let v = in_free_space(&[Effect::FreeForm(form)], 2.0).velocity_m_s[0];
    assert!((v - (2.0 - 500.0 / 2493.56)).abs() < 2e-5, "{v}");
}

/// Goal: measured wheel speeds are rim speeds of the wheels that are mounted, of a car under torque too. Method: the over-speed of each contact at the first instant, by the
/// radius.
#[test]
fn regress_measured_rims_of_a_car_under_torque_turn_with_the_radius() {
    let (speed, relative) = (2.0, 0.1);
    let effects = [Effect::TyreRadius(TyreRadius { relative })];
    for (radius, effects) in [(1.0, &effects[..0]), (1.0 + relative, &effects[..])] {
        let car = torque_truck().with_effects(effects);
        let drive = Drive::new(car.clone(), speed);
        let (input, _) = drive.input(&Control { speed_m_s: speed, second: 0.0 });
        let wheels = measured_wheels(&car, &[speed / car.wheel_radius_m; 4], &[0.0; 4]);
        for contact in StepModel::new(&car, 0.05, 1).step(&StepInput { wheels, ..input }).contacts {
            assert!((contact.overspeed_m_s - (radius - 1.0) * speed).abs() < 1e-9, "{}", contact.overspeed_m_s);
        }
    }
}

/// Goal: a drag that is large against the mass stops a vehicle and does not throw it back. Method: a car of 6 kg in drags up to the end of their range, told to stand; it
/// comes to rest from 1 m/s but for what its springs make of it (5 cm/s).
#[test]
fn regress_a_large_drag_stops_a_light_vehicle() {
    let share = 6.0 / truck().mass_kg;
    let mut car = Vehicle { mass_kg: 6.0, inertia_kg_m2: truck().inertia_kg_m2.map(|row| row.map(|x| x * share)), ..truck() };
    (car.suspension_n_m, car.suspension_n_s_m) = (car.suspension_n_m.map(|x| x * share), car.suspension_n_s_m.map(|x| x * share));
    let drags = [200.0, 400.0, 1500.0].map(|n_s_m| Effect::LinearDrag(LinearDrag { n_s_m }));
    for drag in drags.into_iter().chain([Effect::QuadraticDrag(QuadraticDrag { n_s2_m2: 500.0 })]) {
        let mut drive = Drive::new(car.with_effects(&[drag]), 1.0);
        let mut before = 1.0;
        for _ in 0..20 {
            drive.step(0.0, 0.0);
            let speed = drive.state.velocity_m_s[0];
            assert!(speed > -0.05 && speed < before + 0.05, "{drag:?}: {before} {speed}");
            before = speed;
        }
    }
}

/// Goal: effects that leave no body are refused by their names, in the phase in which they do. Method: a payload that takes more than there is, one that takes mass from
/// where none is, and one that another one makes up for from the start, or later.
#[test]
fn regress_effects_that_leave_no_body_are_refused() {
    let payload = |mass_kg: f64, x_m: f64| Effect::Payload(Payload { mass_kg, at_m: [x_m, 0.0, 0.0] });
    let from = |effect: Effect, onset_s: f64| ScheduledEffect { effect, onset_s };
    let offset = Effect::SteeringOffset(SteeringOffset { second: 0.1 });
    let error = robot().check_effects(&[offset.into(), payload(-60.0, 0.0).into()], 0.1).unwrap_err();
    assert!(error.contains("`robot` a mass of -10 kg (by `payload`)"), "{error}");
    let error = robot().check_effects(&[offset.into(), payload(-40.0, 1.0).into()], 0.1).unwrap_err();
    assert!(error.contains("inertia") && error.contains("(by `payload`)"), "{error}");
    robot().check_effects(&[payload(-60.0, 0.0).into(), payload(60.0, 0.0).into()], 0.1).unwrap();
    robot().check_effects(&[payload(-60.0, 0.0).into(), from(payload(60.0, 0.0), 5.0)], 0.1).unwrap_err();
    // What the catalogue gives as typical of a car can be put on one, each and all at once.
    let examples: Vec<ScheduledEffect> = Effect::examples().into_iter().map(ScheduledEffect::from).collect();
    truck().check_effects(&examples, 0.1).unwrap();
}

/// Goal: two free forms act each in its own region. Method: forces ahead in free space, over a second, of one alone and of two.
#[test]
fn regress_free_forms_of_two_regions_act_beside_each_other() {
    let form = |speed_high_m_s: f64, force_n: f64, per_speed: f64| {
        let mut form = FreeForm { speed_low_m_s: 0.0, speed_high_m_s, ..FreeForm::default() };
        form.wrench[0] = [force_n, per_speed, 0.0, 0.0];
        Effect::FreeForm(form)
    };
    let gained = |effects: &[Effect]| in_free_space(effects, 2.0).velocity_m_s[0] - 2.0;
    let (one, other) = (form(1.0, -300.0, 100.0), form(4.0, -200.0, 0.0));
    let both = gained(&[one, other]);
    assert!((both - gained(&[one]) - gained(&[other])).abs() < 2e-5, "{both}");
    assert_eq!(truck().with_effects(&[other, other]).effects, truck().with_effects(&[form(4.0, -400.0, 0.0)]).effects, "more of the same");
}
