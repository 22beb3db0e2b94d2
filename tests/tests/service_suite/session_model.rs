//! Goal: whatever is asked of sessions in whatever order, they do what a model of a few lines does, and a refused command changes nothing. Method: an engine
//! and the model get the same random commands; sessions are copied, moved between engines as a store does, closed and opened again.

use std::collections::BTreeMap;

use nesam_engine::{Command, Engine, EngineError, Limits, MeasureAnswer, Measurement, OpenSession, Outcome, Reply, SessionImage};
use nesam_server::convert::{image_bytes, session_image};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::stage::*;

const RUNS: u64 = 6;
const COMMANDS: usize = 120;
const NAMES: [&str; 4] = ["a", "b", "c", "d"];
const VEHICLES: [&str; 2] = ["truck", "car"];

/// All that the model knows of a session.
#[derive(Clone, Debug, PartialEq)]
struct Model {
    vehicle: &'static str,
    accepted: usize,
}

struct Pair {
    engine: Engine,
    now_ns: u64,
    model: BTreeMap<&'static str, Model>,
    images: Vec<(SessionImage, Model)>,
}

impl Pair {
    fn new() -> Self {
        Self { engine: Engine::new(predictor(), Limits::default()).unwrap(), now_ns: 0, model: BTreeMap::new(), images: Vec::new() }
    }

    fn ask(&mut self, command: Command) -> Result<Reply, EngineError> {
        self.engine.execute(self.now_ns, &command)
    }

    fn image(&mut self, name: &str) -> Option<SessionImage> {
        match self.ask(Command::Export { session: name.into() }) {
            Ok(Reply::Image(image)) => Some(*image),
            _ => None,
        }
    }

    /// The `i`-th measurement of the recorded drive for a session.
    fn measure(
        &mut self,
        name: &str,
        i: usize,
        change: impl FnOnce(&mut Measurement),
        vehicle: Option<&str>,
    ) -> Result<MeasureAnswer, EngineError> {
        let mut measurement = engine_sample(&recorded().drive, i);
        change(&mut measurement);
        match self.ask(Command::Measure { session: name.into(), vehicle: vehicle.map(Into::into), measurement })? {
            Reply::Measured(answer) => Ok(*answer),
            other => panic!("{other:?}"),
        }
    }

    /// Opening, copying or importing under a name: succeeds if the name is free.
    fn begins(&mut self, name: &'static str, command: Command, model: Model) {
        let result = self.ask(command);
        if self.model.contains_key(name) {
            assert!(matches!(result, Err(EngineError::SessionExists { .. })), "{name}: {result:?}");
        } else {
            assert!(matches!(result, Ok(Reply::Session(_))), "{name}: {result:?}");
            self.model.insert(name, model);
        }
    }

    fn step(&mut self, rng: &mut ChaCha8Rng) {
        let (name, other) = (NAMES[rng.random_range(0..NAMES.len())], NAMES[rng.random_range(0..NAMES.len())]);
        let known = self.model.get(name).cloned();
        let unknown = |result: Result<Reply, EngineError>| assert!(matches!(result, Err(EngineError::UnknownSession { .. })), "{result:?}");
        match rng.random_range(0..16) {
            0 | 1 => {
                let vehicle = VEHICLES[rng.random_range(0..VEHICLES.len())];
                let open = OpenSession { session: name.into(), vehicle: vehicle.into(), ..Default::default() };
                self.begins(name, Command::Open(open), Model { vehicle, accepted: 0 });
            }
            2 => {
                let result = self.ask(Command::Close { session: name.into() });
                match self.model.remove(name) {
                    Some(_) => assert!(matches!(result, Ok(Reply::Done)), "{result:?}"),
                    None => unknown(result),
                }
            }
            3 => {
                let fork = Command::Fork { session: name.into(), copy: other.into() };
                match known {
                    Some(model) => self.begins(other, fork, model),
                    None => unknown(self.ask(fork)),
                }
            }
            4 => match (self.image(name), known) {
                (Some(image), Some(model)) => self.images.push((image, model)),
                (image, known) => assert!(image.is_none() && known.is_none(), "{name}"),
            },
            5 if !self.images.is_empty() => {
                let (image, model) = self.images[rng.random_range(0..self.images.len())].clone();
                self.begins(name, Command::Import { image: Box::new(image), session: name.into() }, model);
            }
            6 => self.restart(),
            7..=9 => self.refused_measurement(name, rng),
            _ => {
                let i = known.as_ref().map_or(0, |model| model.accepted);
                if i + 1 >= recorded().drive.states.len() {
                    return;
                }
                self.now_ns += STEP_NS as u64;
                let result = self.measure(name, i, |_| {}, None);
                match self.model.get_mut(name) {
                    Some(model) => {
                        let answer = result.unwrap();
                        model.accepted += 1;
                        assert!(answer.outcome.accepted(), "{name}: {answer:?}");
                        assert_eq!(answer.accepted, model.accepted as u64);
                    }
                    None => assert!(matches!(result, Err(EngineError::UnknownSession { .. })), "{result:?}"),
                }
            }
        }
    }

    /// A measurement that must change nothing.
    fn refused_measurement(&mut self, name: &str, rng: &mut ChaCha8Rng) {
        let Some(model) = self.model.get(name).cloned().filter(|model| model.accepted > 12) else { return };
        let before = self.image(name);
        let newest = model.accepted - 1;
        let stranger = VEHICLES.into_iter().find(|vehicle| *vehicle != model.vehicle);
        match rng.random_range(0..4) {
            0 => assert_eq!(self.measure(name, newest, |_| {}, None).unwrap().outcome, Outcome::Duplicate),
            1 => {
                let late = self.measure(name, newest - 11, |m| m.stamp_ns += STEP_NS / 2, Some(model.vehicle)).unwrap().outcome;
                assert!(matches!(late, Outcome::TooOld { .. }), "{late:?}");
                // That a late one came is noted, so that several in a row can prove a clock that was set.
                return;
            }
            2 => {
                let outcome = self.measure(name, newest + 1, |m| m.state.position_m[0] = f64::NAN, None).map(|answer| answer.outcome);
                assert!(matches!(outcome, Ok(Outcome::NotFinite { .. })), "{outcome:?}");
            }
            _ => {
                let foreign = self.measure(name, newest + 1, |_| {}, stranger);
                assert!(foreign.is_err(), "{foreign:?}");
            }
        }
        assert_eq!(self.image(name), before, "{name}: a refused measurement changed something");
    }

    /// Everything goes on in another engine, as after a crash or a move.
    fn restart(&mut self) {
        let names: Vec<String> = self.model.keys().map(|name| (*name).into()).collect();
        let Ok(Reply::Snapshot(snapshot)) = self.ask(Command::Snapshot { sessions: names, maps: Vec::new() }) else {
            panic!("no snapshot")
        };
        self.engine = Engine::new(predictor(), Limits::default()).unwrap();
        for (name, image) in snapshot.sessions {
            let image = session_image(&image_bytes(&image.unwrap())).unwrap();
            self.ask(Command::Import { image: Box::new(image), session: name }).unwrap();
        }
    }

    fn compare(&mut self) {
        let Ok(Reply::Sessions(views)) = self.ask(Command::List) else { panic!("no list") };
        let told: BTreeMap<&str, (&str, usize, Option<i64>)> =
            views.iter().map(|v| (v.session.as_str(), (v.vehicle.as_str(), v.accepted as usize, v.last_stamp_ns))).collect();
        let expected: BTreeMap<&str, _> = self
            .model
            .iter()
            .map(|(name, m)| (*name, (m.vehicle, m.accepted, m.accepted.checked_sub(1).map(|newest| newest as i64 * STEP_NS))))
            .collect();
        assert_eq!(told, expected);
    }
}

#[test]
fn property_sessions_do_what_the_model_does() {
    for seed in 0..RUNS {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut pair = Pair::new();
        for _ in 0..COMMANDS {
            pair.step(&mut rng);
            pair.compare();
        }
    }
}
