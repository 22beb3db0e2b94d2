//! Goal: every kind of measurement gets its typed answer and only accepted ones leave a trace.

use nesam_adaptation::FilterConfig;
use nesam_physics::{Control, Driveline, SecondCommand, VehicleState};

use super::*;
use crate::measurement::WheelMeasurement;

const STEP_NS: i64 = 100_000_000;

fn cart() -> Vehicle {
    Vehicle {
        name: "cart".into(),
        mass_kg: 100.0,
        inertia_kg_m2: [[5.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 12.0]],
        inertia_estimated: true,
        wheel_centre_m: [[0.5, 0.3, -0.1], [0.5, -0.3, -0.1], [-0.5, 0.3, -0.1], [-0.5, -0.3, -0.1]],
        wheel_radius_m: 0.2,
        wheel_width_m: 0.1,
        suspension_n_m: [1e4; 4],
        suspension_n_s_m: [1e3; 4],
        second: SecondCommand::RoadWheelAngleRad,
        command_range: [[-1.0, 3.0], [-0.5, 0.5]],
        steering: None,
        track_m: 0.6,
        wheelbase_m: 1.0,
        driveline: Driveline {
            steering_lag_s: 0.1,
            steering_rate_limit_per_s: 1.0,
            speed_gain: 0.5,
            overspeed_limit_m_s: 1.0,
            rims: Default::default(),
            side_coupling_n_m_s: 0.0,
            speed_integral_gain_per_s: 0.0,
            speed_integral_leak_s: 1.0,
            speed_integral_limit_m: 0.0,
        },
        gravity_m_s2: 9.81,
        effects: Default::default(),
    }
}

fn at(stamp_ns: i64) -> Measurement {
    let mut state = VehicleState::zero();
    state.position_m[0] = stamp_ns as f64 * 1e-9;
    Measurement { sequence: None, stamp_ns, state, command: Control { speed_m_s: 1.0, second: 0.0 }, wheels: WheelMeasurement::default() }
}

fn observe(session: &mut Session, measurement: &Measurement) -> Result<Outcome, EngineError> {
    session.observe(measurement, 0, Rules { step_ns: STEP_NS, vehicle: &cart(), limits: &Limits::default() })
}

/// A session with `n` steps.
fn driven(n: i64) -> Session {
    let mut session = Session::new("s", "v", None, SoilFilter::new(FilterConfig::default()).unwrap(), 0);
    for i in 0..n {
        assert_eq!(observe(&mut session, &at(i * STEP_NS)), Ok(Outcome::Applied));
    }
    session
}

#[test]
fn analytic_history_holds_the_newest_32_steps() {
    let session = driven(40);
    assert_eq!(session.history().len(), HISTORY);
    assert_eq!(session.history_epoch(), 40);
    assert_eq!(session.newest().unwrap().state.position_m[0], at(39 * STEP_NS).state.position_m[0]);
    assert_eq!(session.history()[0].state.position_m[0], at(8 * STEP_NS).state.position_m[0]);
}

#[test]
fn analytic_resent_and_late_measurements_change_nothing() {
    let mut session = driven(5);
    let before = format!("{session:?}");
    for i in 0..5 {
        assert_eq!(observe(&mut session, &at(i * STEP_NS)), Ok(Outcome::Duplicate));
    }
    assert_eq!(observe(&mut session, &at(STEP_NS / 2)), Ok(Outcome::TooOld { behind_s: seconds(350_000_000) }));
    let numbered = Measurement { sequence: Some(7), ..at(5 * STEP_NS) };
    assert_eq!(format!("{session:?}"), before);
    assert_eq!(observe(&mut session, &numbered), Ok(Outcome::Applied));
    assert_eq!(observe(&mut session, &Measurement { sequence: Some(7), ..at(6 * STEP_NS) }), Ok(Outcome::Duplicate));
    assert_eq!(observe(&mut session, &Measurement { sequence: Some(6), ..at(6 * STEP_NS) }), Ok(Outcome::TooOld { behind_s: 0.0 }));
}

#[test]
fn analytic_dense_stamps_are_thinned_and_gaps_restart_the_history() {
    let mut session = driven(1);
    for i in 1..10 {
        assert_eq!(observe(&mut session, &at(i * STEP_NS / 10)).map(|o| o.label()), Ok("buffered"));
    }
    assert_eq!(observe(&mut session, &at(STEP_NS)), Ok(Outcome::Applied));
    assert_eq!(session.history().len(), 2);
    assert_eq!(observe(&mut session, &at(10 * STEP_NS)), Ok(Outcome::Gap { gap_s: seconds(9 * STEP_NS) }));
    assert_eq!((session.history().len(), session.history_epoch()), (1, 3));
    assert_eq!(observe(&mut session, &at(11 * STEP_NS)), Ok(Outcome::Applied));
}

#[test]
fn property_no_bad_number_gets_in() {
    let mut session = driven(3);
    let before = format!("{session:?}");
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for i in 0..12 {
            let mut x = at(3 * STEP_NS).state.to_array();
            x[i] = bad;
            let measurement = Measurement { state: VehicleState::from_array(x), ..at(3 * STEP_NS) };
            assert!(matches!(observe(&mut session, &measurement), Ok(Outcome::NotFinite { .. })));
        }
        let mut wheels = at(3 * STEP_NS);
        wheels.wheels.speed_rad_s = Some([0.0, 0.0, bad, 0.0]);
        assert_eq!(observe(&mut session, &wheels), Ok(Outcome::NotFinite { field: "wheels.speed_rad_s[2]".into() }));
    }
    for (measurement, field) in [
        (Measurement { command: Control { speed_m_s: 3.01, second: 0.0 }, ..at(3 * STEP_NS) }, "command.speed_m_s"),
        (Measurement { command: Control { speed_m_s: 3.0, second: -0.51 }, ..at(3 * STEP_NS) }, "command.second"),
        (Measurement { stamp_ns: i64::MAX, ..at(3 * STEP_NS) }, "stamp_ns"),
        (at(i64::MAX), "state.position_m.x"),
    ] {
        assert_eq!(observe(&mut session, &measurement).unwrap_err().field(), field);
    }
    assert_eq!(format!("{session:?}"), before);
}
