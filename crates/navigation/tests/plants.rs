//! Goal: a plant is the same whichever way it is reached, and the loop around it is repeatable.
//! Method: the plant of `tests/plant` in this process and over UDP; a foreign plant in Python; laps with the kinematic model, which needs no server.
#![allow(clippy::unwrap_used)]

use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::{Child, Command as Process, Stdio};
use std::sync::Arc;

use nesam_evaluation::Kinematic;
use nesam_navigation::{
    BuiltInPlant, Forecaster, KinematicForecaster, Lap, LapPlan, MppiSettings, PlantLink, Reading, ReferencePath, RemotePlant, Start,
    TrackingCost, run_lap,
};
use nesam_physics::Control;
use nesam_plant::{Ground, HiddenEffects, Plant, PlantServer, PlantVehicle, Sensors};
use nesam_terrain::WorldMap;
use nesam_trajectories::read_vehicle_card;

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn sample() -> PathBuf {
    repository().join("tests/data/chrono_sample")
}

fn start(world: &str) -> Start {
    Start { world: world.into(), seed: 5, position_m: [23.5, 0.0], yaw_rad: 1.57 }
}

/// A free port of loopback, held by the socket.
fn socket() -> (UdpSocket, String) {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = socket.local_addr().unwrap().to_string();
    (socket, address)
}

#[test]
fn service_plant_over_udp_is_the_built_in_plant() {
    let (socket, address) = socket();
    let vehicle = Arc::new(PlantVehicle::of_root(&sample()).unwrap());
    let mut server = PlantServer::new(move |world, seed, [x, y, yaw]| {
        let ground = Ground::read(&sample().join("worlds").join(world)).map_err(|e| e.to_string())?;
        let effects = HiddenEffects::default();
        Ok((Plant::at_rest(Arc::clone(&vehicle), Arc::new(ground), effects, x, y, yaw), Sensors::new(seed, &effects)))
    });
    std::thread::spawn(move || server.run(&socket));
    let mut remote = RemotePlant::connect(&address, 0).unwrap();
    let mut built_in = BuiltInPlant::new(&sample(), HiddenEffects::default()).unwrap();
    // Numbers that travel as decimal text may come back with another last bit.
    let same = |a: Reading, b: Reading, k: u32| {
        let pairs = a.measured.iter().chain(&a.truth).zip(b.measured.iter().chain(&b.truth));
        pairs.for_each(|(a, b)| assert!((a - b).abs() < 1e-12 * (1.0 + a.abs()), "step {k}: {a} {b}"));
    };
    same(remote.reset(&start("w35")).unwrap(), built_in.reset(&start("w35")).unwrap(), 0);
    for k in 1..15 {
        let command = Control { speed_m_s: 2.0, second: 0.02 * f64::from(k) };
        same(remote.step(command).unwrap(), built_in.step(command).unwrap(), k);
    }
    let error = remote.reset(&start("nowhere")).unwrap_err().to_string();
    assert!(error.contains("nowhere"), "{error}");
}

#[test]
fn property_a_request_that_is_asked_again_moves_nothing_and_bad_ones_are_answered() {
    let vehicle = Arc::new(PlantVehicle::of_root(&sample()).unwrap());
    let mut server = PlantServer::new(move |world, seed, [x, y, yaw]| {
        let ground = Ground::read(&sample().join("worlds").join(world)).map_err(|e| e.to_string())?;
        let effects = HiddenEffects::default();
        Ok((Plant::at_rest(Arc::clone(&vehicle), Arc::new(ground), effects, x, y, yaw), Sensors::new(seed, &effects)))
    });
    let mut ask = |text: &str| String::from_utf8(server.answer(text.as_bytes()).0).unwrap();
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

/// A child that is ended with the test.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The reference plant in Python speaks the protocol: a lap on it with the kinematic model is completed.
#[test]
fn service_python_plant_drives_a_lap() {
    let (held, address) = socket();
    drop(held);
    let script = repository().join("clients/python/examples/plant_stub.py");
    let child = Process::new("python3").arg(script).arg(&address).stdout(Stdio::null()).spawn();
    let _stub = Ended(child.expect("python3 runs the reference plant"));
    let mut remote = RemotePlant::connect(&address, 7).unwrap();
    // Position and velocity are those of one point: on a steady circle it moves as its velocity says, but for 0.1 mm of the Euler steps of that plant.
    remote.reset(&start("w35")).unwrap();
    let circle: Vec<[f64; 12]> = (0..40).map(|_| remote.step(Control { speed_m_s: 2.0, second: 0.5 }).unwrap().measured).collect();
    let (before, after) = (circle[38], circle[39]);
    let (sin, cos) = (0.5 * (before[5] + after[5])).sin_cos();
    let moved = [0.1 * (after[6] * cos - after[7] * sin), 0.1 * (after[6] * sin + after[7] * cos)];
    (0..2).for_each(|i| assert!((after[i] - before[i] - moved[i]).abs() < 1e-3, "{before:?} {after:?}"));
    let lap = lap_on(&mut remote, "w35", 1);
    assert!(lap.completed && lap.hausdorff_m < 3.0, "{:?}", Lap { path: Vec::new(), ..lap });
}

fn lap_on(plant: &mut dyn PlantLink, world: &str, seed: u64) -> Lap {
    let vehicle = read_vehicle_card(&sample().join("vehicle_hmmwv.json")).unwrap();
    let map = Arc::new(WorldMap::load(&sample().join("worlds").join(world)).unwrap());
    let mut model = Forecaster::Kinematic(KinematicForecaster { model: Kinematic::ideal(&vehicle), vehicle: Arc::new(vehicle), map });
    let plan = LapPlan {
        world: world.into(),
        start_phi: 0.0,
        seed,
        path: ReferencePath::of_ood_soil(),
        cost: TrackingCost { speed_m_s: 3.0, lag: 0.1, tilt: 0.0 },
        mppi: MppiSettings {
            candidates: 32,
            limits: [[0.5, 4.0], [-1.0, 1.0]],
            noise_sd: [0.4, 0.16],
            noise_correlation: 0.8,
            temperature: 0.1,
        },
        horizon: 20,
        plan_every: 3,
        steering_guess: 0.4,
        caution: None,
    };
    // The kinematic model never waits for anybody.
    let waker = std::task::Waker::noop();
    let mut lap = Box::pin(run_lap(&plan, plant, &mut model));
    match lap.as_mut().poll(&mut std::task::Context::from_waker(waker)) {
        std::task::Poll::Ready(lap) => lap.unwrap(),
        std::task::Poll::Pending => panic!("the kinematic model waited"),
    }
}

/// Goal: same seeds, same lap, to the last bit; another seed, another lap. On ground of the sample, whose soil the kinematic model does not know.
#[test]
fn property_laps_are_repeatable() {
    let mut plant = BuiltInPlant::new(&sample(), HiddenEffects::default()).unwrap();
    let first = lap_on(&mut plant, "w05", 1);
    assert_eq!(first, lap_on(&mut plant, "w05", 1));
    let other = lap_on(&mut plant, "w05", 2);
    assert_ne!(first.path, other.path);
    assert!(first.progress > 0.2, "{:?}", Lap { path: Vec::new(), ..first });
}
