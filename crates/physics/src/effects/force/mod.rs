//! Effects on body and wheels: masses, forces, springs.

mod cg_forward;
mod cg_height;
mod cg_lateral;
mod free_form;
mod friction_cap;
mod linear_drag;
mod payload;
mod pitch_stiffness;
mod quadratic_drag;
mod roll_stiffness;
mod rolling_resistance;
mod tow;
mod turning_resistance;
mod tyre_radius;
mod tyre_radius_front;
mod tyre_radius_rear;
mod wheel_drag;
mod wind;

pub use cg_forward::CgForward;
pub use cg_height::CgHeight;
pub use cg_lateral::CgLateral;
pub use free_form::{FREE_FORM_AXES, FREE_FORM_FEATURES, FreeForm};
pub use friction_cap::FrictionCap;
pub use linear_drag::LinearDrag;
pub use payload::Payload;
pub use pitch_stiffness::PitchStiffness;
pub use quadratic_drag::QuadraticDrag;
pub use roll_stiffness::RollStiffness;
pub use rolling_resistance::RollingResistance;
pub use tow::Tow;
pub use turning_resistance::TurningResistance;
pub use tyre_radius::TyreRadius;
pub use tyre_radius_front::TyreRadiusFront;
pub use tyre_radius_rear::TyreRadiusRear;
pub use wheel_drag::WheelDrag;
pub use wind::Wind;

use crate::effects::PLACES_MAX;
use crate::effects::written::{WRITTEN_MAX, Written};
use crate::vehicle::WHEELS;

/// What effects change of body and wheels; all zero by default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ForceTerms {
    /// Mass added, kg.
    pub added_mass_kg: f64,
    /// Where it is, relative to the reference point, Body, m.
    pub added_at_m: [f64; 3],
    /// Shift of the vehicle's own centre of mass from the reference point, Body, m.
    pub centre_shift_m: [f64; 3],
    /// Drag per speed, N s/m.
    pub linear_drag_n_s_m: f64,
    /// Drag per speed squared, N s²/m².
    pub quadratic_drag_n_s2_m2: f64,
    /// Pull backwards along Body x, N.
    pub tow_n: f64,
    /// Its moment about Body y at the reference point, N m.
    pub tow_moment_n_m: f64,
    /// Moment against turning per quarter of weight times wheelbase, of a skid-steer base, -.
    pub turning_resistance: f64,
    /// Force fixed in World (east, north), N.
    pub wind_n: [f64; 2],
    /// Rolling resistance per wheel load, -.
    pub rolling_resistance: f64,
    /// Friction torque at each wheel, N m, opposing its rolling.
    pub wheel_drag_n_m: [f64; WHEELS],
    /// Relative change of the wheel radius of front and rear axle, -.
    pub radius_relative: [f64; 2],
    /// Relative stiffness added against roll and against pitch, -.
    pub roll_pitch_stiffness: [f64; 2],
    /// 1 / μ of a cap on the tangential force of a wheel; 0 = none.
    pub friction_cap_inverse: f64,
    /// Wrenches without a cause, each with the region that it is valid in.
    pub free_form: [FreeForm; PLACES_MAX],
    /// Wrenches that somebody wrote down.
    pub written: [Option<Written>; WRITTEN_MAX],
}

impl ForceTerms {
    /// Whether a force acts on the body beside those of the wheels.
    pub fn acts_on_body(&self) -> bool {
        self.linear_drag_n_s_m != 0.0
            || self.quadratic_drag_n_s2_m2 != 0.0
            || self.tow_n != 0.0
            || self.tow_moment_n_m != 0.0
            || self.turning_resistance != 0.0
            || self.wind_n != [0.0; 2]
            || self.free_form.iter().any(FreeForm::acts)
            || self.written[0].is_some()
    }

    /// Whether a wheel is another one than the card's, but for friction torques.
    pub fn acts_on_wheels(&self) -> bool {
        self.rolling_resistance != 0.0
            || self.radius_relative != [0.0; 2]
            || self.roll_pitch_stiffness != [0.0; 2]
            || self.friction_cap_inverse != 0.0
    }
}
