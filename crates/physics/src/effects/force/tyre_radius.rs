//! Wheels of both axles with another radius than the card's.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Tyre radius of all wheels (catalogue nos. 19 and 20 together): r ← (1 + k) r in contact geometry, ride height, and rim speed of a servoed or measured rim.
    ///
    /// Other tyres, or another pressure in all of them. On each axle alone it is [`TyreRadiusFront`](super::TyreRadiusFront) or
    /// [`TyreRadiusRear`](super::TyreRadiusRear).
    struct TyreRadius = "tyre_radius" in Force {
        /// k, -.
        relative: ("-", [-0.3, 0.3], 0.05, Size),
    }
    |effect, terms| terms.force.radius_relative.iter_mut().for_each(|axle| *axle += effect.relative)
}
