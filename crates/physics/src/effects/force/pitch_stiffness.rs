//! Springs that resist pitch more or less than the card's.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Pitch stiffness (catalogue no. 29): a relative change κ of the suspension rate in pitch alone, ΔF_i = κ k_i (d_i - d̄) with the compressions d of
    /// front and rear axle and their mean. Compression is read against the undeformed ground: neglects differences of sinkage.
    struct PitchStiffness = "pitch_stiffness" in Force {
        /// κ, -.
        relative: ("-", [-0.6, 1.5], 0.3, Size),
    }
    |effect, terms| terms.force.roll_pitch_stiffness[1] += effect.relative
}
