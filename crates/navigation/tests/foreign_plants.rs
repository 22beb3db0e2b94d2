//! Goal: simulators of others fail in every way there is, and a campaign goes on or says what was wrong.
//! Method: a bicycle behind the plant protocol, in this process and over UDP, whose answers are spoilt one way after the other.
#![allow(clippy::unwrap_used)]

#[path = "common/bicycle.rs"]
mod bicycle;
mod common;

use std::net::UdpSocket;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bicycle::{Habits, RIGHT, bicycle, bicycle_with};
use common::lap_on;
use nesam_navigation::{Answer, Lap, NavigationError, PlantLink, RemotePlant, Scored, Start};
use nesam_physics::Control;
use serde_json::{Value, json};

/// Time that plants of these tests get for an answer.
const TIMEOUT: Duration = Duration::from_secs(60);
/// Step of a lap at which its plant fails: 25 steps are those before the lap.
const FAILS_AT: usize = 60;

fn connect(address: &str) -> RemotePlant {
    RemotePlant::connect(address, 0, TIMEOUT).unwrap()
}

fn start() -> Start {
    Start { world: "w05".into(), seed: 5, position_m: [23.5, -2.25], yaw_rad: 1.57 }
}

/// Replaces parts of the replies from a step on.
fn spoilt(from: usize, part: &'static str) -> String {
    bicycle(move |_, steps, reply| {
        let (mut reply, part) = (reply, if steps >= from { part } else { "{}" });
        let part: Value = serde_json::from_str(part).unwrap();
        reply.as_object_mut().unwrap().extend(part.as_object().unwrap().clone());
        vec![reply.to_string()]
    })
}

/// Replies with numbers that are none, as Python writes them.
fn diverged(from: usize) -> String {
    bicycle(move |request, steps, reply| {
        let id = request["id"].as_u64().unwrap();
        let nan = format!(r#"{{"nesam_plant": 1, "id": {id}, "state": [{0}], "truth": [{0}]}}"#, ["NaN"; 12].join(", "));
        vec![if steps >= from { nan } else { reply.to_string() }]
    })
}

/// Goal: a vehicle that overturns and a simulation that diverges end their lap, not the campaign. Method: each once on the way and once before the lap begins;
/// what is kept of the lap is finite and can be read back.
#[test]
fn service_a_vehicle_that_is_lost_ends_its_lap() {
    let state = |channel: usize, value: &str| {
        let numbers: Vec<&str> = (0..12).map(|i| if i == channel { value } else { "0" }).collect();
        let part: &'static str = format!(r#"{{"state": [{}]}}"#, numbers.join(",")).leak();
        part
    };
    let nulls = r#"{"state": [null,null,null,null,null,null,null,null,null,null,null,null]}"#;
    let faults = [
        (nulls, "plant_lost"),
        (r#"{"state": null}"#, "plant_lost"),
        (state(6, "500"), "plant_lost"),
        (state(9, "300"), "plant_lost"),
        (state(3, "3.05"), "overturned"),
        (state(4, "-1.6"), "overturned"),
        (r#"{"state": null, "ended": "on its roof"}"#, "on its roof"),
        (r#"{"ended": "complete"}"#, "the plant said: complete"),
        ("{\"ended\": \"rolled\\u001b\\u202e\"}", r"rolled\u{1b}\u{202e}"),
        (r#"{"ended": true}"#, "plant_lost"),
    ];
    for from in [FAILS_AT, 3, 0] {
        for (part, end) in faults {
            // At `reset` a vehicle has to be where it was asked to be.
            if from > 0 || !part.contains("0,0") {
                held(&spoilt(from, part), from, end);
            }
        }
        held(&diverged(from), from, "plant_lost");
    }
}

fn held(address: &str, from: usize, end: &str) {
    let lap = lap_on(&mut connect(address), "w05", 1).unwrap();
    let text = serde_json::to_string(&lap).unwrap();
    assert!(serde_json::from_str::<Lap>(&text).is_ok() && !lap.completed && lap.end == end, "{from} {end}: {text}");
    assert_eq!(lap.time_s > 0.0, from == FAILS_AT, "{text}");
    // A lap that never began has no figures.
    let figures = [lap.roll_deg, lap.pitch_deg, lap.hausdorff_m.map(|m| if m < 5.0 { 0.0 } else { m })];
    assert_eq!(figures, [(from == FAILS_AT).then_some(0.0); 3], "{from} {end}: {text}");
    assert_eq!(lap.path.len(), if from == FAILS_AT { lap.lean.len() + 1 } else { 0 }, "every position: {text}");
}

/// Goal: a fault of the simulator itself ends the command, with its words; a plant that was started anew can drive the lap again. Method: both at one step.
#[test]
fn service_errors_are_told_from_laps_that_were_lost() {
    let error = lap_on(&mut connect(&spoilt(FAILS_AT, r#"{"error": "no licence"}"#)), "w05", 1).unwrap_err();
    assert!(matches!(&error, NavigationError::Plant { reason, .. } if reason == "no licence"), "{error}");
    let error = lap_on(&mut connect(&spoilt(FAILS_AT, r#"{"error": "reset comes first"}"#)), "w05", 1).unwrap_err();
    assert!(matches!(error, NavigationError::Lost { .. }), "{error}");
}

/// Goal: answers that would be scored wrongly are refused by name. Method: another version, truth of another length or that is none, a vehicle elsewhere.
#[test]
fn service_answers_of_another_form_are_refused() {
    for (part, word) in [
        (r#"{"nesam_plant": 7}"#, "version 7"),
        (r#"{"truth": [0,0,0,0,0,0,0,0,0,0,0,0,0]}"#, "`truth`"),
        (r#"{"truth": [0,0,0,0,0,0,0,0,0,0,0,null]}"#, "`truth`"),
        (r#"{"truth": "none"}"#, "`truth`"),
        (r#"{"state": [0,0,0]}"#, "`state`"),
        (r#"{"state": [23.5,-0.9,0.6,0,0,1.57,0,0,0,0,0,0]}"#, "y of `state` reads -0.900 where -2.250"),
        (r#"{"state": [23.5,-2.25,0.6,0,0,0.1,0,0,0,0,0,0]}"#, "yaw of `state` reads 0.100 where 1.570"),
        (r#"{"state": [23.5,-2.25,0.6,0,0,90.1,0,0,0,0,0,0]}"#, "yaw of `state` reads 90.100 (degrees?) where 1.570"),
        (r#"{"truth": [23.5,0.75,0.6,0,0,1.57,0,0,0,0,0,0]}"#, "y of `truth` reads 0.750 where -2.250"),
        (r#"{"error": "solver\nexploded"}"#, r"solver\nexploded"),
    ] {
        let address = spoilt(0, part);
        let error = connect(&address).reset(&start()).unwrap_err().to_string();
        assert!(error.contains(word) && error.contains(&address), "{part}: {error}");
    }
    // Just within, and a yaw of more turns.
    let within = r#"{"state": [24.4,-3.2,0.6,0,0,-4.9,0,0,0,0,0,0]}"#;
    assert!(connect(&spoilt(0, within)).reset(&start()).is_ok());
}

/// Goal: an id as languages with one kind of number write it is the id; what answers nothing is skipped. Method: `3.0`, and noise before each answer.
#[test]
fn service_strays_and_numbers_with_a_point_are_borne() {
    let address = bicycle(|request, _, mut reply| {
        reply["id"] = json!(request["id"].as_f64().unwrap());
        reply["truth"] = reply["state"].clone();
        vec!["hello?".into(), json!({ "id": 9, "state": [] }).to_string(), String::new(), reply.to_string()]
    });
    let mut remote = RemotePlant::connect(&address.replace("127.0.0.1", "localhost"), 100, TIMEOUT).unwrap();
    assert!(remote.reset(&start()).unwrap().reading().unwrap().truth.is_some());
    let answer = remote.step(Control { speed_m_s: 1.0, second: 0.0 }).unwrap();
    assert!(matches!(answer, Answer::Reading(_)));
    let nowhere = RemotePlant::connect("localhost", 0, TIMEOUT).err().map(|e| e.to_string());
    assert!(nowhere.is_some_and(|e| e.contains("localhost")));
}

/// Goal: strays keep nobody from asking again and from giving up. Method: a plant that sends a datagram every 50 ms and never the answer, for one second.
#[test]
fn service_a_plant_that_never_answers_is_given_up_in_time() {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = socket.local_addr().unwrap().to_string();
    let asked = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&asked);
    std::thread::spawn(move || {
        let mut buffer = [0; 2048];
        let (_, client) = socket.recv_from(&mut buffer).unwrap();
        count.fetch_add(1, Ordering::SeqCst);
        socket.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_secs(20) {
            for stray in [r#"{"id": 77, "state": []}"#, "hello?"] {
                if socket.send_to(stray.as_bytes(), client).is_err() {
                    return;
                }
            }
            if socket.recv_from(&mut buffer).is_ok() {
                count.fetch_add(1, Ordering::SeqCst);
            }
        }
    });
    let begin = Instant::now();
    let mut remote = RemotePlant::connect(&address, 0, Duration::from_secs(1)).unwrap();
    let error = remote.reset(&start()).unwrap_err().to_string();
    // On a busy machine later, but not after the strays.
    assert!(begin.elapsed() < Duration::from_secs(10) && asked.load(Ordering::SeqCst) >= 2, "{:?}", begin.elapsed());
    for words in ["no answer within 1 s", "answers came with other ids, the last was 77", "datagrams were no JSON"] {
        assert!(error.contains(words), "{error}");
    }
    let lost = remote.step(Control { speed_m_s: 0.0, second: 0.0 }).unwrap_err();
    assert!(matches!(lost, NavigationError::Lost { .. }), "a step without an answer can be driven again: {lost}");
}

/// What was told of plants that are silent.
static TOLD: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// Goal: who waits for a plant that is not there learns of it before the timeout, and why. Method: a port where nobody listens, for longer than the five seconds
/// after which that is told; then one whose answers come from another port.
#[test]
fn regress_a_plant_that_is_not_there_is_told_of() {
    let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let plant = RemotePlant::connect(&free, 0, Duration::from_secs(7)).unwrap();
    let error = plant.telling(|text| TOLD.lock().unwrap().push(text.into())).reset(&start()).unwrap_err().to_string();
    assert!(error.contains("no answer within 7 s; the last error was: ") && error.to_lowercase().contains("refused"), "{error}");
    let told = TOLD.lock().unwrap().clone();
    assert!(told.len() == 1 && told[0].contains("for 5 s") && told[0].to_lowercase().contains("refused"), "{told:?}");
    assert!(told[0].contains(&free) && told[0].contains("it is asked for 7 s"), "{told:?}");
    let asked = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = asked.local_addr().unwrap().to_string();
    std::thread::spawn(move || {
        let (mut buffer, answering) = ([0; 2048], UdpSocket::bind("127.0.0.1:0").unwrap());
        while let Ok((length, from)) = asked.recv_from(&mut buffer) {
            let request: Value = serde_json::from_slice(&buffer[..length]).unwrap();
            let reading = json!({ "id": request["id"], "state": [23.5, -2.25, 0.6, 0, 0, 1.57, 0, 0, 0, 0, 0, 0] });
            answering.send_to(reading.to_string().as_bytes(), from).unwrap();
        }
    });
    let error = RemotePlant::connect(&address, 0, Duration::from_secs(1)).unwrap().reset(&start()).unwrap_err().to_string();
    assert!(error.contains("nothing came from the address and port that are asked"), "{error}");
}

/// Goal: a plant that says that it is still computing is waited for. Method: it says so for three times the timeout.
#[test]
fn service_a_busy_plant_is_waited_for() {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = socket.local_addr().unwrap().to_string();
    std::thread::spawn(move || {
        let mut buffer = [0; 2048];
        let (length, client) = socket.recv_from(&mut buffer).unwrap();
        let request: Value = serde_json::from_slice(&buffer[..length]).unwrap();
        for _ in 0..30 {
            socket.send_to(json!({ "id": request["id"], "busy": true }).to_string().as_bytes(), client).unwrap();
            std::thread::sleep(Duration::from_millis(200));
        }
        let reading = json!({ "id": request["id"], "state": [23.5, -2.25, 0.6, 0, 0, 1.57, 0, 0, 0, 0, 0, 0] });
        socket.send_to(reading.to_string().as_bytes(), client).unwrap();
        std::thread::sleep(TIMEOUT);
    });
    let mut remote = RemotePlant::connect(&address, 0, Duration::from_secs(2)).unwrap();
    assert!(remote.reset(&start()).unwrap().reading().is_some());
}

/// Goal: a campaign is on one plant. Method: its name is told with the answer to one `reset`, which serves the first lap; another name is refused.
#[test]
fn service_a_plant_says_once_which_it_is() {
    let resets = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&resets);
    let address = bicycle(move |request, _, mut reply| {
        if request["type"] == "reset" {
            reply["plant"] = ["one", "one", "two"][count.fetch_add(1, Ordering::SeqCst)].into();
        }
        vec![reply.to_string()]
    });
    let mut remote = connect(&address);
    assert_eq!(remote.name(&start()).unwrap().as_deref(), Some("one"));
    remote.reset(&start()).unwrap();
    assert_eq!(resets.load(Ordering::SeqCst), 1);
    remote.reset(&start()).unwrap();
    assert_eq!(resets.load(Ordering::SeqCst), 2);
    let error = remote.reset(&start()).unwrap_err().to_string();
    assert!(error.contains("`two`") && error.contains("`one`"), "{error}");
    assert_eq!(connect(&spoilt(0, "{}")).name(&start()).unwrap(), None);
}

/// Goal: velocities in World, which drive plausibly for a while, are seen. Method: one lap with them and one with those in Body, truth told and not.
#[test]
fn service_velocities_in_world_are_seen() {
    let in_world = bicycle(|_, _, mut reply| {
        let state: Vec<f64> = reply["state"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        let (sin, cos) = state[5].sin_cos();
        reply["truth"] = reply["state"].clone();
        reply["state"][6] = json!(cos * state[6] - sin * state[7]);
        reply["state"][7] = json!(sin * state[6] + cos * state[7]);
        vec![reply.to_string()]
    });
    let wrong = lap_on(&mut connect(&in_world), "w05", 1).unwrap();
    assert_eq!(wrong.moved_over_told, None, "no factor turns a frame");
    assert!(wrong.scored == Scored::Truth && wrong.velocity_mismatch_m_s.is_some_and(|m_s| m_s > 0.5), "{:?}", wrong.velocity_mismatch_m_s);
    let right = lap_on(&mut connect(&spoilt(0, "{}")), "w05", 1).unwrap();
    assert!(right.turn_correlation.is_some_and(|correlation| correlation > 0.5), "{:?}", right.turn_correlation);
    assert!(right.scored == Scored::State && right.velocity_mismatch_m_s.is_some_and(|m_s| m_s < 0.1), "{:?}", right.velocity_mismatch_m_s);
}

/// Goal: what a plant makes of time and of the sign of a command is seen in a lap. Method: steps of half and of twice their time, and steering to the other side.
#[test]
fn regress_steps_of_another_time_and_reversed_steering_are_seen() {
    let lap = |habits: Habits| lap_on(&mut connect(&bicycle_with(habits, |_, _, reply| vec![reply.to_string()])), "w05", 1).unwrap();
    for step_s in [0.05, 0.2] {
        let factor = lap(Habits { step_s, ..RIGHT }).moved_over_told;
        assert!(factor.is_some_and(|factor| (factor * 0.1 / step_s - 1.0).abs() < 0.02), "{step_s}: {factor:?}");
    }
    let reversed = lap(Habits { left: -1.0, ..RIGHT });
    assert!(
        reversed.end == "off_path" && reversed.turn_correlation.is_some_and(|correlation| correlation < -0.8),
        "{:?}",
        reversed.turn_correlation
    );
}

/// Goal: a lap is scored by one of state and truth, of one point. Method: truth that is left out on the way or told from there on, errors that are none, and truth 0.8 m from
/// the state.
#[test]
fn service_truth_is_told_always_or_never() {
    let truthful = |tells: fn(usize) -> bool, off_m: f64| {
        bicycle(move |_, steps, mut reply| {
            if tells(steps) {
                reply["truth"] = reply["state"].clone();
                reply["truth"][1] = json!(reply["state"][1].as_f64().unwrap() + off_m);
            }
            (reply["error"], reply["ended"]) = (json!(""), json!(steps == FAILS_AT + 30));
            vec![reply.to_string()]
        })
    };
    for tells in [|steps| steps < FAILS_AT, |steps| steps >= FAILS_AT] {
        let error = lap_on(&mut connect(&truthful(tells, 0.0)), "w05", 1).unwrap_err().to_string();
        assert!(error.contains("`truth` is told in some answers and not in others"), "{error}");
    }
    let lap = |tells, off_m| lap_on(&mut connect(&truthful(tells, off_m)), "w05", 1).unwrap();
    let off = lap(|_| true, 0.8);
    assert!(off.scored == Scored::Truth && off.measured_off_m.is_some_and(|m| (m - 0.8).abs() < 1e-6), "{:?}", off.measured_off_m);
    assert!(!off.is_driven_out() && lap(|_| false, 0.0).measured_off_m.is_none());
}

/// Goal: a name that says nothing is none, or laps of any plant would be taken for those of another. Method: blank names and one with signs that do not print.
#[test]
fn service_a_blank_name_is_none() {
    let named = |name: &'static str| {
        let address = bicycle(move |_, _, mut reply| {
            reply["plant"] = name.into();
            vec![reply.to_string()]
        });
        connect(&address).name(&start()).unwrap()
    };
    assert_eq!([named(""), named("  ")], [None, None]);
    assert_eq!(named(" mine\n\u{202e} ").as_deref(), Some(r"mine\n\u{202e}"));
}
