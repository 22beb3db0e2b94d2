//! Whether a vehicle card makes sense.

use nesam_physics::{SecondCommand, Vehicle};

use super::{Doubt, doubt};

/// Share of the mass by which its parts may weigh more: numbers of cards are rounded (chosen).
const ROUNDED: f64 = 0.001;
/// Track over wheelbase, least and most (chosen: from long lorries to short robots).
const TRACK_PER_WHEELBASE: [f64; 2] = [0.15, 3.0];
/// Mass of a vehicle over the third power of the radius of its wheels, least and most, kg/m³ (chosen: cars, lorries and robots have 5000 to 60 000).
const MASS_PER_RADIUS_KG_M3: [f64; 2] = [500.0, 2e6];

/// Mean track of the axles, m.
fn track_m(vehicle: &Vehicle) -> f64 {
    let [fl, fr, rl, rr] = vehicle.wheel_centre_m;
    0.5 * (fl[1] - fr[1] + rl[1] - rr[1])
}

/// The largest road-wheel angle that the card speaks of, rad, and where.
fn steepest_rad(vehicle: &Vehicle) -> Option<(&'static str, f64)> {
    let steepest = |angles: &mut dyn Iterator<Item = f64>| angles.map(f64::abs).fold(0.0, f64::max);
    let of_table = vehicle.steering.as_ref().map(|table| {
        let mut angles = table.front_left_rad.iter().chain(&table.front_right_rad).copied();
        ("the largest road-wheel angle", steepest(&mut angles))
    });
    let is_angle = vehicle.second == SecondCommand::RoadWheelAngleRad;
    let of_range =
        is_angle.then(|| ("the largest road-wheel angle of the range of commands", steepest(&mut vehicle.command_range[1].into_iter())));
    of_table.into_iter().chain(of_range).max_by(|a, b| a.1.total_cmp(&b.1))
}

/// What does not fit together in a card. `mass_of_parts_kg` is what the parts that it states weigh together.
pub fn card_doubts(vehicle: &Vehicle, mass_of_parts_kg: Option<f64>) -> Vec<Doubt> {
    let mut found = Vec::new();
    if let Some(parts_kg) = mass_of_parts_kg.filter(|parts_kg| *parts_kg > (1.0 + ROUNDED) * vehicle.mass_kg) {
        let what = format!("the mass is {:.1} kg, and chassis and wheels alone weigh {parts_kg:.1} kg", vehicle.mass_kg);
        found.push(doubt(what, "`mass_total` is that of the whole vehicle, with its load"));
    }
    let about = |what: &str, value: f64, range: [f64; 2], unit: &str| {
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        let text = format!("{what} is {value:.3}{unit}, off-road vehicles have {} to {}{unit}", range[0], range[1]);
        (!(range[0]..=range[1]).contains(&value)).then(|| doubt(text, "see the unit in the card"))
    };
    let (track_m, radius_m, mass_kg) = (track_m(vehicle), vehicle.wheel_radius_m, vehicle.mass_kg);
    let sizes = [
        about("the mass", mass_kg, [5.0, 60_000.0], "kg"),
        about("the radius of the wheels", radius_m, [0.05, 1.2], "m"),
        about("the width of the wheels", vehicle.wheel_width_m, [0.02, 1.2], "m"),
        about("the wheelbase", vehicle.wheelbase_m, [0.15, 8.0], "m"),
        about("the track", track_m, [0.1, 4.0], "m"),
    ];
    if sizes.iter().all(Option::is_none) {
        found.extend(about("the track over the wheelbase", track_m / vehicle.wheelbase_m, TRACK_PER_WHEELBASE, ""));
        let [least, most] = MASS_PER_RADIUS_KG_M3.map(|density| density * radius_m.powi(3));
        if !(least..=most).contains(&mass_kg) {
            let what =
                format!("the mass is {mass_kg:.3} kg, vehicles on wheels of {radius_m:.3} m in radius have {least:.1} to {most:.0} kg");
            found.push(doubt(what, "see the units of both in the card"));
        }
    }
    found.extend(sizes.into_iter().flatten());
    let rate_n_m = vehicle.suspension_n_m.iter().sum::<f64>();
    let deflection_m = vehicle.mass_kg * vehicle.gravity_m_s2 / rate_n_m;
    found.extend(about("the deflection of the springs under the weight", deflection_m, [0.001, 0.5], "m"));
    found.extend(about("the lag of the steering", vehicle.driveline.steering_lag_s, [0.0, 2.0], "s"));
    found.extend(steepest_rad(vehicle).and_then(|(what, angle_rad)| about(what, angle_rad, [0.0, 1.3], "rad")));
    found.extend(about("gravity", vehicle.gravity_m_s2, [9.7, 9.9], "m/s²"));
    found.extend(about("the height of the centre of gravity over the ground", vehicle.standing_height_m(), [0.02, 3.0], "m"));
    let mut moments: [f64; 3] = core::array::from_fn(|axis| vehicle.inertia_kg_m2[axis][axis]);
    moments.sort_by(f64::total_cmp);
    if moments[2] > 1.001 * (moments[0] + moments[1]) {
        let what = format!("no body has the moments of inertia {:.0}, {:.0} and {:.0} kg m²", moments[0], moments[1], moments[2]);
        found.push(doubt(what, "the largest of the three about x, y and z is at most the sum of the other two"));
    }
    found
}
