//! Goal: a machine of ROS 2 is served without a bridge. Method: a recorded drive as messages that another implementation of CDR has encoded
//! (`tests/tools/make_ros2_sample.py`), published as rmw_zenoh does through a router, against the same drive over gRPC. What the server publishes is read by
//! that other implementation in `clients/python/tests/test_ros2.py`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::BufReader;
use std::time::Duration;

use nesam_client::v1;
use nesam_import::{Options, Topics, drives, read_bag};
use nesam_mcap::{Reader, Record};
use nesam_server::{Config, Distribution, Ros2Config, Ros2Vehicle};
use nesam_tests::repository;
use zenoh::qos::CongestionControl;

use crate::stage::*;
use crate::zenoh_network::{PATIENCE, behind, router};

/// Keys as machines have them: of Jazzy, and of Humble, which hashes no types.
pub const ODOMETRY: &str = "nav_msgs::msg::dds_::Odometry_/RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0";
const ODOMETRY_OF_HUMBLE: &str = "nav_msgs::msg::dds_::Odometry_/TypeHashNotSupported";
const ACKERMANN: &str =
    "ackermann_msgs::msg::dds_::AckermannDrive_/RIHS01_acf287a224a947dd1b0b87d6d76cdb73f497b0237b8fc73be2173b2ebbb82c99";
const TWIST: &str = "geometry_msgs::msg::dds_::Twist_/RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a";
/// Messages of each topic in the bag.
const RECORDED: usize = 101;

/// The messages of the committed bag by topic.
pub fn bag() -> BTreeMap<String, Vec<Vec<u8>>> {
    let file = File::open(repository().join("tests/data/ros2/n0005/n0005.mcap")).unwrap();
    let mut reader = Reader::new(BufReader::new(file));
    let (mut topics, mut messages) = (BTreeMap::new(), BTreeMap::<String, Vec<Vec<u8>>>::new());
    while let Some(record) = reader.next_record().unwrap() {
        match record {
            Record::Channel { id, topic, .. } => drop(topics.insert(id, topic)),
            Record::Message { channel_id, data, .. } => messages.entry(topics[&channel_id].clone()).or_default().push(data),
            _ => {}
        }
    }
    messages
}

/// Machines of ROS 2 of these vehicles.
pub fn machines(vehicles: &[&str]) -> Ros2Config {
    let machine = |vehicle: &&str| Ros2Vehicle { vehicle: (*vehicle).into(), ..Ros2Vehicle::default() };
    Ros2Config {
        enabled: true,
        // The drive is published faster and slower than it was driven: its commands hold for it all the same.
        command_hold_s: 60.0,
        diagnostics_interval_s: 0.2,
        vehicles: vehicles.iter().map(machine).collect(),
        ..Ros2Config::default()
    }
}

fn published(config: &mut Config, endpoint: &str, change: impl FnOnce(&mut Ros2Vehicle)) {
    behind(config, endpoint);
    config.ros2 = machines(&["truck"]);
    change(&mut config.ros2.vehicles[0]);
}

/// Waits until a session has accepted so many measurements.
async fn until_accepted(client: &mut nesam_client::Client, session: &str, count: u64) -> v1::Session {
    let deadline = tokio::time::Instant::now() + PATIENCE;
    loop {
        if let Ok(found) = client.session(session).await
            && found.accepted >= count
        {
            assert_eq!(found.accepted, count, "more than was sent");
            return found;
        }
        assert!(tokio::time::Instant::now() < deadline, "{:?}", client.session(session).await);
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// A publisher that has a subscriber: what is put before is heard by nobody. Nor may the network drop what is put faster than a busy server reads.
async fn publisher(router: &zenoh::Session, key: String) -> zenoh::pubsub::Publisher<'static> {
    let declared = router.declare_publisher(key).congestion_control(CongestionControl::Block);
    let publisher = declared.await.unwrap();
    let key = publisher.key_expr().clone();
    eventually(PATIENCE, &format!("somebody listens to {key}"), async || publisher.matching_status().await.unwrap().matching()).await;
    publisher
}

#[test]
fn oracle_a_bag_of_another_codec_is_the_drive_that_it_was_made_of() {
    let recorded = recorded();
    let topics = Topics { command: Some("/truck/ackermann_cmd".into()), ..Topics::default() };
    let (log, notes) = read_bag(&repository().join("tests/data/ros2/n0005"), &topics).unwrap();
    assert!(notes.is_empty(), "{notes:?}");
    let (found, _) = drives(&log, &Options { name: "n0005".into(), ..Options::default() }).unwrap();
    let column = |name: &str| &found[0].columns.iter().find(|(held, _)| held == name).unwrap().1;
    assert_eq!((found.len(), column("t").len()), (1, RECORDED));
    let names = ["x", "y", "z", "roll", "pitch", "yaw", "vbx", "vby", "vbz", "wx", "wy", "wz"];
    for (i, state) in recorded.drive.states[..RECORDED].iter().enumerate() {
        for (name, value) in names.into_iter().zip(state.to_array()) {
            assert!((column(name)[i] - value).abs() < 1e-9, "{name} of {i}: {} and {value}", column(name)[i]);
        }
        assert!((column("cmd_speed")[i] - recorded.drive.controls[i].speed_m_s).abs() < 1e-6);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_machine_of_ros2_gets_what_a_vehicle_of_grpc_gets() {
    let (recorded, bag) = (recorded(), bag());
    let (router, endpoint) = router().await;
    let steered = |machine: &mut Ros2Vehicle| {
        machine.command = "ackermann_cmd".into();
        machine.command_type = "ackermann_msgs/msg/AckermannDrive".into();
        machine.map = recorded.world.id().into();
    };
    let (server, mut client) = start_with(|config| published(config, &endpoint, steered)).await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "grpc", recorded.world.id()).await;

    let odometry = publisher(&router, format!("0/truck/odom/{ODOMETRY}")).await;
    let of_humble = publisher(&router, format!("0/truck/odom/{ODOMETRY_OF_HUMBLE}")).await;
    let command = publisher(&router, format!("0/truck/ackermann_cmd/{ACKERMANN}")).await;
    let soil = router.declare_subscriber("0/truck/soil/**").await.unwrap();
    let diagnostics = router.declare_subscriber("0/diagnostics/**").await.unwrap();
    for (i, (moved, told)) in bag["/truck/odom"].iter().zip(&bag["/truck/ackermann_cmd"]).enumerate() {
        command.put(told.as_slice()).await.unwrap();
        if i % 2 == 0 { odometry.put(moved.as_slice()).await } else { of_humble.put(moved.as_slice()).await }.unwrap();
        // Bytes that are no message change nothing.
        odometry.put(&moved[..moved.len() - 1]).await.unwrap();
        command.put(vec![7; 30]).await.unwrap();
        if i == 20 {
            odometry.put(vec![0; 70_000]).await.unwrap();
        }
    }
    // The session was opened on the map when the first odometry came, and nothing was lost.
    let session = until_accepted(&mut client, "truck", RECORDED as u64).await;
    let answered = client.feed(samples("grpc", &recorded.drive, RECORDED - 1)).await.unwrap();
    let twin = client.session("grpc").await.unwrap();
    assert_eq!(session.provenance, twin.provenance);
    assert_eq!((session.history_steps, session.vehicle_id.as_str()), (32, "truck"));
    assert_eq!(session.last_stamp_ns, Some(1_700_000_000_000_000_000 + (RECORDED as i64 - 1) * STEP_NS));
    let numbers = |session: &v1::Session| {
        let (state, control) = (session.state.unwrap(), session.command.unwrap());
        let vectors = [state.position_m, state.attitude_rad, state.velocity_m_s, state.angular_velocity_rad_s];
        let all = vectors.into_iter().flat_map(|v| v.map(|v| [v.x, v.y, v.z]).unwrap()).chain([control.speed_m_s, control.second]);
        let delta = session.soil_correction.as_ref().unwrap().delta.unwrap();
        all.chain([delta.k_phi, delta.n, delta.phi_rad]).collect::<Vec<f64>>()
    };
    // Attitudes went through quaternions and commands through single floats.
    for (i, (of_ros, of_grpc)) in numbers(&session).into_iter().zip(numbers(&twin)).enumerate() {
        assert!((of_ros - of_grpc).abs() <= 1e-6 * of_grpc.abs().max(1.0), "number {i}: {of_ros} and {of_grpc}");
    }
    let epochs: BTreeSet<u64> = answered.iter().map(|answer| answer.soil_epoch).filter(|epoch| *epoch > 0).collect();
    let mut told = 0;
    while let Ok(Some(message)) = soil.try_recv() {
        assert!(message.attachment().is_some_and(|bytes| bytes.len() == 33), "rmw_zenoh drops what has none");
        told += 1;
    }
    assert_eq!(told, epochs.len(), "each change is told once");
    let diagnosed = tokio::time::timeout(PATIENCE, diagnostics.recv_async()).await.expect("in time").unwrap();
    assert!(diagnosed.attachment().is_some_and(|bytes| bytes.len() == 33));

    // The node and its four ends are in the graph while it is there.
    let graph = async || {
        let tokens = router.liveliness().get("@ros2_lv/0/**").await.unwrap();
        let mut ends = BTreeSet::new();
        while let Ok(reply) = tokens.recv_async().await {
            let key = reply.result().unwrap().key_expr().as_str().split('/').map(String::from).collect::<Vec<_>>();
            ends.insert((key[5].clone(), key.get(9).cloned().unwrap_or_default()));
        }
        ends
    };
    let ends = [("NN", ""), ("MS", "%truck%odom"), ("MS", "%truck%ackermann_cmd"), ("MP", "%truck%soil"), ("MP", "%diagnostics")];
    assert_eq!(graph().await, ends.map(|(end, topic)| (end.into(), topic.into())).into());
    server.shutdown().await;
    eventually(PATIENCE, "the node is gone", async || graph().await.is_empty()).await;
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn service_twists_steer_and_what_nobody_tells_stands() {
    // Goal: a twist becomes the steering that turns so, and a command ends. Method: the twists of the bag, which were made of the drive's steering; then odometry
    // without commands for longer than they hold.
    let (recorded, bag) = (recorded(), bag());
    let (router, endpoint) = router().await;
    let change = |config: &mut Config| {
        published(config, &endpoint, |_| {});
        config.ros2.distribution = Distribution::Humble;
        config.ros2.domain = 5;
        config.ros2.command_hold_s = 1.0;
    };
    let (server, mut client) = start_with(change).await;
    let odometry = publisher(&router, format!("5/truck/odom/{ODOMETRY_OF_HUMBLE}")).await;
    let command = publisher(&router, format!("5/truck/cmd_vel/{TWIST}")).await;
    for i in 0..30 {
        command.put(bag["/truck/cmd_vel"][i].as_slice()).await.unwrap();
        odometry.put(bag["/truck/odom"][i].as_slice()).await.unwrap();
    }
    let session = until_accepted(&mut client, "truck", 30).await;
    let (found, driven) = (session.command.unwrap(), recorded.drive.controls[29]);
    assert!((found.speed_m_s - driven.speed_m_s).abs() < 1e-9 && (found.second - driven.second).abs() < 1e-6, "{found:?} {driven:?}");
    assert!(driven.second.abs() > 0.05, "the drive steers there");
    tokio::time::sleep(Duration::from_millis(1200)).await;
    odometry.put(bag["/truck/odom"][30].as_slice()).await.unwrap();
    let stood = until_accepted(&mut client, "truck", 31).await.command.unwrap();
    assert_eq!((stood.speed_m_s, stood.second), (0.0, 0.0));
    server.shutdown().await;
    router.close().await.unwrap();
}
