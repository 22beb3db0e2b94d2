//! Wheels of the front axle with another radius than the card's.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Tyre radius of the front axle (catalogue no. 19): r ← (1 + k) r in contact geometry, ride height, and rim speed of a servoed or measured rim.
    ///
    /// A drive that tracks the speed of the vehicle makes up for the rim speed; then height and contact are what is left.
    struct TyreRadiusFront = "tyre_radius_front" in Force {
        /// k, -.
        relative: ("-", [-0.3, 0.3], 0.05, Size),
    }
    |effect, terms| terms.force.radius_relative[0] += effect.relative
}
