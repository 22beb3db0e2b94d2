//! The closed path to follow.

use std::f64::consts::TAU;

/// Points of the arc-length table in one turn.
const TABLE: usize = 4096;

/// r(phi) = mean + wave cos(lobes phi) about the origin of World, driven counter-clockwise.
#[derive(Clone, Debug, PartialEq)]
pub struct ReferencePath {
    mean_m: f64,
    wave_m: f64,
    lobes: f64,
    /// Arc length from phi = 0 to i / TABLE of a turn, m.
    arc_m: Vec<f64>,
}

/// A place relative to the path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Offset {
    /// Angle of the place about the origin, (-pi, pi].
    pub phi: f64,
    /// Distance from the path, outside positive, m: the radial distance times the cosine of the path's slope, exact on the path and within 2 % at 5 m.
    pub outside_m: f64,
}

impl ReferencePath {
    /// The path of `ood_soil` (DATA.md): r(phi) = 21 + 2.5 cos(3 phi) m.
    pub fn of_ood_soil() -> Self {
        Self::new(21.0, 2.5, 3.0)
    }

    fn new(mean_m: f64, wave_m: f64, lobes: f64) -> Self {
        let mut path = Self { mean_m, wave_m, lobes, arc_m: Vec::with_capacity(TABLE + 1) };
        let mut arc = 0.0;
        path.arc_m.push(arc);
        for i in 0..TABLE {
            let middle = (i as f64 + 0.5) * TAU / TABLE as f64;
            arc += path.radius_m(middle).hypot(path.radius_slope_m(middle)) * TAU / TABLE as f64;
            path.arc_m.push(arc);
        }
        path
    }

    fn radius_m(&self, phi: f64) -> f64 {
        self.mean_m + self.wave_m * (self.lobes * phi).cos()
    }

    fn radius_slope_m(&self, phi: f64) -> f64 {
        -self.wave_m * self.lobes * (self.lobes * phi).sin()
    }

    /// Length of a lap, m.
    pub fn length_m(&self) -> f64 {
        self.arc_m[TABLE]
    }

    /// Arc length from phi = 0; grows by the length of a lap with every turn, m.
    pub fn arc_m(&self, phi: f64) -> f64 {
        let turns = (phi / TAU).floor();
        let at = (phi / TAU - turns) * TABLE as f64;
        let low = (at as usize).min(TABLE - 1);
        turns * self.length_m() + self.arc_m[low] + (at - low as f64) * (self.arc_m[low + 1] - self.arc_m[low])
    }

    /// Angle at an arc length (inverse of [`ReferencePath::arc_m`]).
    pub fn phi_at(&self, arc_m: f64) -> f64 {
        let turns = (arc_m / self.length_m()).floor();
        let rest = arc_m - turns * self.length_m();
        let above = self.arc_m.partition_point(|a| *a < rest).clamp(1, TABLE);
        let share = (rest - self.arc_m[above - 1]) / (self.arc_m[above] - self.arc_m[above - 1]);
        (turns + ((above - 1) as f64 + share) / TABLE as f64) * TAU
    }

    /// World x, y of the path at an angle, m.
    pub fn point(&self, phi: f64) -> [f64; 2] {
        let r = self.radius_m(phi);
        [r * phi.cos(), r * phi.sin()]
    }

    /// Direction of travel at an angle, rad.
    pub fn heading(&self, phi: f64) -> f64 {
        let (r, slope) = (self.radius_m(phi), self.radius_slope_m(phi));
        let (sin, cos) = phi.sin_cos();
        (slope * sin + r * cos).atan2(slope * cos - r * sin)
    }

    /// Where a place is relative to the path.
    pub fn offset(&self, x_m: f64, y_m: f64) -> Offset {
        let phi = y_m.atan2(x_m);
        let (r, slope) = (self.radius_m(phi), self.radius_slope_m(phi));
        Offset { phi, outside_m: (x_m.hypot(y_m) - r) * r / r.hypot(slope) }
    }

    /// The path from one angle to a later one as points about `step_m` apart, both ends included.
    pub fn points_between(&self, from_phi: f64, to_phi: f64, step_m: f64) -> Vec<[f64; 2]> {
        let (from, to) = (self.arc_m(from_phi), self.arc_m(to_phi));
        let count = ((to - from) / step_m).ceil().max(1.0) as usize;
        (0..=count).map(|i| self.point(self.phi_at(from + (to - from) * i as f64 / count as f64))).collect()
    }
}

/// `phi` plus whole turns such that it lies within half a turn of `near`.
pub(crate) fn unwrapped(phi: f64, near: f64) -> f64 {
    phi + TAU * ((near - phi) / TAU).round()
}

/// Distance from a point to a polyline, m.
pub(crate) fn distance_to_line(point: [f64; 2], line: &[[f64; 2]]) -> f64 {
    let to_segment = |a: [f64; 2], b: [f64; 2]| {
        let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
        let (px, py) = (point[0] - a[0], point[1] - a[1]);
        let squared = dx * dx + dy * dy;
        let t = if squared > 0.0 { ((px * dx + py * dy) / squared).clamp(0.0, 1.0) } else { 0.0 };
        (px - t * dx).hypot(py - t * dy)
    };
    match line {
        [] => f64::INFINITY,
        [only] => to_segment(*only, *only),
        _ => line.windows(2).map(|w| to_segment(w[0], w[1])).fold(f64::INFINITY, f64::min),
    }
}

/// Hausdorff distance of two polylines (largest distance from a vertex of one to the other), m.
pub(crate) fn hausdorff_m(a: &[[f64; 2]], b: &[[f64; 2]]) -> f64 {
    let one_way = |from: &[[f64; 2]], to: &[[f64; 2]]| from.iter().map(|p| distance_to_line(*p, to)).fold(0.0, f64::max);
    one_way(a, b).max(one_way(b, a))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_circle_and_inverse_of_the_arc_length() {
        let circle = ReferencePath::new(10.0, 0.0, 3.0);
        assert!((circle.length_m() - TAU * 10.0).abs() < 1e-6);
        let path = ReferencePath::of_ood_soil();
        for phi in [-4.0, -0.1, 0.0, 1.0, 3.0, 7.0, 14.0] {
            assert!((path.phi_at(path.arc_m(phi)) - phi).abs() < 1e-5, "{phi}");
        }
        let h = 1e-5;
        for phi in [0.3, 1.4, 2.9] {
            let (a, b) = (path.point(phi), path.point(phi + h));
            assert!((path.heading(phi) - (b[1] - a[1]).atan2(b[0] - a[0])).abs() < 1e-4);
        }
    }

    /// The closed form of the distance against the polyline, up to 5 m off the path.
    #[test]
    fn property_offset_agrees_with_the_distance_to_the_path() {
        let path = ReferencePath::of_ood_soil();
        let line = path.points_between(0.0, TAU, 0.02);
        for i in 0..60 {
            let phi = f64::from(i) * 0.1;
            for off in [-2.0, -0.5, 0.3, 1.0] {
                let heading = path.heading(phi);
                let [x, y] = path.point(phi);
                let (x, y) = (x + off * heading.sin(), y - off * heading.cos());
                let (closed, exact) = (path.offset(x, y).outside_m, distance_to_line([x, y], &line));
                assert!(
                    (closed.abs() - exact).abs() < 0.02 + 0.06 * off.abs() && closed.signum() == off.signum(),
                    "{phi} {off}: {closed} {exact}"
                );
            }
        }
    }

    #[test]
    fn analytic_hausdorff_of_parallel_lines() {
        let line = |y: f64, end: f64| vec![[0.0, y], [end, y]];
        assert!((hausdorff_m(&line(0.0, 4.0), &line(1.5, 4.0)) - 1.5).abs() < 1e-12);
        assert!((hausdorff_m(&line(0.0, 4.0), &line(0.0, 7.0)) - 3.0).abs() < 1e-12);
        assert_eq!(unwrapped(-3.0, 3.5), TAU - 3.0);
    }
}
