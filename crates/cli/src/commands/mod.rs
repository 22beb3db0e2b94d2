//! One module per command: its options and `run`.

pub mod adapt;
pub mod bench;
pub mod calibrate;
pub mod check;
mod coverage;
pub mod demo;
pub mod diagnose;
pub mod effects;
pub mod evaluate;
pub mod fleet;
pub mod import;
pub mod inside;
pub mod inspect;
pub mod navigate;
pub mod plant;
pub mod predict;
pub mod replay;
pub mod router_config;
pub mod serve;
pub mod train;
