//! The plant's side of the plant adapter: datagrams of JSON in lock-step, as `docs/plant-adapter.md` defines.

use std::net::{SocketAddr, UdpSocket};

use serde_json::{Value, json};

use crate::plant::{Command, Plant};
use crate::sensors::Sensors;

/// Version of the protocol.
const VERSION: u64 = 1;
/// Largest datagram read, bytes.
const DATAGRAM_MAX: usize = 2048;

/// What a client asks for.
#[derive(Clone, Debug, PartialEq)]
pub enum Request {
    /// Fresh soil, the vehicle at rest.
    Reset {
        /// World.
        world: String,
        /// Seed of the sensors.
        seed: u64,
        /// x, y (m) and yaw (rad).
        pose: [f64; 3],
    },
    /// One step with a command.
    Step(Command),
}

impl Request {
    /// Reads a datagram; gives its number too.
    ///
    /// # Errors
    /// The number as far as it was readable, and what was wrong.
    pub fn parse(datagram: &[u8]) -> Result<(u64, Self), (u64, String)> {
        let json: Value = serde_json::from_slice(datagram).map_err(|e| (0, format!("not JSON: {e}")))?;
        let id = json.get("id").and_then(whole).ok_or((0, "`id` is missing".to_string()))?;
        let number = |key: &str| {
            let value = json.get(key).and_then(Value::as_f64).filter(|v| v.is_finite() && v.abs() < 1e6);
            value.ok_or_else(|| (id, format!("`{key}` must be a number")))
        };
        if json.get("nesam_plant").and_then(whole) != Some(VERSION) {
            return Err((id, format!("`nesam_plant` must be {VERSION}")));
        }
        match json.get("type").and_then(Value::as_str) {
            Some("reset") => {
                let world = json.get("world").and_then(Value::as_str).ok_or((id, "`world` is missing".to_string()))?;
                let seed = json.get("seed").and_then(whole).ok_or((id, "`seed` must be a whole number".to_string()))?;
                let pose = [number("x_m")?, number("y_m")?, number("yaw_rad")?];
                Ok((id, Self::Reset { world: world.into(), seed, pose }))
            }
            Some("step") => Ok((id, Self::Step(Command { speed_m_s: number("speed_m_s")?, steering: number("second")? }))),
            _ => Err((id, "`type` must be reset or step".into())),
        }
    }
}

/// A whole number, also one that is written `30.0`.
fn whole(value: &Value) -> Option<u64> {
    let of_float = || value.as_f64().filter(|v| v.fract() == 0.0 && (0.0..9_007_199_254_740_992.0).contains(v)).map(|v| v as u64);
    value.as_u64().or_else(of_float)
}

/// A reply.
#[derive(Clone, Debug, PartialEq)]
pub struct Answer(pub Vec<u8>);

type Make = Box<dyn FnMut(&str, u64, [f64; 3]) -> Result<(Plant, Sensors), String> + Send>;

/// Answers datagrams with a plant behind them.
pub struct PlantServer {
    make: Make,
    name: String,
    running: Option<(Plant, Sensors)>,
    last: Option<Last>,
}

/// The last request carried out, for clients that ask again.
struct Last {
    from: SocketAddr,
    id: u64,
    answer: Answer,
}

impl PlantServer {
    /// A server that makes its plants from world, seed and pose. `name` says in every answer to `reset` which plant it is: laps on plants of one name are laps
    /// on one plant.
    pub fn new(
        name: impl Into<String>,
        make: impl FnMut(&str, u64, [f64; 3]) -> Result<(Plant, Sensors), String> + Send + 'static,
    ) -> Self {
        Self { make: Box::new(make), name: name.into(), running: None, last: None }
    }

    /// The answer to one datagram. The same number from the same sender asked again gets the same answer and moves nothing; a smaller one is a late copy and gets
    /// none. Another sender begins another conversation, with `reset`.
    pub fn answer(&mut self, from: SocketAddr, datagram: &[u8]) -> Option<Answer> {
        let (id, request) = match Request::parse(datagram) {
            Ok(parsed) => parsed,
            Err((id, reason)) => return Some(error(id, &reason)),
        };
        if let Some(last) = self.last.as_ref().filter(|last| last.from == from && id <= last.id) {
            return (id == last.id).then(|| last.answer.clone());
        }
        // Somebody else's vehicle is not theirs to move.
        if matches!(request, Request::Step(_)) && self.last.as_ref().is_some_and(|last| last.from != from) {
            return Some(error(id, "reset comes first"));
        }
        let answer = match self.carry_out(request) {
            Ok(reading) => {
                let mut reply = json!({ "nesam_plant": VERSION, "id": id });
                if let (Some(to), Value::Object(from)) = (reply.as_object_mut(), reading) {
                    to.extend(from);
                }
                Answer(reply.to_string().into_bytes())
            }
            Err(reason) => return Some(error(id, &reason)),
        };
        self.last = Some(Last { from, id, answer: answer.clone() });
        Some(answer)
    }

    fn carry_out(&mut self, request: Request) -> Result<Value, String> {
        let begins = matches!(request, Request::Reset { .. });
        match request {
            Request::Reset { world, seed, pose } => self.running = Some((self.make)(&world, seed, pose)?),
            Request::Step(command) => self.running.as_mut().ok_or("reset comes first")?.0.advance(command),
        }
        let (plant, sensors) = self.running.as_mut().ok_or("reset comes first")?;
        let truth = plant.truth();
        let measured = sensors.read(&truth);
        let mut reading = json!({
            "t_s": truth.time_s,
            "state": measured.state,
            "wheel_rad_s": measured.wheel_rad_s,
            "road_wheel_rad": measured.road_wheel_rad,
            "truth": truth.state,
        });
        if begins {
            reading["plant"] = self.name.as_str().into();
        }
        Ok(reading)
    }

    /// Answers until the socket fails.
    ///
    /// # Errors
    /// What the socket said.
    pub fn run(&mut self, socket: &UdpSocket) -> std::io::Result<()> {
        let mut buffer = [0; DATAGRAM_MAX];
        loop {
            let (length, from) = socket.recv_from(&mut buffer)?;
            if let Some(answer) = self.answer(from, &buffer[..length]) {
                socket.send_to(&answer.0, from)?;
            }
        }
    }
}

fn error(id: u64, reason: &str) -> Answer {
    Answer(json!({ "nesam_plant": VERSION, "id": id, "error": reason }).to_string().into_bytes())
}
