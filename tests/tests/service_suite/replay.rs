//! Goal: the recorded commands of a run give the same answers when they are executed again.

use std::sync::{Arc, Mutex};

use nesam_engine::{
    Candidates, Command, CostWeights, Drawing, Engine, EngineHandle, Executed, Limits, ManualClock, OpenSession, PathCost, PredictExtras,
    PredictQuery,
};

use crate::stage::*;

#[test]
fn property_replayed_commands_give_the_same_bytes() {
    let recorded = recorded();
    let engine = Engine::new(predictor(), Limits::default()).unwrap();
    let clock = Arc::new(ManualClock::default());
    let log = Arc::new(Mutex::new(Vec::new()));
    let heard = Arc::clone(&log);
    let tap = Box::new(move |executed: Executed| heard.lock().unwrap().push((executed.now_ns, executed.command)));
    let handle = EngineHandle::spawn_tapped(engine, clock.clone(), Some(tap));
    let mut first = Vec::new();
    let mut call = |command: Command| {
        clock.advance_ns(7_000_000);
        first.push(format!("{:?}", handle.call(command)));
    };
    call(Command::PutMap { map: recorded.world.clone(), base: None });
    call(Command::Open(OpenSession { vehicle: "truck".into(), map: recorded.world.id().into(), ..Default::default() }));
    for i in (0..40).chain([38, 20, 60]) {
        let measurement = engine_sample(&recorded.drive, i);
        call(Command::Measure { session: "truck".into(), vehicle: None, measurement });
        if i % 16 == 7 {
            let query = engine_query("truck", &recorded.drive, i, 3, 8);
            let extras = PredictExtras { jacobians: i % 32 == 7, risk: true, ..Default::default() };
            call(Command::Predict(PredictQuery { extras, ..query.clone() }));
            let nominal = candidates("truck", &recorded.drive, i, 3, 8).controls[..16].to_vec();
            let weights = CostWeights { path: 1.0, speed: 1.0, ..Default::default() };
            call(Command::Predict(PredictQuery {
                samples: 5,
                controls: Candidates::Drawn(Drawing { nominal, sd: [0.5, 0.1], correlation: 0.8, seed: i as u64 }),
                cost: Some(PathCost { path: vec![0.0, 0.0, 50.0, 50.0], speed_m_s: 2.0, weights, best: 2, temperature: 1.0 }),
                ..query
            }));
        }
    }
    call(Command::Get { session: "nobody".into() });
    call(Command::List);
    call(Command::Close { session: "truck".into() });

    handle.stop().expect("the engine's thread ended well");
    let log = log.lock().unwrap();
    assert_eq!(log.len(), first.len());
    let mut again = Engine::new(Arc::new(fresh_predictor()), Limits::default()).unwrap();
    for ((now_ns, command), answer) in log.iter().zip(&first) {
        // Debug prints every float with as many digits as its bits need.
        assert!(&format!("{:?}", again.execute(*now_ns, command)) == answer, "command {} at {now_ns} ns", command.label());
    }
}
