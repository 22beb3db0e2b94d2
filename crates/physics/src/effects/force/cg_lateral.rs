//! A centre of mass that lies elsewhere than the card says: shifted to the left.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Centre of mass shifted to the left (catalogue no. 3): c ← c + d e_y in Newton-Euler about the reference point, which stays where it is measured.
    ///
    /// The springs keep their preload, so the axle (or side) that carries more sags; the inertia about the centre of mass stays.
    struct CgLateral = "cg_lateral" in Force {
        /// d, m.
        metres: ("m", [-0.6, 0.6], 0.1, Size).odd(),
    }
    |effect, terms| terms.force.centre_shift_m[1] += effect.metres
}
