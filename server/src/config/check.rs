//! What a configuration must be, beyond the types of its keys.

use std::net::{IpAddr, SocketAddr};

use nesam_engine::FleetSoilSettings;
use nesam_model::MAX_HORIZON;

use super::{Config, is_loopback_endpoint, is_tls_endpoint, zenoh};
use crate::convert::predict_bytes_max;
use crate::error::ServerError;

/// Most worker threads: more than processors of any one machine, and few enough to start.
pub(super) const THREADS_MAX: usize = 1024;

/// Most connections, uploads, pages and measurements of a stream at a time: more than any machine bears, and few enough to count places for.
const AT_A_TIME_MAX: usize = 1_000_000;

impl Config {
    /// Checks what the types do not.
    ///
    /// # Errors
    /// `ServerError::Value` naming the key.
    pub fn check(&self) -> Result<(), ServerError> {
        self.check_numbers()?;
        let reports = &self.http.reports;
        if self.http.enabled && reports.exists() && !reports.is_dir() {
            return Err(ServerError::value(
                "http.reports",
                format!("{} is not a folder; give the one that `nesam diagnose` writes its reports to", reports.display()),
            ));
        }
        self.check_ports()?;
        self.tls.check()?;
        self.zenoh.check()?;
        let query_bytes = predict_bytes_max(&self.limits);
        if self.zenoh.message_bytes_max < query_bytes {
            return Err(ServerError::value(
                "zenoh.message_bytes_max",
                format!("is {}, but a prediction within `limits` takes {query_bytes}", self.zenoh.message_bytes_max),
            ));
        }
        self.ros2.check()?;
        if self.ros2.enabled && !self.zenoh.enabled {
            return Err(ServerError::value("ros2.enabled", "is on, but `zenoh.enabled` is off: machines of ROS 2 are heard over Zenoh"));
        }
        self.cluster.check()?;
        self.diagnosis.check()?;
        if self.cluster.enabled() && self.store.enabled {
            return Err(ServerError::value("store.enabled", "is on, but with `cluster.etcd` sessions are kept in etcd; choose one"));
        }
        if self.zenoh.uses_tls() && !self.tls.restricts() {
            return Err(ServerError::value(
                "zenoh",
                "has an endpoint `tls/...`, which needs certificates for both sides: set `tls.client_ca`",
            ));
        }
        self.check_side_doors()?;
        FleetSoilSettings::from(&self.fleet_soil).check().map_err(|error| ServerError::value("fleet_soil", error.to_string()))
    }

    /// Checks the range of each number by itself.
    fn check_numbers(&self) -> Result<(), ServerError> {
        self.check_seconds()?;
        self.check_counts()?;
        let magnitudes = [
            ("limits.position_max_m", self.limits.position_max_m),
            ("limits.speed_max_m_s", self.limits.speed_max_m_s),
            ("limits.angular_speed_max_rad_s", self.limits.angular_speed_max_rad_s),
        ];
        match magnitudes.into_iter().find(|(_, value)| !(*value > 0.0 && value.is_finite())) {
            Some((key, value)) => Err(ServerError::value(key, format!("is {value}, allowed is a finite number above 0"))),
            None => Ok(()),
        }
    }

    fn check_seconds(&self) -> Result<(), ServerError> {
        let seconds = [
            ("grpc.deadline_s", self.grpc.deadline_s),
            ("grpc.upload_deadline_s", self.grpc.upload_deadline_s),
            ("grpc.keepalive_s", self.grpc.keepalive_s),
            ("grpc.drain_s", self.grpc.drain_s),
            ("tls.handshake_s", self.tls.handshake_s),
            ("tls.reload_s", self.tls.reload_s),
            ("limits.pause_max_s", self.limits.pause_max_s),
            ("limits.session_idle_s", self.limits.session_idle_s),
            ("limits.clock_ahead_max_s", self.limits.clock_ahead_max_s),
            ("store.interval_s", self.store.interval_s),
            ("diagnosis.limit_s", self.diagnosis.limit_s),
            ("zenoh.status_interval_s", self.zenoh.status_interval_s),
            ("ros2.command_hold_s", self.ros2.command_hold_s),
            ("ros2.diagnostics_interval_s", self.ros2.diagnostics_interval_s),
        ];
        if let Some((key, value)) = seconds.into_iter().find(|(_, value)| !(*value > 0.0 && *value <= 1e6)) {
            return Err(ServerError::value(key, format!("is {value}, allowed is above 0 and up to 1e6 s")));
        }
        if !(self.fleet_soil.exchange_s >= 0.0 && self.fleet_soil.exchange_s <= 1e6) {
            return Err(ServerError::value(
                "fleet_soil.exchange_s",
                format!("is {}, allowed is 0 (off) up to 1e6 s", self.fleet_soil.exchange_s),
            ));
        }
        let window_s = self.limits.reorder_window_s;
        if !(0.0..=1.0).contains(&window_s) {
            return Err(ServerError::value("limits.reorder_window_s", format!("is {window_s}, allowed is 0 to 1 s")));
        }
        Ok(())
    }

    fn check_counts(&self) -> Result<(), ServerError> {
        let needed = [
            ("grpc.uploads_max", self.grpc.uploads_max == 0),
            ("grpc.tile_bytes_max", self.grpc.tile_bytes_max == 0),
            ("grpc.measurements_in_flight_max", self.grpc.measurements_in_flight_max == 0),
            ("grpc.connections_max", self.grpc.connections_max == 0),
            ("grpc.streams_per_connection_max", self.grpc.streams_per_connection_max == 0),
            ("http.watchers_max", self.http.watchers_max == 0),
            ("limits.sessions_max", self.limits.sessions_max == 0),
            ("limits.sessions_per_vehicle_max", self.limits.sessions_per_vehicle_max == 0),
            ("limits.samples_max", self.limits.samples_max == 0),
            ("limits.horizon_max", self.limits.horizon_max == 0),
            ("limits.sample_steps_max", self.limits.sample_steps_max == 0),
            ("limits.waiting_predictions_max", self.limits.waiting_predictions_max == 0),
            ("limits.waiting_predictions_per_vehicle_max", self.limits.waiting_predictions_per_vehicle_max == 0),
            ("limits.waiting_commands_max", self.limits.waiting_commands_max == 0),
            ("limits.waiting_measurements_per_vehicle_max", self.limits.waiting_measurements_per_vehicle_max == 0),
            ("recording.part_bytes_max", self.recording.part_bytes_max == 0),
            ("recording.bytes_max", self.recording.bytes_max == 0),
            ("recording.queue_bytes_max", self.recording.queue_bytes_max == 0),
        ];
        if let Some((key, _)) = needed.into_iter().find(|(_, is_none)| *is_none) {
            return Err(ServerError::value(key, "is 0, at least 1 is needed"));
        }
        if self.workers.threads > THREADS_MAX {
            return Err(ServerError::value("workers.threads", format!("is {}, at most {THREADS_MAX} are allowed", self.workers.threads)));
        }
        let at_a_time = [
            ("grpc.uploads_max", self.grpc.uploads_max),
            ("grpc.connections_max", self.grpc.connections_max),
            ("grpc.measurements_in_flight_max", self.grpc.measurements_in_flight_max),
            ("http.watchers_max", self.http.watchers_max),
        ];
        if let Some((key, value)) = at_a_time.into_iter().find(|(_, value)| *value > AT_A_TIME_MAX) {
            return Err(ServerError::value(key, format!("is {value}, at most {AT_A_TIME_MAX} are allowed")));
        }
        if self.limits.horizon_max > MAX_HORIZON {
            return Err(ServerError::value(
                "limits.horizon_max",
                format!("is {}, the model predicts {MAX_HORIZON} steps at most", self.limits.horizon_max),
            ));
        }
        Ok(())
    }

    /// Addresses that the server listens on itself, with their keys.
    ///
    /// # Errors
    /// `ServerError::Value` as [`HttpConfig::health_address`].
    pub fn addresses(&self) -> Result<Vec<(&'static str, SocketAddr)>, ServerError> {
        let http = self.http.enabled.then_some(("http.listen", self.http.listen));
        let health = self.http.health_address()?.map(|address| ("http.health", address));
        let zenoh = self.zenoh.listen.iter().filter(|_| self.zenoh.enabled).filter_map(|endpoint| zenoh::socket(endpoint));
        let zenoh = zenoh.map(|address| ("zenoh.listen", address));
        Ok([("grpc.listen", self.grpc.listen)].into_iter().chain(http).chain(health).chain(zenoh).collect())
    }

    /// No two listeners may want the same port.
    fn check_ports(&self) -> Result<(), ServerError> {
        // All addresses of IPv6 are those of IPv4 too.
        let covers = |a: IpAddr, b: IpAddr| a == b || (a.is_unspecified() && (a.is_ipv6() || b.is_ipv4()));
        let addresses = self.addresses()?;
        for (i, (key, address)) in addresses.iter().enumerate().filter(|(_, (_, address))| address.port() != 0) {
            let same = |other: &SocketAddr| {
                other.port() == address.port() && (covers(other.ip(), address.ip()) || covers(address.ip(), other.ip()))
            };
            if let Some((taken_by, _)) = addresses[..i].iter().find(|(_, other)| same(other)) {
                return Err(ServerError::value(key, format!("is {address}, whose port `{taken_by}` has already")));
            }
        }
        Ok(())
    }

    /// Where clients have to say who they are, nothing else that knows no identities may be open to the network.
    fn check_side_doors(&self) -> Result<(), ServerError> {
        if !self.tls.restricts() {
            return Ok(());
        }
        if self.http.enabled && !self.http.listen.ip().is_loopback() {
            return Err(ServerError::value(
                "http.listen",
                "is open to the network and knows no identities; with `tls.client_ca` only loopback is allowed",
            ));
        }
        if self.zenoh.enabled
            && let Some(endpoint) = self.zenoh.listen.iter().find(|endpoint| !is_loopback_endpoint(endpoint) && !is_tls_endpoint(endpoint))
        {
            return Err(ServerError::value(
                "zenoh.listen",
                format!(
                    "`{endpoint}` is open to the network and knows no identities; with `tls.client_ca` listen on `tls/...`, or on loopback only \
                     behind a router (`nesam router-config` writes its configuration)"
                ),
            ));
        }
        Ok(())
    }
}
