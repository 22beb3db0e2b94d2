//! Goal: what somebody writes down acts as mechanics says. Method: closed forms in free space, the same effect of the catalogue.

use nesam_physics::effects::written::{AXES, WrittenParameter, WrittenText};
use nesam_physics::effects::{Effect, LinearDrag, QuadraticDrag, ScheduledEffect, Written};
use nesam_test_vehicles::truck;

use crate::force::in_free_space;

fn written(id: &str, formulas: &[(&str, &str)], parameters: &[(&str, f64, &str)]) -> Effect {
    let mut text = WrittenText { id: id.into(), ..WrittenText::default() };
    for (axis, formula) in formulas {
        text.formulas[AXES.iter().position(|a| a == axis).unwrap()] = (*formula).into();
    }
    let parameter = |(name, value, unit): &(&str, f64, &str)| WrittenParameter {
        name: (*name).into(),
        value: *value,
        unit: (*unit).into(),
        range: [-1e6, 1e6],
    };
    text.parameters = parameters.iter().map(parameter).collect();
    Effect::Written(Written::read(&text).unwrap())
}

#[test]
fn analytic_a_constant_force_accelerates_and_a_constant_moment_turns() {
    let truck = truck();
    let push = written("push", &[("force_x", "f"), ("moment_z", "m")], &[("f", 500.0, "N"), ("m", 300.0, "N m")]);
    let state = in_free_space(&[push], 2.0);
    let yaw_rate = 300.0 / truck.inertia_kg_m2[2][2];
    assert!((state.angular_velocity_rad_s[2] / yaw_rate - 1.0).abs() < 1e-2, "{state:?}");
    let speed = 2.0 + 500.0 / truck.mass_kg;
    assert!((state.velocity_m_s[0] - speed).abs() < 0.01, "{state:?} {speed}");
    assert_eq!(in_free_space(&[push.scaled(0.0)], 2.0), in_free_space(&[], 2.0), "scaled away");
}

#[test]
fn analytic_a_written_drag_is_that_of_the_catalogue() {
    let drag =
        written("my_drag", &[("force_x", "-k * v_ahead - q * v_ahead * abs(v_ahead)")], &[("k", 200.0, "N s/m"), ("q", 30.0, "kg/m")]);
    let named = [Effect::LinearDrag(LinearDrag { n_s_m: 200.0 }), Effect::QuadraticDrag(QuadraticDrag { n_s2_m2: 30.0 })];
    let [own, theirs] = [&[drag][..], &named[..]].map(|effects| in_free_space(effects, 4.0).velocity_m_s[0]);
    assert!((own - theirs).abs() < 1e-5, "{own} {theirs}");
}

#[test]
fn property_a_written_wrench_is_bounded_and_at_most_four_act() {
    let mad = written("mad", &[("force_x", "f / (v_ahead * 0)")], &[("f", 1.0, "N m/s")]);
    let state = in_free_space(&[mad], 2.0);
    assert!(state.velocity_m_s[0].is_finite() && state.velocity_m_s[0].abs() < 200.0, "{state:?}");
    let small = |i: usize| written(&format!("small_{i}"), &[("force_y", "f")], &[("f", 100.0, "N")]);
    let effects: Vec<Effect> = (0..6).map(small).collect();
    assert_eq!(in_free_space(&effects, 2.0), in_free_space(&effects[..4], 2.0));
}

#[test]
fn property_what_is_no_number_is_nothing() {
    let nothing = in_free_space(&[], 2.0);
    let undefined = written("undefined", &[("force_x", "f * (v_ahead - v_ahead) / (v_ahead - v_ahead)")], &[("f", 1e3, "N")]);
    assert_eq!(in_free_space(&[undefined], 2.0), nothing, "0 / 0");
    let infinite = written("infinite", &[("force_x", "f / (v_ahead * 0)")], &[("f", 1.0, "N m/s")]);
    assert_eq!(in_free_space(&[infinite.scaled(0.0)], 2.0), nothing, "an infinite force, scaled away");
}

#[test]
fn property_a_written_effect_is_read_once_and_none_of_the_catalogue() {
    let [one, two] = [0, 1].map(|_| written("twice", &[("force_z", "f")], &[("f", 1.0, "N")]));
    assert_eq!(one, two);
    assert!(!Effect::IDS.contains(&one.id()) && !Effect::examples().iter().any(|e| e.id() == "twice"));
    let scheduled = ScheduledEffect::from(one);
    assert_eq!((scheduled.effect.id(), scheduled.effect.parameters()[0].unit), ("twice", "N"));
}
