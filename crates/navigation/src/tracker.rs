//! What a predicted trajectory costs a vehicle that is to follow a path.

use serde::Serialize;

use crate::caution::Caution;
use crate::reference_path::{ReferencePath, unwrapped};

/// Weights of the tracking cost: the mean over the horizon of d^2 + `lag` l^2 + `tilt` (roll^2 + pitch^2), d the distance from the path and l what the
/// vehicle is short of the progress at the wanted speed (both m), angles in rad. Caution moves the path inside and wants less speed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TrackingCost {
    /// Wanted speed, m/s.
    pub speed_m_s: f64,
    /// Weight of the missing progress.
    pub lag: f64,
    /// Weight of roll and pitch.
    pub tilt: f64,
}

/// Cost of a trajectory that is not finite.
const INVALID_COST: f64 = 1e6;

impl TrackingCost {
    /// Cost of the poses (x, y, roll, pitch) at steps of `dt_s` after a place that has come as far as `from_phi`.
    pub fn of(&self, path: &ReferencePath, caution: &Caution, from_phi: f64, poses: &[[f64; 4]], dt_s: f64) -> f64 {
        let start_m = path.arc_m(from_phi);
        let step = |(k, [x, y, roll, pitch]): (usize, &[f64; 4])| {
            let at = path.offset(*x, *y);
            let arc_m = path.arc_m(unwrapped(at.phi, from_phi));
            let wanted = start_m + caution.speed_m_s(arc_m, self.speed_m_s) * dt_s * (k + 1) as f64;
            let (lag, outside_m) = (wanted - arc_m, at.outside_m + caution.inside_m(arc_m));
            outside_m * outside_m + self.lag * lag * lag + self.tilt * (roll * roll + pitch * pitch)
        };
        let cost = poses.iter().enumerate().map(step).sum::<f64>() / poses.len().max(1) as f64;
        if cost.is_finite() { cost.min(INVALID_COST) } else { INVALID_COST }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn property_following_is_cheaper_than_lagging_or_leaving() {
        let (path, cost) = (ReferencePath::of_ood_soil(), TrackingCost { speed_m_s: 3.0, lag: 0.2, tilt: 4.0 });
        let along = |speed: f64, off: f64| -> Vec<[f64; 4]> {
            (1..=30)
                .map(|k| {
                    let phi = path.phi_at(path.arc_m(1.0) + speed * 0.1 * f64::from(k));
                    let ([x, y], h) = (path.point(phi), path.heading(phi));
                    [x + off * h.sin(), y - off * h.cos(), 0.0, 0.0]
                })
                .collect()
        };
        let none = Caution::new(None);
        let of = |speed, off| cost.of(&path, &none, 1.0, &along(speed, off), 0.1);
        assert!(of(3.0, 0.0) < 1e-4 && of(2.0, 0.0) > 0.1 && of(3.0, 1.0) > 0.9);
        let broken = vec![[f64::NAN, 0.0, 0.0, 0.0]; 30];
        assert_eq!(cost.of(&path, &none, 1.0, &broken, 0.1), INVALID_COST);
    }
}
