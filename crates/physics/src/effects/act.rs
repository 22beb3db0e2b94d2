//! What every effect of the catalogue says of itself.

use super::{EffectTerms, Layer};

/// How a parameter changes when its effect is scaled by a share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scaling {
    /// value · share: a size, absent at 0.
    Size,
    /// value^share: a factor, absent at 1.
    Factor,
    /// value / share: a limit, absent at infinity.
    Limit,
    /// value: where or how, not how much.
    Held,
}

impl Scaling {
    /// The value of a parameter under a share of its effect.
    pub fn apply(self, value: f64, share: f64) -> f64 {
        match self {
            Self::Size => value * share,
            Self::Factor => value.powf(share),
            Self::Limit => value / share,
            Self::Held => value,
        }
    }

    /// The share under which `unit` becomes `value`: the reverse of [`Scaling::apply`]; 1 for what is held.
    pub fn share(self, unit: f64, value: f64) -> f64 {
        match self {
            Self::Size => value / unit,
            Self::Factor => value.ln() / unit.ln(),
            Self::Limit => unit / value,
            Self::Held => 1.0,
        }
    }
}

/// What a parameter is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quantity {
    /// Name as in `effects.toml` and reports.
    pub name: &'static str,
    /// Unit as in reports.
    pub unit: &'static str,
    /// Physical range; an estimate at its end is not accepted, unless it is `complete` there.
    pub range: [f64; 2],
    /// A size that a good drive shows.
    pub typical: f64,
    /// How it scales.
    pub scaling: Scaling,
    /// Whether a mirror image of the vehicle has it with the other sign.
    pub odd: bool,
    /// Whether the upper end of the range is something that vehicles have, such as a lock that is closed, and no bound of what is believed.
    pub complete: bool,
}

impl Quantity {
    /// A quantity that a mirror image shares.
    pub const fn new(name: &'static str, unit: &'static str, range: [f64; 2], typical: f64, scaling: Scaling) -> Self {
        Self { name, unit, range, typical, scaling, odd: false, complete: false }
    }

    /// The same with left and right exchanged by its sign.
    pub const fn odd(self) -> Self {
        Self { odd: true, ..self }
    }

    /// The same with an upper end that vehicles have.
    pub const fn complete(self) -> Self {
        Self { complete: true, ..self }
    }
}

/// One parameter of an effect with its value.
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

/// An effect: identity, parameters, and what it changes.
pub trait Act: Copy {
    /// Id as in `effects.toml` and reports, snake_case.
    const ID: &'static str;
    /// Layer in which it acts.
    const LAYER: Layer;
    /// What its parameters are.
    const QUANTITIES: &'static [Quantity];

    /// Values of the parameters in the order of [`Act::QUANTITIES`].
    fn values(&self) -> Vec<f64>;
    /// Inverse of [`Act::values`]; `None` for a wrong number of them.
    fn from_values(values: &[f64]) -> Option<Self>;
    /// Adds what it changes to the terms.
    fn add_to(&self, terms: &mut EffectTerms);

    /// At the size of [`Quantity::typical`].
    fn typical() -> Self {
        let values: Vec<f64> = Self::QUANTITIES.iter().map(|q| q.typical).collect();
        Self::from_values(&values).expect("as many values as quantities; this is a bug")
    }
}

/// Declares an effect whose parameters are plain numbers: the struct and its [`Act`].
///
/// `effect! { /// docs struct Name = "id" in Layer { /// docs field: Quantity, … } |self, terms| … }`; a field is named like its quantity.
macro_rules! effect {
    ($(#[$doc:meta])* struct $effect:ident = $id:literal in $layer:ident {
        $($(#[$field_doc:meta])* $field:ident: ($($quantity:tt)*) $(.$sign:ident())?,)*
    } |$this:ident, $terms:ident| $body:expr) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub struct $effect {
            $($(#[$field_doc])* pub $field: f64,)*
        }

        impl $crate::effects::Act for $effect {
            const ID: &'static str = $id;
            const LAYER: $crate::effects::Layer = $crate::effects::Layer::$layer;
            const QUANTITIES: &'static [$crate::effects::Quantity] =
                &[$($crate::effects::Quantity::new(stringify!($field), $($quantity)*)$(.$sign())?),*];

            fn values(&self) -> Vec<f64> {
                vec![$(self.$field),*]
            }

            fn from_values(values: &[f64]) -> Option<Self> {
                match *values {
                    [$($field),*] => Some(Self { $($field),* }),
                    _ => None,
                }
            }

            fn add_to(&self, $terms: &mut $crate::effects::EffectTerms) {
                let $this = self;
                $body;
            }
        }
    };
}
pub(super) use effect;
