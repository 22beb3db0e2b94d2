//! What a recording says about the run that it holds.

use std::collections::BTreeMap;
use std::path::Path;

use nesam_engine::Limits;
use nesam_model::{Precision, Predictor};

use super::error::RecordingError;
use crate::clock::unix_ns;
use crate::config::FleetSoilConfig;

/// Name of the metadata record that begins every part.
pub(crate) const HEADER: &str = "nesam.recording";
/// Name of the metadata record that ends a finished part.
pub(crate) const END: &str = "nesam.recording.end";
/// Layout of the recordings that this program writes and reads.
pub(crate) const SCHEMA: &str = "nesam.recording/1";

/// What ran, the same in all parts of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordingHeader {
    /// Program and version.
    pub program: String,
    /// Name of the bundle.
    pub bundle: String,
    /// Hash of the bundle.
    pub bundle_hash: String,
    /// Name of the vehicle card.
    pub vehicle: String,
    /// Limits in force.
    pub limits: Limits,
    /// Soil map of the fleet.
    pub fleet_soil: FleetSoilConfig,
    /// Settings of the soil filter that the bundle carries, JSON; empty = the defaults of the program.
    pub soil_filter: String,
    /// What the network's products were rounded to.
    pub precision: Precision,
    /// Processor and the vector units that decide which kernels compute.
    pub machine: String,
    /// Unix time at which the engine's clock stood at 0, ns.
    pub clock_zero_unix_ns: u64,
    /// Name of the run, the same in all parts.
    pub run: String,
}

impl RecordingHeader {
    /// The header of a run that starts now.
    pub fn of_run(predictor: &Predictor, limits: &Limits, fleet_soil: &FleetSoilConfig, engine_now_ns: u64) -> Self {
        let bundle = predictor.bundle();
        let now_ns = unix_ns().unsigned_abs();
        Self {
            program: Self::this_program(),
            bundle: bundle.name.clone(),
            bundle_hash: bundle.hash.clone(),
            vehicle: bundle.vehicle.name.clone(),
            limits: limits.clone(),
            fleet_soil: fleet_soil.clone(),
            soil_filter: bundle.soil_filter_json.clone().unwrap_or_default(),
            precision: predictor.precision(),
            machine: Self::this_machine(),
            clock_zero_unix_ns: now_ns.saturating_sub(engine_now_ns),
            run: format!("nesam-{}-{}", utc(now_ns / 1_000_000_000), std::process::id()),
        }
    }

    /// This program, as recordings name it.
    pub fn this_program() -> String {
        format!("nesam {}", env!("CARGO_PKG_VERSION"))
    }

    /// Processor and the vector units that decide which kernels compute: answers of another machine may differ in the last bits.
    pub fn this_machine() -> String {
        let mut units = vec![std::env::consts::ARCH];
        #[cfg(target_arch = "x86_64")]
        {
            let found = [
                ("fma", std::arch::is_x86_feature_detected!("fma")),
                ("avx2", std::arch::is_x86_feature_detected!("avx2")),
                ("avx512f", std::arch::is_x86_feature_detected!("avx512f")),
            ];
            units.extend(found.into_iter().filter(|(_, there)| *there).map(|(name, _)| name));
        }
        units.join(" ")
    }

    /// The metadata of part `part`.
    pub(crate) fn to_metadata(&self, part: u32) -> BTreeMap<String, String> {
        let limits = serde_json::to_string(&self.limits).expect("numbers always serialise; this is a bug");
        let fleet_soil = serde_json::to_string(&self.fleet_soil).expect("numbers always serialise; this is a bug");
        let pairs = [
            ("schema", SCHEMA.to_string()),
            ("program", self.program.clone()),
            ("bundle", self.bundle.clone()),
            ("bundle_hash", self.bundle_hash.clone()),
            ("vehicle", self.vehicle.clone()),
            ("limits", limits),
            ("fleet_soil", fleet_soil),
            ("soil_filter", self.soil_filter.clone()),
            ("precision", self.precision.as_str().to_string()),
            ("machine", self.machine.clone()),
            ("clock_zero_unix_ns", self.clock_zero_unix_ns.to_string()),
            ("run", self.run.clone()),
            ("part", part.to_string()),
        ];
        pairs.into_iter().map(|(key, value)| (key.to_string(), value)).collect()
    }

    /// Reads the metadata of a part: header and part number.
    ///
    /// # Errors
    /// `RecordingError::Unusable` naming the key at fault, or the layout where this program reads another one.
    pub(crate) fn of_metadata(path: &Path, metadata: &BTreeMap<String, String>) -> Result<(Self, u32), RecordingError> {
        let schema = metadata.get("schema").map_or("", String::as_str);
        if schema != SCHEMA {
            let by = metadata.get("program").map_or("an unknown program", String::as_str);
            let reason =
                format!("is a recording of layout `{schema}` by {by}; this program reads `{SCHEMA}`: use a matching version of nesam");
            return Err(RecordingError::unusable(path, reason));
        }
        let text = |key: &str| {
            let missing = || RecordingError::unusable(path, format!("the description of the run has no `{key}`; the file is damaged"));
            metadata.get(key).cloned().ok_or_else(missing)
        };
        let wrong = |key: &str| RecordingError::unusable(path, format!("`{key}` in the description of the run is not readable"));
        let limits_text = text("limits")?;
        let mut limits: Limits = serde_json::from_str(&limits_text).map_err(|_| wrong("limits"))?;
        // Recordings from before there was a limit for one vehicle had none.
        if !limits_text.contains("\"sessions_per_vehicle_max\"") {
            limits.sessions_per_vehicle_max = limits.sessions_max;
        }
        let fleet_soil: FleetSoilConfig = serde_json::from_str(&text("fleet_soil")?).map_err(|_| wrong("fleet_soil"))?;
        let header = Self {
            program: text("program")?,
            bundle: text("bundle")?,
            bundle_hash: text("bundle_hash")?,
            vehicle: text("vehicle")?,
            limits,
            fleet_soil,
            soil_filter: text("soil_filter")?,
            // Recordings from before there was a choice are in f32.
            precision: match metadata.get("precision") {
                Some(name) => Precision::named(name).ok_or_else(|| wrong("precision"))?,
                None => Precision::F32,
            },
            machine: text("machine")?,
            clock_zero_unix_ns: text("clock_zero_unix_ns")?.parse().map_err(|_| wrong("clock_zero_unix_ns"))?,
            run: text("run")?,
        };
        let part = text("part")?.parse().map_err(|_| wrong("part"))?;
        Ok((header, part))
    }
}

/// Seconds since 1970 as `20261121T193512Z` (proleptic Gregorian calendar, no leap seconds).
pub(crate) fn utc(unix_s: u64) -> String {
    let leap = |year: u64| year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
    let (mut days, second) = (unix_s / 86_400, unix_s % 86_400);
    let mut year = 1970;
    while days >= 365 + u64::from(leap(year)) {
        days -= 365 + u64::from(leap(year));
        year += 1;
    }
    let lengths = [31, 28 + u64::from(leap(year)), 31, 30, 31, 30, 31, 31, 30, 31, 30, 31];
    let mut month = 0;
    while days >= lengths[month] {
        days -= lengths[month];
        month += 1;
    }
    format!("{year:04}{:02}{:02}T{:02}{:02}{:02}Z", month + 1, days + 1, second / 3600, second / 60 % 60, second % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_dates_of_unix_time() {
        for (unix_s, expected) in [
            (0, "19700101T000000Z"),
            (951_782_400, "20000229T000000Z"),
            (1_234_567_890, "20090213T233130Z"),
            (1_735_689_599, "20241231T235959Z"),
            (4_107_542_400, "21000301T000000Z"),
        ] {
            assert_eq!(utc(unix_s), expected);
        }
    }

    #[test]
    fn property_header_round_trip_and_refusals() {
        let header = RecordingHeader {
            program: RecordingHeader::this_program(),
            bundle: "b".into(),
            bundle_hash: "h".into(),
            vehicle: "v".into(),
            limits: Limits::default(),
            fleet_soil: FleetSoilConfig::default(),
            soil_filter: String::new(),
            precision: Precision::bf16_here().unwrap_or_default(),
            machine: RecordingHeader::this_machine(),
            clock_zero_unix_ns: 7,
            run: "r".into(),
        };
        let path = Path::new("x.mcap");
        let metadata = header.to_metadata(3);
        assert_eq!(RecordingHeader::of_metadata(path, &metadata).unwrap(), (header, 3));
        for key in metadata.keys().filter(|key| *key != "precision") {
            let mut without = metadata.clone();
            without.remove(key);
            assert!(RecordingHeader::of_metadata(path, &without).is_err(), "{key}");
        }
        let mut older = metadata.clone();
        older.remove("precision");
        assert_eq!(RecordingHeader::of_metadata(path, &older).unwrap().0.precision, Precision::F32);
        let limits = older["limits"].replace("\"sessions_per_vehicle_max\":32,", "");
        older.insert("limits".into(), limits);
        assert_eq!(RecordingHeader::of_metadata(path, &older).unwrap().0.limits.sessions_per_vehicle_max, 1024);
        older.insert("precision".into(), "f16".into());
        assert!(RecordingHeader::of_metadata(path, &older).unwrap_err().to_string().contains("precision"));
        let mut newer = metadata.clone();
        newer.insert("schema".into(), "nesam.recording/9".into());
        let message = RecordingHeader::of_metadata(path, &newer).unwrap_err().to_string();
        assert!(message.contains("nesam.recording/9") && message.contains(SCHEMA), "{message}");
    }
}
