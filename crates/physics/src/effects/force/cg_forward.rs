//! A centre of mass that lies elsewhere than the card says: shifted forward.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Centre of mass shifted forward (catalogue no. 2): c ← c + d e_x in Newton-Euler about the reference point, which stays where it is measured.
    ///
    /// The springs keep their preload, so the axle (or side) that carries more sags; the inertia about the centre of mass stays.
    struct CgForward = "cg_forward" in Force {
        /// d, m.
        metres: ("m", [-1.0, 1.0], 0.15, Size),
    }
    |effect, terms| terms.force.centre_shift_m[0] += effect.metres
}
