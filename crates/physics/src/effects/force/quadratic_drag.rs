//! Drag in proportion to speed squared: water, air.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Quadratic drag (catalogue no. 6): F = -c_2 |v| v at the reference point, c_2 = ρ C_d A / 2. Alone it stops a mass M by v = v_0 / (1 + c_2 v_0 t / M).
    struct QuadraticDrag = "quadratic_drag" in Force {
        /// c_2, N s²/m².
        n_s2_m2: ("N s²/m²", [-60.0, 500.0], 60.0, Size),
    }
    |effect, terms| terms.force.quadratic_drag_n_s2_m2 += effect.n_s2_m2
}
