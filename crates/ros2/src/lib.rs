//! The few messages of ROS 2 that say how a vehicle moves, what it was told and what is known of it, in CDR ([`messages`]), and the keys, liveliness tokens and
//! attachments with which rmw_zenoh sends them ([`graph`]).
//!
//! No network and no clock: bags are read with it, and the server speaks it over Zenoh. The clients' tests hold it against another implementation of CDR and of
//! the type hashes.

mod cdr;
pub mod graph;
pub mod messages;
