//! Bekker-Wong terramechanics and Newton-Euler, once, generic over the scalar.
#![forbid(unsafe_code)]

mod command_path;
mod contacts;
mod contradiction;
pub mod driveline;
pub mod effects;
mod integral_observer;
pub mod linear;
mod ride;
pub mod risk;
pub mod scalar;
mod soil;
mod soil_correction;
mod state;
pub mod step;
mod step_effects;
pub mod terramechanics;
mod torque_drive;
pub mod vec3;
mod vehicle;

pub use command_path::CommandPath;
pub use contacts::{ROLLING, Rolling, SUNK, Sunk, Wheels};
pub use contradiction::{CONTRADICTIONS, contradiction, unseen};
pub use ride::{Ride, UsualRide};
pub use scalar::Real;
pub use soil::{HARD_GROUND, SOIL_BOUNDS, SOIL_DIM, SOIL_NAMES, SOIL_UNITS, Soil};
pub use soil_correction::{SOIL_LOGARITHMIC, SoilCoordinates, SoilCorrection};
pub use state::{Control, DT_S, POINT_MAX_M, STATE_DIM, VehicleState, wrap_angle};
pub use vehicle::{Driveline, RimServo, SecondCommand, SteeringTable, TORQUE_KNOTS, TorqueDrive, Vehicle, WHEELS};
