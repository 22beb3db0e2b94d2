//! Messages to domain values and back. The only place that knows both; every refusal names the path of the field.

mod alarm;
mod candidates;
mod command;
mod effects;
mod extras;
mod fleet_soil;
mod image;
mod measurement;
mod packed;
mod prediction;
mod session;
mod state;
mod status;
mod terrain;
mod terrain_message;

pub use alarm::alarm_message;
pub use command::{measurement_message, open_message, predict_message};
pub use effects::{applied_effects, effect_messages};
pub use fleet_soil::{SoilTeller, fleet_soil_map, fleet_soil_shares, heard_fleet_soil};
pub use image::{image_bytes, session_image};
pub use measurement::{measurement, measurement_answer};
pub use packed::{Precision, decode_f32, encode};
pub use prediction::{OutputSelection, predict_bytes_max, predict_error, predict_query, predict_reply};
pub use session::{open_session, provenance, session_view, soil_correction, soil_estimate, soil_of, soil_vector};
pub(crate) use state::unsigned_zero;
pub use state::{control, control_message, vehicle_state, vehicle_state_message};
pub(crate) use status::refused;
pub use status::{FIELD_METADATA, code, to_status};
pub use terrain::{MapBuilder, description, patched};
pub(crate) use terrain_message::{changed_tile, upload};
