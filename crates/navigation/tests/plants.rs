//! Goal: a plant is the same whichever way it is reached, and the loop around it is repeatable.
//! Method: the plant of `tests/plant` in this process and over UDP; a foreign plant in Python; laps with the kinematic model, which needs no server.
#![allow(clippy::unwrap_used)]

mod common;

use std::net::{SocketAddr, UdpSocket};
use std::process::{Child, Command as Process, Stdio};
use std::sync::Arc;
use std::time::Duration;

use common::{lap_on, repository, sample};
use nesam_navigation::{Answer, BuiltInPlant, Lap, PlantLink, Reading, RemotePlant, Scored, Start};
use nesam_physics::Control;
use nesam_plant::{Ground, HiddenEffects, Plant, PlantServer, PlantVehicle, Sensors};
use serde_json::Value;

/// Time that plants of these tests get for an answer.
const TIMEOUT: Duration = Duration::from_secs(60);

fn start(world: &str) -> Start {
    Start { world: world.into(), seed: 5, position_m: [23.5, 0.0], yaw_rad: 1.57 }
}

/// A free port of loopback, held by the socket.
fn socket() -> (UdpSocket, String) {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = socket.local_addr().unwrap().to_string();
    (socket, address)
}

/// The built-in plant behind the protocol.
fn server() -> PlantServer {
    let vehicle = Arc::new(PlantVehicle::of_root(&sample()).unwrap());
    PlantServer::new("the plant of the test", move |world, seed, [x, y, yaw]| {
        let ground = Ground::read(&sample().join("worlds").join(world)).map_err(|e| e.to_string())?;
        let effects = HiddenEffects::default();
        Ok((Plant::at_rest(Arc::clone(&vehicle), Arc::new(ground), effects, x, y, yaw), Sensors::new(seed, &effects)))
    })
}

fn reading(answer: Answer) -> Reading {
    answer.reading().unwrap()
}

#[test]
fn service_plant_over_udp_is_the_built_in_plant() {
    let (socket, address) = socket();
    let mut server = server();
    std::thread::spawn(move || server.run(&socket));
    let mut remote = RemotePlant::connect(&address, 0, TIMEOUT).unwrap();
    let mut built_in = BuiltInPlant::new(&sample(), HiddenEffects::default()).unwrap();
    // Numbers that travel as decimal text may come back with another last bit.
    let same = |a: Reading, b: Reading, k: u32| {
        assert!(a.truth.is_some() && b.truth.is_some());
        let pairs = a.measured.iter().chain(a.scored()).zip(b.measured.iter().chain(b.scored()));
        pairs.for_each(|(a, b)| assert!((a - b).abs() < 1e-12 * (1.0 + a.abs()), "step {k}: {a} {b}"));
    };
    same(reading(remote.reset(&start("w35")).unwrap()), reading(built_in.reset(&start("w35")).unwrap()), 0);
    assert_eq!(remote.name(&start("w35")).unwrap().as_deref(), Some("the plant of the test"));
    assert_eq!(built_in.name(&start("w35")).unwrap(), None);
    // The answer to the question for the name is that to this start.
    same(reading(remote.reset(&start("w35")).unwrap()), reading(built_in.reset(&start("w35")).unwrap()), 0);
    for k in 1..15 {
        let command = Control { speed_m_s: 2.0, second: 0.02 * f64::from(k) };
        same(reading(remote.step(command).unwrap()), reading(built_in.step(command).unwrap()), k);
    }
    let error = remote.reset(&start("nowhere")).unwrap_err().to_string();
    assert!(error.contains("nowhere"), "{error}");
}

#[test]
fn property_a_request_that_is_asked_again_moves_nothing_and_bad_ones_are_answered() {
    let mut server = server();
    let client: SocketAddr = "127.0.0.1:4000".parse().unwrap();
    let mut ask = |text: &str| String::from_utf8(server.answer(client, text.as_bytes()).unwrap().0).unwrap();
    assert!(ask(r#"{"nesam_plant":1,"id":1,"type":"step","speed_m_s":1,"second":0}"#).contains("reset comes first"));
    let reset = r#"{"nesam_plant":1,"id":2,"type":"reset","world":"w35","seed":1,"x_m":0,"y_m":0,"yaw_rad":0}"#;
    assert!(ask(reset).contains("state"));
    let step = r#"{"nesam_plant":1,"id":3,"type":"step","speed_m_s":2,"second":0.1}"#;
    let first = ask(step);
    assert_eq!(first, ask(step));
    assert_ne!(first, ask(&step.replace(":3,", ":4,")).replace(":4,", ":3,"));
    for (text, part) in [
        ("", "not JSON"),
        ("{}", "`id`"),
        (r#"{"nesam_plant":2,"id":5,"type":"step"}"#, "nesam_plant"),
        (r#"{"nesam_plant":1,"id":5,"type":"jump"}"#, "type"),
        (r#"{"nesam_plant":1,"id":5,"type":"step","speed_m_s":1e999,"second":0}"#, ""),
        (r#"{"nesam_plant":1,"id":5,"type":"step","speed_m_s":"x","second":0}"#, "speed_m_s"),
    ] {
        let answer = ask(text);
        assert!(answer.contains("error") && answer.contains(part), "{text}: {answer}");
    }
}

/// What a plant has to do with the same number again, a smaller one, and one from elsewhere. `ask` sends a request from one of two clients.
fn moves_once(mut ask: impl FnMut(usize, &str) -> Option<Value>) {
    let step = |id: u64| format!(r#"{{"nesam_plant":1,"id":{id},"type":"step","speed_m_s":2,"second":0}}"#);
    let reset = r#"{"nesam_plant":1,"id":10,"type":"reset","world":"w35","seed":1,"x_m":0,"y_m":0,"yaw_rad":0}"#;
    let first = ask(0, reset).unwrap();
    assert!(first["plant"].is_string() && first["state"].is_array(), "{first}");
    let before = ask(0, &step(11)).unwrap();
    let after = ask(0, &step(12)).unwrap();
    assert_ne!(before["state"], after["state"]);
    assert!(ask(0, &step(11)).is_none() && ask(0, reset).is_none(), "late copies get no answer");
    assert_eq!(ask(0, &step(12)).unwrap(), after, "and have moved nothing");
    let elsewhere = ask(1, &step(12)).unwrap();
    assert_eq!(elsewhere["error"], "reset comes first", "another client's vehicle is not this one's to move");
    let again = ask(1, &reset.replace("10", "13")).unwrap();
    assert_eq!(again["state"], first["state"], "another client's vehicle is set down anew");
    assert!(ask(1, &step(14)).unwrap()["state"].is_array());
}

/// Goal: a datagram that the network delivers twice, late, does not move the vehicle. Method: the same conversation with the built-in plant and with the stub
/// in Python over UDP, whose silence lasts for 0.3 s.
#[test]
fn service_a_late_copy_of_a_request_moves_nothing() {
    let mut server = server();
    moves_once(|client, text| {
        let from = SocketAddr::from(([127, 0, 0, 1], 4000 + client as u16));
        server.answer(from, text.as_bytes()).map(|answer| serde_json::from_slice(&answer.0).unwrap())
    });
    let (_stub, address) = python_plant();
    let clients = [0, 1].map(|_| {
        let client = socket().0;
        client.connect(&address).unwrap();
        client.set_read_timeout(Some(Duration::from_millis(300))).unwrap();
        client
    });
    RemotePlant::connect(&address, 0, TIMEOUT).unwrap().reset(&start("w35")).unwrap();
    moves_once(|client, text| {
        let mut buffer = [0; 4096];
        clients[client].send(text.as_bytes()).unwrap();
        clients[client].recv(&mut buffer).ok().map(|length| serde_json::from_slice(&buffer[..length]).unwrap())
    });
}

/// A child that is ended with the test.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The reference plant in Python on a free port.
fn python_plant() -> (Ended, String) {
    let (held, address) = socket();
    drop(held);
    let script = repository().join("clients/python/examples/plant_stub.py");
    let child = Process::new("python3").arg(script).arg(&address).stdout(Stdio::null()).spawn();
    (Ended(child.expect("python3 runs the reference plant")), address)
}

/// The reference plant in Python speaks the protocol: a lap on it with the kinematic model is completed.
#[test]
fn service_python_plant_drives_a_lap() {
    let (_stub, address) = python_plant();
    let mut remote = RemotePlant::connect(&address, 7, TIMEOUT).unwrap();
    // Position and velocity are those of one point: on a steady circle it moves as its velocity says, but for 0.1 mm of the Euler steps of that plant.
    remote.reset(&start("w35")).unwrap();
    let circle: Vec<[f64; 12]> = (0..40).map(|_| reading(remote.step(Control { speed_m_s: 2.0, second: 0.5 }).unwrap()).measured).collect();
    let (before, after) = (circle[38], circle[39]);
    let (sin, cos) = (0.5 * (before[5] + after[5])).sin_cos();
    let moved = [0.1 * (after[6] * cos - after[7] * sin), 0.1 * (after[6] * sin + after[7] * cos)];
    (0..2).for_each(|i| assert!((after[i] - before[i] - moved[i]).abs() < 1e-3, "{before:?} {after:?}"));
    let lap = lap_on(&mut remote, "w35", 1).unwrap();
    assert!(lap.scored == Scored::State && lap.velocity_mismatch_m_s.is_some_and(|m_s| m_s < 0.1), "{:?}", lap.velocity_mismatch_m_s);
    assert!(lap.completed && lap.hausdorff_m.is_some_and(|m| m < 3.0), "{:?}", Lap { path: Vec::new(), ..lap });
}

/// Goal: same seeds, same lap, to the last bit; another seed, another lap. On ground of the sample, whose soil the kinematic model does not know.
#[test]
fn property_laps_are_repeatable() {
    let mut plant = BuiltInPlant::new(&sample(), HiddenEffects::default()).unwrap();
    let mut lap = |seed: u64| lap_on(&mut plant, "w05", seed).unwrap();
    let first = lap(1);
    assert_eq!(first, lap(1));
    let other = lap(2);
    // Noise of the position makes 0.03 m/s of it.
    assert!(first.scored == Scored::Truth && first.velocity_mismatch_m_s.is_some_and(|m_s| m_s < 0.1), "{:?}", first.velocity_mismatch_m_s);
    assert_ne!(first.path, other.path);
    assert!(first.progress > 0.2, "{:?}", Lap { path: Vec::new(), ..first });
}
