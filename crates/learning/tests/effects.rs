//! Goal: effects act alike in rollouts, tangents and the reference, in measured coordinates, and from their onsets on.
//! Method: the same query through a predictor with each effect of the catalogue; exact comparison where nothing may change.

mod common;

use std::sync::{Arc, OnceLock};

use common::{drive, hills, lively_weights, measured_scales, predictor_of, truck};
use nesam_model::{HistoryStep, Predictor, Rollout, RolloutQuery, Variant};
use nesam_physics::effects::*;
use nesam_physics::{Driveline, SoilCoordinates, SoilCorrection, TorqueDrive, Vehicle, VehicleState};
use nesam_terrain::WorldMap;
use nesam_test_vehicles::torque_truck;

struct Scene {
    map: Arc<WorldMap>,
    predictor: Predictor,
    history: Vec<HistoryStep>,
    start: VehicleState<f64>,
    controls: Vec<f32>,
    soil_correction: SoilCorrection,
}

const HORIZON: usize = 12;

fn scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| scene_of(truck(), SoilCorrection::NONE))
}

/// The same with a speed control whose integral is observed, on ground that is known to be softer than it looks.
fn observed_scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| {
        let car = torque_truck();
        let torque = car.driveline.torque.map(|torque| TorqueDrive { integral_observer_per_s: 1.0, ..torque });
        let driveline = Driveline { torque, ..car.driveline.clone() };
        let delta = [-0.8, -0.8, 0.0, 0.0, 0.0, 0.0];
        scene_of(Vehicle { driveline, ..car }, SoilCorrection { coordinates: SoilCoordinates::Logarithmic, delta })
    })
}

fn scene_of(vehicle: Vehicle, soil_correction: SoilCorrection) -> Scene {
    let map = hills();
    let drive = drive(Some(&map), 60);
    let scales = measured_scales(&drive);
    let controls = drive.controls[33..33 + HORIZON].iter().flat_map(|c| [c.speed_m_s as f32 + 0.3, c.second as f32 + 0.1]).collect();
    let predictor = predictor_of(vehicle, &scales, lively_weights(&scales));
    Scene { predictor, history: drive.history(2, 33), start: drive.states[33], controls, map, soil_correction }
}

impl Scene {
    fn query(&self, start_time_s: Option<f64>) -> RolloutQuery<'_> {
        RolloutQuery {
            history: &self.history,
            start: self.start,
            controls: &self.controls,
            samples: 1,
            horizon: HORIZON,
            map: Some(&self.map),
            soil_correction: self.soil_correction,
            variant: Variant::Full,
            start_time_s,
            wheels: None,
        }
    }

    fn with<E: Copy + Into<ScheduledEffect>>(&self, effects: &[E], start_time_s: Option<f64>) -> Rollout {
        self.predictor.with_effects(effects).rollout(&self.query(start_time_s)).expect("a valid query")
    }

    /// The rollout from 4 s on, which the tangents have to agree with.
    fn agreeing(&self, scheduled: ScheduledEffect) -> Rollout {
        let (predictor, query) = (self.predictor.with_effects(&[scheduled]), self.query(Some(4.0)));
        let fast = predictor.rollout(&query).expect("a valid query");
        let exact = predictor.linearise(&query).expect("a valid query").remove(0);
        for (k, state) in exact.states().enumerate() {
            for (i, (a, b)) in fast.state(0, k).to_array().iter().zip(state.to_array()).enumerate() {
                // f32 against f64, and the ground at the pose against the ground in the table of the fast path.
                assert!((f64::from(*a) - b).abs() < 2e-3, "{} step {k}, entry {i}: {a} {b}", scheduled.effect.id());
            }
        }
        fast
    }
}

#[test]
fn property_absent_effects_change_no_bit_of_a_rollout() {
    let plain = scene().with::<Effect>(&[], Some(4.0));
    for effect in Effect::examples() {
        assert_eq!(scene().with(&[effect.scaled(0.0)], Some(4.0)), plain, "{}", effect.id());
    }
}

#[test]
fn property_tangents_and_fast_path_agree_on_every_effect() {
    let scene = scene();
    let plain = scene.with::<Effect>(&[], Some(4.0));
    for effect in Effect::examples() {
        let fast = scene.agreeing(effect.into());
        let moved = fast.states.iter().zip(&plain.states).any(|(a, b)| (a - b).abs() > 1e-5);
        // Of a car the rims are not turned against each other.
        assert_eq!(moved, !effect.is_of_skid_steer(), "{}", effect.id());
    }
}

/// What the speed control made up for before the start is another thing with more weight, less torque or another contact.
#[test]
fn property_tangents_and_fast_path_agree_on_effects_that_begin_on_the_way() {
    for id in ["payload", "torque_limit", "elastic_recovery"] {
        let effect = Effect::example(id).expect("an effect of the catalogue");
        observed_scene().agreeing(ScheduledEffect { effect, onset_s: 4.5 });
    }
}

#[test]
fn property_an_effect_acts_from_its_onset_on() {
    for scene in [scene(), observed_scene()] {
        let plain = scene.with::<Effect>(&[], Some(4.0));
        for effect in Effect::examples() {
            let from = |onset_s: f64| scene.with(&[ScheduledEffect { effect, onset_s }], Some(4.0));
            assert_eq!(from(4.0 + 0.1 * HORIZON as f64 + 0.05), plain, "{} after the horizon", effect.id());
            let later = from(4.5);
            for k in 0..4 {
                assert_eq!(later.state(0, k), plain.state(0, k), "{} before its onset, step {k}", effect.id());
            }
        }
    }
    let scene = scene();
    let plain = scene.with::<Effect>(&[], Some(4.0));
    let offset = Effect::SteeringOffset(SteeringOffset { second: 0.1 });
    let scheduled = ScheduledEffect { effect: offset, onset_s: 4.5 };
    let (later, always) = (scene.with(&[scheduled], Some(4.0)), scene.with(&[offset], Some(4.0)));
    let yaw = |r: &Rollout| r.state(0, HORIZON - 1).attitude_rad[2];
    assert!(yaw(&plain) + 1e-3 < yaw(&later) && yaw(&later) + 1e-3 < yaw(&always), "{} {} {}", yaw(&plain), yaw(&later), yaw(&always));
    assert_eq!(scene.with(&[scheduled], None), scene.with(&[offset], None), "without a time all effects have begun");
}

#[test]
fn property_sensor_effects_report_the_same_motion_through_other_eyes() {
    let scene = scene();
    let sensors: Vec<Effect> = Effect::examples().into_iter().filter(|e| e.layer() == Layer::Sensor && e.id() != "clock_drift").collect();
    let mut terms = EffectTerms::default();
    sensors.iter().for_each(|e| e.add_to(&mut terms));
    let seen = |state: &VehicleState<f64>| terms.sensor.to_measured(state);
    let history: Vec<HistoryStep> = scene.history.iter().map(|s| HistoryStep { state: seen(&s.state), ..*s }).collect();
    let query = RolloutQuery { history: &history, start: seen(&scene.start), ..scene.query(None) };
    let through = scene.predictor.with_effects(&sensors).rollout(&query).expect("a valid query");
    let plain = scene.with::<Effect>(&[], None);
    for k in 0..HORIZON {
        let want = seen(&plain.state(0, k).map(f64::from)).to_array();
        for (i, (got, want)) in through.state(0, k).to_array().iter().zip(want).enumerate() {
            assert!((f64::from(*got) - want).abs() < 1e-4, "step {k}, entry {i}: {got} {want}");
        }
    }
}

#[test]
fn property_a_raised_map_and_vehicle_are_the_same_scene() {
    let scene = scene();
    let raised = |state: &VehicleState<f64>| {
        let mut state = *state;
        state.position_m[2] += 0.25;
        state
    };
    let history: Vec<HistoryStep> = scene.history.iter().map(|s| HistoryStep { state: raised(&s.state), ..*s }).collect();
    let query = RolloutQuery { history: &history, start: raised(&scene.start), ..scene.query(None) };
    let offset = [Effect::MapOffset(MapOffset { z_m: 0.25 })];
    let higher = scene.predictor.with_effects(&offset).rollout(&query).expect("a valid query");
    let plain = scene.with::<Effect>(&[], None);
    for k in 0..HORIZON {
        let want = raised(&plain.state(0, k).map(f64::from)).to_array();
        for (got, want) in higher.state(0, k).to_array().iter().zip(want) {
            assert!((f64::from(*got) - want).abs() < 1e-4, "step {k}: {got} {want}");
        }
    }
}

/// Goal: the network is asked about the pose that the vehicle would have without what effects make of its ride. Method: with a load, what it says of a pose
/// is what it says without one of the pose without the shift, to the bit.
#[test]
fn property_the_network_is_asked_about_the_ride_that_it_knows() {
    let scene = scene();
    let loaded = scene.predictor.with_effects(&[Effect::Payload(Payload { mass_kg: 600.0, at_m: [-1.4, 0.2, 0.8] })]);
    let model = loaded.step_model();
    let [up_m, roll_rad, pitch_rad] = *model.ride_shift();
    assert!(up_m < -0.005 && roll_rad < -1e-4 && pitch_rad < -1e-3, "{up_m} m, {roll_rad} {pitch_rad} rad");

    let known: Vec<HistoryStep> = scene.history.iter().map(|step| HistoryStep { state: model.as_known(&step.state), ..*step }).collect();
    let asked = |predictor: &Predictor, history: &[HistoryStep], start: &VehicleState<f64>| {
        let control = history[history.len() - 1].control;
        predictor.transition(history, start, &control, Some(&scene.map))
    };
    let with = asked(&loaded, &scene.history, &scene.start);
    let without = asked(&scene.predictor, &known, &model.as_known(&scene.start));
    assert_eq!(with.hidden, without.hidden);
    assert_eq!(with.residual, without.residual);
    assert_ne!(with.hidden, asked(&scene.predictor, &scene.history, &scene.start).hidden);
    // Asked from outside, for effects that the bundle does not have, it says the same but for the place of one rounding.
    let outside = asked(&scene.predictor.asked_without(model.ride_shift()), &scene.history, &scene.start);
    for (a, b) in with.residual.iter().zip(outside.residual) {
        assert!((a - b).abs() < 1e-4 * a.abs().max(1e-2), "{a} {b}");
    }
}
