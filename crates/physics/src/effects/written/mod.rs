//! Effects that an engineer writes down: a wrench on the body as formulas with units, read from a bundle and not compiled in.
//!
//! A formula may use its own parameters and the variables of [`VARIABLES`]. Formulas are checked for dimensions when they are read and bounded when they
//! act, so none can throw a rollout out of its range; one that gives no number (0 / 0) gives no force. A written effect has an id of its own, which is none of
//! the catalogue. It acts at a share of what is written, and that share is what a diagnosis estimates when it is given the effect as a hypothesis.

mod program;
mod unit;

use std::sync::Mutex;

use crate::effects::{EffectTerms, Layer, Quantity, Scaling};
use crate::scalar::Real;

pub use program::{Name, Program};
pub use unit::Dimension;

/// Written effects that act at once, at most.
pub const WRITTEN_MAX: usize = 4;
/// Largest force over the mass of the vehicle, m/s², and largest moment as the same at an arm of 1 m (chosen: far beyond what a vehicle survives).
const BOUND_M_S2: f64 = 100.0;
/// The share of what is written: absent at 0, as written at 1; the sign is part of the formulas.
const SHARE: Quantity = Quantity::new("share", "1", [0.0, 10.0], 1.0, Scaling::Size);

/// Forces (N) and moments (N m) about the reference point, Body, as `effects.toml` names them.
pub const AXES: [&str; 6] = ["force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z"];

/// What formulas may use: velocity and angular velocity (Body), roll and pitch, mean road-wheel angle of the front wheels, slope of the ground under the
/// vehicle (rise over run, ahead and to the left), mass and gravity.
pub const VARIABLES: [(&str, Dimension); 13] = [
    ("v_ahead", Dimension::SPEED),
    ("v_left", Dimension::SPEED),
    ("v_up", Dimension::SPEED),
    ("roll_rate", Dimension::RATE),
    ("pitch_rate", Dimension::RATE),
    ("yaw_rate", Dimension::RATE),
    ("roll", Dimension::NONE),
    ("pitch", Dimension::NONE),
    ("road_wheel_angle", Dimension::NONE),
    ("slope_ahead", Dimension::NONE),
    ("slope_left", Dimension::NONE),
    ("mass", Dimension::MASS),
    ("gravity", Dimension::ACCELERATION),
];

/// A parameter of a written effect.
#[derive(Clone, Debug, PartialEq)]
pub struct WrittenParameter {
    /// Name in the formulas.
    pub name: String,
    /// Value in the unit.
    pub value: f64,
    /// Unit, such as `N s/m`.
    pub unit: String,
    /// Physical range.
    pub range: [f64; 2],
}

/// The text of a written effect.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WrittenText {
    /// Its id, snake_case, none of the catalogue.
    pub id: String,
    /// Formulas by axis ([`AXES`]); empty = nothing.
    pub formulas: [String; 6],
    /// Parameters.
    pub parameters: Vec<WrittenParameter>,
}

/// A written effect that was read.
#[derive(Debug, PartialEq)]
struct Definition {
    text: WrittenText,
    programs: [Program; 6],
    quantities: Vec<Quantity>,
}

/// Definitions that were read, each once: effects are plain copies everywhere, so what they say must stay.
static READ: Mutex<Vec<&'static Definition>> = Mutex::new(Vec::new());

/// A wrench that somebody wrote down, at a share of its size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Written {
    definition: &'static Definition,
    share: f64,
}

impl Written {
    /// Reads a written effect. Every different text is kept for as long as the program runs.
    ///
    /// # Errors
    /// What is wrong, to follow the name of the file: an id that is not snake_case, no formula, a formula that cannot be read or has another dimension, a
    /// parameter that is a variable, occurs twice, has an unknown unit or lies outside of its range.
    pub fn read(text: &WrittenText) -> Result<Self, String> {
        let mut read = READ.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(definition) = read.iter().find(|d| d.text == *text) {
            return Ok(Self { definition, share: 1.0 });
        }
        let definition: &'static Definition = Box::leak(Box::new(Definition::of(text).map_err(|e| format!("says of `{}`: {e}", text.id))?));
        read.push(definition);
        Ok(Self { definition, share: 1.0 })
    }

    /// What was read.
    pub fn text(&self) -> &WrittenText {
        &self.definition.text
    }

    /// The same at this share of what is written.
    pub fn at(&self, share: f64) -> Self {
        Self { share, ..*self }
    }

    /// Share of what is written.
    pub fn share(&self) -> f64 {
        self.share
    }

    /// Its id.
    pub fn id(&self) -> &'static str {
        &self.definition.text.id
    }

    /// What its parameters are; the share comes last.
    pub fn quantities(&self) -> &'static [Quantity] {
        &self.definition.quantities
    }

    /// Values of its parameters.
    pub fn values(&self) -> Vec<f64> {
        self.own_values().chain([self.share]).collect()
    }

    /// The same with these values, of which the share alone can differ from what is written; `None` for others.
    pub fn with_values(&self, values: &[f64]) -> Option<Self> {
        let (share, own) = values.split_last()?;
        own.iter().copied().eq(self.own_values()).then(|| self.at(*share))
    }

    fn own_values(&self) -> impl Iterator<Item = f64> {
        self.definition.text.parameters.iter().map(|p| p.value)
    }

    /// Where it acts.
    pub fn layer(&self) -> Layer {
        Layer::Force
    }

    /// Takes the next free place; one beyond [`WRITTEN_MAX`] is left out.
    pub fn add_to(&self, terms: &mut EffectTerms) {
        if let Some(free) = terms.force.written.iter_mut().find(|place| place.is_none()) {
            *free = Some(*self);
        }
    }

    /// Force (N) and moment (N m) about the reference point, Body, at the values of [`VARIABLES`]; bounded, and nothing where a formula gives no number.
    pub(crate) fn wrench<T: Real>(&self, variables: &[T; VARIABLES.len()], mass_kg: f64) -> [T; 6] {
        let (bound, nothing) = (T::lit(BOUND_M_S2 * mass_kg), T::lit(0.0));
        core::array::from_fn(|axis| {
            let program = &self.definition.programs[axis];
            if program.is_empty() {
                return nothing;
            }
            let written = program.at(variables) * T::lit(self.share);
            // A square is at least 0 unless it is no number.
            T::select_ge0(written.sqr(), written, nothing).min(bound).max(-bound)
        })
    }
}

impl Definition {
    fn of(text: &WrittenText) -> Result<Self, String> {
        let plain = |name: &str| {
            name.starts_with(|c: char| c.is_ascii_lowercase())
                && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
        };
        if !plain(&text.id) || crate::effects::Effect::IDS.contains(&text.id.as_str()) {
            return Err("an id is snake_case and none of the catalogue".into());
        }
        let mut names: Vec<Name> =
            VARIABLES.iter().map(|(name, dimension)| Name { name: (*name).into(), dimension: *dimension, value: None }).collect();
        for p in &text.parameters {
            let [low, high] = p.range;
            if !plain(&p.name) || p.name == SHARE.name || names.iter().any(|n| n.name == p.name) {
                return Err(format!("the parameter `{}` is not snake_case, is a variable or the share, or stands twice", p.name));
            }
            if !(low <= high && (low..=high).contains(&p.value) && low.is_finite() && high.is_finite()) {
                return Err(format!("{} = {} {} is outside {low}…{high}", p.name, p.value, p.unit));
            }
            let dimension = Dimension::parse(&p.unit).map_err(|e| format!("the parameter `{}` {e}", p.name))?;
            names.push(Name { name: p.name.clone(), dimension, value: Some(p.value) });
        }
        let mut programs: [Program; 6] = Default::default();
        for (axis, formula) in text.formulas.iter().enumerate().filter(|(_, f)| !f.trim().is_empty()) {
            let wanted = if axis < 3 { Dimension::FORCE } else { Dimension::MOMENT };
            programs[axis] = Program::parse(formula, &names, wanted).map_err(|e| format!("{}: {e}", AXES[axis]))?;
        }
        if programs.iter().all(Program::is_empty) {
            return Err(format!("it has no formula; give one of {}", AXES.join(", ")));
        }
        let kept = |text: &str| -> &'static str { Box::leak(text.to_string().into_boxed_str()) };
        let own = text.parameters.iter().map(|p| Quantity::new(kept(&p.name), kept(&p.unit), p.range, p.value, Scaling::Held));
        let quantities = own.chain([SHARE]).collect();
        Ok(Self { text: text.clone(), programs, quantities })
    }
}
