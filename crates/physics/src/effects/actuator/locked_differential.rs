//! Wheels of an axle that cannot turn at different speeds.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Locked differential (catalogue no. 21): Ω_left = Ω_right on each axle of a speed-controlled car. The rims follow the ground under the middle
    /// of the axle in place of that under the wheel, so a turn is resisted: the inner wheel is driven, the outer one braked. Between rims that torque drives
    /// it is a coupling, of all four, that grows from nothing to one which is stiff against every soil (`torque_drive.rs`).
    ///
    /// Neglects that a lock passes torque without limit when one wheel stands on ice.
    struct LockedDifferential = "locked_differential" in Actuator {
        /// Share of the difference of speeds that the lock takes away: 0 = open, 1 = locked.
        share: ("-", [0.0, 1.0], 1.0, Size).complete(),
    }
    |effect, terms| terms.actuator.lock += effect.share
}
