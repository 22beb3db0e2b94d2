//! A map at another height than the positions.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Map offset (catalogue no. 32): the ground is at m(x, y) + z_0.
    struct MapOffset = "map_offset" in Map {
        /// z_0, m.
        z_m: ("m", [-1.0, 1.0], 0.05, Size),
    }
    |effect, terms| terms.map.offset_m += effect.z_m
}
