//! Goal: whatever order the threads of engine, keeper, vehicles and planners take their turns in, every command is answered once and in order, nobody waits for
//! ever, and what is called durable is in the store. Shuttle runs the real code over schedules from a seed; a failure prints its schedule.
//!
//! `cargo test --release --workspace --features nesam-tests/shuttle --test interleavings`; `NESAM_SCHEDULES=20000` tries more of them.
#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use nesam_engine::{
    Candidates, Clock, Command, Engine, EngineError, EngineHandle, EventSink, Executed, Limits, ManualClock, Measurement, OpenSession,
    PredictQuery, Reply, SessionView, Submission, WheelMeasurement,
};
use nesam_model::{ModelBundle, Predictor};
use nesam_physics::{Control, VehicleState};
use nesam_server::convert::session_image;
use nesam_server::store::{Change, Contents, Keeper, Restored, SessionStore, StoreError};
use nesam_tests::shipped_bundle;
use shuttle::scheduler::{PctScheduler, RandomScheduler};
use shuttle::sync::Mutex;
use shuttle::{Config, Runner, thread};

const SEED: u64 = 20261123;
/// The engine's thread predicts.
const STACK_BYTES: usize = 8 << 20;
/// Turns at which a schedule with priorities changes them.
const CHANGES: usize = 3;

fn schedules() -> usize {
    std::env::var("NESAM_SCHEDULES").map_or(2000, |asked| asked.parse().unwrap())
}

/// Runs `threads` under random schedules, and under schedules in which the threads have priorities that seldom change.
fn try_schedules(threads: impl Fn() + Copy + Send + Sync + 'static) {
    let mut config = Config::new();
    config.stack_size = STACK_BYTES;
    Runner::new(RandomScheduler::new_from_seed(SEED, schedules()), config.clone()).run(threads);
    Runner::new(PctScheduler::new_from_seed(SEED, CHANGES, schedules()), config).run(threads);
}

fn engine(sink: Option<EventSink>) -> (Engine, Arc<dyn Clock>) {
    static PREDICTOR: OnceLock<Arc<Predictor>> = OnceLock::new();
    let predictor = PREDICTOR.get_or_init(|| Arc::new(Predictor::new(Arc::new(ModelBundle::load(&shipped_bundle()).unwrap())).unwrap()));
    let engine = Engine::new(predictor.clone(), Limits::default()).unwrap();
    let engine = match sink {
        Some(sink) => engine.with_events(sink),
        None => engine,
    };
    (engine, Arc::new(ManualClock::default()))
}

fn open(session: &str) -> Command {
    Command::Open(OpenSession { vehicle: session.into(), ..Default::default() })
}

fn measure(session: &str, step: i64) -> Command {
    let measurement = Measurement {
        sequence: None,
        boot: None,
        stamp_ns: step * 100_000_000,
        state: VehicleState::zero(),
        command: Control { speed_m_s: 0.0, second: 0.0 },
        wheels: WheelMeasurement::default(),
    };
    Command::Measure { session: session.into(), vehicle: None, measurement }
}

fn predict(session: &str) -> Command {
    Command::Predict(PredictQuery {
        session: session.into(),
        start: None,
        instant: None,
        use_history: true,
        samples: 1,
        samples_min: 0,
        horizon: 1,
        controls: Candidates::Given(vec![0.0; 2]),
        cost: None,
        extras: Default::default(),
    })
}

fn view(engine: &EngineHandle, session: &str) -> SessionView {
    match engine.call(Command::Get { session: session.into() }).unwrap() {
        Reply::Session(view) => *view,
        other => panic!("{other:?}"),
    }
}

/// What came back, by who asked, in the order of the answers.
type Answers = Arc<Mutex<BTreeMap<&'static str, Vec<(usize, bool)>>>>;

fn submit(engine: &EngineHandle, answers: &Answers, who: &'static str, number: usize, command: Command) {
    let answers = answers.clone();
    engine.submit(Submission::new(command, move |answer| {
        let fine = !matches!(answer.result, Err(EngineError::Internal { .. }));
        answers.lock().unwrap().entry(who).or_default().push((number, fine));
    }));
}

/// Two vehicles and a planner at an engine that is stopped by the last of them, while predictions may still wait.
fn vehicles_and_a_planner(engine: EngineHandle) {
    const MEASUREMENTS: usize = 3;
    const PREDICTIONS: usize = 3;
    const LATE: usize = 2;
    let answers = Answers::default();
    let vehicles = ["a", "b"].map(|session| {
        let (engine, answers) = (engine.clone(), answers.clone());
        thread::spawn(move || {
            engine.call(open(session)).unwrap();
            (0..MEASUREMENTS).for_each(|i| submit(&engine, &answers, session, i, measure(session, i as i64)));
            // Commands have their turn in order: who reads after it wrote sees what it wrote.
            assert_eq!(view(&engine, session).accepted, MEASUREMENTS as u64);
        })
    });
    let planner = {
        let (engine, answers) = (engine.clone(), answers.clone());
        thread::spawn(move || (0..PREDICTIONS).for_each(|i| submit(&engine, &answers, "planner", i, predict("a"))))
    };
    // Commands that may come while somebody stops the engine.
    let late = {
        let (engine, answers) = (engine.clone(), answers.clone());
        thread::spawn(move || (0..LATE).for_each(|i| submit(&engine, &answers, "late", i, Command::List)))
    };
    vehicles.into_iter().for_each(|vehicle| vehicle.join().unwrap());
    let stopped = {
        let engine = engine.clone();
        thread::spawn(move || engine.stop().is_some())
    };
    let again = engine.stop().is_some();
    assert!(stopped.join().unwrap() ^ again, "one of two gets the engine back");
    planner.join().unwrap();
    late.join().unwrap();
    let answers = answers.lock().unwrap();
    for (who, asked) in [("a", MEASUREMENTS), ("b", MEASUREMENTS), ("planner", PREDICTIONS), ("late", LATE)] {
        let mut got = answers[who].clone();
        assert!(got.iter().all(|(_, fine)| *fine), "{who}: {got:?}");
        // Refusals overtake answers; measurements are all answered.
        if who == "planner" || who == "late" {
            got.sort_unstable();
        }
        assert_eq!(got.iter().map(|(number, _)| *number).collect::<Vec<_>>(), (0..asked).collect::<Vec<_>>(), "{who}");
    }
    assert!(matches!(engine.call(predict("a")), Err(EngineError::Stopped)));
}

#[test]
fn shuttle_every_command_is_answered_once_and_in_order() {
    try_schedules(|| {
        let (engine, clock) = engine(None);
        vehicles_and_a_planner(EngineHandle::spawn(engine, clock));
    });
}

#[test]
fn shuttle_without_a_thread_nothing_is_left_lying() {
    try_schedules(|| {
        let (engine, clock) = engine(None);
        vehicles_and_a_planner(EngineHandle::unthreaded(engine, clock, None));
    });
}

/// Goes on whenever somebody looks at it, so that predictions take time.
#[derive(Default)]
struct Ticking(AtomicU64);

impl Clock for Ticking {
    fn now_ns(&self) -> u64 {
        self.0.fetch_add(1_000_000, Ordering::Relaxed)
    }
}

/// Goal: whenever a short prediction comes in the midst of a long one both are answered, and in some schedules the short one first, though it was begun later. Method: two
/// planners, and somebody who stops the engine; the order of answers, and that of a recording.
#[test]
fn shuttle_a_short_prediction_in_the_midst_of_a_long_one() {
    const LONG: usize = 1200;
    static OVERTAKEN: AtomicU64 = AtomicU64::new(0);
    let of = |samples: usize| {
        let Command::Predict(query) = predict("a") else { panic!("a prediction was asked for") };
        Command::Predict(PredictQuery { samples, controls: Candidates::Given(vec![0.0; 2 * samples]), ..query })
    };
    try_schedules(move || {
        let begun = Arc::new(Mutex::new(Vec::new()));
        let answered = Arc::new(Mutex::new(Vec::new()));
        let tap = {
            let begun = begun.clone();
            Box::new(move |executed: Executed| {
                if let (Command::Predict(query), Ok(_)) = (executed.command, executed.result) {
                    begun.lock().unwrap().push(query.samples);
                }
            })
        };
        let engine = EngineHandle::spawn_tapped(engine(None).0, Arc::new(Ticking::default()), Some(tap));
        engine.call(open("a")).unwrap();
        engine.call(measure("a", 0)).unwrap();
        engine.call(of(1)).unwrap();
        let planners = [LONG, 1].map(|samples| {
            let (engine, answered) = (engine.clone(), answered.clone());
            thread::spawn(move || {
                engine.submit(Submission::new(of(samples), move |answer| answered.lock().unwrap().push((samples, answer.result.is_ok()))));
            })
        });
        planners.into_iter().for_each(|planner| planner.join().unwrap());
        engine.stop().unwrap();
        let mut answered = answered.lock().unwrap().clone();
        let overtaken = answered == [(1, true), (LONG, true)] && *begun.lock().unwrap() == [1, LONG, 1];
        OVERTAKEN.fetch_add(u64::from(overtaken), Ordering::Relaxed);
        answered.sort_unstable();
        assert_eq!(answered.iter().map(|(samples, _)| *samples).collect::<Vec<_>>(), [1, LONG]);
    });
    assert!(OVERTAKEN.load(Ordering::Relaxed) > 0, "in no schedule the short one came first");
}

/// What is on stable storage: accepted measurements of each session.
type Disk = Arc<Mutex<BTreeMap<String, u64>>>;

struct MemoryStore(Disk);

impl SessionStore for MemoryStore {
    fn load(&self) -> Result<Contents, StoreError> {
        Ok(Contents::default())
    }

    fn commit(&mut self, changes: &[Change]) -> Result<Vec<String>, StoreError> {
        for change in changes {
            match change {
                Change::PutSession(stored) => {
                    let accepted = session_image(&stored.image).unwrap().accepted;
                    self.0.lock().unwrap().insert(stored.name.clone(), accepted);
                }
                Change::RemoveSession(name) | Change::SetAside(name) => drop(self.0.lock().unwrap().remove(name)),
                Change::PutMap(..) | Change::RemoveMap(_) | Change::PutSoil(_) | Change::RemoveSoil(_) => {}
            }
        }
        Ok(Vec::new())
    }
}

/// Opens a session, drives, closes it and opens another one of the same name, while the keeper commits and somebody looks.
#[test]
fn shuttle_what_is_called_durable_is_in_the_store() {
    try_schedules(|| {
        let keeper = Arc::new(Keeper::new(Duration::ZERO));
        let noted = keeper.clone();
        let (engine, clock) = engine(Some(Box::new(move |event| noted.note(&event))));
        let engine = EngineHandle::spawn(engine, clock);
        let disk = Disk::default();
        keeper.start(Box::new(MemoryStore(disk.clone())), engine.clone(), Restored::default()).unwrap();
        let looks = {
            let (keeper, disk) = (keeper.clone(), disk.clone());
            thread::spawn(move || {
                for _ in 0..4 {
                    let durable = keeper.durable("other");
                    let held = disk.lock().unwrap().get("other").copied().unwrap_or(0);
                    assert!(durable <= held, "{durable} are called durable, the store holds {held}");
                }
            })
        };
        let other = {
            let engine = engine.clone();
            thread::spawn(move || {
                engine.call(open("other")).unwrap();
                (0..3).for_each(|i| drop(engine.call(measure("other", i)).unwrap()));
            })
        };
        engine.call(open("again")).unwrap();
        (0..3).for_each(|i| drop(engine.call(measure("again", i)).unwrap()));
        engine.call(Command::Close { session: "again".into() }).unwrap();
        engine.call(open("again")).unwrap();
        // Of the session of that name that was: commits that were on their way say nothing of this one.
        assert_eq!(keeper.durable("again"), 0);
        engine.call(measure("again", 0)).unwrap();
        assert!(keeper.durable("again") <= 1);
        other.join().unwrap();
        looks.join().unwrap();
        keeper.finish();
        assert_eq!((keeper.durable("again"), keeper.durable("other")), (1, 3));
        assert_eq!(*disk.lock().unwrap(), BTreeMap::from([("again".to_string(), 1), ("other".to_string(), 3)]));
        engine.stop().unwrap();
    });
}
