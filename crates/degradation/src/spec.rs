//! What is wrong with a link and its sensors, as text and as numbers.

use std::fmt;

use crate::DegradationError;

/// What is wrong; 0 = nothing. The defaults of the keys are chosen: a radio link at the edge of its range and an inertial sensor of the cheap kind.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Degradation {
    /// Mean of the exponentially distributed delay of each message, s.
    pub jitter_s: f64,
    /// Standard deviation of the error of each stamp, s.
    pub stamp_s: f64,
    /// Probability that a message is lost, each for itself.
    pub loss: f64,
    /// Probability that a message is overtaken by the one after it.
    pub reorder: f64,
    /// How far the vehicle's clock runs ahead in the middle third of a drive, s; it steps there and back again.
    pub clock_step_s: f64,
    /// Rate of the messages, Hz; 0 = that of the drive. Between the samples of the drive, states are interpolated.
    pub imu_hz: f64,
    /// Standard deviation over drives of the constant error of each angular velocity, rad/s.
    pub gyro_bias_rad_s: f64,
    /// Standard deviation over drives of the constant error of each velocity, m/s.
    pub velocity_bias_m_s: f64,
    /// Standard deviation of the coloured noise of each angular velocity, rad/s.
    pub gyro_noise_rad_s: f64,
    /// Standard deviation of the coloured noise of each velocity, m/s.
    pub velocity_noise_m_s: f64,
    /// Time in which the coloured noise forgets itself (autocorrelation e^-1), s.
    pub noise_time_s: f64,
}

/// A key of a specification: name, unit of a number, default, largest value, what it sets.
struct Key {
    name: &'static str,
    unit: &'static str,
    default: f64,
    most: f64,
    field: fn(&mut Degradation) -> &mut f64,
}

const KEYS: [Key; 11] = [
    Key { name: "jitter", unit: "s", default: 0.01, most: 10.0, field: |d| &mut d.jitter_s },
    Key { name: "stamp", unit: "s", default: 0.002, most: 1.0, field: |d| &mut d.stamp_s },
    Key { name: "loss", unit: "", default: 0.05, most: 1.0, field: |d| &mut d.loss },
    Key { name: "reorder", unit: "", default: 0.1, most: 1.0, field: |d| &mut d.reorder },
    Key { name: "clock-step", unit: "s", default: 0.5, most: 3600.0, field: |d| &mut d.clock_step_s },
    Key { name: "imu", unit: "hz", default: 200.0, most: 1000.0, field: |d| &mut d.imu_hz },
    Key { name: "gyro-bias", unit: "", default: 0.005, most: 1.0, field: |d| &mut d.gyro_bias_rad_s },
    Key { name: "velocity-bias", unit: "", default: 0.02, most: 10.0, field: |d| &mut d.velocity_bias_m_s },
    Key { name: "gyro-noise", unit: "", default: 0.005, most: 1.0, field: |d| &mut d.gyro_noise_rad_s },
    Key { name: "velocity-noise", unit: "", default: 0.02, most: 10.0, field: |d| &mut d.velocity_noise_m_s },
    Key { name: "noise-time", unit: "s", default: 1.0, most: 1000.0, field: |d| &mut d.noise_time_s },
];

/// Keys that `all` sets; the inertial sensor brings its errors with it.
const ALL: [&str; 5] = ["jitter", "loss", "reorder", "clock-step", "imu"];
/// Keys that `imu` sets beside its rate, where they are not given.
const OF_IMU: [&str; 5] = ["gyro-bias", "velocity-bias", "gyro-noise", "velocity-noise", "noise-time"];

impl Degradation {
    /// Reads a specification: `all`, `none`, or keys with or without a value, separated by commas: `jitter=10ms,loss=0.05,imu=200hz`.
    ///
    /// # Errors
    /// `DegradationError::Spec` naming the part at fault and what is allowed.
    pub fn parse(text: &str) -> Result<Self, DegradationError> {
        let mut found = Self::default();
        let mut given: Vec<&str> = Vec::new();
        for part in text.split(',').map(str::trim).filter(|part| !part.is_empty() && *part != "none") {
            if part == "all" {
                for key in KEYS.iter().filter(|key| ALL.contains(&key.name) && !given.contains(&key.name)) {
                    *(key.field)(&mut found) = key.default;
                }
                continue;
            }
            let (name, value) = part.split_once('=').map_or((part, None), |(name, value)| (name.trim(), Some(value.trim())));
            let Some(key) = KEYS.iter().find(|key| key.name == name) else {
                let names: Vec<&str> = KEYS.iter().map(|key| key.name).collect();
                let reason = format!("is not known; allowed are all, none and {}", names.join(", "));
                return Err(DegradationError::Spec { part: part.into(), reason });
            };
            let value = value.map_or(Ok(key.default), |value| number(part, value, key))?;
            *(key.field)(&mut found) = value;
            given.push(key.name);
        }
        if found.imu_hz > 0.0 {
            for key in KEYS.iter().filter(|key| OF_IMU.contains(&key.name) && !given.contains(&key.name)) {
                *(key.field)(&mut found) = key.default;
            }
        }
        let noisy = found.gyro_noise_rad_s > 0.0 || found.velocity_noise_m_s > 0.0;
        if noisy && found.noise_time_s <= 0.0 {
            found.noise_time_s = 1.0;
        }
        if found.imu_hz != 0.0 && found.imu_hz < 10.0 {
            return Err(DegradationError::Spec { part: "imu".into(), reason: "is below 10 Hz, the step of the model".into() });
        }
        Ok(found)
    }
}

/// A number with its unit, in SI.
fn number(part: &str, value: &str, key: &Key) -> Result<f64, DegradationError> {
    let wrong = |reason: String| DegradationError::Spec { part: part.into(), reason };
    let lower = value.to_ascii_lowercase();
    let (digits, factor) = match key.unit {
        "s" => [("ms", 1e-3), ("us", 1e-6), ("s", 1.0)].iter().find_map(|(unit, f)| lower.strip_suffix(unit).map(|d| (d, *f))),
        "hz" => lower.strip_suffix("hz").map(|d| (d, 1.0)),
        _ => None,
    }
    .unwrap_or((lower.as_str(), 1.0));
    let number: f64 = digits.trim().parse().map_err(|_| wrong(format!("`{value}` is not a number{}", unit_hint(key.unit))))?;
    let number = number * factor;
    let least = if key.name == "clock-step" { -key.most } else { 0.0 };
    if !(least..=key.most).contains(&number) {
        return Err(wrong(format!("is {number}, allowed are {least} to {}{}", key.most, unit_hint(key.unit))));
    }
    Ok(number)
}

fn unit_hint(unit: &str) -> &'static str {
    match unit {
        "s" => " with s, ms or us",
        "hz" => " with hz",
        _ => "",
    }
}

impl fmt::Display for Degradation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut copy = *self;
        let parts: Vec<String> = KEYS
            .iter()
            .filter_map(|key| {
                let value = *(key.field)(&mut copy);
                // What the sensor would bring with it is said even where it is switched off.
                let said = value != 0.0 || (self.imu_hz > 0.0 && OF_IMU.contains(&key.name));
                said.then(|| format!("{}={value}{}", key.name, key.unit))
            })
            .collect();
        f.write_str(&if parts.is_empty() { "none".into() } else { parts.join(",") })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_specifications_are_read_and_written() {
        let parse = |text: &str| Degradation::parse(text).unwrap();
        assert_eq!(parse("none"), Degradation::default());
        assert_eq!(parse("jitter=10ms"), Degradation { jitter_s: 0.01, ..Default::default() });
        assert_eq!(parse(" loss , clock-step=-0.25s"), Degradation { loss: 0.05, clock_step_s: -0.25, ..Default::default() });
        let imu = parse("imu=100hz,gyro-bias=0");
        assert_eq!((imu.imu_hz, imu.gyro_bias_rad_s, imu.velocity_bias_m_s, imu.noise_time_s), (100.0, 0.0, 0.02, 1.0));
        let all = parse("loss=0.2,all");
        assert_eq!(
            (all.loss, all.jitter_s, all.reorder, all.clock_step_s, all.imu_hz, all.gyro_noise_rad_s),
            (0.2, 0.01, 0.1, 0.5, 200.0, 0.005)
        );
        for spec in [imu, all, parse("stamp=300us"), Degradation::default()] {
            assert_eq!(parse(&spec.to_string()), spec, "{spec}");
        }
    }

    #[test]
    fn analytic_wrong_specifications_name_the_part() {
        for (text, part) in [
            ("los=0.1", "los=0.1"),
            ("loss=1.5", "loss=1.5"),
            ("jitter=fast", "jitter=fast"),
            ("loss=0.1,imu=5hz", "imu"),
            ("loss=-1", "loss"),
        ] {
            let message = Degradation::parse(text).unwrap_err().to_string();
            assert!(message.contains(part), "{text}: {message}");
        }
    }
}
