//! A limit of the tangential force of a wheel in proportion to its load.

use crate::effects::Scaling::Limit;
use crate::effects::act::effect;

effect! {
    /// Friction cap (catalogue no. 41): |F_t| ≤ μ F_z at each wheel, for instance wet leaves on firm soil, where the soil itself is not what gives way.
    /// Forces below the cap are untouched, those beyond it keep their direction.
    struct FrictionCap = "friction_cap" in Force {
        /// μ, -.
        mu: ("-", [0.05, 3.0], 0.25, Limit),
    }
    |effect, terms| terms.force.friction_cap_inverse = terms.force.friction_cap_inverse.max(1.0 / effect.mu)
}
