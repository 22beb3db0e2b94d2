//! Whether a vehicle card makes sense.

use nesam_physics::{Vehicle, WHEELS};

use super::{Doubt, doubt};

/// Height of the centre of gravity of a vehicle that stands on level ground, m: its springs at rest.
pub fn standing_height_m(vehicle: &Vehicle) -> f64 {
    vehicle.wheel_radius_m - vehicle.wheel_centre_m.iter().map(|centre| centre[2]).sum::<f64>() / WHEELS as f64
}

/// Share of the mass by which its parts may weigh more: numbers of cards are rounded (chosen).
const ROUNDED: f64 = 0.001;

/// What does not fit together in a card. `mass_of_parts_kg` is what the parts that it states weigh together.
pub fn card_doubts(vehicle: &Vehicle, mass_of_parts_kg: Option<f64>) -> Vec<Doubt> {
    let mut found = Vec::new();
    if let Some(parts_kg) = mass_of_parts_kg.filter(|parts_kg| *parts_kg > (1.0 + ROUNDED) * vehicle.mass_kg) {
        let what = format!("the mass is {:.1} kg, and chassis and wheels alone weigh {parts_kg:.1} kg", vehicle.mass_kg);
        found.push(doubt(what, "`mass_total` is that of the whole vehicle, with its load"));
    }
    let [fl, fr, rl, rr] = vehicle.wheel_centre_m;
    if fl[1] <= fr[1] || rl[1] <= rr[1] {
        found
            .push(doubt("the left wheels lie right of the right ones".into(), "y points to the left, and wheels are named FL, FR, RL, RR"));
    }
    if fl[0] <= rl[0] || fr[0] <= rr[0] {
        found.push(doubt("the front wheels lie behind the rear ones".into(), "x points forward, and wheels are named FL, FR, RL, RR"));
    } else if fl[0] <= 0.0 || rl[0] >= 0.0 {
        let what = format!("the centre of gravity lies outside of the wheels (x of the axles {:.2} and {:.2} m)", fl[0], rl[0]);
        found.push(doubt(what, "wheel centres are given relative to the centre of gravity"));
    }
    let about = |what: &str, value: f64, range: [f64; 2], unit: &str| {
        let text = format!("{what} is {value:.3} {unit}, off-road vehicles have {} to {} {unit}", range[0], range[1]);
        (!(range[0]..=range[1]).contains(&value)).then(|| doubt(text, "see the unit in the card"))
    };
    found.extend(about("the mass", vehicle.mass_kg, [5.0, 60_000.0], "kg"));
    found.extend(about("the radius of the wheels", vehicle.wheel_radius_m, [0.05, 1.2], "m"));
    found.extend(about("the width of the wheels", vehicle.wheel_width_m, [0.02, 1.2], "m"));
    found.extend(about("the wheelbase", vehicle.wheelbase_m, [0.15, 8.0], "m"));
    found.extend(about("gravity", vehicle.gravity_m_s2, [9.7, 9.9], "m/s²"));
    found.extend(about("the height of the centre of gravity over the ground", standing_height_m(vehicle), [0.02, 3.0], "m"));
    let mut moments: [f64; 3] = core::array::from_fn(|axis| vehicle.inertia_kg_m2[axis][axis]);
    moments.sort_by(f64::total_cmp);
    if moments[2] > 1.001 * (moments[0] + moments[1]) {
        let what = format!("no body has the moments of inertia {:.0}, {:.0} and {:.0} kg m²", moments[0], moments[1], moments[2]);
        found.push(doubt(what, "the largest of the three about x, y and z is at most the sum of the other two"));
    }
    found
}
