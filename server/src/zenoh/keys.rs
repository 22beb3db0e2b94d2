//! Keys: `nesam/v1/<fleet>/<vehicle>/<topic>`.

/// Key expression of a topic of all vehicles of a fleet.
pub fn all_vehicles(fleet: &str, topic: &str) -> String {
    of_vehicle(fleet, "*", topic)
}

/// Key of a topic of one vehicle.
pub fn of_vehicle(fleet: &str, vehicle: &str, topic: &str) -> String {
    format!("nesam/v1/{fleet}/{vehicle}/{topic}")
}

/// Key of a topic of the whole fleet.
pub fn of_fleet(fleet: &str, topic: &str) -> String {
    format!("nesam/v1/{fleet}/{topic}")
}

/// Key of a topic of one server; one level deeper than those of vehicles, so that no vehicle can be taken for it.
pub fn of_server(fleet: &str, server: &str, topic: &str) -> String {
    format!("nesam/v1/{fleet}/server/{server}/{topic}")
}

/// The vehicle in a key.
pub fn vehicle(key: &str) -> &str {
    key.split('/').nth(3).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_vehicle_is_the_fourth_part() {
        assert_eq!(vehicle(&of_vehicle("f", "truck-7", "measurement")), "truck-7");
        assert_eq!(vehicle("nesam/v1"), "");
    }
}
