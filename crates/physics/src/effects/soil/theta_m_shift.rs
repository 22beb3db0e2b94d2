//! Greatest pressure at another place under the wheel.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Shift of the angle of maximum stress (catalogue no. 25): θ_m = (c_1 + Δ + c_2 |s|) θ_1 (Wong & Reece 1967 give c_1 = 0.43 for compact and 0.18 for loose sand).
    struct ThetaMShift = "theta_m_shift" in Soil {
        /// Δ, -.
        c1: ("-", [-0.4, 0.4], -0.1, Size),
    }
    |effect, terms| terms.soil.theta_m_shift += effect.c1
}
