//! The catalogue: physical effects that a base vehicle lacks, each in its own file with equation, source, units and range.
//!
//! An effect belongs to one [`Layer`], has named [`Parameter`]s, can be [scaled](Effect::scaled) down to nothing and states what it changes through
//! [`EffectTerms`], which drive line, step, soil, ground and sensors evaluate. All terms are zero without effects, so a vehicle without effects
//! computes what it always did. A bundle lists its effects by id and parameters, with the instant from which each acts ([`ScheduledEffect`]);
//! `nesam diagnose` finds them.
//!
//! | layer | folder | acts in |
//! |---|---|---|
//! | actuator | [`actuator`] | `driveline.rs`: commands to rims and road-wheel angles |
//! | force | [`force`] | `step.rs`, `step_effects.rs`: body and wheels |
//! | soil | [`soil`] | the soil vector and the contact coefficients of the wheels |
//! | sensor | [`sensor`] | [`SensorTerms::to_true`] and [`SensorTerms::to_measured`] around a prediction |
//! | map | [`map`] | [`MapTerms::raised`], where ground is looked up |
//! | force | [`written`] | formulas that somebody wrote into a bundle; `step_effects.rs` |
//!
//! A new effect is one file in its layer's folder (a struct through the macro `effect!` or an [`Act`] by hand), a term for what it changes, and one
//! line in `catalogue!` below.

mod act;
pub mod actuator;
mod fit;
pub mod force;
pub mod map;
mod schedule;
pub mod sensor;
pub mod soil;
pub mod written;

pub use act::{Act, Parameter, Quantity, Scaling};
pub use actuator::*;
pub use fit::places_at_fault;
pub use force::*;
pub use map::*;
pub use schedule::{Phases, ScheduledEffect};
pub use sensor::*;
pub use soil::*;
pub use written::Written;

use crate::vehicle::Vehicle;

/// Effects of one id that hold a place of their own (a depth, a time, a region) and act at once, at most.
pub const PLACES_MAX: usize = 4;

/// Adds a size at a place, (size, place …), to what is there, else to the next free one; one beyond [`PLACES_MAX`] is left out.
fn add_at_place<const N: usize>(places: &mut [[f64; N]; PLACES_MAX], added: [f64; N]) {
    let same = places.iter().position(|p| p[0] != 0.0 && p[1..] == added[1..]);
    if let Some(i) = same.or(places.iter().position(|p| p[0] == 0.0)) {
        places[i] = core::array::from_fn(|k| if k == 0 { places[i][0] + added[0] } else { added[k] });
    }
}

/// What effects change; all zero by default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EffectTerms {
    /// Commands to rims and angles.
    pub actuator: ActuatorTerms,
    /// Body and wheels.
    pub force: ForceTerms,
    /// Soil under the wheels.
    pub soil: SoilTerms,
    /// True states to measured states.
    pub sensor: SensorTerms,
    /// Map to ground.
    pub map: MapTerms,
}

/// Layer in which an effect acts; a residual in another layer speaks against it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Layer {
    /// Command to wheel speeds and road-wheel angles.
    Actuator,
    /// Forces on the vehicle.
    Force,
    /// Soil and its constitutive law.
    Soil,
    /// True motion to measured motion.
    Sensor,
    /// Map to ground.
    Map,
}

impl Layer {
    /// Whether its effects act as forces, directly or through the soil: their size hangs on a constitutive law, that of the others on geometry.
    pub fn is_force(self) -> bool {
        matches!(self, Self::Force | Self::Soil)
    }

    /// As in reports.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Actuator => "actuator",
            Self::Force => "force",
            Self::Soil => "soil",
            Self::Sensor => "sensor",
            Self::Map => "map",
        }
    }
}

macro_rules! catalogue {
    ($($effect:ident)*) => {
        /// An effect: of the catalogue, a closed list, so that every effect is one file and one line; or one that somebody wrote down.
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub enum Effect {
            $(#[doc = concat!("See [`", stringify!($effect), "`].")] $effect($effect),)*
            /// See [`Written`].
            Written(Written),
        }

        impl Effect {
            /// Ids of the catalogue, in its order.
            pub const IDS: &'static [&'static str] = &[$($effect::ID),*];

            /// Every effect once, at a size that a good drive shows (catalogue; see [`Quantity::typical`]).
            pub fn examples() -> Vec<Self> {
                vec![$(Self::$effect($effect::typical())),*]
            }

            /// An effect from its id and its parameters in the order of [`Effect::parameters`]; `None` for an unknown id or a wrong number of them.
            pub fn from_parameters(id: &str, values: &[f64]) -> Option<Self> {
                match id {
                    $(id if id == $effect::ID => $effect::from_values(values).map(Self::$effect),)*
                    _ => None,
                }
            }

            /// Id as in `effects.toml` and reports.
            pub fn id(&self) -> &'static str {
                match self { $(Self::$effect(_) => $effect::ID,)* Self::Written(e) => e.id() }
            }

            /// What the parameters are, in the order of [`Effect::parameters`].
            pub fn quantities(&self) -> &'static [Quantity] {
                match self { $(Self::$effect(_) => $effect::QUANTITIES,)* Self::Written(e) => e.quantities() }
            }

            /// Values of the parameters, in the order of [`Effect::parameters`].
            pub fn values(&self) -> Vec<f64> {
                match self { $(Self::$effect(e) => e.values(),)* Self::Written(e) => e.values() }
            }

            /// The same effect with other values of its parameters, in the order of [`Effect::parameters`]; `None` for a wrong number of them, and for
            /// values that a written effect holds.
            pub fn with_values(&self, values: &[f64]) -> Option<Self> {
                match self {
                    $(Self::$effect(_) => $effect::from_values(values).map(Self::$effect),)*
                    Self::Written(e) => e.with_values(values).map(Self::Written),
                }
            }

            /// Layer in which the effect acts.
            pub fn layer(&self) -> Layer {
                match self { $(Self::$effect(_) => $effect::LAYER,)* Self::Written(e) => e.layer() }
            }

            /// Adds the effect to a vehicle's terms.
            pub fn add_to(&self, terms: &mut EffectTerms) {
                match self { $(Self::$effect(e) => e.add_to(terms),)* Self::Written(e) => e.add_to(terms) }
            }
        }
    };
}

catalogue! {
    Payload CgForward CgLateral CgHeight LinearDrag QuadraticDrag Tow Wind RollingResistance WheelDrag TorqueLimit
    SpeedLag SpeedDelay SteeringLag SteeringDelay SteeringOffset SteeringRatio SteeringBacklash SteeringCompliance SpeedGain
    TyreRadius TyreRadiusFront TyreRadiusRear LockedDifferential SkidSteerTrack
    SlipSinkage MultiPass ElasticRecovery ThetaMShift Grousers FrontBulldozing SideBulldozing
    RollStiffness PitchStiffness MapTilt MapOffset SoilDrift
    GyroBias GyroScale VelocityScale PositionLatency LeverArm MountAngle ClockDrift FrictionCap SoilCrust
    PoseLatency TurnLimit TurningResistance AccelerationLimit TurnAccelerationLimit WheelSpeedLimit TurnEfficiency
    FreeForm
}

impl Effect {
    /// The effect of an id at the size of [`Effect::examples`].
    pub fn example(id: &str) -> Option<Self> {
        Self::examples().into_iter().find(|effect| effect.id() == id)
    }

    /// Whether the effect is one of the drive of skid-steer bases; it changes nothing on another vehicle.
    pub fn is_of_skid_steer(&self) -> bool {
        matches!(
            self,
            Self::SkidSteerTrack(_)
                | Self::TurnLimit(_)
                | Self::TurningResistance(_)
                | Self::AccelerationLimit(_)
                | Self::TurnAccelerationLimit(_)
                | Self::WheelSpeedLimit(_)
                | Self::TurnEfficiency(_)
        )
    }

    /// What somebody wrote down; `None` for an effect of the catalogue.
    pub fn written(&self) -> Option<Written> {
        if let Self::Written(written) = self { Some(*written) } else { None }
    }

    /// Parameters with units and ranges.
    pub fn parameters(&self) -> Vec<Parameter> {
        let of = |(q, value): (&Quantity, f64)| Parameter { name: q.name, unit: q.unit, value, range: q.range };
        self.quantities().iter().zip(self.values()).map(of).collect()
    }

    /// The effect scaled: 0 = absent, 1 = as it is.
    pub fn scaled(&self, share: f64) -> Self {
        let values: Vec<f64> = self.quantities().iter().zip(self.values()).map(|(q, value)| q.scaling.apply(value, share)).collect();
        self.with_values(&values).expect("as many values as quantities; this is a bug")
    }
}

impl Vehicle {
    /// This vehicle with effects in addition to those it has, all of them begun.
    pub fn with_effects(&self, effects: &[Effect]) -> Self {
        let mut vehicle = self.clone();
        for effect in effects {
            effect.add_to(&mut vehicle.effects);
        }
        vehicle
    }
}
