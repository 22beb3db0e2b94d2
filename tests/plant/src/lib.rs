//! A simulated vehicle on deformable soil: the truth that closed-loop runs and discovery are tested on.
//!
//! It shares no code with the model (invariant 5 of ARCHITECTURE.md): own arithmetic, own contact, own suspension, own drive line, own readers of the
//! vehicle's data sheet and of worlds. Soil is a height field of nodes 0.05 m apart, after the idea of Chrono's SCM (Serban et al. 2023, doi
//! 10.1115/1.4056851; Krenn and Hirzinger 2008): every node under a wheel carries the Bekker pressure of its own depth, yields plastically, unloads
//! elastically and shears after Mohr-Coulomb and Janosi-Hanamoto; what was pressed stays pressed. The chassis is a rigid body on four sprung wheels that
//! spin; engine, gears, limited-slip couplings, brakes, speed controller and steering actuator follow the data sheet. Step 2 ms.
//!
//! World is x east, y north, z up; Body is x forward, y left, z up; attitude is roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll). SI and radians.
//! Wheels are FL, FR, RL, RR. What it is not: no suspension linkage (no jacking, bump steer or camber change), no tyre compliance, no bulldozing.
#![forbid(unsafe_code)]

mod card;
mod contact;
mod drive_line;
mod effects;
mod error;
mod ground;
mod math;
mod plant;
mod record;
mod sensors;
mod serve;

pub use card::PlantVehicle;
pub use effects::{EFFECTS, HiddenEffects};
pub use error::PlantError;
pub use ground::{Ground, SoilParameters};
pub use plant::{Command, Plant, STEP_S, Truth, WHEELS};
pub use record::{Drive, DriveRecorder, write_set};
pub use sensors::{Measured, Sensors};
pub use serve::{Answer, PlantServer, Request};
