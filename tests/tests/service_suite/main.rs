//! The service over real sockets: a server on loopback, the Rust client, a recorded drive, the shipped bundle.
#![allow(clippy::unwrap_used)]

mod alarms;
mod authority;
mod bad_input;
mod effects;
mod extras;
mod fleet_soil;
mod fleet_soil_sharing;
mod forecasts;
mod from_now;
mod lifecycle;
mod live_page;
mod measurements;
mod moving;
mod overload;
mod predictions;
mod random_bytes;
mod ranked;
mod recording;
mod reload;
mod reorder;
mod replay;
mod resets;
mod routing;
mod security;
mod session_model;
mod sessions;
mod sharing;
mod simulation;
mod slides;
mod soil;
mod stage;
mod streams;
mod zenoh_network;
mod zenoh_presence;
mod zenoh_security;
