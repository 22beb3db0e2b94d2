//! A map that is tilted against the world.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Map tilt (catalogue no. 31): the ground is at m(x, y) - x tan β_p + y tan β_r with x and y from the middle of the map, about which it is turned by a pitch
    /// (positive: falls to the east) and a roll (positive: rises to the north) in the sense of the attitude angles. What the encoders see of the map stays.
    struct MapTilt = "map_tilt" in Map {
        /// β_p, rad.
        pitch_rad: ("rad", [-0.2, 0.2], 0.015, Size),
        /// β_r, rad.
        roll_rad: ("rad", [-0.2, 0.2], 0.01, Size).odd(),
    }
    |effect, terms| {
        terms.map.tilt_rad[0] += effect.pitch_rad;
        terms.map.tilt_rad[1] += effect.roll_rad
    }
}
