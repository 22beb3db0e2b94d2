//! Goal: the recorded commands of a run give the same answers when they are executed again.

use std::sync::Arc;

use nesam_engine::{
    Candidates, Command, CostWeights, Drawing, Engine, EngineHandle, Limits, ManualClock, Measurement, OpenSession, PathCost,
    PredictExtras, PredictQuery, WheelMeasurement,
};

use crate::stage::*;

#[test]
fn property_replayed_commands_give_the_same_bytes() {
    let recorded = recorded();
    let mut engine = Engine::new(predictor(), Limits::default()).unwrap();
    engine.start_recording();
    let clock = Arc::new(ManualClock::default());
    let handle = EngineHandle::spawn(engine, clock.clone());
    let mut first = Vec::new();
    let mut call = |command: Command| {
        clock.advance_ns(7_000_000);
        first.push(format!("{:?}", handle.call(command)));
    };
    call(Command::PutMap { map: recorded.world.clone(), base: None });
    call(Command::Open(OpenSession { vehicle: "truck".into(), map: recorded.world.id().into(), ..Default::default() }));
    for i in (0..40).chain([38, 20, 60]) {
        let measurement = Measurement {
            sequence: None,
            boot: None,
            stamp_ns: i as i64 * STEP_NS,
            state: recorded.drive.states[i],
            command: recorded.drive.controls[i],
            wheels: WheelMeasurement::default(),
        };
        call(Command::Measure { session: "truck".into(), vehicle: None, measurement });
        if i % 16 == 7 {
            let candidates = candidates("truck", &recorded.drive, i, 3, 8);
            call(Command::Predict(PredictQuery {
                session: candidates.session,
                start: None,
                instant: None,
                use_history: true,
                samples: 3,
                samples_min: 0,
                horizon: 8,
                controls: Candidates::Given(candidates.controls.clone()),
                cost: None,
                extras: PredictExtras { jacobians: i % 32 == 7, risk: true, ..Default::default() },
            }));
            let weights = CostWeights { path: 1.0, speed: 1.0, ..Default::default() };
            call(Command::Predict(PredictQuery {
                session: "truck".into(),
                start: None,
                instant: None,
                use_history: true,
                samples: 5,
                samples_min: 0,
                horizon: 8,
                controls: Candidates::Drawn(Drawing {
                    nominal: candidates.controls[..16].to_vec(),
                    sd: [0.5, 0.1],
                    correlation: 0.8,
                    seed: i as u64,
                }),
                cost: Some(PathCost { path: vec![0.0, 0.0, 50.0, 50.0], speed_m_s: 2.0, weights, best: 2, temperature: 1.0 }),
                extras: PredictExtras::default(),
            }));
        }
    }
    call(Command::Get { session: "nobody".into() });
    call(Command::List);
    call(Command::Close { session: "truck".into() });

    let log = handle.stop().expect("the engine's thread ended well").take_recording();
    assert_eq!(log.len(), first.len());
    let mut again = Engine::new(Arc::new(fresh_predictor()), Limits::default()).unwrap();
    for ((now_ns, command), answer) in log.iter().zip(&first) {
        // Debug prints every float with as many digits as its bits need.
        assert!(&format!("{:?}", again.execute(*now_ns, command)) == answer, "command {} at {now_ns} ns", command.label());
    }
}
