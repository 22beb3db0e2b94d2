//! Vehicle cards as data roots give them: data sheets in several dialects, read into one [`Vehicle`].
//!
//! Names are harmonised here: each quantity is read under every name that a known card uses for it. A card in the schema of bundles
//! (`"format": "nesam.vehicle/1"`) is accepted too. What a sheet leaves out is estimated by the rules below, all of them chosen:
//!
//! * Name: that of the file without `vehicle_`. Wheel width: 0.6 r. Wheelbase: the track of a skid-steer base, 1.8 tracks of a car. All three are said.
//! * Meaning of the second command: `drive` in words of skid, differential or tracks means a yaw rate, of Ackermann or a car a road-wheel angle; where it says
//!   neither, the columns of a data root that name it decide, and that is said.
//! * Inertia: that of a solid box of wheelbase + 2 r by track + wheel width by 2.4 r, flagged in `inertia_estimated`.
//! * Height of the reference point over the ground: 1.25 r (a low robot carries its battery between the axles).
//! * Wheel centres: half wheelbase ahead and behind, half track to the sides.
//! * Suspension: none means stiff, a static deflection of 10 mm and a damping ratio of 0.7. A sheet's spring and damper act at the
//!   shock; with a motion ratio of about 0.8 the wheel sees 0.6 of the rate and 0.64 of the damping.
//! * Driven axles: both, which is said of a car unless `drive` or `driveline.type` has the words all-wheel, four-wheel, AWD, 4WD or 4x4.
//! * Drive line: a car-like vehicle holds 0.15 of its speed error as rim over-speed, at most 0.8 m/s, and one whose wheels are smaller than 0.46 m as much more as their
//!   contact is shorter: soil is sheared by slip times the length of the contact. A skid-steer vehicle servoes its
//!   rims (gain 1) with an actuator lag of 0.1 s, up to 3 m/s of rim speed. [`Vehicle`] parameters that matter can be calibrated later.

use std::path::Path;

use nesam_physics::{Driveline, RimServo, SecondCommand, SteeringTable, Vehicle, WHEELS};
use nesam_vehicle_card::{are_in_order, is_inertia};
use serde_json::Value;

use crate::channels::names_of;
use crate::error::TrajectoryError;
use crate::json::JsonFile;

/// Share of the spring rate at the shock that the wheel sees (the given card: motion ratio about 0.8, roughly 0.6).
const WHEEL_RATE_SHARE: f64 = 0.6;
/// Share of the damping at the shock that the wheel sees: motion ratio 0.8 squared.
const WHEEL_DAMPING_SHARE: f64 = 0.64;
/// Static deflection of a vehicle without suspension, m.
const STIFF_DEFLECTION_M: f64 = 0.01;
/// Damping ratio of a vehicle without suspension.
const STIFF_DAMPING_RATIO: f64 = 0.7;
/// Speed range of a car-like card that gives none, m/s.
const CAR_SPEED_RANGE_M_S: [f64; 2] = [-2.0, 12.0];
/// Largest rim speed of a skid-steer card that gives none, m/s.
const SKID_RIM_LIMIT_M_S: f64 = 3.0;
/// Two statements of one length may differ by this share: they are rounded.
const SAME: f64 = 0.02;
/// Width of a wheel whose card gives none, in radii.
const WIDTH_SHARE: f64 = 0.6;
/// Wheelbase of a card that gives none, in tracks: of a skid-steer base and of a car.
const WHEELBASE_SHARE: [f64; 2] = [1.0, 1.8];
/// Largest road-wheel angle of a car-like card that gives none, rad.
const ROAD_WHEEL_ANGLE_RAD: f64 = 0.7;
/// Over-speed of the rims of a car-like vehicle per speed error, and the radius of its wheels, m, below which they need more.
const CAR_SPEED_GAIN: f64 = 0.15;
const LARGE_WHEEL_M: f64 = 0.46;
/// Rate limit where a card gives none: none in practice, 1/s.
const UNLIMITED_RATE_PER_S: f64 = 1e3;

/// What the second command means by the columns of recorded drives, and which column says so.
pub(crate) type OfColumns<'a> = &'a dyn Fn() -> Option<(SecondCommand, String)>;

/// Reads a vehicle card.
///
/// # Errors
/// `TrajectoryError` naming the file and the key that is missing, of the wrong type or out of range.
pub fn read_vehicle_card(path: &Path) -> Result<Vehicle, TrajectoryError> {
    read_with_notes(path, &|| None).map(|card| card.vehicle)
}

/// The same with what the card leaves out and is estimated, one sentence each.
///
/// # Errors
/// As [`read_vehicle_card`].
pub fn read_vehicle_card_with_notes(path: &Path) -> Result<(Vehicle, Vec<String>), TrajectoryError> {
    read_with_notes(path, &|| None).map(|card| (card.vehicle, card.notes))
}

/// A vehicle card that was read.
pub(crate) struct CardReading {
    pub(crate) vehicle: Vehicle,
    /// What the card leaves out and is estimated, one sentence each.
    pub(crate) notes: Vec<String>,
    /// Which of the two command ranges no key of the card states.
    pub(crate) implied_range: [bool; 2],
}

/// Reads a vehicle card with what it does not state. `of_columns` is asked only where the card does not say what the second command means.
///
/// # Errors
/// As [`read_vehicle_card`].
pub(crate) fn read_with_notes(path: &Path, of_columns: OfColumns<'_>) -> Result<CardReading, TrajectoryError> {
    let sheet = JsonFile::read(path)?;
    let mut notes = Vec::new();
    let refused = |error: nesam_vehicle_card::CardError| TrajectoryError::Card { path: path.into(), reason: error.to_string() };
    if sheet.get("format").is_some() {
        let vehicle = card_from_json(&sheet.root().to_string()).map_err(refused)?;
        return Ok(CardReading { vehicle, notes, implied_range: [false; 2] });
    }
    let second = second_command(&sheet, of_columns, &mut notes)?;
    let wheels = Wheels::read(&sheet, second, &mut notes)?;
    let mass_kg = sheet.required(&["mass_total", "mass_kg", "mass"])?;
    let gravity_m_s2 = sheet.positive(&["gravity", "gravity_m_s2"])?.unwrap_or(9.81);
    let (inertia_kg_m2, inertia_estimated) = inertia(&sheet, mass_kg, &wheels)?;
    let (suspension_n_m, suspension_n_s_m) = suspension(&sheet, mass_kg, gravity_m_s2)?;
    let steering = (second == SecondCommand::SteeringNormalised).then(|| steering_table(&sheet)).transpose()?;
    let track_m = sheet.positive(&["nominal_diff_drive_base_m"])?.filter(|_| second == SecondCommand::YawRateRadS);
    let track_m = track_m.unwrap_or(wheels.track_m);
    let (command_range, implied_range) = command_range(&sheet, second, wheels.radius_m, track_m, steering.as_ref())?;
    let vehicle = Vehicle {
        name: name(&sheet, path, &mut notes)?,
        mass_kg,
        inertia_kg_m2,
        inertia_estimated,
        wheel_centre_m: wheels.centre_m,
        wheel_radius_m: wheels.radius_m,
        wheel_width_m: wheels.width_m,
        suspension_n_m,
        suspension_n_s_m,
        second,
        command_range,
        steering,
        track_m,
        wheelbase_m: wheels.wheelbase_m,
        driveline: driveline(&sheet, second, wheels.radius_m)?,
        gravity_m_s2,
        contact_law: Default::default(),
        soil_damping_pa_s_m: 0.0,
        effects: Default::default(),
    };
    nesam_vehicle_card::check(&vehicle).map_err(refused)?;
    if second != SecondCommand::YawRateRadS && !says_all_wheels(&sheet) {
        notes.push("vehicle card: neither `drive` nor `driveline.type` says which axles are driven: taken for both".into());
    }
    Ok(CardReading { vehicle, notes, implied_range })
}

/// The name on the card, else that of its file.
fn name(sheet: &JsonFile, path: &Path, notes: &mut Vec<String>) -> Result<String, TrajectoryError> {
    if let Some(stated) = sheet.text("vehicle")?.or(sheet.text("name")?) {
        return Ok(stated.into());
    }
    let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    let name = stem.strip_prefix("vehicle_").unwrap_or(&stem);
    if name.is_empty() {
        return Err(sheet.missing(&["vehicle", "name"]));
    }
    notes.push(format!("vehicle card: no `vehicle` or `name`: called `{name}` as its file"));
    Ok(name.into())
}

/// The vehicle as a card in the schema of bundles.
pub fn card_to_json(vehicle: &Vehicle) -> String {
    nesam_vehicle_card::to_json(vehicle)
}

/// The vehicle of a card in the schema of bundles.
///
/// # Errors
/// `CardError` naming the key at fault.
pub fn card_from_json(text: &str) -> Result<Vehicle, nesam_vehicle_card::CardError> {
    nesam_vehicle_card::from_json(text)
}

/// Rounds a derived number to 12 digits, which JSON carries without loss: a card read, bundled and read again stays the same.
fn round(x: f64) -> f64 {
    format!("{x:.11e}").parse().unwrap_or(x)
}

/// Placement and size of the wheels.
struct Wheels {
    centre_m: [[f64; 3]; WHEELS],
    radius_m: f64,
    width_m: f64,
    track_m: f64,
    wheelbase_m: f64,
}

impl Wheels {
    fn read(sheet: &JsonFile, second: SecondCommand, notes: &mut Vec<String>) -> Result<Self, TrajectoryError> {
        let radius_m = sheet.required(&["tyre.radius", "wheel_radius_m", "wheel.radius"])?;
        let width_m = sheet.positive(&["tyre.width", "wheel_width_m", "wheel.width"])?.unwrap_or_else(|| {
            let width_m = round(WIDTH_SHARE * radius_m);
            notes.push(format!("vehicle card: no `wheel_width_m`: taken for {WIDTH_SHARE} of the radius, {width_m} m"));
            width_m
        });
        let centres = &["wheel_centres_rel_P_static", "wheel_centre_m"];
        if let Some((key, value)) = sheet.first(centres) {
            let centre_m: [[f64; 3]; WHEELS] = sheet.matrix(key, value)?;
            let apart = |a: usize, b: usize, axis: usize| centre_m[a][axis] - centre_m[b][axis];
            if !are_in_order(&centre_m) {
                return Err(sheet.wrong(key, "expected the order FL, FR, RL, RR with x forward and y left"));
            }
            let track_m = round((apart(0, 1, 1) + apart(2, 3, 1)) / 2.0);
            let wheelbase_m = round((apart(0, 2, 0) + apart(1, 3, 0)) / 2.0);
            let stated_m = sheet.positive(&["wheelbase_m", "wheelbase"])?.filter(|stated_m| (stated_m / wheelbase_m - 1.0).abs() > SAME);
            if let Some(stated_m) = stated_m {
                notes.push(format!(
                    "vehicle card: a wheelbase of {stated_m} m is stated, and the wheel centres are {wheelbase_m} m apart, which counts"
                ));
            }
            return Ok(Self { centre_m, radius_m, width_m, track_m, wheelbase_m });
        }
        let front = sheet.required(&["track_m", "track_front", "track_front_m"])?;
        let rear = sheet.positive(&["track_rear", "track_rear_m"])?.unwrap_or(front);
        let wheelbase_m = sheet.positive(&["wheelbase_m", "wheelbase"])?.unwrap_or_else(|| {
            let [of_skid, of_car] = WHEELBASE_SHARE;
            let share = if second == SecondCommand::YawRateRadS { of_skid } else { of_car };
            let wheelbase_m = round(share * (front + rear) / 2.0);
            notes.push(format!("vehicle card: no `wheelbase_m`: taken for {share} tracks, {wheelbase_m} m"));
            wheelbase_m
        });
        let height = &["cg_height_above_rigid_flat_ground_static_m", "cg_height_m"];
        let z = round(radius_m - sheet.positive(height)?.unwrap_or(1.25 * radius_m));
        let x = wheelbase_m / 2.0;
        let centre_m = [[x, front / 2.0, z], [x, -front / 2.0, z], [-x, rear / 2.0, z], [-x, -rear / 2.0, z]];
        Ok(Self { centre_m, radius_m, width_m, track_m: round((front + rear) / 2.0), wheelbase_m })
    }
}

/// Whether the card says that every wheel is driven, which is what the physics does.
fn says_all_wheels(sheet: &JsonFile) -> bool {
    let says = |key: &str| sheet.get(key).and_then(Value::as_str).unwrap_or_default().to_lowercase();
    ["drive", "driveline.type"].into_iter().any(|key| {
        let text = says(key);
        text.contains("all wheel")
            || text.contains("all-wheel")
            || text.contains("four wheel")
            || text.contains("four-wheel")
            || text.split(|c: char| !c.is_alphanumeric()).any(|word| matches!(word, "awd" | "4wd" | "4x4"))
    })
}

/// What the second command means: stated, implied by the kind of drive, or told by the columns of the data.
fn second_command(sheet: &JsonFile, of_columns: OfColumns<'_>, notes: &mut Vec<String>) -> Result<SecondCommand, TrajectoryError> {
    if let Some(stated) = sheet.text("second")? {
        return match stated {
            "steering_normalised" => Ok(SecondCommand::SteeringNormalised),
            "road_wheel_angle_rad" => Ok(SecondCommand::RoadWheelAngleRad),
            "yaw_rate_rad_s" => Ok(SecondCommand::YawRateRadS),
            other => {
                let reason = format!("`{other}`, expected steering_normalised, road_wheel_angle_rad or yaw_rate_rad_s");
                Err(sheet.wrong("second", reason))
            }
        };
    }
    let drive = sheet.text("drive")?;
    if matches!(drive, Some("skid_steer" | "differential")) {
        return Ok(SecondCommand::YawRateRadS);
    }
    if sheet.get("steering.command_to_road_wheel_table").is_some() {
        return Ok(SecondCommand::SteeringNormalised);
    }
    if let Some(second) = drive.and_then(implied_by) {
        return Ok(second);
    }
    if let Some((second, column)) = of_columns() {
        let (_, meaning) = names_of(second);
        notes.push(format!("vehicle card: neither `second` nor `drive` says what the second command means; {column} says {meaning}"));
        return Ok(second);
    }
    let words =
        "state `second`, a steering table, or a `drive` with one of skid, diff, track (a yaw rate), ackermann, car (a road-wheel angle)";
    match drive {
        Some(other) => Err(sheet.wrong("drive", format!("`{other}` does not say what the second command means; {words}"))),
        None => Err(sheet.wrong("second", format!("missing, and neither `drive` nor a steering table implies it; {words}"))),
    }
}

/// What the second command of a vehicle of this kind means; `None` where the words name neither kind or both, as a car with a differential does.
fn implied_by(drive: &str) -> Option<SecondCommand> {
    let text = drive.to_lowercase();
    let turns = ["skid", "diff", "track"].into_iter().any(|word| text.contains(word));
    let steers = text.contains("ackermann") || text.split(|c: char| !c.is_alphabetic()).any(|word| word == "car");
    match (turns, steers) {
        (true, false) => Some(SecondCommand::YawRateRadS),
        (false, true) => Some(SecondCommand::RoadWheelAngleRad),
        _ => None,
    }
}

/// The inertia matrix of the card, else that of a box.
fn inertia(sheet: &JsonFile, mass_kg: f64, wheels: &Wheels) -> Result<([[f64; 3]; 3], bool), TrajectoryError> {
    if let Some((key, value)) = sheet.first(&["inertia_about_cg.matrix", "inertia_kg_m2"]) {
        let matrix: [[f64; 3]; 3] = sheet.matrix(key, value)?;
        if !is_inertia(&matrix) {
            return Err(sheet.wrong(key, "expected a symmetric positive definite matrix"));
        }
        return Ok((matrix, false));
    }
    let length = wheels.wheelbase_m + 2.0 * wheels.radius_m;
    let width = wheels.track_m + wheels.width_m;
    let height = 2.4 * wheels.radius_m;
    let about = |a: f64, b: f64| round(mass_kg * (a * a + b * b) / 12.0);
    let (xx, yy, zz) = (about(width, height), about(length, height), about(length, width));
    Ok(([[xx, 0.0, 0.0], [0.0, yy, 0.0], [0.0, 0.0, zz]], true))
}

/// Rate and damping at each wheel.
fn suspension(sheet: &JsonFile, mass_kg: f64, gravity: f64) -> Result<([f64; WHEELS], [f64; WHEELS]), TrajectoryError> {
    if sheet.get("suspension").is_none() {
        let load_kg = mass_kg / WHEELS as f64;
        let rate = round(load_kg * gravity / STIFF_DEFLECTION_M);
        let damping = round(2.0 * STIFF_DAMPING_RATIO * (rate * load_kg).sqrt());
        return Ok(([rate; WHEELS], [damping; WHEELS]));
    }
    let axle = |name: &str| -> Result<(f64, f64), TrajectoryError> {
        let spring = sheet.required(&[&format!("suspension.{name}.spring_N_per_m"), &format!("suspension.{name}.spring_n_m")])?;
        let damper = sheet.required(&[&format!("suspension.{name}.damper_Ns_per_m"), &format!("suspension.{name}.damper_n_s_m")])?;
        Ok((round(spring * WHEEL_RATE_SHARE), round(damper * WHEEL_DAMPING_SHARE)))
    };
    let (front, rear) = (axle("front")?, axle("rear")?);
    Ok(([front.0, front.0, rear.0, rear.0], [front.1, front.1, rear.1, rear.1]))
}

/// The table from normalised steering to road-wheel angles.
fn steering_table(sheet: &JsonFile) -> Result<SteeringTable, TrajectoryError> {
    const KEY: &str = "steering.command_to_road_wheel_table";
    let rows = sheet.get(KEY).and_then(Value::as_array).ok_or_else(|| sheet.missing(&[KEY]))?;
    let mut table = SteeringTable { command: Vec::new(), front_left_rad: Vec::new(), front_right_rad: Vec::new() };
    for (i, row) in rows.iter().enumerate() {
        let number = |name: &str| {
            let key = format!("{KEY}[{i}].{name}");
            row.get(name).ok_or_else(|| sheet.wrong(&key, "missing")).and_then(|value| sheet.finite(&key, value))
        };
        table.command.push(number("cmd")?);
        table.front_left_rad.push(number("fl_rad")?);
        table.front_right_rad.push(number("fr_rad")?);
    }
    if table.command.len() < 2 || !table.command.windows(2).all(|w| w[0] < w[1]) {
        return Err(sheet.wrong(KEY, "expected at least two rows with ascending cmd"));
    }
    Ok(table)
}

/// Admissible commands: stated, else what the kind of drive implies; and which of the two nothing on the card states.
fn command_range(
    sheet: &JsonFile,
    second: SecondCommand,
    radius_m: f64,
    track_m: f64,
    steering: Option<&SteeringTable>,
) -> Result<([[f64; 2]; 2], [bool; 2]), TrajectoryError> {
    let rim_rad_s = sheet.positive(&["max_wheel_speed_rad_s"])?;
    let rim_m_s = rim_rad_s.map_or(SKID_RIM_LIMIT_M_S, |omega| round(omega * radius_m));
    let (implied, is_implied) = match second {
        SecondCommand::YawRateRadS => {
            let turn = round(2.0 * rim_m_s / track_m);
            ([[-rim_m_s, rim_m_s], [-turn, turn]], [rim_rad_s.is_none(); 2])
        }
        SecondCommand::SteeringNormalised => {
            let ends = steering.map(|t| [t.command[0], t.command[t.command.len() - 1]]);
            ([CAR_SPEED_RANGE_M_S, ends.unwrap_or([-1.0, 1.0])], [true, false])
        }
        SecondCommand::RoadWheelAngleRad => {
            let stated = largest_road_wheel_angle(sheet)?;
            let largest = stated.unwrap_or(ROAD_WHEEL_ANGLE_RAD);
            ([CAR_SPEED_RANGE_M_S, [-largest, largest]], [true, stated.is_none()])
        }
    };
    let stated = stated_range(sheet)?;
    Ok((
        core::array::from_fn(|axis| stated[axis].unwrap_or(implied[axis])),
        core::array::from_fn(|axis| is_implied[axis] && stated[axis].is_none()),
    ))
}

/// The ranges of the speed and of the second command that a card states.
fn stated_range(sheet: &JsonFile) -> Result<[Option<[f64; 2]>; 2], TrajectoryError> {
    const KEY: &str = "command_range";
    const NAMES: [&str; 2] = ["speed_m_s", "second"];
    let shape = r#"expected {"speed_m_s": [min, max], "second": [min, max]} or one of the two"#;
    match sheet.get(KEY) {
        None => return Ok([None; 2]),
        Some(Value::Object(given)) => {
            if let Some(other) = given.keys().find(|key| !NAMES.contains(&key.as_str())) {
                return Err(sheet.wrong(&format!("{KEY}.{other}"), format!("no such key; {shape}")));
            }
        }
        Some(other) => return Err(sheet.wrong(KEY, format!("{shape}, found {other}"))),
    }
    let range = |name: &str| {
        let key = format!("{KEY}.{name}");
        let Some(value) = sheet.get(&key) else { return Ok(None) };
        let range: [f64; 2] = sheet.array(&key, value)?;
        if range[0] < range[1] { Ok(Some(range)) } else { Err(sheet.wrong(&key, "expected [min, max] with min < max")) }
    };
    Ok([range(NAMES[0])?, range(NAMES[1])?])
}

/// The largest angle of a road wheel, rad, where the card gives one or one for each wheel: each above 0, for it is turned to both sides.
fn largest_road_wheel_angle(sheet: &JsonFile) -> Result<Option<f64>, TrajectoryError> {
    const KEY: &str = "steering.max_road_wheel_angle_rad";
    let Some(Value::Array(angles)) = sheet.get(KEY) else { return sheet.positive(&[KEY]) };
    if angles.is_empty() {
        return Err(sheet.wrong(KEY, "expected an angle or one for each wheel, found none"));
    }
    let mut largest = 0.0_f64;
    for (i, angle) in angles.iter().enumerate() {
        let key = format!("{KEY}[{i}]");
        let angle_rad = sheet.finite(&key, angle)?;
        if angle_rad <= 0.0 {
            return Err(sheet.wrong(&key, format!("{angle_rad} is not positive")));
        }
        largest = largest.max(angle_rad);
    }
    Ok(Some(largest))
}

/// Actuators and drive line: stated values, else the defaults of the kind of drive.
fn driveline(sheet: &JsonFile, second: SecondCommand, radius_m: f64) -> Result<Driveline, TrajectoryError> {
    let skid = second == SecondCommand::YawRateRadS;
    let or = |keys: &[&str], default: f64| -> Result<f64, TrajectoryError> {
        let value = sheet.number(keys)?.unwrap_or(default);
        if value >= 0.0 { Ok(value) } else { Err(sheet.wrong(keys[0], format!("{value} is negative"))) }
    };
    let rim_limit_m_s = sheet.positive(&["max_wheel_speed_rad_s"])?.map_or(RimServo::NO_LIMIT, |omega| round(omega * radius_m));
    let steering_lag_s = or(&["steering.actuator.time_constant_s", "driveline.steering_lag_s"], if skid { 0.1 } else { 0.0 })?;
    Ok(Driveline {
        steering_lag_s,
        steering_rate_limit_per_s: or(
            &["steering.actuator.rate_limit_per_s", "driveline.steering_rate_limit_per_s"],
            UNLIMITED_RATE_PER_S,
        )?,
        speed_gain: or(&["driveline.speed_gain"], if skid { 1.0 } else { round(CAR_SPEED_GAIN * (LARGE_WHEEL_M / radius_m).max(1.0)) })?,
        speed_integral_gain_per_s: or(&["driveline.speed_integral_gain_per_s"], 0.0)?,
        speed_integral_leak_s: sheet.positive(&["driveline.speed_integral_leak_s"])?.unwrap_or(2.0),
        speed_integral_limit_m: or(&["driveline.speed_integral_limit_m"], 2.0)?,
        overspeed_limit_m_s: sheet.positive(&["driveline.overspeed_limit_m_s"])?.unwrap_or(if skid { SKID_RIM_LIMIT_M_S } else { 0.8 }),
        // Two lags of half the time each.
        rims: RimServo { yaw_lag_s: 0.5 * steering_lag_s, rim_limit_m_s, ..RimServo::default() },
        side_coupling_n_m_s: or(&["driveline.lsd_Nm_per_rad_s", "driveline.side_coupling_n_m_s"], 0.0)?,
        torque: None,
    })
}
