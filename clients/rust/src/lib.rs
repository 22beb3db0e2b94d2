//! Typed client of the nesam service.
//!
//! [`Client`] speaks gRPC: it opens sessions, uploads maps, streams measurements and asks for predictions. [`zenoh_vehicle::ZenohVehicle`] is the
//! vehicle's side over Zenoh. Arrays are plain `Vec<f32>` in row-major order with the shape in the documentation; everything small is the message of
//! `nesam.v1` itself, re-exported as [`v1`]. Units and frames are those of the protocol: SI, radians, World ENU, Body FLU.
//!
//! ```no_run
//! # async fn example() -> Result<(), nesam_client::ClientError> {
//! use nesam_client::{Candidates, Client, measurement, v1};
//!
//! let mut client = Client::connect("http://127.0.0.1:50051").await?;
//! client.open_session(v1::OpenSessionRequest { vehicle_id: "truck-1".into(), ..Default::default() }).await?;
//! let state = [0.0; 12]; // x y z roll pitch yaw vx vy vz wx wy wz
//! client.feed(vec![measurement("truck-1", 0, state, [1.0, 0.0])]).await?;
//! let controls = vec![1.0, 0.1, 1.0, 0.1]; // (samples = 1, horizon = 2, 2)
//! let prediction = client.predict(Candidates::new("truck-1", 1, 2, controls)).await?;
//! println!("after 0.2 s: {:?}", prediction.state(0, 1));
//! # Ok(())
//! # }
//! ```
//!
//! A planner that must have an answer in every cycle gives a deadline and a declared fallback, and is told which of the two has answered:
//!
//! ```no_run
//! # async fn example(mut client: nesam_client::Client, controls: Vec<f32>) -> Result<(), nesam_client::ClientError> {
//! use nesam_client::{Candidates, ComputedBy, KinematicFallback};
//!
//! let card = client.session("truck-1").await?.vehicle.unwrap_or_default();
//! let candidates = Candidates::new("truck-1", 64, 32, controls).or_fall_back(KinematicFallback::new(card));
//! let prediction = client.predict_within(candidates, Some(std::time::Duration::from_millis(50))).await?;
//! if prediction.computed_by == ComputedBy::KinematicFallback {
//!     println!("without terrain and soil: {:?}", prediction.fallback_reason);
//! }
//! # Ok(())
//! # }
//! ```
#![forbid(unsafe_code)]

mod client;
mod error;
mod fallback;
mod known_states;
mod map;
mod measure;
mod message;
mod outbox;
mod prediction;
mod refused;
mod tls;
pub mod zenoh_vehicle;

pub use client::Client;
pub use error::ClientError;
pub use fallback::KinematicFallback;
pub use map::MapLayers;
pub use measure::MeasurementStream;
pub use message::{measurement, outcome_label, state_array, state_message};
pub use nesam_proto::v1;
pub use outbox::Outbox;
pub use prediction::{Candidates, ComputedBy, ExtraOutputs, FallbackReason, Prediction};
pub use tls::Tls;
