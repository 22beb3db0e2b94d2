//! Soil that is firmer where a wheel has passed.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Multi-pass hardening (catalogue no. 23): k_c, k_φ ← (1 + h) k_c, k_φ under the rear wheels, which roll in the ruts of the front wheels;
    /// backwards it is the front wheels that roll in the ruts of the rear ones.
    ///
    /// Neglects that they leave the ruts in a tight turn, and older ruts: the vehicle's own track is not remembered.
    struct MultiPass = "multi_pass" in Soil {
        /// h, -.
        relative: ("-", [-0.8, 5.0], 0.5, Size),
    }
    |effect, terms| terms.soil.hardening += effect.relative
}
