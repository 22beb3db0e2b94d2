//! Goal: every kind of measurement gets its typed answer and only accepted ones leave a trace.

use nesam_adaptation::FilterConfig;
use nesam_model::HISTORY;
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
            torque: None,
            speed_integral_gain_per_s: 0.0,
            speed_integral_leak_s: 1.0,
            speed_integral_limit_m: 0.0,
        },
        gravity_m_s2: 9.81,
        contact_law: Default::default(),
        soil_damping_pa_s_m: 0.0,
        effects: Default::default(),
    }
}

fn at(stamp_ns: i64) -> Measurement {
    let mut state = VehicleState::zero();
    state.position_m[0] = (stamp_ns % (10_000 * STEP_NS)) as f64 * 1e-9;
    let command = Control { speed_m_s: 1.0, second: 0.0 };
    Measurement { sequence: None, boot: None, stamp_ns, state, command, wheels: WheelMeasurement::default() }
}

fn numbered(stamp_ns: i64, sequence: u64) -> Measurement {
    Measurement { sequence: Some(sequence), ..at(stamp_ns) }
}

fn observe_at(session: &mut Session, measurement: &Measurement, now_ns: u64) -> Result<Outcome, EngineError> {
    let rules = Rules { step_ns: STEP_NS, vehicle: &cart(), limits: &Limits::default() };
    session.observe(measurement, now_ns, rules).map(|observed| observed.outcome)
}

fn observe(session: &mut Session, measurement: &Measurement) -> Result<Outcome, EngineError> {
    observe_at(session, measurement, 0)
}

/// Everything that a refused measurement may not change: all but the suspicion that a clock was set.
fn trace(session: &Session) -> String {
    let mut session = session.clone();
    session.order.suspect = None;
    format!("{session:?}")
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
    let before = trace(&session);
    for i in 0..5 {
        assert_eq!(observe(&mut session, &at(i * STEP_NS)), Ok(Outcome::Duplicate));
    }
    // The newest is 0.4 s: the window ends at 0.2 s, and what lies on its edge is final.
    assert_eq!(observe(&mut session, &at(STEP_NS / 2)), Ok(Outcome::TooOld { behind_s: seconds(350_000_000) }));
    assert_eq!(trace(&session), before);
    assert_eq!(observe(&mut session, &numbered(5 * STEP_NS, 7)), Ok(Outcome::Applied));
    assert_eq!(observe(&mut session, &numbered(6 * STEP_NS, 7)), Ok(Outcome::Duplicate));
    assert_eq!(observe(&mut session, &numbered(6 * STEP_NS, 6)), Ok(Outcome::TooOld { behind_s: 0.0 }));
}

#[test]
fn analytic_the_window_holds_at_its_edge() {
    let window_ns = Limits::default().reorder_window_ns();
    for (behind_ns, outcome) in [(window_ns, "too_old"), (window_ns - 1, "buffered")] {
        let mut session = driven(7);
        let newest_ns = 6 * STEP_NS + STEP_NS / 2;
        observe(&mut session, &at(newest_ns)).unwrap();
        assert_eq!(observe(&mut session, &at(newest_ns - behind_ns)).unwrap().label(), outcome, "{behind_ns} ns behind");
    }
}

#[test]
fn analytic_a_late_measurement_heals_the_gap_that_it_left() {
    let (whole, mut healed) = (driven(9), driven(7));
    assert_eq!(observe(&mut healed, &at(8 * STEP_NS)), Ok(Outcome::Gap { gap_s: 0.2 }));
    assert_eq!(healed.history().len(), 1);
    let rules = Rules { step_ns: STEP_NS, vehicle: &cart(), limits: &Limits::default() };
    let late = healed.observe(&at(7 * STEP_NS), 0, rules).unwrap();
    assert_eq!(late, Observed { outcome: Outcome::Applied, reordered: true });
    assert_eq!((healed.history(), healed.newest_at().unwrap().stamp_ns), (whole.history(), 8 * STEP_NS));
}

#[test]
fn analytic_a_restarted_vehicle_begins_anew_and_its_former_life_is_over() {
    let boot = |boot: u64, i: i64| Measurement { boot: Some(boot), ..numbered(i * STEP_NS, i as u64 + 1) };
    let mut session = driven(0);
    for i in 100..120 {
        assert_eq!(observe(&mut session, &boot(77, i)), Ok(Outcome::Applied));
    }
    // Stamps that begin again are believed the second time.
    assert!(matches!(observe(&mut session, &boot(5, 0)), Ok(Outcome::TooOld { .. })));
    assert_eq!(observe(&mut session, &boot(5, 1)), Ok(Outcome::Restarted));
    let begun = (session.history().len(), session.last_stamp_ns(), session.last_sequence(), session.boot());
    assert_eq!(begun, (1, Some(STEP_NS), Some(2), Some(5)));
    assert_eq!(observe(&mut session, &boot(5, 2)), Ok(Outcome::Applied));
    let before = trace(&session);
    assert!(matches!(observe(&mut session, &boot(77, 120)), Ok(Outcome::TooOld { .. })));
    assert_eq!(trace(&session), before);
    // Without an id the numbers say it, the second time: these stamps go on, the numbers begin again.
    assert_eq!(observe(&mut session, &numbered(8 * STEP_NS, 900)).map(|o| o.label()), Ok("gap"));
    assert_eq!(observe(&mut session, &numbered(9 * STEP_NS, 1)), Ok(Outcome::TooOld { behind_s: 0.0 }));
    assert_eq!(observe(&mut session, &numbered(10 * STEP_NS, 2)), Ok(Outcome::Restarted));
    assert_eq!(observe(&mut session, &numbered(11 * STEP_NS, 3)), Ok(Outcome::Applied));
    assert_eq!(session.history().len(), 2);
}

/// Goal: whatever was accepted of a start that is told can be sent once more, at any time and pace, and changes nothing; with another stamp neither. Method: 400 measurements,
/// of which 256 stamps are remembered; the first of them again, a tenth of a second apart, then numbers of old on new stamps; after a restart those of the start before.
#[test]
fn analytic_what_is_sent_again_begins_no_line() {
    let boot = |boot: u64, i: i64| Measurement { boot: Some(boot), ..numbered(i * STEP_NS, i as u64 + 1) };
    let rules = Rules { step_ns: STEP_NS, vehicle: &cart(), limits: &Limits::default() };
    let mut session = driven(0);
    let mut now_ns = 0;
    let mut arrives = |session: &mut Session, measurement: &Measurement| {
        now_ns += STEP_NS as u64;
        session.observe(measurement, now_ns, rules).unwrap().outcome.label()
    };
    for i in 0..400 {
        assert_eq!(arrives(&mut session, &boot(7, i)), "applied");
    }
    let before = trace(&session);
    for i in (0..40).chain(380..390) {
        assert_eq!(arrives(&mut session, &boot(7, i)), "duplicate");
    }
    for i in 401..410 {
        assert_eq!(arrives(&mut session, &Measurement { sequence: Some(i as u64 - 100), ..boot(7, i) }), "duplicate");
    }
    assert_eq!(trace(&session), before);
    // What was lost on its way and comes when nobody waits for it any more is no duplicate, and no restart either.
    assert_eq!(arrives(&mut session, &boot(7, 420)), "gap");
    let before = trace(&session);
    for i in 405..415 {
        assert_eq!(arrives(&mut session, &boot(7, i)), "too_old");
    }
    assert_eq!(trace(&session), before);
    assert_eq!(arrives(&mut session, &boot(8, 450)), "restarted");
    let before = trace(&session);
    for i in 350..390 {
        assert_eq!(arrives(&mut session, &boot(7, i)), "too_old");
    }
    assert_eq!((trace(&session), session.boot()), (before, Some(8)));
}

/// Goal: no measurement counts twice, and one of the present boot that was accepted is known again, whatever its clock did since. Method: a vehicle whose messages are lost, late, sent
/// again in runs at its pace, whose clock is set ahead and back, and which is restarted with and without its clock, against the set of all (boot, number) that were accepted.
#[test]
fn property_no_measurement_counts_twice() {
    for seed in 1..5_u64 {
        let mut bits = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let mut random = |below: u64| {
            bits = bits.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (bits >> 33) % below
        };
        let mut session = driven(0);
        let (mut now_ns, mut boot, mut number, mut stamp_ns) = (0_u64, 1_u64, 0_u64, 0_i64);
        let (mut told, mut accepted) = (Vec::new(), std::collections::BTreeSet::new());
        let (mut again, mut live) = (0, 0);
        let mut send = |session: &mut Session, measurement: &Measurement, now_ns: u64| {
            let key = (measurement.boot.unwrap(), measurement.sequence.unwrap());
            let (present, before) = (session.boot(), accepted.contains(&key).then(|| trace(session)));
            let outcome = observe_at(session, measurement, now_ns).unwrap();
            if let Some(before) = before {
                again += 1;
                assert!(!outcome.accepted(), "seed {seed}: {key:?} counts twice as {outcome:?}, present boot {present:?}");
                assert_eq!(trace(session), before, "seed {seed}: {key:?} was {outcome:?}");
                assert!(present != Some(key.0) || outcome == Outcome::Duplicate, "seed {seed}: {key:?} is {outcome:?}");
            } else if outcome.accepted() {
                accepted.insert(key);
            }
            outcome.accepted()
        };
        for _ in 0..800 {
            match random(100) {
                0 => {
                    (boot, number) = (boot + 1, 0);
                    stamp_ns = if random(2) == 0 { stamp_ns + 5 * STEP_NS } else { 0 };
                }
                // Its clock is set, by less than the reorder window and by more.
                1 => stamp_ns += [36_000 * STEP_NS, -36_000 * STEP_NS, -5 * STEP_NS / 2, -STEP_NS / 2][random(4) as usize],
                2..70 => {
                    (number, stamp_ns, now_ns) = (number + 1, stamp_ns + STEP_NS, now_ns + STEP_NS as u64);
                    told.push(Measurement { boot: Some(boot), ..numbered(stamp_ns, number) });
                    if random(10) > 0 {
                        live += usize::from(send(&mut session, &told[told.len() - 1], now_ns));
                    }
                }
                _ if told.is_empty() => {}
                _ => {
                    let near = told.len().saturating_sub(random(4) as usize + 1);
                    let first = if random(2) == 0 { near } else { random(told.len() as u64) as usize };
                    for late in told[first..].iter().take(1 + random(9) as usize) {
                        now_ns += random(2) * STEP_NS as u64;
                        send(&mut session, late, now_ns);
                    }
                }
            }
        }
        assert!(again > 200 && live > 300, "seed {seed}: {again} sent again, {live} new ones accepted of {}", told.len());
    }
}

/// Goal: a clock that is set makes no measurement of the same boot new or unknown. Method: ten of them, the clock set by an hour ahead and by a quarter of a second back, two
/// more; then all that were accepted once more.
#[test]
fn regress_what_was_accepted_before_the_clock_was_set_is_a_duplicate() {
    for set_ns in [36_000 * STEP_NS, -5 * STEP_NS / 2] {
        let boot = |i: i64, ahead_ns: i64| Measurement { boot: Some(7), ..numbered(i * STEP_NS + ahead_ns, i as u64 + 1) };
        let mut session = driven(0);
        for i in 0..10 {
            assert_eq!(observe(&mut session, &boot(i, 0)), Ok(Outcome::Applied));
        }
        let set = [10, 11].map(|i| observe(&mut session, &boot(i, set_ns)).unwrap().label());
        assert_eq!(set[1], "clock_jump", "{set:?}");
        let before = trace(&session);
        for again in (0..10).map(|i| boot(i, 0)).chain([boot(11, set_ns)]) {
            assert_eq!(observe(&mut session, &again), Ok(Outcome::Duplicate), "set by {set_ns} ns: {again:?}");
        }
        assert_eq!((trace(&session), session.last_sequence()), (before, Some(12)));
        // The one that was refused lies within the window, and is not known.
        assert!(observe(&mut session, &boot(10, set_ns)).unwrap().accepted() && session.accepted() == 12);
    }
}

/// Goal: a vehicle that comes back after a pause goes on, however long the pause was; a clock that is ahead of what has passed is not believed before. Method: stamps just below and
/// above the longest pause, after as long a silence on the clock of the engine and after none.
#[test]
fn regress_a_pause_that_both_clocks_have_seen_is_a_gap() {
    let limits = Limits { pause_max_s: 3.0, ..Limits::default() };
    let rules = Rules { step_ns: STEP_NS, vehicle: &cart(), limits: &limits };
    for (ahead, silent, outcome) in
        [(30, 0, Ok("gap")), (31, 30, Err("stamp_ns")), (31, 31, Ok("gap")), (45, 45, Ok("gap")), (31, 0, Err("stamp_ns"))]
    {
        let mut session = driven(5);
        let before = trace(&session);
        let came_back = session.observe(&at((4 + ahead) * STEP_NS), (silent * STEP_NS) as u64, rules);
        let told = came_back.as_ref().map(|observed| observed.outcome.label()).map_err(EngineError::field);
        assert_eq!(told, outcome, "{ahead} steps ahead after {silent}");
        if outcome.is_err() {
            assert_eq!(trace(&session), before);
            let after = (silent + 31) * STEP_NS;
            assert!(session.observe(&at((4 + ahead) * STEP_NS), after as u64, rules).is_ok(), "as much time has passed");
        }
        assert_eq!(session.history().len(), 1);
    }
}

/// Goal: what was delayed or is sent once more ends no life of the vehicle, and a life that was taken for over can go on. Method: strays of another boot, new or over, among
/// measurements of the present one; a boot with later stamps; then the former one alone, in a burst and at its pace.
#[test]
fn analytic_strays_of_another_boot_end_nothing() {
    let boot = |boot: u64, i: i64| Measurement { boot: Some(boot), ..numbered(i * STEP_NS, i as u64 + 1) };
    let mut session = driven(0);
    for i in 100..110 {
        assert_eq!(observe(&mut session, &boot(77, i)), Ok(Outcome::Applied));
        assert!(matches!(observe(&mut session, &boot(5, i - 60)), Ok(Outcome::TooOld { .. })));
    }
    assert_eq!((session.history().len(), session.boot()), (10, Some(77)));
    assert_eq!(observe(&mut session, &boot(78, 111)), Ok(Outcome::Restarted), "stamps that go on are believed at once");
    for i in 112..120 {
        assert_eq!(observe(&mut session, &boot(78, i)), Ok(Outcome::Applied));
        assert!(matches!(observe(&mut session, &boot(77, i - 50)), Ok(Outcome::TooOld { .. })));
    }
    for i in 60..80 {
        assert!(matches!(observe(&mut session, &boot(77, i)), Ok(Outcome::TooOld { .. })), "a burst is no proof");
    }
    assert_eq!(observe(&mut session, &boot(78, 120)), Ok(Outcome::Applied));
    let rules = Rules { step_ns: STEP_NS, vehicle: &cart(), limits: &Limits::default() };
    let outcomes: Vec<&str> =
        (0..7).map(|i| session.observe(&boot(77, 121 + i), (i * STEP_NS) as u64, rules).unwrap().outcome.label()).collect();
    assert_eq!(outcomes, ["too_old", "too_old", "too_old", "too_old", "too_old", "restarted", "applied"]);
    assert_eq!(session.boot(), Some(77));
}

#[test]
fn analytic_clocks_that_jump_are_believed_the_second_time() {
    let year_ns = 31_536_000_000_000_000;
    // Ahead, at once: one wrong stamp is refused, a second one in a row is a clock that was set.
    let mut session = driven(5);
    let ahead = seconds(year_ns + STEP_NS);
    assert_eq!(observe(&mut session, &at(year_ns + 5 * STEP_NS)), Ok(Outcome::Future { ahead_s: ahead }));
    assert_eq!(observe(&mut session, &at(5 * STEP_NS)), Ok(Outcome::Applied), "one wrong stamp does no harm");
    observe(&mut session, &at(year_ns)).unwrap();
    let jumped = observe(&mut session, &at(year_ns + STEP_NS)).unwrap();
    assert_eq!((jumped.label(), session.history().len()), ("clock_jump", 1));
    // Back, numbered on: the same.
    let mut session = driven(0);
    for i in 0..5 {
        observe(&mut session, &numbered((i + 900) * STEP_NS, i as u64 + 1)).unwrap();
    }
    assert_eq!(observe(&mut session, &numbered(100 * STEP_NS, 6)).map(|o| o.label()), Ok("too_old"));
    assert_eq!(observe(&mut session, &numbered(101 * STEP_NS, 7)), Ok(Outcome::ClockJump { jump_s: seconds(-803 * STEP_NS) }));
    // Back by whole intervals, numbered on: the same, although the stamps are known.
    for back in [2, 3, 20] {
        let mut session = driven(0);
        let sent: Vec<_> = (0..60).map(|i| numbered(i * STEP_NS, i as u64 + 1)).collect();
        sent.iter().for_each(|m| assert_eq!(observe(&mut session, m), Ok(Outcome::Applied)));
        assert_eq!(observe(&mut session, &sent[60 - back]), Ok(Outcome::Duplicate), "resent");
        let jumped = (60..63).map(|i| observe(&mut session, &numbered((i - back as i64) * STEP_NS, i as u64 + 1)).unwrap().label());
        assert_eq!(jumped.collect::<Vec<_>>(), ["too_old", "clock_jump", "applied"], "{back} intervals");
    }
    // Back, without numbers: the stamps have to keep pace with the arrivals, as those of a burst do not.
    let mut session = driven(1);
    observe(&mut session, &at(100 * STEP_NS)).unwrap();
    let burst: Vec<_> = (10..60).map(|i| observe(&mut session, &at(i * STEP_NS)).unwrap().label()).collect();
    assert!(burst.iter().all(|label| *label == "too_old"));
    let paced: Vec<_> = (10..17).map(|i| observe_at(&mut session, &at(i * STEP_NS), (i * STEP_NS) as u64).unwrap().label()).collect();
    assert_eq!(paced, ["too_old", "too_old", "too_old", "too_old", "too_old", "clock_jump", "applied"]);
    // A pause that time has passed for is a gap, however long.
    let mut session = driven(1);
    assert_eq!(observe_at(&mut session, &at(36_000 * STEP_NS), 3_600_000_000_000).map(|o| o.label()), Ok("gap"));
}

/// Goal: a clock that is set, or a vehicle that starts again, is believed however seldom it measures. Method: stamps and arrivals in steps of 0.15 to 1 s, as of a
/// slow sensor or a link that loses some, ahead, back and of another start.
#[test]
fn analytic_a_clock_is_believed_of_vehicles_that_measure_seldom() {
    for step in [STEP_NS * 3 / 2, STEP_NS * 8 / 5, 2 * STEP_NS, 3 * STEP_NS, 10 * STEP_NS] {
        let labels = |shift_ns: i64, boot: Option<u64>| -> Vec<&str> {
            let mut session = driven(0);
            let hour_ns = 3_600_000_000_000;
            let one = |k: i64, shift: i64, boot: Option<u64>| Measurement { boot, ..at(hour_ns + k * step + shift) };
            for k in 0..10 {
                assert!(observe_at(&mut session, &one(k, 0, boot.map(|_| 1)), (k * step) as u64).unwrap().accepted());
            }
            (10..18).map(|k| observe_at(&mut session, &one(k, shift_ns, boot), (k * step) as u64).unwrap().label()).collect()
        };
        assert_eq!(labels(3_600_000_000_000, None)[..2], ["future", "clock_jump"], "{step}");
        assert!(labels(-3_000_000_000_000, None).contains(&"clock_jump"), "{step}");
        assert_eq!(labels(-3_000_000_000_000, Some(2))[..2], ["too_old", "restarted"], "{step}");
    }
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
    let before = trace(&session);
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
    // The cart's wheels have a radius of 0.2 m.
    let spinning = WheelMeasurement { speed_rad_s: Some([0.0, 500.0, -500.1, 0.0]), road_wheel_angle_rad: None };
    let in_degrees = WheelMeasurement { speed_rad_s: None, road_wheel_angle_rad: Some([1.5, 30.0]) };
    for (measurement, field) in [
        (Measurement { wheels: spinning, ..at(3 * STEP_NS) }, "wheels.speed_rad_s[2]"),
        (Measurement { wheels: in_degrees, ..at(3 * STEP_NS) }, "wheels.road_wheel_angle_rad[1]"),
        (Measurement { command: Control { speed_m_s: 3.01, second: 0.0 }, ..at(3 * STEP_NS) }, "command.speed_m_s"),
        (Measurement { command: Control { speed_m_s: 3.0, second: -0.51 }, ..at(3 * STEP_NS) }, "command.second"),
        (Measurement { state: VehicleState { position_m: [1e7, 0.0, 0.0], ..at(0).state }, ..at(3 * STEP_NS) }, "state.position_m.x"),
    ] {
        assert_eq!(observe(&mut session, &measurement).unwrap_err().field(), field);
    }
    let last = Measurement { stamp_ns: i64::MAX, ..at(3 * STEP_NS) };
    assert_eq!(observe(&mut session, &last).map(|o| o.label()), Ok("future"));
    assert_eq!(observe(&mut session, &last).map(|o| o.label()), Ok("future"));
    assert_eq!(trace(&session), before);
}
