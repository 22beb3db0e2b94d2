//! A firm crust on weaker soil, or a soft layer on firm ground.

use crate::effects::Scaling::{Factor, Held};
use crate::effects::act::effect;

effect! {
    /// Crust (catalogue no. 42): below the depth z_h the moduli are f times those above, p(z) = k (z_h^n + f (z^n - z_h^n)) for z > z_h. The wheel meets it as the
    /// mean modulus down to its sinkage, k (f + (1 - f) (z_h / z)^n), from one repetition of the load balance. Crusts
    /// of different depths lie within each other.
    struct SoilCrust = "soil_crust" in Soil {
        /// f, -.
        factor: ("-", [0.05, 20.0], 0.5, Factor),
        /// z_h, m.
        depth_m: ("m", [0.0, 0.3], 0.03, Held),
    }
    |effect, terms| crate::effects::add_at_place(&mut terms.soil.crust, [effect.factor.ln(), effect.depth_m])
}
