//! Physical effects that a base vehicle lacks, each in its own file: equation, source, units, range.
//!
//! An effect states what it changes through [`EffectTerms`], which the step evaluates: a mass that rides along, a drag at a wheel, an
//! offset of the steering. All terms are zero without effects, so a bundle without effects computes what it always did.
//! A bundle lists its effects by id and parameters; `nesam diagnose` finds them.

mod payload;
mod steering_offset;
mod wheel_drag;

pub use payload::Payload;
pub use steering_offset::SteeringOffset;
pub use wheel_drag::WheelDrag;

use crate::vehicle::{Vehicle, WHEELS};

/// What effects add to the step; all zero by default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EffectTerms {
    /// Mass added, kg.
    pub added_mass_kg: f64,
    /// Where it is, relative to the reference point, Body, m.
    pub added_at_m: [f64; 3],
    /// Friction torque at each wheel, N m, opposing its rolling.
    pub wheel_drag_n_m: [f64; WHEELS],
    /// Added to the steering command at the actuator, in the unit of the second command.
    pub steering_offset: f64,
}

/// One parameter of an effect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parameter {
    /// Name as in reports.
    pub name: &'static str,
    /// Unit as in reports.
    pub unit: &'static str,
    /// Value.
    pub value: f64,
    /// Physical range; an estimate at its end is not accepted.
    pub range: [f64; 2],
}

/// Layer in which an effect acts; a residual in another layer speaks against it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layer {
    /// Command to wheel speeds and road-wheel angles.
    Actuator,
    /// Forces on the vehicle.
    Force,
}

/// The catalogue: a closed list, so that every effect is one file and one variant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Effect {
    /// A mass carried along.
    Payload(Payload),
    /// Friction at one wheel.
    WheelDrag(WheelDrag),
    /// A constant offset of the steering.
    SteeringOffset(SteeringOffset),
}

impl Effect {
    /// Ids of the catalogue.
    pub const IDS: [&'static str; 3] = ["payload", "wheel_drag", "steering_offset"];

    /// An effect from its id and its parameters in the order of [`Effect::parameters`]; `None` for an unknown id or a wrong number of them.
    pub fn from_parameters(id: &str, values: &[f64]) -> Option<Self> {
        match (id, values) {
            ("payload", &[mass_kg, x, y, z]) => Some(Self::Payload(Payload { mass_kg, at_m: [x, y, z] })),
            ("wheel_drag", &[wheel, torque_n_m]) => Some(Self::WheelDrag(WheelDrag { wheel: wheel as usize, torque_n_m })),
            ("steering_offset", &[second]) => Some(Self::SteeringOffset(SteeringOffset { second })),
            _ => None,
        }
    }

    /// Id as in `effects.toml` and reports.
    pub fn id(&self) -> &'static str {
        match self {
            Self::Payload(_) => "payload",
            Self::WheelDrag(_) => "wheel_drag",
            Self::SteeringOffset(_) => "steering_offset",
        }
    }

    /// Parameters with units and ranges.
    pub fn parameters(&self) -> Vec<Parameter> {
        match self {
            Self::Payload(e) => e.parameters(),
            Self::WheelDrag(e) => e.parameters(),
            Self::SteeringOffset(e) => e.parameters(),
        }
    }

    /// Layer in which the effect acts.
    pub fn layer(&self) -> Layer {
        match self {
            Self::SteeringOffset(_) => Layer::Actuator,
            Self::Payload(_) | Self::WheelDrag(_) => Layer::Force,
        }
    }

    /// The effect scaled: 0 = absent, 1 = as it is.
    pub fn scaled(&self, share: f64) -> Self {
        match *self {
            Self::Payload(e) => Self::Payload(Payload { mass_kg: e.mass_kg * share, ..e }),
            Self::WheelDrag(e) => Self::WheelDrag(WheelDrag { torque_n_m: e.torque_n_m * share, ..e }),
            Self::SteeringOffset(e) => Self::SteeringOffset(SteeringOffset { second: e.second * share }),
        }
    }

    /// Adds the effect to a vehicle's terms.
    pub fn add_to(&self, terms: &mut EffectTerms) {
        match self {
            Self::Payload(e) => e.add_to(terms),
            Self::WheelDrag(e) => e.add_to(terms),
            Self::SteeringOffset(e) => e.add_to(terms),
        }
    }
}

impl Vehicle {
    /// This vehicle with effects in addition to those it has.
    pub fn with_effects(&self, effects: &[Effect]) -> Self {
        let mut vehicle = self.clone();
        for effect in effects {
            effect.add_to(&mut vehicle.effects);
        }
        vehicle
    }
}
