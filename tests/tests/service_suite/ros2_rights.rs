//! Goal: on the topics of ROS 2, too, nobody is heard in another one's name. Method: a router with the written configuration, a server and two vehicles with
//! real certificates; each publishes on both topics.

use nesam_server::access::FleetFile;
use nesam_server::{Config, LinkFiles, router_config};

use crate::authority::{Authority, FLEET, dns, secured_with, uri, written};
use crate::ros2::{ODOMETRY, bag, machines};
use crate::stage::eventually;
use crate::zenoh_network::{PATIENCE, behind};
use crate::zenoh_security::{SILENCE, free_endpoint, joining};

const DIAGNOSTICS: &str =
    "diagnostic_msgs::msg::dds_::DiagnosticArray_/RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e";

#[tokio::test(flavor = "multi_thread")]
async fn service_a_machine_of_ros2_is_heard_on_its_own_topics_alone() {
    let (endpoint, ros2, messages) = (free_endpoint(), machines(&["truck", "other"]), bag());
    let (authority, files) = (Authority::new(), tempfile::tempdir().unwrap());
    let signed = |authority: &Authority, name: &str| {
        let (certificate, key) = authority.sign(&[dns("localhost"), uri(name)], false);
        let stem = name.replace(':', "-");
        (written(files.path(), &format!("{stem}.pem"), &certificate), written(files.path(), &format!("{stem}.key"), &key))
    };
    let ca = written(files.path(), "ca.pem", authority.pem.as_bytes());
    let (certificate, key) = signed(&authority, "router");
    let links = LinkFiles { certificate: &certificate, key: &key, authority: &ca };
    let members = FleetFile::parse(FLEET).unwrap();
    let servers = Config { ros2: ros2.clone(), ..Config::default() };
    let config = router_config(&members, "test", &servers, std::slice::from_ref(&endpoint), links);
    let router = zenoh::open(zenoh::Config::from_json5(&config.to_string()).unwrap()).await.unwrap();
    let (certificate, key) = signed(&authority, "nesam:server:alpha");
    let mut stage = secured_with(|config| {
        (config.tls.certificate, config.tls.key, config.tls.client_ca) = (certificate, key, ca.clone());
        behind(config, &endpoint);
        config.zenoh.name = "alpha".into();
        config.ros2 = ros2;
    })
    .await;
    stage.authority = authority;
    let operator = stage.client("nesam:operator:control").await;
    let accepted = async |session: &str| operator.clone().session(session).await.map_or(0, |session| session.accepted);

    let joined = async |name: &str| {
        let (certificate, key) = signed(&stage.authority, name);
        zenoh::open(zenoh::Config::from_json5(&joining(&endpoint, &certificate, &key, &ca)).unwrap()).await.unwrap()
    };
    let (truck, other) = (joined("nesam:vehicle:truck").await, joined("nesam:vehicle:other").await);
    let control = joined("nesam:operator:control").await;
    // As rmw_zenoh subscribes: to the whole key. Diagnostics tell of all machines: of alarms, effects and soils of others.
    let [heard, of_all] = [&control, &truck].map(|session| session.declare_subscriber(format!("0/diagnostics/{DIAGNOSTICS}")));
    let (heard, of_all) = (heard.await.unwrap(), of_all.await.unwrap());
    let of_other = truck.declare_subscriber(format!("0/other/odom/{ODOMETRY}")).await.unwrap();
    // Each on its own topic until it is heard: whoever joins has to be let through first.
    for (machine, name) in [(&truck, "truck"), (&other, "other")] {
        let key = format!("0/{name}/odom/{ODOMETRY}");
        let (machine, messages) = (machine.clone(), messages["/truck/odom"].clone());
        let publishing = tokio::spawn(async move {
            for message in messages {
                machine.put(&key, message).await.unwrap();
                tokio::time::sleep(std::time::Duration::from_millis(50)).await;
            }
        });
        eventually(PATIENCE, "the machine is heard on its own topic", async || accepted(name).await > 0).await;
        publishing.await.unwrap();
    }
    assert!(of_other.try_recv().unwrap().is_none(), "what a machine says is for servers");
    eventually(PATIENCE, "an operator hears diagnostics", async || heard.try_recv().unwrap().is_some()).await;
    let before = (accepted("truck").await, accepted("other").await);
    let late = &messages["/truck/odom"][100];
    let mut later = late.clone();
    // The stamp begins with the seconds: one second on.
    later[4] = later[4].wrapping_add(1);
    truck.put(format!("0/other/odom/{ODOMETRY}"), later.clone()).await.unwrap();
    tokio::time::sleep(SILENCE).await;
    assert_eq!((accepted("truck").await, accepted("other").await), before, "a machine is heard in another one's name");
    other.put(format!("0/other/odom/{ODOMETRY}"), later).await.unwrap();
    eventually(PATIENCE, "the same message from the machine itself", async || accepted("other").await == before.1 + 1).await;
    assert!(of_all.try_recv().unwrap().is_none(), "a machine hears what is told of others");
    stage.server.shutdown().await;
    router.close().await.unwrap();
}
