//! Wheels with grousers.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Grousers (catalogue no. 26): shear strength c (1 + 2 h / b) + σ tan φ (1 + 0.64 (h / b) atan(b / h)) for grousers of height h on a wheel of width b
    /// (Bekker 1969). Neglects the longer arm of the grouser tips.
    struct Grousers = "grousers" in Soil {
        /// h, m.
        metres: ("m", [0.0, 0.2], 0.03, Size),
    }
    |effect, terms| terms.soil.grouser_height_m += effect.metres
}
