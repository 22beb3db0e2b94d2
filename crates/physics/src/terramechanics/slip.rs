//! Slip: from wheel and ground speeds to the ratios that the shear displacement needs.

use crate::scalar::Real;

/// Speed below which slip ratios are regularised, m/s (chosen: creep of a parked vehicle).
pub(crate) const SLIP_SPEED_FLOOR_M_S: f64 = 0.05;

/// Motion of the wheel centre against the ground in the wheel's contact frame.
#[derive(Clone, Copy, Debug)]
pub struct WheelMotion<T> {
    /// Rim speed r Ω, m/s, positive = rolling forward.
    pub rim_speed_m_s: T,
    /// Speed of the wheel centre along the heading of the wheel, in the tangent plane, m/s.
    pub forward_m_s: T,
    /// Speed of the wheel centre to the left, m/s.
    pub left_m_s: T,
}

/// Motion in the rolling direction as ratios to the rim speed: what the shear displacement integrates.
#[derive(Clone, Copy, Debug)]
pub struct ContactMotion<T> {
    /// v_x / (rΩ) in the rolling direction: 1 - s when driving, 1 / (1 + s) when braking.
    pub travel_ratio: T,
    /// Rim share: rΩ / |rΩ|_ε; 1 for a rolling wheel, 0 for a locked one, so that a locked wheel shears backwards only.
    pub rim_ratio: T,
    /// v_y / (rΩ).
    pub lateral_ratio: T,
    /// Slip s ∈ [-1, 1]: (rΩ - v_x) / max(rΩ, v_x).
    pub slip: T,
    /// Rim speed rΩ in the rolling direction where the soil is fresh, m/s: what is pressed down at θ ahead of the axle goes down at this times sin θ. Less where a
    /// wheel has passed before.
    pub pressing_m_s: T,
}

impl<T: Real> ContactMotion<T> {
    /// From a slip and a lateral ratio alone (wheel that rolls very slowly), as single-wheel tests state them. `slip > -1`.
    pub fn from_slip(slip: f64, tan_slip_angle: f64) -> Self {
        let travel = if slip >= 0.0 { 1.0 - slip } else { 1.0 / (1.0 + slip) };
        Self {
            travel_ratio: T::lit(travel),
            rim_ratio: T::lit(1.0),
            lateral_ratio: T::lit(travel * tan_slip_angle),
            slip: T::lit(slip),
            pressing_m_s: T::lit(0.0),
        }
    }
}

impl<T> ContactMotion<T> {
    /// Each number of it under a function.
    #[inline(always)]
    pub fn map<U>(self, of: impl Fn(T) -> U) -> ContactMotion<U> {
        let Self { travel_ratio, rim_ratio, lateral_ratio, slip, pressing_m_s } = self;
        ContactMotion {
            travel_ratio: of(travel_ratio),
            rim_ratio: of(rim_ratio),
            lateral_ratio: of(lateral_ratio),
            slip: of(slip),
            pressing_m_s: of(pressing_m_s),
        }
    }
}

impl<T: Real> WheelMotion<T> {
    /// Rolling direction in (-1, 1), smooth through standstill, and the ratios seen along it.
    ///
    /// Speeds are measured along the direction of rΩ + v_x, so driving, braking, locked, towed and reversed wheels share one formula.
    #[inline(always)]
    pub fn contact(&self) -> (T, ContactMotion<T>) {
        let sum = self.rim_speed_m_s + self.forward_m_s;
        let direction = sum / sum.abs_smooth(SLIP_SPEED_FLOOR_M_S);
        let rim = direction * self.rim_speed_m_s;
        let travel = direction * self.forward_m_s;
        let scale = T::lit(1.0) / rim.abs_smooth(SLIP_SPEED_FLOOR_M_S);
        let slip = (rim - travel) / rim.max(travel).abs_smooth(SLIP_SPEED_FLOOR_M_S);
        let motion = ContactMotion {
            travel_ratio: travel * scale,
            rim_ratio: rim * scale,
            lateral_ratio: self.left_m_s * scale,
            slip: slip.max(T::lit(-1.0)).min(T::lit(1.0)),
            pressing_m_s: rim,
        };
        (direction, motion)
    }
}

/// Speed around which the direction of travel turns, m/s: half that of [`SLIP_SPEED_FLOOR_M_S`], which counts rim and ground.
pub(crate) const TRAVEL_SPEED_FLOOR_M_S: f64 = 0.5 * SLIP_SPEED_FLOOR_M_S;

/// Direction in which a wheel travels over its ground, in (-1, 1), smooth through standstill: motion resistance points against it. Chosen, as Wong and Reece give the
/// resistance of a wheel that travels; neglects what one that spins on the spot digs.
#[inline(always)]
pub(crate) fn travel_direction<T: Real>(forward_m_s: T) -> T {
    forward_m_s / forward_m_s.abs_smooth(TRAVEL_SPEED_FLOOR_M_S)
}
