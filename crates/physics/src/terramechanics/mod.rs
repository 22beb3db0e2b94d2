//! Bekker-Wong terramechanics of one rigid wheel.
//!
//! Sources: Bekker, *Introduction to Terrain-Vehicle Systems* (1969); Wong & Reece, J. Terramechanics 4 (1967) parts I and II; Janosi &
//! Hanamoto (1961); Wong, *Theory of Ground Vehicles*, ch. 2; Ishigami et al., J. Field Robotics 24 (2007); Jia et al. (2011) for the
//! isotropic combination of longitudinal and lateral shear.

mod bulldozing;
mod gauss;
mod load_balance;
mod pressure_sinkage;
mod shear;
mod slip;
mod wheel;

pub use bulldozing::{BearingCapacity, ContactArc, front_bulldozing, side_bulldozing, side_mobilisation, side_resistance};
pub use gauss::GaussRule;
pub use load_balance::{Support, balance_sinkage};
pub use pressure_sinkage::{bekker_sinkage, normal_stress};
pub use shear::{mobilised_share, mohr_coulomb};
pub use slip::{ContactMotion, WheelMotion};
pub(crate) use slip::{TRAVEL_SPEED_FLOOR_M_S, travel_direction};
pub use wheel::{ContactLaw, WheelGeometry, WheelWrench, wheel_wrench};
pub(crate) use wheel::{SINKAGE_FLOOR_M, SINKAGE_SHARE_MAX, viscous_rate_n_m};
