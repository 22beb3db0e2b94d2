//! Soil that the side walls of the wheels push aside.

use crate::effects::Scaling::{Held, Size};
use crate::effects::act::effect;

effect! {
    /// Side bulldozing (catalogue no. 28): the share a of the side force of [`crate::terramechanics::side_bulldozing`] (Hegedüs; Ishigami et al. 2007) on each wheel.
    struct SideBulldozing = "side_bulldozing" in Soil {
        /// a, -.
        share: ("-", [0.0, 2.0], 1.0, Size),
        /// Unit weight of the soil, N/m³.
        unit_weight_n_m3: ("N/m³", [5e3, 25e3], 16e3, Held),
    }
    |effect, terms| super::add_bulldozing(&mut terms.soil.side_bulldozing, effect.share, effect.unit_weight_n_m3)
}
