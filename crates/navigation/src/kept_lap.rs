//! A lap in a file of its own, from which a later command takes it.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::score::Run;

/// A lap with the settings that it was driven with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct KeptLap {
    /// Settings of the lap.
    pub settings: Value,
    /// What was driven.
    pub run: Run,
}

impl KeptLap {
    /// The file.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("numbers and texts serialise; this is a bug")
    }

    /// Reads a file.
    ///
    /// # Errors
    /// What is wrong with it, and where.
    pub fn from_json(bytes: &[u8]) -> Result<Self, String> {
        serde_json::from_slice(bytes).map_err(|error| error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::score::tests::run;

    /// Goal: a report of laps that were read back is that of the laps as they were driven, byte for byte. Method: numbers whose decimals a fast reading takes for a
    /// neighbour, among them 0.9573016465330382, in a lap and in its settings.
    #[test]
    fn property_a_lap_is_read_back_to_the_last_bit() {
        let numbers: Vec<f64> = (1..500).map(|i| (f64::from(i) * 0.731).sin().abs() * 40.0).chain([0.957_301_646_533_038_2]).collect();
        for value in numbers {
            let mut run = run("fixed", "w35", 0, 1, value, true);
            run.lap.path = vec![[value, -value]];
            let kept = KeptLap { settings: serde_json::json!({ "speed_m_s": value }), run };
            let read = KeptLap::from_json(kept.to_json().as_bytes()).unwrap();
            assert_eq!(read.run.lap.hausdorff_m.to_bits(), value.to_bits(), "{value}");
            assert_eq!(read, kept, "{value}");
        }
    }
}
