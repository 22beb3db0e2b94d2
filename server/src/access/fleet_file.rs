//! The fleet file: who there is and what each may do. Whoever is not in it may do nothing, whatever certificate there is: taking a name out of it
//! revokes a certificate.

use std::collections::{BTreeMap, BTreeSet};

use nesam_engine::check_name;
use serde::Deserialize;

use super::identity::Identity;

/// A planner's entry in `vehicles` that stands for all vehicles.
const ALL: &str = "*";

/// The members of a fleet and their rights.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FleetFile {
    /// Names that may do everything.
    operators: BTreeSet<String>,
    /// Servers of the fleet: what Zenoh routers let answer vehicles and planners. Over gRPC they read maps, as everybody
    /// in the file does, and nothing else.
    servers: BTreeSet<String>,
    /// Proxies that are believed for whom they call; they may do nothing themselves.
    proxies: BTreeSet<String>,
    /// By vehicle id.
    vehicles: BTreeMap<String, VehicleEntry>,
    /// By name.
    planners: BTreeMap<String, PlannerEntry>,
}

#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct VehicleEntry {
    /// Maps that it may upload, patch and delete.
    maps: BTreeSet<String>,
}

#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct PlannerEntry {
    /// Vehicles that it may read and predict; `*` = all.
    vehicles: BTreeSet<String>,
    /// Maps that it may upload, patch and delete.
    maps: BTreeSet<String>,
}

impl FleetFile {
    /// Reads the text of a file.
    ///
    /// # Errors
    /// Which entry is wrong.
    pub fn parse(text: &str) -> Result<Self, String> {
        let file: Self = toml::from_str(text).map_err(|error| error.to_string())?;
        file.check().map(|()| file)
    }

    fn check(&self) -> Result<(), String> {
        let maps = self.vehicles.values().map(|v| &v.maps).chain(self.planners.values().map(|p| &p.maps)).flatten();
        let names = self
            .operators
            .iter()
            .chain(&self.servers)
            .chain(&self.proxies)
            .chain(self.vehicles.keys())
            .chain(self.planners.keys())
            .chain(maps);
        for name in names {
            check_name("name", name).map_err(|error| format!("`{name}`: {error}"))?;
        }
        Ok(())
    }

    /// What is readable and may be a mistake: vehicles of planners that are not in the file, after a vehicle was revoked or for want of a letter.
    pub fn doubts(&self) -> Vec<String> {
        let unknown = |vehicle: &&String| *vehicle != ALL && !self.vehicles.contains_key(*vehicle);
        let of_planner = |(planner, entry): (&String, &PlannerEntry)| {
            let unknown: Vec<&str> = entry.vehicles.iter().filter(unknown).map(String::as_str).collect();
            (!unknown.is_empty()).then(|| format!("planner `{planner}` has vehicles that are not in the file: {}", unknown.join(", ")))
        };
        self.planners.iter().filter_map(of_planner).collect()
    }

    /// Whether the identity is in the file.
    pub fn knows(&self, identity: &Identity) -> bool {
        match identity {
            Identity::Vehicle(name) => self.vehicles.contains_key(name),
            Identity::Planner(name) => self.planners.contains_key(name),
            Identity::Operator(name) => self.operators.contains(name),
            Identity::Server(name) => self.servers.contains(name),
            Identity::Proxy(name) => self.proxies.contains(name),
        }
    }

    /// Everybody in the file but the proxies, which Zenoh does not know.
    pub fn members(&self) -> impl Iterator<Item = Identity> {
        let vehicles = self.vehicles.keys().cloned().map(Identity::Vehicle);
        let planners = self.planners.keys().cloned().map(Identity::Planner);
        let operators = self.operators.iter().cloned().map(Identity::Operator);
        vehicles.chain(planners).chain(operators).chain(self.servers.iter().cloned().map(Identity::Server))
    }

    /// Vehicles that a planner may read; `*` = all.
    pub fn vehicles_of_planner(&self, name: &str) -> impl Iterator<Item = &str> {
        self.planners.get(name).into_iter().flat_map(|planner| planner.vehicles.iter().map(String::as_str))
    }

    /// Whether it may read the sessions of a vehicle and predict from them.
    pub fn may_read(&self, identity: &Identity, vehicle: &str) -> bool {
        match identity {
            Identity::Vehicle(name) => name == vehicle && self.knows(identity),
            Identity::Planner(name) => {
                self.planners.get(name).is_some_and(|planner| planner.vehicles.contains(vehicle) || planner.vehicles.contains(ALL))
            }
            Identity::Operator(_) => self.knows(identity),
            Identity::Server(_) | Identity::Proxy(_) => false,
        }
    }

    /// Whether it may open, feed, copy, move and close the sessions of a vehicle.
    pub fn may_change(&self, identity: &Identity, vehicle: &str) -> bool {
        match identity {
            Identity::Vehicle(name) => name == vehicle && self.knows(identity),
            Identity::Planner(_) | Identity::Server(_) | Identity::Proxy(_) => false,
            Identity::Operator(_) => self.knows(identity),
        }
    }

    /// Whether it may give a session this name: not that of another vehicle, which would find its own name taken.
    pub fn may_name(&self, identity: &Identity, session: &str) -> bool {
        match identity {
            Identity::Vehicle(name) => name == session || !self.vehicles.contains_key(session),
            Identity::Planner(_) | Identity::Server(_) | Identity::Proxy(_) => false,
            Identity::Operator(_) => true,
        }
    }

    /// Whether it may change what a session takes its vehicle to be: every planner of the vehicle would be answered for another one. Also whether it may diagnose:
    /// recordings hold all vehicles, and the work takes processors from everybody.
    pub fn may_operate(&self, identity: &Identity) -> bool {
        matches!(identity, Identity::Operator(_)) && self.knows(identity)
    }

    /// Whether it may upload, patch and delete a map.
    pub fn may_change_map(&self, identity: &Identity, map: &str) -> bool {
        match identity {
            Identity::Vehicle(name) => self.vehicles.get(name).is_some_and(|vehicle| vehicle.maps.contains(map)),
            Identity::Planner(name) => self.planners.get(name).is_some_and(|planner| planner.maps.contains(map)),
            Identity::Operator(_) => self.knows(identity),
            Identity::Server(_) | Identity::Proxy(_) => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = r#"
operators = ["control"]
servers = ["alpha"]
[vehicles.truck-7]
maps = ["truck-7-local"]
[vehicles.truck-8]
[planners.mission]
vehicles = ["truck-7"]
[planners.dispatch]
vehicles = ["*"]
maps = ["quarry"]
"#;

    #[test]
    fn analytic_rights_are_those_of_the_table() {
        let file = FleetFile::parse(FILE).unwrap();
        let [seven, eight, nine] = ["truck-7", "truck-8", "truck-9"].map(|name| Identity::Vehicle(name.into()));
        let [mission, dispatch] = ["mission", "dispatch"].map(|name| Identity::Planner(name.into()));
        let control = Identity::Operator("control".into());
        let alpha = Identity::Server("alpha".into());
        let who = [&seven, &eight, &nine, &mission, &dispatch, &control, &alpha];
        let rights = |may: &dyn Fn(&Identity) -> bool| who.map(may);
        assert_eq!(rights(&|i| file.knows(i)), [true, true, false, true, true, true, true]);
        assert_eq!(rights(&|i| file.may_read(i, "truck-7")), [true, false, false, true, true, true, false]);
        assert_eq!(rights(&|i| file.may_read(i, "truck-8")), [false, true, false, false, true, true, false]);
        assert_eq!(rights(&|i| file.may_read(i, "truck-9")), [false, false, false, false, true, true, false]);
        assert_eq!(rights(&|i| file.may_change(i, "truck-7")), [true, false, false, false, false, true, false]);
        assert_eq!(rights(&|i| file.may_operate(i)), [false, false, false, false, false, true, false]);
        assert_eq!(rights(&|i| file.may_change_map(i, "truck-7-local")), [true, false, false, false, false, true, false]);
        assert_eq!(rights(&|i| file.may_change_map(i, "quarry")), [false, false, false, false, true, true, false]);
        assert_eq!(rights(&|i| file.may_name(i, "truck-8")), [false, true, false, false, false, true, false]);
        assert!(file.may_name(&seven, "truck-7") && file.may_name(&seven, "what-if"));
        assert!(!file.knows(&Identity::Operator("truck-7".into())) && !file.may_read(&Identity::Operator("x".into()), "truck-7"));
    }

    /// A vehicle is revoked by its own line alone, although planners still name it.
    #[test]
    fn regress_a_revoked_vehicle_that_a_planner_names_has_no_rights() {
        let file = FleetFile::parse(&FILE.replace("[vehicles.truck-7]\nmaps = [\"truck-7-local\"]\n", "")).unwrap();
        let seven = Identity::Vehicle("truck-7".into());
        assert!(!file.knows(&seven) && !file.may_read(&seven, "truck-7") && !file.may_change(&seven, "truck-7"));
        assert_eq!(file.doubts(), ["planner `mission` has vehicles that are not in the file: truck-7"]);
        assert!(FleetFile::parse(FILE).unwrap().doubts().is_empty(), "`*` and known vehicles are no mistake");
    }

    #[test]
    fn regress_wrong_files_are_refused_with_the_entry() {
        for (text, part) in [
            ("[planners.p]\nvehicles = 3", "vehicles"),
            ("[vehicles.\"a/b\"]", "a/b"),
            ("operator = [\"x\"]", "operator"),
            ("[vehicles.a]\nmap = [\"m\"]", "map"),
        ] {
            let result = FleetFile::parse(text);
            assert!(result.as_ref().is_err_and(|error| error.contains(part)), "{text}: {result:?}");
        }
    }
}
