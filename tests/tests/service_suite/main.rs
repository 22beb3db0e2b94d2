//! The service over real sockets: a server on loopback, the Rust client, a recorded drive, the shipped bundle.
#![allow(clippy::unwrap_used)]

mod bad_input;
mod from_now;
mod lifecycle;
mod measurements;
mod overload;
mod predictions;
mod random_bytes;
mod recording;
mod replay;
mod sessions;
mod soil;
mod stage;
mod zenoh_network;
