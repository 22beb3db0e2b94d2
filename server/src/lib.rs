//! The edge of the service: gRPC, Zenoh and HTTP around the engine.
//!
//! [`serve`] starts everything that a [`Config`] asks for and gives a [`RunningServer`]; the command line and the tests use the same function.
//! A request takes one way whatever brought it: `convert` turns the message into a domain value or names the field at fault, [`call::EngineClient`]
//! puts it into the engine's queue and awaits the answer, `convert` turns that into a message. Handlers do nothing else.
#![forbid(unsafe_code)]

pub mod access;
pub mod call;
mod clock;
mod cluster;
mod config;
mod connection;
pub mod convert;
mod diagnosis;
mod error;
mod expiry;
mod grpc;
mod health;
mod http;
mod http_connections;
mod listener;
mod one_thread;
pub mod recording;
mod serve;
mod signals;
pub mod store;
mod telemetry;
mod web;
mod workers;
mod zenoh;

pub use clock::MonotonicClock;
pub use cluster::{etcd_endpoint, knows_record};
pub use config::{
    ClusterConfig, Config, DiagnosisConfig, Distribution, FleetSoilConfig, GrpcConfig, HttpConfig, RecordingConfig, Ros2Config,
    Ros2Vehicle, StoreConfig, TlsConfig, WorkersConfig, ZenohConfig, ZenohMode, is_loopback_endpoint, is_tls_endpoint,
};
pub use diagnosis::knows_report;
pub use error::ServerError;
pub use grpc::grpc_timeout;
pub use one_thread::{Sessions, serve_on_one_thread};
pub use serve::{RunningServer, serve};
pub use signals::{outlive_file_limit, second_interrupt, termination};
pub use telemetry::Metrics;
pub use web::shown_reports;
pub use workers::start_workers;
pub use zenoh::{LinkFiles, router_config};
