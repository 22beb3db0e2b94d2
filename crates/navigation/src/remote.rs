//! Another simulator in the plant's place: datagrams of JSON in lock-step (docs/plant-adapter.md).

use std::net::UdpSocket;
use std::time::{Duration, Instant};

use nesam_physics::Control;
use serde_json::{Value, json};

use crate::error::NavigationError;
use crate::link::{PlantLink, Reading, Start};

/// Version of the protocol.
const VERSION: u64 = 1;
/// Time after which an unanswered request is sent again.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// Time after which nobody is expected to answer any more: a slow simulator may take two minutes for a step.
const GIVE_UP: Duration = Duration::from_secs(120);
/// Largest datagram read, bytes.
const DATAGRAM_MAX: usize = 65_536;

/// A plant behind a UDP address.
pub struct RemotePlant {
    address: String,
    socket: UdpSocket,
    number: u64,
}

impl RemotePlant {
    /// Prepares to talk to a plant, e.g. at `127.0.0.1:5599`. `first_number` is the number of the first request; another one than in an earlier
    /// conversation keeps a plant that remembers its last answer from repeating it.
    ///
    /// # Errors
    /// `NavigationError::Plant` when the address cannot be used.
    pub fn connect(address: &str, first_number: u64) -> Result<Self, NavigationError> {
        let failed = |e: std::io::Error| NavigationError::Plant { address: address.into(), reason: e.to_string() };
        let any = if address.starts_with('[') { "[::]:0" } else { "0.0.0.0:0" };
        let socket = UdpSocket::bind(any).map_err(failed)?;
        socket.connect(address).map_err(failed)?;
        socket.set_read_timeout(Some(ASK_AGAIN)).map_err(failed)?;
        Ok(Self { address: address.into(), socket, number: first_number })
    }

    fn wrong(&self, reason: impl Into<String>) -> NavigationError {
        NavigationError::Plant { address: self.address.clone(), reason: reason.into() }
    }

    /// Sends a request until it is answered.
    fn ask(&mut self, mut request: Value) -> Result<Reading, NavigationError> {
        self.number += 1;
        request["nesam_plant"] = VERSION.into();
        request["id"] = self.number.into();
        let datagram = request.to_string();
        let mut buffer = vec![0; DATAGRAM_MAX];
        let begin = Instant::now();
        while begin.elapsed() < GIVE_UP {
            let sent = Instant::now();
            let mut answer = self.socket.send(datagram.as_bytes()).and_then(|_| self.socket.recv(&mut buffer));
            while let Ok(length) = answer {
                let reply: Value =
                    serde_json::from_slice(&buffer[..length]).map_err(|e| self.wrong(format!("its reply is not JSON: {e}")))?;
                if reply.get("id").and_then(Value::as_u64) == Some(self.number) {
                    return self.reading(&reply);
                }
                answer = self.socket.recv(&mut buffer);
            }
            // Where nobody listens yet the datagram is refused at once; the plant may still come.
            std::thread::sleep(ASK_AGAIN.saturating_sub(sent.elapsed()));
        }
        Err(self.wrong(format!("no answer within {} s", GIVE_UP.as_secs())))
    }

    fn reading(&self, reply: &Value) -> Result<Reading, NavigationError> {
        if let Some(reason) = reply.get("error").and_then(Value::as_str) {
            return Err(self.wrong(reason));
        }
        let state = |key: &str| -> Option<[f64; 12]> {
            let numbers: Vec<f64> = reply.get(key)?.as_array()?.iter().map(Value::as_f64).collect::<Option<_>>()?;
            numbers.try_into().ok()
        };
        let measured = state("state").ok_or_else(|| self.wrong("`state` must be twelve numbers"))?;
        Ok(Reading { measured, truth: state("truth").unwrap_or(measured) })
    }
}

impl PlantLink for RemotePlant {
    fn reset(&mut self, start: &Start) -> Result<Reading, NavigationError> {
        let [x_m, y_m] = start.position_m;
        self.ask(json!({ "type": "reset", "world": start.world, "seed": start.seed, "x_m": x_m, "y_m": y_m, "yaw_rad": start.yaw_rad }))
    }

    fn step(&mut self, command: Control<f64>) -> Result<Reading, NavigationError> {
        self.ask(json!({ "type": "step", "speed_m_s": command.speed_m_s, "second": command.second }))
    }
}
