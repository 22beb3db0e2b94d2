//! A force fixed in World.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Wind (catalogue no. 8): a constant force (W_x, W_y) in World at the reference point. Turning round turns its effect round, which tells it from a tow.
    ///
    /// Neglects that it depends on the vehicle's own speed (2 % for 3 m/s in a storm) and on its heading, and its moment.
    struct Wind = "wind" in Force {
        /// W_x to the east, N.
        fx_n: ("N", [-3000.0, 3000.0], 500.0, Size),
        /// W_y to the north, N.
        fy_n: ("N", [-3000.0, 3000.0], 300.0, Size).odd(),
    }
    |effect, terms| {
        terms.force.wind_n[0] += effect.fx_n;
        terms.force.wind_n[1] += effect.fy_n
    }
}
