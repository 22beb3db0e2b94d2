//! A centre of mass that lies elsewhere than the card says: shifted up.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Centre of mass shifted up (catalogue no. 4): c ← c + d e_z in Newton-Euler about the reference point, which stays where it is measured.
    ///
    /// The springs keep their preload, so the axle (or side) that carries more sags; the inertia about the centre of mass stays.
    struct CgHeight = "cg_height" in Force {
        /// d, m.
        metres: ("m", [-1.0, 1.5], 0.3, Size),
    }
    |effect, terms| terms.force.centre_shift_m[2] += effect.metres
}
