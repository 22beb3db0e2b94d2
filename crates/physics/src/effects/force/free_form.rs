//! A wrench without a cause: what drives show beyond every effect that could be named.

use crate::effects::{Act, EffectTerms, Layer, Quantity, Scaling};
use crate::scalar::Real;
use crate::vec3::Vec3;

/// Axes of the wrench: three forces, three moments about the reference point, Body.
pub const FREE_FORM_AXES: usize = 6;
/// Features of each axis: constant, speed, steering, slope.
pub const FREE_FORM_FEATURES: usize = 4;

/// Free-form wrench on the body, linear in speed, steering and slope:
///
/// w_a = k_a0 + k_a1 (v - v_m) + k_a2 δ + k_a3 s_a, with v the forward speed held in [`speed_low_m_s`, `speed_high_m_s`] and v_m the middle of that range, δ the mean
/// road-wheel angle of the front wheels held in ±`angle_max_rad`, s_a the mean slope of the ground under the wheels held in ±`slope_max`: ahead for F_x, F_z
/// and M_y, to the left for F_y, M_x and M_z. Outside of what was driven it stays what it was at the edge, so it is bounded everywhere.
///
/// It is no effect of the catalogue: no diagnosis takes it for a hypothesis, and its numbers have no meaning beyond the drives that they were fitted on.
/// A vehicle without road-wheel angles has δ = 0.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FreeForm {
    /// Coefficients k by axis: F_x, F_y, F_z (N), M_x, M_y, M_z (N m); constant, per m/s, per rad, per unit of slope.
    pub wrench: [[f64; FREE_FORM_FEATURES]; FREE_FORM_AXES],
    /// Least speed of the valid region, m/s.
    pub speed_low_m_s: f64,
    /// Largest speed of the valid region, m/s.
    pub speed_high_m_s: f64,
    /// Largest road-wheel angle of the valid region, rad.
    pub angle_max_rad: f64,
    /// Largest slope of the valid region, -.
    pub slope_max: f64,
}

const fn even(name: &'static str, unit: &'static str, bound: f64, typical: f64) -> Quantity {
    Quantity::new(name, unit, [-bound, bound], typical, Scaling::Size)
}

const fn odd(name: &'static str, unit: &'static str, bound: f64, typical: f64) -> Quantity {
    even(name, unit, bound, typical).odd()
}

const fn edge(name: &'static str, unit: &'static str, range: [f64; 2], typical: f64) -> Quantity {
    Quantity::new(name, unit, range, typical, Scaling::Held)
}

const SIZES: usize = FREE_FORM_AXES * FREE_FORM_FEATURES;

impl Act for FreeForm {
    const ID: &'static str = "free_form";
    const LAYER: Layer = Layer::Force;
    const QUANTITIES: &'static [Quantity] = &[
        even("fx_n", "N", 4000.0, -150.0),
        even("fx_speed", "N s/m", 2000.0, -50.0),
        odd("fx_angle", "N/rad", 15000.0, 100.0),
        even("fx_slope", "N", 30000.0, -500.0),
        odd("fy_n", "N", 4000.0, 100.0),
        odd("fy_speed", "N s/m", 2000.0, 50.0),
        even("fy_angle", "N/rad", 15000.0, 300.0),
        even("fy_slope", "N", 30000.0, 500.0),
        even("fz_n", "N", 8000.0, -200.0),
        even("fz_speed", "N s/m", 2000.0, 50.0),
        odd("fz_angle", "N/rad", 15000.0, 100.0),
        even("fz_slope", "N", 30000.0, 500.0),
        odd("mx_nm", "N m", 8000.0, 100.0),
        odd("mx_speed", "N m s/m", 3000.0, 50.0),
        even("mx_angle", "N m/rad", 20000.0, 300.0),
        even("mx_slope", "N m", 40000.0, 500.0),
        even("my_nm", "N m", 8000.0, 150.0),
        even("my_speed", "N m s/m", 3000.0, 50.0),
        odd("my_angle", "N m/rad", 20000.0, 300.0),
        even("my_slope", "N m", 40000.0, 500.0),
        odd("mz_nm", "N m", 8000.0, 100.0),
        odd("mz_speed", "N m s/m", 3000.0, 50.0),
        even("mz_angle", "N m/rad", 20000.0, 300.0),
        even("mz_slope", "N m", 40000.0, 500.0),
        edge("speed_low_m_s", "m/s", [-10.0, 30.0], 0.5),
        edge("speed_high_m_s", "m/s", [-10.0, 30.0], 5.0),
        edge("angle_max_rad", "rad", [0.0, 1.0], 0.5),
        edge("slope_max", "-", [0.0, 1.0], 0.3),
    ];

    fn values(&self) -> Vec<f64> {
        let region = [self.speed_low_m_s, self.speed_high_m_s, self.angle_max_rad, self.slope_max];
        self.wrench.as_flattened().iter().copied().chain(region).collect()
    }

    fn from_values(values: &[f64]) -> Option<Self> {
        let (sizes, region) = values.split_at_checked(SIZES)?;
        let &[speed_low_m_s, speed_high_m_s, angle_max_rad, slope_max] = region else { return None };
        let wrench = core::array::from_fn(|a| core::array::from_fn(|f| sizes[a * FREE_FORM_FEATURES + f]));
        Some(Self { wrench, speed_low_m_s, speed_high_m_s, angle_max_rad, slope_max })
    }

    /// A second one of the same region adds its coefficients; one of another region acts beside it, up to [`PLACES_MAX`](crate::effects::PLACES_MAX).
    fn add_to(&self, terms: &mut EffectTerms) {
        let forms = &mut terms.force.free_form;
        let region = |form: &Self| Self { wrench: Default::default(), ..*form };
        let same = forms.iter().position(|form| form.acts() && region(form) == region(self));
        let Some(sum) = same.or(forms.iter().position(|form| !form.acts())).map(|i| &mut forms[i]) else { return };
        let wrench = core::array::from_fn(|a| core::array::from_fn(|f| sum.wrench[a][f] + self.wrench[a][f]));
        *sum = Self { wrench, ..*self };
    }
}

impl FreeForm {
    /// Whether it does anything.
    pub fn acts(&self) -> bool {
        self.wrench != [[0.0; FREE_FORM_FEATURES]; FREE_FORM_AXES]
    }

    /// Force (N) and moment (N m) at a forward speed, a road-wheel angle and slopes of the ground ahead and to the left.
    #[inline(always)]
    pub fn at<T: Real>(&self, speed_m_s: T, angle_rad: T, slope_ahead: T, slope_left: T) -> [Vec3<T>; 2] {
        let held = |x: T, low: f64, high: f64| x.max(T::lit(low)).min(T::lit(high));
        let middle = 0.5 * (self.speed_low_m_s + self.speed_high_m_s);
        let speed = held(speed_m_s, self.speed_low_m_s, self.speed_high_m_s) - T::lit(middle);
        let angle = held(angle_rad, -self.angle_max_rad, self.angle_max_rad);
        let [ahead, left] = [slope_ahead, slope_left].map(|s| held(s, -self.slope_max, self.slope_max));
        let of = |axis: usize| {
            let [constant, per_speed, per_angle, per_slope] = self.wrench[axis].map(T::lit);
            let slope = if matches!(axis, 0 | 2 | 4) { ahead } else { left };
            constant + per_speed * speed + per_angle * angle + per_slope * slope
        };
        [[of(0), of(1), of(2)], [of(3), of(4), of(5)]]
    }
}
