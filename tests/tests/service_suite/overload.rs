//! Goal: too much is refused at once and typed, measurements still get through, and the server lives on.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use nesam_client::zenoh_vehicle::ZenohVehicle;
use nesam_client::{outcome_label, v1};
use nesam_engine::{
    Clock, Command, Engine, EngineError, EngineHandle, Executed, Limits, ManualClock, OpenSession, PredictExtras, PredictQuery, Reply,
    Submission, Tap,
};
use nesam_server::MonotonicClock;
use tonic::Code;

use crate::stage::*;
use crate::zenoh_network::{PATIENCE, behind, router};

#[tokio::test(flavor = "multi_thread")]
async fn service_overload_is_resource_exhausted_and_measurements_get_through() {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| config.limits.waiting_predictions_max = 2).await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "s", recorded.world.id()).await;
    client.feed(samples("s", &recorded.drive, 40)).await.unwrap();
    let heavy = candidates("s", &recorded.drive, 40, 512, 32);
    let asked: Vec<_> = (0..40)
        .map(|_| {
            let (mut client, heavy) = (client.clone(), heavy.clone());
            tokio::spawn(async move { client.predict(heavy).await })
        })
        .collect();
    // While the planners hammer, the vehicle reports.
    let answers = client.feed((41..60).map(|i| sample("s", &recorded.drive, i)).collect()).await.unwrap();
    assert!(answers.iter().all(|a| outcome_label(a) == "APPLIED"));
    let (mut answered, mut refused) = (0, 0);
    for task in asked {
        match task.await.unwrap() {
            Ok(_) => answered += 1,
            Err(error) => {
                assert_eq!(error.code(), Some(Code::ResourceExhausted), "{error}");
                assert!(error.retry_after().is_some_and(|pause| !pause.is_zero() && pause < Duration::from_secs(60)), "{error}");
                refused += 1;
            }
        }
    }
    assert!(answered >= 1 && refused >= 1 && answered + refused == 40, "{answered} answered, {refused} refused");
    let after = client.predict(candidates("s", &recorded.drive, 59, 2, 4)).await.unwrap();
    assert_eq!(after.provenance.history_epoch, 60);
    server.shutdown().await;
}

/// Holds the thread of an engine until what this gives is dropped.
async fn hold(engine: &EngineHandle) -> Sender<()> {
    let (release, released) = channel();
    let (held, holds) = tokio::sync::oneshot::channel();
    engine.submit(Submission::new(Command::List, move |_| {
        let _ = held.send(());
        let _ = released.recv();
    }));
    holds.await.unwrap();
    release
}

/// Goal: who sends what is refused takes the places of nobody. Method: while the engine is held, four streams send more measurements without a state than commands
/// may wait; then another vehicle reports.
#[tokio::test(flavor = "multi_thread")]
async fn service_measurements_that_are_invalid_leave_room_for_others() {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| {
        config.limits.waiting_commands_max = 64;
        config.limits.waiting_measurements_per_vehicle_max = 8;
    })
    .await;
    for vehicle in ["noisy", "quiet"] {
        client.open_session(v1::OpenSessionRequest { vehicle_id: vehicle.into(), ..Default::default() }).await.unwrap();
    }
    let release = hold(server.engine()).await;
    let noisy: Vec<_> = (0..4)
        .map(|_| {
            let mut client = client.clone();
            let invalid = (0..40).map(|i| v1::Measurement { state: None, ..sample("noisy", &recorded.drive, i) }).collect();
            tokio::spawn(async move { client.feed(invalid).await })
        })
        .collect();
    eventually(PATIENCE, "the first of them look at their session", async || server.engine().waiting().0 >= 8).await;
    // The others come meanwhile.
    tokio::time::sleep(Duration::from_millis(500)).await;
    // One more for each stream that looks for room at the same time, and what the server asks itself.
    let waiting = server.engine().waiting().0;
    assert!(waiting < 32, "{waiting} commands wait");
    let quiet = tokio::spawn({
        let (mut client, first) = (client.clone(), sample("quiet", &recorded.drive, 0));
        async move { client.feed(vec![first]).await }
    });
    tokio::time::sleep(Duration::from_millis(300)).await;
    drop(release);
    let answers = quiet.await.unwrap().unwrap();
    assert_eq!(answers.iter().map(outcome_label).collect::<Vec<_>>(), ["APPLIED"]);
    for stream in noisy {
        let answers = stream.await.unwrap().unwrap();
        assert_eq!(answers.len(), 40);
        for answer in answers {
            let Some(v1::measurement_answer::Outcome::Rejected(rejected)) = answer.outcome else { panic!("{answer:?}") };
            assert_eq!((rejected.code, rejected.field.as_str()), (3, "state"), "{}", rejected.message);
        }
    }
    server.shutdown().await;
}

/// Goal: over Zenoh a vehicle has one share, whatever it says that its sessions are called. Method: while the engine is held a vehicle sends under more names than
/// measurements of one vehicle may wait.
#[tokio::test(flavor = "multi_thread")]
async fn service_invented_names_over_zenoh_take_one_share() {
    let recorded = recorded();
    let (router, endpoint) = router().await;
    let (server, _client) = start_with(|config| {
        behind(config, &endpoint);
        config.limits.waiting_measurements_per_vehicle_max = 4;
    })
    .await;
    let vehicle = ZenohVehicle::connect(&endpoint, "test", "truck").await.unwrap();
    vehicle.wait_for_service(PATIENCE).await.unwrap();
    let code = async || match vehicle.answer(PATIENCE).await.unwrap().expect("an answer on the status key").outcome {
        Some(v1::measurement_answer::Outcome::Rejected(rejected)) => rejected.code,
        other => panic!("{other:?}"),
    };
    let release = hold(server.engine()).await;
    for i in 0..24 {
        vehicle.publish(&sample(&format!("invented-{i}"), &recorded.drive, i)).await.unwrap();
    }
    for i in 0..20 {
        assert_eq!(code().await, Code::ResourceExhausted as i32, "answer {i}");
    }
    drop(release);
    for i in 0..4 {
        assert_eq!(code().await, Code::NotFound as i32, "answer {i} of those that waited");
    }
    vehicle.close().await.unwrap();
    server.shutdown().await;
    router.close().await.unwrap();
}

/// Whoever asks again as soon as its answer is there finds nobody before it, however long the engine's thread takes to look for its next turn.
#[test]
fn service_one_after_the_other_is_never_too_many() {
    let recorded = recorded();
    let clock = Arc::new(ManualClock::default());
    let handle = EngineHandle::spawn(Engine::new(predictor(), Limits::default()).unwrap(), clock.clone());
    drive(&handle, &recorded, "");
    let query = engine_query("s", &recorded.drive, 2, 1, 2);
    // Sooner than an answer finds its way back: let in only by an idle engine.
    let (mut again, answer) = asked(query.clone());
    again.deadline_ns = Some(clock.now_ns() + 1);
    let engine = handle.clone();
    handle.submit(Submission::new(Command::Predict(query), move |answer| {
        answer.result.unwrap();
        engine.submit(again);
    }));
    answer.recv().unwrap().unwrap();
    handle.stop();
}

/// Goes on by this much whenever somebody looks at it.
const TICK_NS: u64 = 10_000_000;

#[derive(Default)]
struct Ticking(AtomicU64);

impl Clock for Ticking {
    fn now_ns(&self) -> u64 {
        self.0.fetch_add(TICK_NS, Ordering::Relaxed)
    }
}

/// The first three steps of a drive in a session of an engine.
fn drive(handle: &EngineHandle, recorded: &Recorded, map: &str) {
    handle.call(Command::Open(OpenSession { vehicle: "s".into(), map: map.into(), ..Default::default() })).unwrap();
    for i in 0..3 {
        let measurement = engine_sample(&recorded.drive, i);
        handle.call(Command::Measure { session: "s".into(), vehicle: None, measurement }).unwrap();
    }
}

/// What a recording notes of each executed command, and what lets it hear of them.
fn listen<T: Send + 'static>(note: impl Fn(Executed) -> Option<T> + Send + 'static) -> (Arc<Mutex<Vec<T>>>, Tap) {
    let heard = Arc::new(Mutex::new(Vec::new()));
    let noted = heard.clone();
    (heard, Box::new(move |executed| noted.lock().unwrap().extend(note(executed))))
}

/// A prediction to be submitted, and where its answer comes.
fn asked(query: PredictQuery) -> (Submission, Receiver<Result<Reply, EngineError>>) {
    let (sender, receiver) = channel();
    (Submission::new(Command::Predict(query), move |answer| sender.send(answer.result).unwrap()), receiver)
}

/// Nine samples are too many for Jacobians, also where there is time for one of them alone and the asker would take it.
#[test]
fn service_a_limit_holds_whatever_the_load() {
    let recorded = recorded();
    let engine = Engine::new(predictor(), Limits::default()).unwrap();
    let handle = EngineHandle::unthreaded(engine, Arc::new(Ticking::default()), None);
    drive(&handle, &recorded, "");
    // It takes a tick: the engine expects eight for nine samples with Jacobians, two for one.
    handle.call(Command::Predict(engine_query("s", &recorded.drive, 2, 1, 2))).unwrap();
    let extras = PredictExtras { jacobians: true, ..Default::default() };
    let query = PredictQuery { samples_min: 1, extras, ..engine_query("s", &recorded.drive, 2, 9, 2) };
    for within_ns in [None, Some(8 * TICK_NS)] {
        let (mut asked, answer) = asked(query.clone());
        asked.deadline_ns = within_ns.map(|within_ns| handle.now_ns() + within_ns);
        handle.submit(asked);
        let refused = answer.recv().unwrap().expect_err("too many samples");
        assert_eq!(refused.field(), "extras.jacobians", "{refused}");
    }
}

/// The first question about new terrain has it encoded, and that says nothing of the next one. Each takes a tick by the clock; if the tick of the three samples on
/// new terrain were that of samples alone, 48 of the next 128 would be expected to be done in time.
#[test]
fn service_terrain_that_was_new_does_not_count_as_time_of_samples() {
    let recorded = recorded();
    let engine = Engine::new(Arc::new(fresh_predictor()), Limits::default()).unwrap();
    let handle = EngineHandle::unthreaded(engine, Arc::new(Ticking::default()), None);
    handle.call(Command::PutMap { map: recorded.world.clone(), base: None }).unwrap();
    drive(&handle, &recorded, recorded.world.id());
    handle.call(Command::Predict(engine_query("s", &recorded.drive, 2, 3, 32))).unwrap();
    let query = PredictQuery { samples_min: 1, ..engine_query("s", &recorded.drive, 2, 128, 32) };
    let (mut asked, answer) = asked(query);
    asked.deadline_ns = Some(handle.now_ns() + 10 * TICK_NS);
    handle.submit(asked);
    let Reply::Predicted(prediction) = answer.recv().unwrap().unwrap() else { panic!("a prediction was asked for") };
    assert_eq!(prediction.candidates(), 128);
}

#[tokio::test(flavor = "multi_thread")]
async fn service_deadlines_are_honoured_and_abandoned_requests_are_skipped() {
    let (server, mut client, recorded) = driven("s", 40).await;
    let heavy = candidates("s", &recorded.drive, 40, 2048, 32);
    let busy = {
        let (mut client, heavy) = (client.clone(), heavy.clone());
        tokio::spawn(async move { client.predict(heavy).await })
    };
    tokio::time::sleep(Duration::from_millis(30)).await;
    // Behind a prediction that takes longer than the deadline. Whoever notices first answers: the server with DEADLINE_EXCEEDED or the
    // client's own timer, which tonic reports as CANCELLED.
    let started = Instant::now();
    let late: Vec<_> = (0..8)
        .map(|_| {
            let (mut client, heavy) = (client.clone(), heavy.clone());
            tokio::spawn(async move { client.predict_within(heavy, Some(Duration::from_millis(40))).await })
        })
        .collect();
    for task in late {
        let code = task.await.unwrap().expect_err("the engine is busy").code();
        assert!(matches!(code, Some(Code::DeadlineExceeded | Code::Cancelled)), "{code:?}");
    }
    assert!(started.elapsed() < Duration::from_secs(2));
    busy.await.unwrap().unwrap();
    // None of the late ones was computed.
    client.predict(candidates("s", &recorded.drive, 40, 1, 1)).await.unwrap();
    assert_eq!(server.metrics().predictions(), 2);
    server.shutdown().await;
}

/// Goal: what nobody waits for any more costs the others nothing. Method: predictions of seconds whose flag is raised after they have begun; one with covariance
/// spends its time in derivatives.
#[test]
fn service_a_prediction_that_nobody_waits_for_is_given_up() {
    let recorded = recorded();
    let handle = EngineHandle::spawn(Engine::new(predictor(), Limits::default()).unwrap(), Arc::new(ManualClock::default()));
    drive(&handle, &recorded, "");
    let jacobians = PredictExtras { jacobians: true, ..Default::default() };
    for (samples, extras) in [(2048, PredictExtras::default()), (8, jacobians)] {
        let query = PredictQuery { extras, ..engine_query("s", &recorded.drive, 2, samples, 32) };
        let (mut asked, answer) = asked(query);
        let abandoned = Arc::new(AtomicBool::new(false));
        asked.abandoned = Some(abandoned.clone());
        handle.submit(asked);
        while handle.waiting().1 > 0 {
            std::thread::yield_now();
        }
        std::thread::sleep(Duration::from_millis(5));
        abandoned.store(true, Ordering::Relaxed);
        assert!(matches!(answer.recv().unwrap(), Err(EngineError::Abandoned)), "{samples} samples");
    }
    handle.call(Command::Predict(engine_query("s", &recorded.drive, 2, 1, 1))).unwrap();
    handle.stop();
}

/// Goal: measurements do not wait for a prediction, and a recording has both in the order in which they were executed. Method: a prediction of seconds, a measurement
/// that is answered while it is computed, then its flag.
#[test]
fn service_measurements_do_not_wait_for_a_prediction() {
    let recorded = recorded();
    let (heard, tap) = listen(|executed| Some(executed.command.label()));
    let engine = Engine::new(predictor(), Limits::default()).unwrap();
    let handle = EngineHandle::spawn_tapped(engine, Arc::new(ManualClock::default()), Some(tap));
    drive(&handle, &recorded, "");
    let extras = PredictExtras { jacobians: true, ..Default::default() };
    let (mut asked, answer) = asked(PredictQuery { extras, ..engine_query("s", &recorded.drive, 2, 8, 32) });
    let abandoned = Arc::new(AtomicBool::new(false));
    asked.abandoned = Some(abandoned.clone());
    handle.submit(asked);
    while handle.waiting().1 > 0 {
        std::thread::yield_now();
    }
    let measurement = engine_sample(&recorded.drive, 3);
    handle.call(Command::Measure { session: "s".into(), vehicle: None, measurement }).unwrap();
    assert!(answer.try_recv().is_err(), "the prediction is still computed");
    assert_eq!(heard.lock().unwrap().len(), 4, "what came after it is told after it");
    abandoned.store(true, Ordering::Relaxed);
    assert!(matches!(answer.recv().unwrap(), Err(EngineError::Abandoned)));
    handle.stop();
    assert_eq!(*heard.lock().unwrap(), ["open", "measure", "measure", "measure", "predict", "measure"]);
}

/// Goal: a short question does not wait for a long one, neither answer is another for it, and a recording has them in the order in which they began. Method: a long one,
/// of states or of derivatives, and a short one in the midst of it; both once more alone.
#[test]
fn service_a_short_question_does_not_wait_for_a_long_one() {
    let recorded = recorded();
    let (heard, tap) = listen(|executed| match executed.command {
        Command::Predict(query) => Some(query.samples),
        _ => None,
    });
    let engine = Engine::new(predictor(), Limits::default()).unwrap();
    let handle = EngineHandle::spawn_tapped(engine, Arc::new(MonotonicClock::default()), Some(tap));
    handle.call(Command::PutMap { map: recorded.world.clone(), base: None }).unwrap();
    drive(&handle, &recorded, recorded.world.id());
    let of = |answer: Result<Reply, EngineError>| {
        let Ok(Reply::Predicted(prediction)) = answer else { panic!("a prediction was asked for") };
        (prediction.rollout.states.clone(), format!("{:?}", prediction.extras))
    };
    let jacobians = PredictExtras { jacobians: true, ..Default::default() };
    for (samples, extras) in [(2048, PredictExtras::default()), (8, jacobians)] {
        let long = PredictQuery { extras, ..engine_query("s", &recorded.drive, 2, samples, 32) };
        let short = engine_query("s", &recorded.drive, 2, 24, 8);
        let alone = [&long, &short].map(|query| of(handle.call(Command::Predict(query.clone()))));
        // On a machine that does other things too the long one may have ended before the short one is asked for.
        let overtook = (0..10).any(|_| {
            let [(first, of_long), (second, of_short)] = [&long, &short].map(|query| asked(query.clone()));
            handle.submit(first);
            while handle.waiting().1 > 0 {
                std::thread::yield_now();
            }
            handle.submit(second);
            let of_short = of(of_short.recv().unwrap());
            let is_first = of_long.try_recv();
            let of_long = is_first.clone().unwrap_or_else(|_| of_long.recv().unwrap());
            assert!([of(of_long), of_short] == alone, "both as they are alone");
            is_first.is_err()
        });
        assert!(overtook, "{samples} samples");
    }
    handle.stop();
    let heard = heard.lock().unwrap();
    assert!(heard.chunks(2).all(|asked| asked[0] != 24 && asked[1] == 24), "{heard:?}");
}

/// Goal: an answer that is due has what is done, is the beginning of the whole, and replays. Method: the flag is raised before a prediction begins, so that it ends
/// as soon as enough is done; the whole of it, and what a recording hears of.
#[test]
fn service_an_answer_that_is_due_has_what_is_done() {
    let recorded = recorded();
    let (heard, tap) = listen(Some);
    let engine = Engine::new(predictor(), Limits::default()).unwrap();
    let handle = EngineHandle::unthreaded(engine, Arc::new(ManualClock::default()), Some(tap));
    handle.call(Command::PutMap { map: recorded.world.clone(), base: None }).unwrap();
    drive(&handle, &recorded, recorded.world.id());
    let ask = |query: PredictQuery, due: bool| {
        let (mut asked, answer) = asked(query);
        asked.due = Some(Arc::new(AtomicBool::new(due)));
        handle.submit(asked);
        let Reply::Predicted(prediction) = answer.recv().unwrap().unwrap() else { panic!("a prediction was asked for") };
        prediction
    };
    let risk = PredictExtras { risk: true, ..Default::default() };
    let query = PredictQuery { samples_min: 70, extras: risk, ..engine_query("s", &recorded.drive, 2, 1024, 32) };
    let [whole, first] = [false, true].map(|due| ask(query.clone(), due));
    assert_eq!(whole.candidates(), 1024);
    let first_rows = first.candidates();
    // No more than the block of 16 or 32 that completes what is asked for, however many threads there are.
    assert!((70..70 + 32).contains(&first_rows), "{first_rows} candidates");
    let beginning = |whole: &[f32], first: &[f32]| whole.iter().zip(first).all(|(a, b)| a.to_bits() == b.to_bits());
    for (whole, first, width) in [
        (&whole.rollout.states, &first.rollout.states, 12),
        (&whole.rollout.sinkage_m, &first.rollout.sinkage_m, 4),
        (&whole.extras.risk.as_ref().unwrap().wheel_load_n, &first.extras.risk.as_ref().unwrap().wheel_load_n, 4),
    ] {
        assert!(first.len() == first_rows * 32 * width && beginning(whole, first), "{width} numbers a step");
    }
    assert_eq!(first.rollout.flags.len(), first_rows);
    // Who needs all of them waits for all of them.
    assert_eq!(ask(PredictQuery { samples_min: 0, ..query }, true).candidates(), 1024);
    // What a recording hears of gives the same answer again.
    let executed = heard.lock().unwrap().iter().rev().nth(1).cloned().unwrap();
    let Command::Predict(recorded) = &executed.command else { panic!("a prediction was recorded") };
    assert_eq!(recorded.samples, first_rows);
    assert_eq!(ask(recorded.clone(), false).rollout, first.rollout);
}

/// Goal: a server says when an answer is due. Method: its first prediction, of which it knows no time and leaves nothing out beforehand; a third of the time that it
/// takes does for the first of the samples.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_first_answer_comes_in_time() {
    let (known, mut client, recorded) = driven("s", 40).await;
    let mut heavy = candidates("s", &recorded.drive, 40, 2048, 32);
    let mut takes = Duration::MAX;
    for _ in 0..3 {
        let begun = Instant::now();
        client.predict(heavy.clone()).await.unwrap();
        takes = takes.min(begun.elapsed());
    }
    known.shutdown().await;
    heavy.samples_min = 32;
    let mut answered = None;
    // On a machine whose pace varies.
    for _ in 0..5 {
        let (server, mut client, _) = driven("s", 40).await;
        answered = client.predict_within(heavy.clone(), Some(takes / 3)).await.ok();
        server.shutdown().await;
        if answered.is_some() {
            break;
        }
    }
    let samples = answered.expect("one of five is in time").samples;
    assert!((32..2048).contains(&samples), "{samples} samples in a third of {takes:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_prediction_ends_at_its_deadline() {
    let (server, mut client, recorded) = driven("s", 40).await;
    let heavy = candidates("s", &recorded.drive, 40, 2048, 32);
    client.predict(heavy.clone()).await.unwrap();
    let begun = Instant::now();
    client.predict(heavy.clone()).await.unwrap();
    let takes = begun.elapsed();
    // After a pause the server does not rely on what it expects, and lets one in while nothing else is to be done.
    tokio::time::sleep(Duration::from_millis(1100)).await;
    client.predict_within(heavy, Some(takes / 4)).await.expect_err("it takes longer");
    client.predict(candidates("s", &recorded.drive, 40, 1, 1)).await.unwrap();
    assert_eq!(server.metrics().predictions(), 3, "the late one was not computed to its end");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_prediction_of_a_stream_ends_with_its_planner() {
    let (server, mut client, recorded) = driven("s", 40).await;
    let heavy = candidates("s", &recorded.drive, 40, 2048, 32).to_message();
    tokio::time::timeout(Duration::from_millis(20), client.predict_stream(vec![heavy])).await.expect_err("it takes longer");
    client.predict(candidates("s", &recorded.drive, 40, 1, 1)).await.unwrap();
    assert_eq!(server.metrics().predictions(), 1, "that of the stream was not computed to its end");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_what_would_be_late_is_refused_at_once() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    open(&mut client, "s", "").await;
    client.feed(samples("s", &recorded.drive, 40)).await.unwrap();
    let heavy = candidates("s", &recorded.drive, 40, 1024, 32);
    // The server learns how long such a prediction takes.
    for _ in 0..4 {
        client.predict(heavy.clone()).await.unwrap();
    }
    let begun = Instant::now();
    client.predict(heavy.clone()).await.unwrap();
    let takes = begun.elapsed();
    let before = server.metrics().predictions();
    // Room for about five of thirty.
    let asked: Vec<_> = (0..30)
        .map(|_| {
            let (mut client, heavy) = (client.clone(), heavy.clone());
            tokio::spawn(async move {
                let sent = Instant::now();
                (client.predict_within(heavy, Some(5 * takes)).await, sent.elapsed())
            })
        })
        .collect();
    let (mut in_time, mut refused_after) = (0, Vec::new());
    for task in asked {
        match task.await.unwrap() {
            (Ok(_), _) => in_time += 1,
            (Err(error), took) if error.code() == Some(Code::ResourceExhausted) => {
                assert!(error.retry_after().is_some(), "{error}");
                refused_after.push(took);
            }
            (Err(error), _) => assert!(matches!(error.code(), Some(Code::DeadlineExceeded | Code::Cancelled)), "{error}"),
        }
    }
    // They learn at once that they ask in vain; how quickly is a figure of `nesam bench serve`. None of those was computed.
    refused_after.sort_unstable();
    assert!(refused_after.len() >= 15 && in_time >= 1, "{in_time} in time, {} refused of 30", refused_after.len());
    assert!(refused_after[9 * refused_after.len() / 10] < takes.max(Duration::from_millis(50)), "{refused_after:?}, one takes {takes:?}");
    assert!(server.metrics().predictions() - before <= 15);
    // Who asks wrongly is told that, and not to ask again later.
    let mut wrong = heavy.clone();
    wrong.samples_min = 1025;
    let refused = client.predict_within(wrong, Some(takes / 2)).await.expect_err("it could not be answered");
    assert_eq!(refused.code(), Some(Code::InvalidArgument), "{refused}");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_fewer_samples_in_time_rather_than_none() {
    let (server, mut client, recorded) = driven("s", 40).await;
    let heavy = candidates("s", &recorded.drive, 40, 2048, 32);
    let mut takes = Duration::MAX;
    let mut whole = None;
    for _ in 0..4 {
        let begun = Instant::now();
        whole = Some(client.predict(heavy.clone()).await.unwrap());
        takes = takes.min(begun.elapsed());
    }
    let (whole, mut fewer) = (whole.unwrap(), heavy.clone());
    fewer.samples_min = 32;
    // A third of the time, on a machine whose pace varies: what matters is that an answer is the beginning of the whole.
    let (mut answered, mut attempts) = (0, 0);
    while answered < 2 {
        attempts += 1;
        assert!(attempts <= 20, "{answered} of 20 in time");
        if let Ok(some) = client.predict_within(fewer.clone(), Some(takes / 3)).await {
            assert!((32..2048).contains(&some.samples), "{} samples in a third of {takes:?}", some.samples);
            let same = some.states.iter().zip(&whole.states).all(|(a, b)| a.to_bits() == b.to_bits());
            assert!(same && some.states.len() == some.samples * 32 * 12 && some.validity == whole.validity[..some.samples]);
            answered += 1;
        }
    }
    // With time enough all are computed, and without leave none is left out.
    assert_eq!(client.predict_within(fewer.clone(), Some(Duration::from_secs(20))).await.unwrap().samples, 2048);
    if let Ok(all) = client.predict_within(heavy, Some(takes / 3)).await {
        assert_eq!(all.samples, 2048);
    }
    fewer.samples_min = 2049;
    assert_refused("more than all", client.predict(fewer).await, Code::InvalidArgument, "samples_min");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_vehicles_share_the_time_evenly() {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| config.limits.waiting_predictions_per_vehicle_max = 20).await;
    for (vehicle, session) in [("greedy", "greedy"), ("greedy", "greedy-too"), ("modest", "modest")] {
        let request = v1::OpenSessionRequest { vehicle_id: vehicle.into(), session_id: session.into(), ..Default::default() };
        client.open_session(request).await.unwrap();
        client.feed(samples(session, &recorded.drive, 40)).await.unwrap();
    }
    let question = |session: &str| candidates(session, &recorded.drive, 40, 1024, 32);
    client.predict(question("modest")).await.unwrap();
    // One vehicle asks for forty predictions through two sessions; the limit holds for the vehicle.
    let greedy: Vec<_> = (0..40)
        .map(|i| {
            let (mut client, question) = (client.clone(), question(["greedy", "greedy-too"][i % 2]));
            tokio::spawn(async move { client.predict(question).await })
        })
        .collect();
    eventually(PATIENCE, "most of them wait", async || server.engine().waiting().1 >= 15).await;
    // The other one asks once: before it come the prediction that runs and one of the greedy vehicle's, and not all of them.
    let before = server.metrics().predictions();
    client.predict(question("modest")).await.unwrap();
    let overtaken = server.metrics().predictions() - before;
    assert!(overtaken <= 4, "{overtaken} predictions were answered before");
    let mut refused = 0;
    for task in greedy {
        if let Err(error) = task.await.unwrap() {
            assert!(error.code() == Some(Code::ResourceExhausted) && error.to_string().contains("of this vehicle"), "{error}");
            refused += 1;
        }
    }
    assert!((1..=25).contains(&refused), "{refused}");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_limits_hold_at_the_edge() {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| {
        config.limits.sessions_max = 3;
        config.limits.maps_max = 2;
        config.limits.map_cells_total_max = 700;
        config.limits.sample_steps_max = 64;
    })
    .await;
    for session in ["a", "b", "c"] {
        open(&mut client, session, "").await;
    }
    let fourth = v1::OpenSessionRequest { vehicle_id: "d".into(), ..Default::default() };
    assert_refused("fourth session", client.open_session(fourth.clone()).await, Code::ResourceExhausted, "session_id");
    client.close_session("b").await.unwrap();
    client.open_session(fourth).await.unwrap();

    let mut map = layers(&recorded.world);
    (map.width, map.height, map.semantic_rgb) = (20, 20, None);
    map.elevation_m = vec![1.0; 400];
    client.upload_map(&map).await.unwrap();
    map.id = "second".into();
    assert_refused("cells of all maps", client.upload_map(&map).await, Code::ResourceExhausted, "map_id");
    (map.height, map.elevation_m) = (10, vec![1.0; 200]);
    client.upload_map(&map).await.unwrap();
    (map.id, map.height, map.elevation_m) = ("third".into(), 2, vec![1.0; 40]);
    assert_refused("third map", client.upload_map(&map).await, Code::ResourceExhausted, "map_id");

    client.feed(samples("a", &recorded.drive, 3)).await.unwrap();
    client.predict(candidates("a", &recorded.drive, 3, 2, 32)).await.unwrap();
    client.predict(candidates("a", &recorded.drive, 3, 64, 1)).await.unwrap();
    assert_refused("N K", client.predict(candidates("a", &recorded.drive, 3, 65, 1)).await, Code::InvalidArgument, "samples");
    server.shutdown().await;
}
