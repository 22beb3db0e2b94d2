//! Soil heaped up ahead of the front wheels.

use crate::effects::Scaling::{Held, Size};
use crate::effects::act::effect;

effect! {
    /// Front bulldozing (catalogue no. 27): the share a of the resistance of [`crate::terramechanics::front_bulldozing`] (Bekker 1969) on each front wheel, against its
    /// motion. The rear wheels roll in ruts; backwards the axles change places.
    struct FrontBulldozing = "front_bulldozing" in Soil {
        /// a, -.
        share: ("-", [0.0, 2.0], 0.5, Size),
        /// Unit weight of the soil, N/m³.
        unit_weight_n_m3: ("N/m³", [5e3, 25e3], 16e3, Held),
    }
    |effect, terms| super::add_bulldozing(&mut terms.soil.front_bulldozing, effect.share, effect.unit_weight_n_m3)
}
