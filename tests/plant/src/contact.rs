//! A rigid wheel on soil nodes.
//!
//! Each node is a vertical column of soil. Under a wheel it is pressed to the wheel's surface; its pressure is the smaller of an elastic one, E times what the
//! depth exceeds the plastic depth, and the Bekker pressure (k_c/b + k_phi) z^n of the depth z, measured along the undeformed normal. Where the
//! latter is reached the plastic depth follows, which is the rut that stays. Shear is (c + sigma tan phi)(1 - exp(-j/K)) against the sliding velocity of
//! the wheel's surface, j being the sliding distance that the node has seen so far, whoever slid.

use crate::ground::{Ground, NODE_M};
use crate::math::{Vec3, add, cross, dot, norm, scale, sub};

/// Elastic stiffness of unloading soil, Pa/m, and damping, Pa s/m: those of the reference simulator.
const ELASTIC_PA_M: f64 = 4e7;
const DAMPING_PA_S_M: f64 = 2e4;

/// Sliding speed below which the shear stress fades to zero, m/s: a parked wheel creeps instead of chattering. Chosen.
const SLIDING_FADE_M_S: f64 = 0.03;

/// What the nodes remember: plastic depth (m), yield pressure (Pa) and sliding distance (m) of each.
#[derive(Clone, Debug)]
pub(crate) struct SoilMemory {
    plastic_m: Vec<f32>,
    yield_pa: Vec<f32>,
    slid_m: Vec<f32>,
}

impl SoilMemory {
    /// Fresh soil. Pages that nobody drives on are never touched.
    pub(crate) fn fresh(ground: &Ground) -> Self {
        let zero = || vec![0.0_f32; ground.nodes()];
        Self { plastic_m: zero(), yield_pa: zero(), slid_m: zero() }
    }
}

/// A wheel in World.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wheel {
    pub(crate) centre: Vec3,
    /// Unit vector to the left.
    pub(crate) axle: Vec3,
    pub(crate) radius_m: f64,
    pub(crate) width_m: f64,
    /// Of the centre.
    pub(crate) velocity: Vec3,
    /// Of the rim, spin included.
    pub(crate) rate: Vec3,
}

/// What the soil does to a wheel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Contact {
    /// World, N.
    pub(crate) force: Vec3,
    /// About the wheel's centre, World, N m.
    pub(crate) moment: Vec3,
    /// How much a faster spin is resisted, N m s: for the implicit step of the spin.
    pub(crate) spin_damping: f64,
    pub(crate) sinkage_max_m: f64,
    pub(crate) sinkage_mean_m: f64,
    pub(crate) nodes: usize,
}

struct Pressed {
    node: usize,
    point: Vec3,
    normal: Vec3,
    depth_m: f64,
    elastic_pa: f64,
}

/// Presses a wheel on the ground for one step.
pub(crate) fn press(ground: &Ground, memory: &mut SoilMemory, wheel: &Wheel, dt_s: f64) -> Contact {
    let (pressed, extent) = pressed_nodes(ground, memory, wheel);
    // Half the perimeter over the area of the rectangle that the pressed nodes span.
    let [length, width] = extent;
    let one_over_b = if pressed.is_empty() { 0.0 } else { (length + width) / (length * width) };
    let mut contact = Contact::default();
    for p in &pressed {
        let soil = ground.soil(p.node);
        let velocity = add(wheel.velocity, cross(wheel.rate, sub(p.point, wheel.centre)));
        let normal_speed = dot(velocity, p.normal);
        let sliding = sub(velocity, scale(p.normal, normal_speed));
        let speed = norm(sliding);
        let mut pressure = p.elastic_pa;
        if pressure > f64::from(memory.yield_pa[p.node]) {
            pressure = pressure.min((one_over_b * soil.k_c + soil.k_phi) * p.depth_m.powf(soil.n));
            memory.yield_pa[p.node] = pressure as f32;
            memory.plastic_m[p.node] = (p.depth_m - pressure / ELASTIC_PA_M) as f32;
        }
        let slid = f64::from(memory.slid_m[p.node]) + speed * dt_s;
        memory.slid_m[p.node] = slid as f32;
        let pressure = pressure - normal_speed * DAMPING_PA_S_M;
        let strength = soil.cohesion_pa + pressure.max(0.0) * soil.friction_rad.tan();
        let shear = strength * (1.0 - (-slid / soil.shear_m).exp());
        let area = NODE_M * NODE_M;
        let resistance = shear / speed.hypot(SLIDING_FADE_M_S);
        let force = scale(sub(scale(p.normal, pressure), scale(sliding, resistance)), area);
        contact.force = add(contact.force, force);
        contact.moment = add(contact.moment, cross(sub(p.point, wheel.centre), force));
        contact.spin_damping += area * resistance * wheel.radius_m * wheel.radius_m;
        contact.sinkage_max_m = contact.sinkage_max_m.max(p.depth_m);
        contact.sinkage_mean_m += p.depth_m;
        contact.nodes += 1;
    }
    contact.sinkage_mean_m /= contact.nodes.max(1) as f64;
    contact
}

/// Nodes that the wheel presses beyond their plastic depth, and the extent of these along and across the wheel, m.
fn pressed_nodes(ground: &Ground, memory: &SoilMemory, wheel: &Wheel) -> (Vec<Pressed>, [f64; 2]) {
    let heading = {
        let level = [wheel.axle[1], -wheel.axle[0], 0.0];
        scale(level, 1.0 / norm(level).max(1e-9))
    };
    let reach: [f64; 2] = std::array::from_fn(|i| wheel.radius_m * heading[i].abs() + 0.5 * wheel.width_m * wheel.axle[i].abs() + NODE_M);
    let low = [wheel.centre[0] - reach[0], wheel.centre[1] - reach[1]];
    let [columns, rows] = ground.range(low, [wheel.centre[0] + reach[0], wheel.centre[1] + reach[1]]);
    let (mut along, mut across) = ([f64::INFINITY, f64::NEG_INFINITY], [f64::INFINITY, f64::NEG_INFINITY]);
    let mut pressed = Vec::new();
    for row in rows {
        for column in columns.clone() {
            let (node, [x, y]) = ground.node(column, row);
            let Some(z) = lowest_point(wheel, x, y) else { continue };
            let [height, slope_x, slope_y] = ground.surface(node);
            if z >= height {
                continue;
            }
            let steep = (1.0 + slope_x * slope_x + slope_y * slope_y).sqrt();
            let depth_m = (height - z) / steep;
            let elastic_pa = ELASTIC_PA_M * (depth_m - f64::from(memory.plastic_m[node]));
            if elastic_pa <= 0.0 {
                continue;
            }
            let away = [x - wheel.centre[0], y - wheel.centre[1], z - wheel.centre[2]];
            for (range, at) in [(&mut along, dot(away, heading)), (&mut across, dot(away, wheel.axle))] {
                *range = [range[0].min(at), range[1].max(at)];
            }
            let normal = [-slope_x / steep, -slope_y / steep, 1.0 / steep];
            pressed.push(Pressed { node, point: [x, y, z], normal, depth_m, elastic_pa });
        }
    }
    (pressed, [along[1] - along[0] + NODE_M, across[1] - across[0] + NODE_M])
}

/// Lowest z of the wheel's cylinder on the vertical through (x, y); `None` where that misses it.
fn lowest_point(wheel: &Wheel, x: f64, y: f64) -> Option<f64> {
    let (dx, dy, axle) = (x - wheel.centre[0], y - wheel.centre[1], wheel.axle);
    // d = (dx, dy, t): |d|^2 - (d . axle)^2 = R^2.
    let level = dx * axle[0] + dy * axle[1];
    let a = 1.0 - axle[2] * axle[2];
    let half_b = -level * axle[2];
    let c = dx * dx + dy * dy - level * level - wheel.radius_m * wheel.radius_m;
    let discriminant = half_b * half_b - a * c;
    if discriminant <= 0.0 {
        return None;
    }
    let t = (-half_b - discriminant.sqrt()) / a;
    let aside = level + t * axle[2];
    (aside.abs() <= 0.5 * wheel.width_m).then_some(wheel.centre[2] + t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ground::SoilParameters;

    const FRICTIONLESS: SoilParameters =
        SoilParameters { k_phi: 2e6, k_c: 0.0, n: 1.0, cohesion_pa: 1e-9, friction_rad: 1e-9, shear_m: 0.02 };

    fn wheel(depth_m: f64, across_m: f64) -> Wheel {
        Wheel {
            centre: [0.0125, across_m, 0.47 - depth_m],
            axle: [0.0, 1.0, 0.0],
            radius_m: 0.47,
            width_m: 0.25,
            velocity: [0.0; 3],
            rate: [0.0; 3],
        }
    }

    /// Goal: the vertical force is the Bekker pressure integrated over the chord of the wheel. Method: n = 1, pressed into level ground by d, averaged over
    /// positions of the wheel on the nodes; closed form of the integral of (z(x) - 0) with z(x) = sqrt(R^2 - x^2) - (R - d). Five nodes across are 0.25 m.
    #[test]
    fn analytic_load_of_a_pressed_wheel_without_friction() {
        let (radius, depth) = (0.47_f64, 0.05_f64);
        let ground = Ground::plane(2.0, [0.0; 2], FRICTIONLESS);
        let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len() as f64;
        let loads = (0..20).map(|i| {
            let mut at = wheel(depth, 0.013);
            at.centre[0] = 0.0025 * f64::from(i);
            press(&ground, &mut SoilMemory::fresh(&ground), &at, 0.002).force[2]
        });
        let half = (radius * radius - (radius - depth).powi(2)).sqrt();
        let segment = radius * radius * (half / radius).asin() - half * (radius - depth);
        let expected = FRICTIONLESS.k_phi * 0.25 * segment;
        let load = mean(loads.collect());
        assert!((load / expected - 1.0).abs() < 0.01, "{load} N against {expected} N");
    }

    #[test]
    fn property_ruts_stay_and_unloading_is_elastic() {
        let ground = Ground::plane(2.0, [0.0; 2], FRICTIONLESS);
        let mut memory = SoilMemory::fresh(&ground);
        let first = press(&ground, &mut memory, &wheel(0.05, 0.013), 0.002);
        let lifted = press(&ground, &mut memory, &wheel(0.04, 0.013), 0.002);
        let again = press(&ground, &mut memory, &wheel(0.05, 0.013), 0.002);
        assert!(first.force[2] > 1e3 && lifted.force[2] < 0.05 * first.force[2], "{first:?} {lifted:?}");
        assert!((again.force[2] / first.force[2] - 1.0).abs() < 0.01);
    }

    #[test]
    fn property_sliding_is_opposed_and_never_stronger_than_coulomb() {
        let soil = SoilParameters { cohesion_pa: 3e3, friction_rad: 0.5, ..FRICTIONLESS };
        let ground = Ground::plane(2.0, [0.0; 2], soil);
        let mut memory = SoilMemory::fresh(&ground);
        let sliding = Wheel { velocity: [0.6, -0.8, 0.0], ..wheel(0.05, 0.013) };
        let contact = (0..200).fold(Contact::default(), |_, _| press(&ground, &mut memory, &sliding, 0.002));
        let (along, level) = (contact.force[0] * 0.6 - contact.force[1] * 0.8, contact.force[0].hypot(contact.force[1]));
        let strength = contact.nodes as f64 * NODE_M * NODE_M * 3e3 + contact.force[2] * 0.5_f64.tan();
        assert!((along + level).abs() < 1e-6 * level && level > 0.9 * strength && level <= strength, "{contact:?} {strength}");
    }
}
