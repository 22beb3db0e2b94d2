//! Who may use which key: the access control of a Zenoh router, from the fleet file.
//!
//! A router knows its neighbours by the common name of their certificate, which is `nesam:<role>:<name>` here. Everything is denied that a rule does not
//! allow. Messages are named from the router's side: what comes in (`ingress`) and what goes out (`egress`).

use std::path::Path;

use serde_json::{Value, json};

use nesam_ros2::messages::{DIAGNOSTIC_ARRAY, FLOAT64_MULTI_ARRAY, ODOMETRY};

use super::keys;
use super::ros2::DIAGNOSTICS;
use crate::access::{FleetFile, Identity};
use crate::config::{Config, Ros2Config, Ros2Vehicle};

/// Topics of a vehicle that servers publish.
const TOLD: [&str; 3] = ["status", "soil", "alarm"];

/// Rules, whom they are for, and both together, as Zenoh's `access_control` has them.
#[derive(Default)]
struct Policies {
    rules: Vec<Value>,
    subjects: Vec<Value>,
    policies: Vec<Value>,
}

/// What one member may do.
struct Member<'a> {
    all: &'a mut Policies,
    name: String,
    rules: Vec<String>,
}

impl Member<'_> {
    /// Allows messages that concern these keys.
    fn allow(&mut self, flow: &[&str], messages: &[&str], keys: Vec<String>) {
        // Zenoh knows no empty lists; whoever has no vehicles has no keys.
        if keys.is_empty() {
            return;
        }
        let id = format!("{} {}", self.name, self.rules.len());
        self.all.rules.push(json!({ "id": id, "permission": "allow", "flows": flow, "messages": messages, "key_exprs": keys }));
        self.rules.push(id);
    }

    /// To hear what is published on these keys.
    fn hears(&mut self, keys: Vec<String>) {
        self.allow(&["ingress"], &["declare_subscriber"], keys.clone());
        self.allow(&["egress"], &["put"], keys);
    }

    /// To see the tokens of whoever is there.
    fn watches(&mut self, keys: Vec<String>) {
        self.allow(&["ingress"], &["declare_liveliness_subscriber", "liveliness_query"], keys.clone());
        self.allow(&["egress"], &["liveliness_token"], keys);
    }

    /// To ask for predictions, and to see whether somebody answers them.
    fn asks(&mut self, fleet: &str, keys: Vec<String>) {
        self.allow(&["ingress"], &["query"], keys.clone());
        self.allow(&["egress"], &["reply"], keys);
        self.allow(&["egress"], &["declare_queryable"], vec![keys::all_vehicles(fleet, "predict")]);
    }

    /// Hands over what the member may do.
    fn done(self) {
        let Self { all, name, rules } = self;
        all.subjects.push(json!({ "id": name, "cert_common_names": [name] }));
        all.policies.push(json!({ "rules": rules, "subjects": [name] }));
    }
}

/// The `access_control` of whatever the members of a fleet connect to.
pub fn access_control(members: &FleetFile, fleet: &str, ros2: &Ros2Config) -> Value {
    let mut all = Policies::default();
    for identity in members.members() {
        let mut member = Member { all: &mut all, name: identity.uri(), rules: Vec::new() };
        match &identity {
            Identity::Vehicle(name) => {
                vehicle(&mut member, fleet, name);
                if let Some(machine) = ros2.machine(name) {
                    machine_of_ros2(&mut member, ros2, machine);
                }
            }
            Identity::Planner(name) => planner(&mut member, fleet, &members.vehicles_of_planner(name).collect::<Vec<_>>()),
            Identity::Operator(_) => {
                operator(&mut member, fleet);
                if ros2.enabled {
                    watches_ros2(&mut member, ros2);
                }
            }
            Identity::Server(name) => {
                server(&mut member, fleet, name);
                if ros2.enabled {
                    node_of_ros2(&mut member, ros2);
                }
            }
            // Zenoh's routers know whom they talk to.
            Identity::Proxy(_) => continue,
        }
        member.done();
    }
    let Policies { rules, subjects, policies } = all;
    json!({ "enabled": true, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies })
}

fn vehicle(member: &mut Member<'_>, fleet: &str, name: &str) {
    let own = |topic: &str| keys::of_vehicle(fleet, name, topic);
    member.allow(&["ingress"], &["put"], vec![own("measurement")]);
    member.allow(&["ingress"], &["liveliness_token"], vec![own("alive")]);
    // That a server listens to all vehicles.
    member.allow(&["egress"], &["declare_subscriber"], vec![keys::all_vehicles(fleet, "measurement")]);
    member.asks(fleet, vec![own("predict")]);
    member.hears(TOLD.map(own).into_iter().chain(of_servers(fleet)).collect());
    member.watches(vec![keys::of_server(fleet, "*", "alive")]);
}

fn planner(member: &mut Member<'_>, fleet: &str, vehicles: &[&str]) {
    let of = |topic: &str| vehicles.iter().map(|vehicle| keys::of_vehicle(fleet, vehicle, topic)).collect::<Vec<_>>();
    member.asks(fleet, of("predict"));
    member.hears(TOLD.iter().flat_map(|topic| of(topic)).chain(of_servers(fleet)).collect());
    member.watches(of("alive").into_iter().chain([keys::of_server(fleet, "*", "alive")]).collect());
}

fn operator(member: &mut Member<'_>, fleet: &str) {
    let every = [
        "put",
        "query",
        "reply",
        "declare_subscriber",
        "declare_queryable",
        "liveliness_token",
        "declare_liveliness_subscriber",
        "liveliness_query",
    ];
    member.allow(&["ingress", "egress"], &every, vec![keys::of_fleet(fleet, "**")]);
}

fn server(member: &mut Member<'_>, fleet: &str, name: &str) {
    let of_all = |topic: &str| keys::all_vehicles(fleet, topic);
    member.hears(vec![of_all("measurement")]);
    member.allow(&["ingress"], &["declare_queryable", "reply"], vec![of_all("predict")]);
    member.allow(&["egress"], &["query"], vec![of_all("predict")]);
    let own = [keys::of_fleet(fleet, "soil_map"), keys::of_server(fleet, name, "about"), keys::of_server(fleet, name, "status")];
    member.allow(&["ingress"], &["put"], TOLD.map(of_all).into_iter().chain(own).collect());
    member.allow(&["ingress"], &["liveliness_token"], vec![keys::of_server(fleet, name, "alive")]);
    member.watches(vec![of_all("alive")]);
    shares_soil(member, fleet, name);
}

/// To tell the other servers what was brought to this one, and to hear and ask them.
fn shares_soil(member: &mut Member<'_>, fleet: &str, name: &str) {
    let (own, all) = (vec![keys::of_server(fleet, name, "soil_map")], vec![keys::of_server(fleet, "*", "soil_map")]);
    member.allow(&["ingress"], &["put", "declare_queryable", "reply"], own);
    member.allow(&["ingress"], &["declare_subscriber"], all.clone());
    member.allow(&["egress"], &["put", "declare_subscriber", "declare_queryable", "reply"], all.clone());
    // One query asks all servers.
    member.allow(&["ingress", "egress"], &["query"], all);
}

/// Keys of what a machine of ROS 2 says, whatever its distribution.
fn said_by(ros2: &Ros2Config, machine: &Ros2Vehicle) -> Vec<String> {
    let domain = ros2.domain();
    let command = machine.kind().ok().map(|kind| domain.key_of_any_version(&machine.command_topic(), kind.message()));
    [domain.key_of_any_version(&machine.odometry_topic(), ODOMETRY)].into_iter().chain(command).collect()
}

/// Key of what such a machine is told.
fn told_to(ros2: &Ros2Config, machine: &Ros2Vehicle) -> String {
    ros2.domain().key(&machine.soil_topic(), FLOAT64_MULTI_ARRAY)
}

/// Keys of what is told of machines: the soil of each, and the diagnostics of all together.
fn told_of_all(ros2: &Ros2Config) -> Vec<String> {
    let soils = ros2.vehicles.iter().map(|machine| told_to(ros2, machine));
    soils.chain([ros2.domain().key(DIAGNOSTICS, DIAGNOSTIC_ARRAY)]).collect()
}

/// A vehicle that speaks ROS 2: its own topics. The graph of its domain is open to it, as tokens do not tell whose they are.
fn machine_of_ros2(member: &mut Member<'_>, ros2: &Ros2Config, machine: &Ros2Vehicle) {
    member.allow(&["ingress"], &["put"], said_by(ros2, machine));
    member.allow(&["egress"], &["declare_subscriber"], said_by(ros2, machine));
    member.hears(vec![told_to(ros2, machine)]);
    sees_the_graph(member, ros2);
}

/// A server in the graph of ROS 2: the topics of all machines.
fn node_of_ros2(member: &mut Member<'_>, ros2: &Ros2Config) {
    member.hears(ros2.vehicles.iter().flat_map(|machine| said_by(ros2, machine)).collect());
    let told = told_of_all(ros2);
    member.allow(&["ingress"], &["put"], told.clone());
    member.allow(&["egress"], &["declare_subscriber"], told);
    sees_the_graph(member, ros2);
}

/// Somebody who watches all machines of ROS 2.
fn watches_ros2(member: &mut Member<'_>, ros2: &Ros2Config) {
    member.hears(told_of_all(ros2));
    sees_the_graph(member, ros2);
}

fn sees_the_graph(member: &mut Member<'_>, ros2: &Ros2Config) {
    member.allow(&["ingress"], &["liveliness_token"], vec![ros2.domain().tokens()]);
    member.watches(vec![ros2.domain().tokens()]);
}

/// What everybody may hear of servers. Their `status` names all sessions and vehicles and is for operators.
fn of_servers(fleet: &str) -> [String; 2] {
    [keys::of_fleet(fleet, "soil_map"), keys::of_server(fleet, "*", "about")]
}

/// Certificate, key and authority of one end of a connection.
#[derive(Clone, Copy, Debug)]
pub struct LinkFiles<'a> {
    /// Certificate with its chain, PEM.
    pub certificate: &'a Path,
    /// Its key.
    pub key: &'a Path,
    /// Authority of the other ends' certificates.
    pub authority: &'a Path,
}

/// Zenoh's `transport/link/tls`: certificates on both sides, links closed when one expires.
pub(super) fn link(files: LinkFiles<'_>) -> Value {
    json!({
        "root_ca_certificate": files.authority,
        "listen_certificate": files.certificate,
        "listen_private_key": files.key,
        "connect_certificate": files.certificate,
        "connect_private_key": files.key,
        "enable_mtls": true,
        "close_link_on_expiration": true,
    })
}

/// The configuration of a Zenoh router that lets each member of a fleet use its own keys and nobody else anything.
/// Of the configuration of its servers it takes the machines of ROS 2 and the limit on messages.
pub fn router_config(members: &FleetFile, fleet: &str, servers: &Config, listen: &[String], files: LinkFiles<'_>) -> Value {
    let received = json!({ "max_message_size": servers.zenoh.message_bytes_max });
    json!({
        "mode": "router",
        "listen": { "endpoints": listen },
        "scouting": { "multicast": { "enabled": false } },
        "transport": { "link": { "protocols": ["tls"], "tls": link(files), "rx": received } },
        "access_control": access_control(members, fleet, &servers.ros2),
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// Keys outside of `a/` that vehicle `a` and the planner of `a` may use: they tell of no vehicle.
    const OF_NOBODY: [&str; 3] = ["nesam/v1/f/soil_map", "nesam/v1/f/server/*/about", "nesam/v1/f/server/*/alive"];

    #[test]
    fn property_nobody_but_operators_and_servers_has_keys_of_all_vehicles() {
        let text = "operators = [\"c\"]\nservers = [\"s\"]\n[vehicles.a]\n[vehicles.b]\n[planners.p]\nvehicles = [\"a\"]\n[planners.idle]";
        let rules = access_control(&FleetFile::parse(text).unwrap(), "f", &Ros2Config::default());
        assert_eq!(rules["subjects"].as_array().unwrap().len(), 6);
        for rule in rules["rules"].as_array().unwrap() {
            let who = rule["id"].as_str().unwrap();
            let only_declared =
                rule["messages"].as_array().unwrap().iter().all(|message| message.as_str().unwrap().starts_with("declare_"));
            for key in rule["key_exprs"].as_array().unwrap().iter().map(|key| key.as_str().unwrap()) {
                assert!(key.starts_with("nesam/v1/f/"), "{who}: {key}");
                let narrow = key.starts_with("nesam/v1/f/a/") || OF_NOBODY.contains(&key);
                match who.split(':').nth(1).unwrap() {
                    "vehicle" if who.contains(":b ") => {
                        let own = key.starts_with("nesam/v1/f/b/") || OF_NOBODY.contains(&key);
                        assert!(own || only_declared, "{who}: {key}");
                    }
                    "vehicle" | "planner" => assert!(narrow || only_declared, "{who}: {key}"),
                    _ => {}
                }
                // Where all sessions and vehicles are told: to operators, by the server.
                let of_status = key.ends_with("/status") && key.contains("/server/");
                assert!(!of_status || who.contains(":server:"), "{who}: {key}");
            }
        }
    }

    #[test]
    fn property_a_machine_of_ros2_says_nothing_on_topics_of_another() {
        let members = FleetFile::parse("operators = [\"o\"]\nservers = [\"s\"]\n[vehicles.a]\n[vehicles.b]\n[vehicles.c]").unwrap();
        let machine = |vehicle: &str| Ros2Vehicle { vehicle: vehicle.into(), ..Ros2Vehicle::default() };
        let mut ros2 = Ros2Config { enabled: true, vehicles: vec![machine("a"), machine("b")], ..Ros2Config::default() };
        let rules = access_control(&members, "f", &ros2);
        let (mut said, mut hear_all) = ([0, 0, 0], BTreeSet::new());
        for rule in rules["rules"].as_array().unwrap() {
            let who = rule["id"].as_str().unwrap();
            let has = |list: &str, value: &str| rule[list].as_array().unwrap().iter().any(|held| held == value);
            for key in rule["key_exprs"].as_array().unwrap().iter().map(|key| key.as_str().unwrap()) {
                if key.starts_with("nesam/") {
                    continue;
                }
                if key.starts_with("0/diagnostics/") && has("flows", "egress") && has("messages", "put") {
                    hear_all.insert(who.split(':').nth(1).unwrap());
                }
                for (i, name) in ["a", "b", "c"].into_iter().enumerate().filter(|(_, name)| who.contains(&format!("vehicle:{name} "))) {
                    let own = key.starts_with(&format!("0/{name}/")) || key.starts_with("@ros2_lv/0/");
                    assert!(own && name != "c", "{who}: {key}");
                    let speaks = has("flows", "ingress") && has("messages", "put");
                    said[i] += usize::from(speaks);
                    assert!(!speaks || key.contains("/odom/") || key.contains("/cmd_vel/"), "{who}: {key}");
                }
            }
        }
        assert_eq!(said, [2, 2, 0]);
        // Of all machines together operators alone hear.
        assert_eq!(hear_all, BTreeSet::from(["operator"]));
        ros2.enabled = false;
        assert_eq!(access_control(&members, "f", &ros2), access_control(&members, "f", &Ros2Config::default()));
    }
}
