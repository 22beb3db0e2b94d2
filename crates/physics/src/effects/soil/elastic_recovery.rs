//! Soil that springs back behind the wheel.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Elastic recovery (catalogue no. 24): the contact ends at θ_2 = -acos(1 - λ z / r) behind the lowest point of the wheel.
    struct ElasticRecovery = "elastic_recovery" in Soil {
        /// λ, -.
        lambda: ("-", [0.0, 1.0], 0.1, Size),
    }
    |effect, terms| terms.soil.recovery += effect.lambda
}
