//! Resistance that grows with the wheel load.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Rolling resistance (catalogue no. 9): F_i = -C_r F_z,i v_i / √(v_i² + (0.07 m/s)²) along the heading of each wheel, at the contact, beside the compaction
    /// resistance of the soil. Neglects its growth with speed.
    struct RollingResistance = "rolling_resistance" in Force {
        /// C_r, -.
        coefficient: ("-", [-0.1, 0.3], 0.03, Size),
    }
    |effect, terms| terms.force.rolling_resistance += effect.coefficient
}
