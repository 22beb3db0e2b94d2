//! Machines that speak ROS 2.

use nesam_engine::{EngineError, check_name};
use nesam_physics::{POINT_MAX_M, SecondCommand, Vehicle};
use nesam_ros2::graph::{self, Domain};
use nesam_ros2::messages::CommandType;
use serde::{Deserialize, Serialize};

use crate::error::ServerError;

/// Highest `ROS_DOMAIN_ID` that ROS 2 takes.
const DOMAIN_MAX: u32 = 232;

/// How a distribution of ROS 2 writes keys.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Distribution {
    /// Without hashes of types.
    Humble,
    /// With them: Jazzy and all since.
    Jazzy,
}

/// Machines of ROS 2 with rmw_zenoh in the Zenoh network of `[zenoh]`: their odometry and commands are measurements, and they hear of the soil and how the service is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ros2Config {
    /// Whether to take part.
    pub enabled: bool,
    /// `ROS_DOMAIN_ID` of the machines.
    pub domain: u32,
    /// Their distribution.
    pub distribution: Distribution,
    /// Absolute name of this node.
    pub node: String,
    /// Time for which a command holds, s; a vehicle that hears none for longer is told to stand.
    pub command_hold_s: f64,
    /// Interval of `/diagnostics`, s.
    pub diagnostics_interval_s: f64,
    /// The machines.
    pub vehicles: Vec<Ros2Vehicle>,
}

/// One machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ros2Vehicle {
    /// Vehicle and name of its session.
    pub vehicle: String,
    /// Namespace that topics without a leading slash are in; empty = `/` and the vehicle.
    pub namespace: String,
    /// Topic of `nav_msgs/msg/Odometry`.
    pub odometry: String,
    /// Topic of the commands.
    pub command: String,
    /// Type of the commands.
    pub command_type: String,
    /// Topic on which the soil is published.
    pub soil: String,
    /// Reference point of the vehicle card in the child frame of the odometry, m.
    pub reference_m: [f64; 3],
    /// Whether the server opens the session where none is open.
    pub open: bool,
    /// Uploaded map on which it opens it; empty = none.
    pub map: String,
}

impl Default for Ros2Config {
    fn default() -> Self {
        Self {
            enabled: false,
            domain: 0,
            distribution: Distribution::Jazzy,
            node: "/nesam".into(),
            command_hold_s: 0.5,
            diagnostics_interval_s: 1.0,
            vehicles: Vec::new(),
        }
    }
}

impl Default for Ros2Vehicle {
    fn default() -> Self {
        let (vehicle, namespace, map) = Default::default();
        Self {
            vehicle,
            namespace,
            odometry: "odom".into(),
            command: "cmd_vel".into(),
            command_type: CommandType::Twist.message().name.into(),
            soil: "soil".into(),
            reference_m: [0.0; 3],
            open: true,
            map,
        }
    }
}

impl Ros2Vehicle {
    /// Absolute name of a topic.
    fn topic(&self, name: &str) -> String {
        if name.starts_with('/') {
            return name.into();
        }
        let namespace = if self.namespace.is_empty() { format!("/{}", graph::sound_name(&self.vehicle)) } else { self.namespace.clone() };
        format!("{}/{name}", namespace.trim_end_matches('/'))
    }

    /// Absolute name of the topic of the odometry.
    pub fn odometry_topic(&self) -> String {
        self.topic(&self.odometry)
    }

    /// Absolute name of the topic of the commands.
    pub fn command_topic(&self) -> String {
        self.topic(&self.command)
    }

    /// Absolute name of the topic on which the soil is published.
    pub fn soil_topic(&self) -> String {
        self.topic(&self.soil)
    }

    /// Type of the commands.
    ///
    /// # Errors
    /// `ServerError::Value` for a type that is not taken.
    pub fn kind(&self) -> Result<CommandType, ServerError> {
        CommandType::named(&self.command_type).ok_or_else(|| {
            let known = CommandType::ALL.map(|kind| kind.message().name).join(", ");
            wrong(format!("{}: command_type `{}` is none of {known}", self.vehicle, self.command_type))
        })
    }
}

/// Something is wrong with the machines.
fn wrong(reason: String) -> ServerError {
    ServerError::value("ros2.vehicles", reason)
}

impl Ros2Config {
    /// The domain of the machines.
    pub fn domain(&self) -> Domain {
        Domain { id: self.domain, hashes_types: self.distribution != Distribution::Humble }
    }

    /// The machine of a vehicle, where there is one.
    pub fn machine(&self, vehicle: &str) -> Option<&Ros2Vehicle> {
        self.vehicles.iter().find(|machine| self.enabled && machine.vehicle == vehicle)
    }

    /// Refuses machines whose commands say nothing to this vehicle.
    ///
    /// # Errors
    /// `ServerError::Value` naming the machine.
    pub fn check_for(&self, vehicle: &Vehicle) -> Result<(), ServerError> {
        for machine in &self.vehicles {
            if machine.kind()?.is_steered() && vehicle.second == SecondCommand::YawRateRadS {
                let twist = CommandType::Twist.message().name;
                return Err(wrong(format!(
                    "{}: {} steers, {} does not; take {twist}",
                    machine.vehicle, machine.command_type, vehicle.name
                )));
            }
        }
        Ok(())
    }

    /// Checks what the types do not; durations are checked with the others.
    ///
    /// # Errors
    /// `ServerError::Value` naming the key.
    pub(super) fn check(&self) -> Result<(), ServerError> {
        if self.domain > DOMAIN_MAX {
            return Err(ServerError::value("ros2.domain", format!("is {}, ROS 2 has domains 0 to {DOMAIN_MAX}", self.domain)));
        }
        graph::check_name(&self.node).map_err(|reason| ServerError::value("ros2.node", reason))?;
        let mut topics: Vec<String> = Vec::new();
        for (i, machine) in self.vehicles.iter().enumerate() {
            check_name("vehicle", &machine.vehicle).map_err(|error: EngineError| wrong(format!("entry {}: {error}", i + 1)))?;
            let named = |reason: String| wrong(format!("{}: {reason}", machine.vehicle));
            if self.vehicles[..i].iter().any(|before| before.vehicle == machine.vehicle) {
                return Err(named("is there twice".into()));
            }
            machine.kind()?;
            for topic in [machine.odometry_topic(), machine.command_topic(), machine.soil_topic()] {
                graph::check_name(&topic).map_err(named)?;
                if topics.contains(&topic) {
                    let remedy = "give each machine its namespace and each topic its name";
                    return Err(named(format!("the topic {topic} is used twice; {remedy}")));
                }
                topics.push(topic);
            }
            if !machine.reference_m.iter().all(|m| m.abs() <= POINT_MAX_M) {
                return Err(named(format!("reference_m is {:?}, allowed is up to {POINT_MAX_M} m", machine.reference_m)));
            }
            if !machine.map.is_empty() {
                check_name("map", &machine.map).map_err(|error| named(error.to_string()))?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(vehicle: &str) -> Ros2Vehicle {
        Ros2Vehicle { vehicle: vehicle.into(), ..Ros2Vehicle::default() }
    }

    #[test]
    fn analytic_topics_are_in_the_namespace_of_the_vehicle_unless_they_are_absolute() {
        let truck = Ros2Vehicle { command: "/cmd_vel".into(), ..machine("truck-7") };
        assert_eq!((truck.odometry_topic(), truck.command_topic()), ("/truck_7/odom".into(), "/cmd_vel".into()));
        let alone = Ros2Vehicle { namespace: "/".into(), odometry: "odometry/filtered".into(), ..machine("a") };
        assert_eq!((alone.odometry_topic(), alone.soil_topic()), ("/odometry/filtered".into(), "/soil".into()));
    }

    #[test]
    fn analytic_what_makes_no_sense_is_named() {
        let told = |vehicles: Vec<Ros2Vehicle>| {
            Ros2Config { enabled: true, vehicles, ..Ros2Config::default() }.check().expect_err("makes no sense").to_string()
        };
        assert!(told(vec![machine("a"), machine("a")]).contains("a: is there twice"));
        assert!(told(vec![machine("")]).contains("entry 1: "));
        let shared = Ros2Vehicle { odometry: "/a/odom".into(), ..machine("b") };
        assert!(told(vec![machine("a"), shared]).contains("b: the topic /a/odom is used twice"));
        assert!(
            told(vec![Ros2Vehicle { command_type: "std_msgs/msg/String".into(), ..machine("a") }]).contains("geometry_msgs/msg/Twist,")
        );
        assert!(told(vec![Ros2Vehicle { odometry: "a-b".into(), ..machine("a") }]).contains("part `a-b`"));
        assert!(told(vec![Ros2Vehicle { reference_m: [f64::NAN, 0.0, 0.0], ..machine("a") }]).contains("reference_m"));
        assert!(Ros2Config { domain: 233, ..Ros2Config::default() }.check().is_err());
        assert!(Ros2Config { node: "nesam".into(), ..Ros2Config::default() }.check().is_err());
        assert!(Ros2Config { enabled: true, vehicles: vec![machine("a"), machine("b-1")], ..Ros2Config::default() }.check().is_ok());
    }
}
