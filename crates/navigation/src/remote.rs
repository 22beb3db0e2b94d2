//! Another simulator in the plant's place: datagrams of JSON in lock-step (docs/plant-adapter.md).

use std::f64::consts::TAU;
use std::io::ErrorKind;
use std::net::{ToSocketAddrs, UdpSocket};
use std::time::{Duration, Instant};

use nesam_physics::{Control, wrap_angle};
use serde_json::{Value, json};

use crate::error::NavigationError;
use crate::lap::OWN_ENDS;
use crate::link::{Answer, PlantLink, Reading, Start};
use crate::plant_message::{read_json, twelve};

/// Version of the protocol.
const VERSION: u64 = 1;
/// Time after which an unanswered request is sent again.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// Largest datagram read, bytes.
const DATAGRAM_MAX: usize = 65_536;
/// How far from where it was asked to be a vehicle may be after `reset`: m and rad. More is another frame, another point or another unit.
const PLACED_WITHIN: [f64; 2] = [1.0, 0.2];
/// What a plant says to `step` that knows of no `reset`, because it was started anew.
const RESET_FIRST: &str = "reset comes first";
/// Longest text of a plant that becomes the end of a lap, characters.
const END_MAX: usize = 200;
/// Silence after which whoever waits is told.
const TOLD_AFTER: Duration = Duration::from_secs(5);

/// A plant behind a UDP address.
pub struct RemotePlant {
    address: String,
    socket: UdpSocket,
    number: u64,
    timeout: Duration,
    /// What the plant calls itself.
    name: Option<String>,
    /// Whether it tells the truth since `reset`.
    tells_truth: bool,
    /// Whether nobody waits for answers any more.
    given_up: fn() -> bool,
    /// Told of a plant that is silent.
    tell: Option<fn(&str)>,
    /// Whether it has been told since the plant last answered soon.
    told: bool,
    /// The answer to a `reset` that was asked to learn the name: the vehicle stands there.
    prepared: Option<(Start, Answer)>,
}

impl RemotePlant {
    /// Prepares to talk to a plant, e.g. at `127.0.0.1:5599` or `localhost:5599`; of several addresses of a name the first of IPv4 is taken. `first_number` is the
    /// number before that of the first request; a larger one than in any earlier conversation keeps a plant that remembers its last answer from repeating it.
    /// After `timeout` without an answer nobody is expected to answer any more.
    ///
    /// # Errors
    /// `NavigationError::Plant` when the address cannot be used.
    pub fn connect(address: &str, first_number: u64, timeout: Duration) -> Result<Self, NavigationError> {
        let failed = |e: std::io::Error| NavigationError::Plant { address: address.into(), reason: e.to_string() };
        let found: Vec<_> = address.to_socket_addrs().map_err(failed)?.collect();
        let to = found.iter().find(|to| to.is_ipv4()).or(found.first());
        let to = to.ok_or_else(|| NavigationError::Plant { address: address.into(), reason: "the name has no address".into() })?;
        let socket = UdpSocket::bind(if to.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" }).map_err(failed)?;
        socket.connect(to).map_err(failed)?;
        socket.set_read_timeout(Some(ASK_AGAIN)).map_err(failed)?;
        Ok(Self {
            address: address.into(),
            socket,
            number: first_number,
            timeout,
            name: None,
            tells_truth: false,
            given_up: || false,
            tell: None,
            told: false,
            prepared: None,
        })
    }

    /// Tells, once in a silence of five seconds, that nothing is heard and what is heard instead. A plant that always takes longer is told of once.
    #[must_use]
    pub fn telling(self, tell: fn(&str)) -> Self {
        Self { tell: Some(tell), ..self }
    }

    /// Waits for no answer once this says so.
    #[must_use]
    pub fn until(self, given_up: fn() -> bool) -> Self {
        Self { given_up, ..self }
    }

    fn wrong(&self, reason: impl Into<String>) -> NavigationError {
        NavigationError::Plant { address: self.address.clone(), reason: reason.into() }
    }

    fn lost(&self, reason: impl Into<String>) -> NavigationError {
        NavigationError::Lost { address: self.address.clone(), reason: reason.into() }
    }

    /// Sends a request until it is answered; else what was heard instead.
    fn ask(&mut self, mut request: Value) -> Result<Value, String> {
        self.number += 1;
        request["nesam_plant"] = VERSION.into();
        request["id"] = self.number.into();
        let datagram = request.to_string();
        let mut buffer = vec![0; DATAGRAM_MAX];
        let mut strays = Strays::default();
        let mut begin = Instant::now();
        let asked = begin;
        while begin.elapsed() < self.timeout && !(self.given_up)() {
            let sent = Instant::now();
            // Where nobody listens yet the datagram is refused at once; the plant may still come.
            let mut failed = self.socket.send(datagram.as_bytes()).err();
            while failed.is_none() && sent.elapsed() < ASK_AGAIN && begin.elapsed() < self.timeout {
                let length = match self.socket.recv(&mut buffer) {
                    Ok(length) => length,
                    Err(error) => {
                        failed = Some(error);
                        continue;
                    }
                };
                strays.refused = None;
                match read_json(&buffer[..length]) {
                    None => strays.unreadable += 1,
                    // 30.0 is 30: some languages know one kind of number.
                    Some(reply) if reply["id"].as_f64() != Some(self.number as f64) => strays.note(&reply),
                    Some(reply) if reply["busy"] == true => begin = Instant::now(),
                    Some(reply) => {
                        self.told &= asked.elapsed() > TOLD_AFTER;
                        return Ok(reply);
                    }
                }
            }
            // Silence is no error of the socket.
            if let Some(error) = failed.filter(|e| !matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut)) {
                strays.refused = Some(error);
            }
            self.tell_of_silence(begin.elapsed(), &strays);
            let left = self.timeout.saturating_sub(begin.elapsed());
            std::thread::sleep(ASK_AGAIN.saturating_sub(sent.elapsed()).min(left));
        }
        if (self.given_up)() {
            return Err("interrupted".into());
        }
        Err(format!("no answer within {} s{}", self.timeout.as_secs_f64(), strays.text()))
    }

    fn tell_of_silence(&mut self, silent: Duration, strays: &Strays) {
        let Some(tell) = self.tell.filter(|_| !self.told && silent > TOLD_AFTER && silent < self.timeout) else { return };
        self.told = true;
        let (address, timeout_s) = (&self.address, self.timeout.as_secs_f64());
        tell(&format!("plant {address}: no answer for {} s{}; it is asked for {timeout_s} s", silent.as_secs(), strays.text()));
    }

    fn answer(&self, reply: &Value) -> Result<Answer, NavigationError> {
        if let Some(version) = reply.get("nesam_plant").filter(|v| v.as_f64() != Some(VERSION as f64)) {
            return Err(self.wrong(format!("it speaks version {version} of the protocol, this program version {VERSION}")));
        }
        let is_none =
            |error: &Value| matches!(error, Value::Null | Value::Bool(false)) || error.as_str().is_some_and(|text| text.trim().is_empty());
        if let Some(reason) = reply.get("error").filter(|error| !is_none(error)) {
            return Err(self.wrong(reason.as_str().map_or_else(|| reason.to_string(), printable)));
        }
        match &reply["ended"] {
            Value::Null | Value::Bool(false) => {}
            Value::String(why) if !why.trim().is_empty() => {
                return Ok(Answer::Ended(end_of_plant(why.trim())));
            }
            _ => return Ok(Answer::Ended("plant_lost".into())),
        }
        let measured = reply.get("state").and_then(twelve).ok_or_else(|| self.wrong("`state` must be twelve numbers"))?;
        let not_true = || self.wrong("`truth` must be twelve finite numbers, or be left out");
        let truth = match &reply["truth"] {
            Value::Null => None,
            told => Some(twelve(told).ok_or_else(not_true)?),
        };
        // Where the vehicle itself is lost its truth may be, too.
        if is_finite(&measured) && truth.as_ref().is_some_and(|state| !is_finite(state)) {
            return Err(not_true());
        }
        Ok(Answer::Reading(Reading { measured, truth }))
    }

    /// The vehicle has to be where it was asked to be, as it is measured and in truth; a number that is none is the end of the lap and no matter of place.
    fn check_place(&self, start: &Start, answer: &Answer) -> Result<(), NavigationError> {
        let Some(Reading { measured, truth }) = answer.reading() else { return Ok(()) };
        let told = [("state", Some(measured)), ("truth", truth)];
        told.into_iter()
            .filter_map(|(name, state)| Some((name, state?)))
            .try_for_each(|(name, state)| self.check_placed(start, name, &state))
    }

    fn check_placed(&self, start: &Start, name: &str, state: &[f64; 12]) -> Result<(), NavigationError> {
        if !is_finite(state) {
            return Ok(());
        }
        let [x_m, y_m] = start.position_m;
        let [within_m, within_rad] = PLACED_WITHIN;
        let channels = [("x", state[0], x_m, within_m), ("y", state[1], y_m, within_m)];
        let off = channels.into_iter().find(|(_, is, asked, within)| (is - asked).abs() > *within);
        // As it came: a yaw of 90 is 90, and not the angle of a turn that it is taken for.
        let turned = wrap_angle(state[5] - start.yaw_rad).abs() > within_rad;
        let off = off.or(turned.then_some(("yaw", state[5], start.yaw_rad, within_rad)));
        off.map_or(Ok(()), |(channel, is, asked, within)| {
            let doubt = if channel == "yaw" && is.abs() > TAU { " (degrees?)" } else { "" };
            Err(self.wrong(format!(
                "after `reset` {channel} of `{name}` reads {is:.3}{doubt} where {asked:.3} was asked for (within {within}): `{name}` begins with x, y, z of the reference point in \
                 World, in m, and roll, pitch, yaw in rad"
            )))
        })
    }

    /// One campaign is one plant: another name is another plant at the same address.
    fn note_name(&mut self, reply: &Value) -> Result<(), NavigationError> {
        // A name that says nothing is none: any plant could have it.
        let Some(name) = reply["plant"].as_str().map(str::trim).filter(|name| !name.is_empty()).map(printable) else { return Ok(()) };
        if let Some(before) = self.name.as_deref().filter(|before| *before != name) {
            return Err(self.wrong(format!("it calls itself `{name}` and was `{before}` before")));
        }
        self.name = Some(name);
        Ok(())
    }
}

impl PlantLink for RemotePlant {
    fn reset(&mut self, start: &Start) -> Result<Answer, NavigationError> {
        if let Some((prepared, answer)) = self.prepared.take()
            && prepared == *start
        {
            return Ok(answer);
        }
        let [x_m, y_m] = start.position_m;
        let request =
            json!({ "type": "reset", "world": start.world, "seed": start.seed, "x_m": x_m, "y_m": y_m, "yaw_rad": start.yaw_rad });
        let reply = self.ask(request).map_err(|reason| self.wrong(reason))?;
        let answer = self.answer(&reply)?;
        self.note_name(&reply)?;
        self.check_place(start, &answer)?;
        self.tells_truth = answer.reading().is_some_and(|reading| reading.truth.is_some());
        Ok(answer)
    }

    fn step(&mut self, command: Control<f64>) -> Result<Answer, NavigationError> {
        let request = json!({ "type": "step", "speed_m_s": command.speed_m_s, "second": command.second });
        let reply = self.ask(request).map_err(|reason| self.lost(reason))?;
        match reply["error"].as_str() {
            Some(reason) if reason.contains(RESET_FIRST) => Err(self.lost(printable(reason))),
            _ => {
                let answer = self.answer(&reply)?;
                // A lap is scored by one of the two; where a number is none it is over.
                let mixed = |reading: Reading| reading.truth.is_some() != self.tells_truth && is_finite(&reading.measured);
                if answer.reading().is_some_and(mixed) {
                    return Err(self.wrong("`truth` is told in some answers and not in others: tell it in all since `reset`, or in none"));
                }
                Ok(answer)
            }
        }
    }

    fn name(&mut self, start: &Start) -> Result<Option<String>, NavigationError> {
        let answer = self.reset(start)?;
        self.prepared = Some((start.clone(), answer));
        Ok(self.name.clone())
    }
}

/// Whether all numbers of a state are some.
fn is_finite(state: &[f64; 12]) -> bool {
    state.iter().all(|v| v.is_finite())
}

/// A text of a plant on one line, with what does not print as it is written in programs.
fn printable(text: &str) -> String {
    let escaped = |c: char| if matches!(c, '\'' | '"' | '\\') { c.to_string() } else { c.escape_debug().to_string() };
    text.chars().map(escaped).collect()
}

/// The end that a plant makes of a lap, in its words; ends that this program finds are not for it to tell.
fn end_of_plant(why: &str) -> String {
    let why = printable(&why.chars().take(END_MAX).collect::<String>());
    if OWN_ENDS.contains(&why.as_str()) { format!("the plant said: {why}") } else { why }
}

/// What came from the plant's address and answered nothing.
#[derive(Default)]
struct Strays {
    /// The last error of the socket, where nothing came since.
    refused: Option<std::io::Error>,
    others: usize,
    last: String,
    unreadable: usize,
}

impl Strays {
    fn note(&mut self, reply: &Value) {
        self.others += 1;
        self.last = reply["id"].to_string();
    }

    fn text(&self) -> String {
        let mut text = String::new();
        if let Some(refused) = &self.refused {
            text += &format!("; the last error was: {refused}");
        } else if self.others + self.unreadable == 0 {
            text += "; nothing came from the address and port that are asked";
        }
        if self.others > 0 {
            text += &format!("; {} answers came with other ids, the last was {}", self.others, self.last);
        }
        if self.unreadable > 0 {
            text += &format!("; {} datagrams were no JSON", self.unreadable);
        }
        text
    }
}
