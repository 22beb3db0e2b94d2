//! Drag in proportion to speed: wading, tall grass.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Linear drag (catalogue no. 5): F = -c_1 v at the reference point. Alone it stops a mass M by v = v_0 e^{-c_1 t / M}.
    struct LinearDrag = "linear_drag" in Force {
        /// c_1, N s/m.
        n_s_m: ("N s/m", [-200.0, 1500.0], 200.0, Size),
    }
    |effect, terms| terms.force.linear_drag_n_s_m += effect.n_s_m
}
