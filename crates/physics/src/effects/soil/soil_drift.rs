//! Soil that changes with time: rain, drying.

use crate::effects::Scaling::{Factor, Held};
use crate::effects::act::effect;

effect! {
    /// Soil drift (catalogue no. 33): k_φ, k_c, c and φ times f^{(t - t_0) / (t_1 - t_0)} from t_0 to t_1, in s since the start of the log, and f from then on.
    struct SoilDrift = "soil_drift" in Soil {
        /// f at the end, -.
        factor_end: ("-", [0.1, 10.0], 0.6, Factor),
        /// t_0, s.
        begin_s: ("s", [0.0, 1e5], 0.0, Held),
        /// t_1, s.
        end_s: ("s", [0.1, 1e5], 25.0, Held),
    }
    |effect, terms| crate::effects::add_at_place(&mut terms.soil.drift, [effect.factor_end.ln(), effect.begin_s, effect.end_s])
}
