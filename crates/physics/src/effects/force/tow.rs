//! A constant pull backwards: something is towed.

use crate::effects::Scaling::{Held, Size};
use crate::effects::act::effect;

effect! {
    /// Tow (catalogue no. 7): F = -T along Body x, at a hitch at height z over the reference point, hence a moment -T z about Body y.
    ///
    /// The direction does not change with that of travel, and the towed mass is not accelerated.
    struct Tow = "tow" in Force {
        /// T, N.
        force_n: ("N", [-2000.0, 8000.0], 800.0, Size),
        /// Height of the hitch over the reference point, m.
        z_m: ("m", [-1.0, 1.0], 0.0, Held),
    }
    |effect, terms| {
        terms.force.tow_n += effect.force_n;
        terms.force.tow_moment_n_m -= effect.force_n * effect.z_m
    }
}
