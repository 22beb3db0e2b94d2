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
        let mut kept: Self = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
        kept.run.lap = kept.run.lap.without_inventions();
        Ok(kept)
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
            assert_eq!(read.run.lap.hausdorff_m.unwrap().to_bits(), value.to_bits(), "{value}");
            assert_eq!(read, kept, "{value}");
        }
    }

    /// Goal: what an earlier version kept of a lap that never began is no figure. Method: its zeros and the place of its start, in a file as it was written then.
    #[test]
    fn regress_zeros_of_a_lap_that_never_began_are_not_read() {
        let mut kept = KeptLap { settings: Value::Null, run: run("fixed", "w36", 0, 1, 0.25, false) };
        (kept.run.lap.lean, kept.run.lap.time_s, kept.run.lap.roll_deg) = (Vec::new(), 0.0, Some(0.0));
        let mut written: Value = serde_json::from_str(&kept.to_json()).unwrap();
        for key in ["moved_over_told", "turn_correlation"] {
            written["run"]["lap"].as_object_mut().unwrap().remove(key);
        }
        let lap = KeptLap::from_json(written.to_string().as_bytes()).unwrap().run.lap;
        let figures = [lap.hausdorff_m, lap.hausdorff_whole_path_m, lap.off_path_mean_m, lap.roll_deg, lap.pitch_deg];
        assert!(figures == [None; 5] && lap.path.is_empty() && lap.end == "off_path", "{lap:?}");
    }
}
