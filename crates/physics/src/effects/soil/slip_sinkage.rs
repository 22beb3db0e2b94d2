//! Wheels that dig themselves in when they slip.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Slip sinkage (catalogue no. 22): z = z_0 (1 + S |s|) with the sinkage z_0 that balances the load (Reece 1964; measured sinkage at s = 0.6 is three to
    /// seven times the static one, Ding 2010). Stresses follow from the deeper contact at the load that is carried.
    struct SlipSinkage = "slip_sinkage" in Soil {
        /// S, -.
        per_slip: ("-", [-0.9, 10.0], 1.0, Size),
    }
    |effect, terms| terms.soil.slip_sinkage += effect.per_slip
}
