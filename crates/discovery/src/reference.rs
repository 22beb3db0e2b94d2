//! What a diagnosis must know of the model's usual errors; a bundle carries it as `reference.json`.
//!
//! It is measured on drives that training never saw: mean and scale of each channel by speed, colour, correlation between channels, how much whole
//! drives differ, and what each drive says of the catalogue although it has no effect. The last gives null groups: the largest |z| of
//! random groups of as many drives as a set has is the family-wise threshold.

use nalgebra::{DMatrix, DVector};
use nesam_evaluation::{median, quantile_sorted};
use nesam_physics::{SoilCorrection, Vehicle};
use rand::SeedableRng;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::candidates::{CATALOGUE, COLUMNS, Candidate};
use crate::channels::{self, CHANNELS, Row};
use crate::error::DiscoveryError;
use crate::normal::Normal;
use crate::observe::ObservedDrive;
use crate::scan::{Stepping, prepare, strength};
use crate::whitening::{CUT_OFF, Whitening};

const SCHEMA: &str = "nesam.reference/1";
/// Speed bins.
pub const SPEED_BINS: usize = 3;
/// Random groups of null drives.
const NULL_GROUPS: usize = 1000;
/// Fewest drives of a reference.
pub const DRIVES_MIN: usize = 8;
/// Family-wise false-alarm rate.
const FALSE_ALARM: f64 = 0.05;
/// Threshold on max|z| below which nothing is claimed, whatever few null drives say: 5 % family-wise for 28 candidates.
const THRESHOLD_FLOOR: f64 = 3.1;
/// Standard deviation of a normal variable per median distance from its median.
const NORMAL_PER_MEDIAN: f64 = 1.4826;
/// Share of the covariance that is moved to its diagonal, against too few drives.
const SHRINKAGE: f64 = 0.03;

/// Statistics of one channel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelStatistics {
    /// Name with unit.
    pub name: String,
    /// Measured in every drive of the reference.
    pub used: bool,
    /// Median deviation by speed bin.
    pub mean: [f64; SPEED_BINS],
    /// Robust standard deviation by speed bin.
    pub scale: [f64; SPEED_BINS],
    /// Correlation of consecutive segments (AR(1) coefficient) within a drive.
    pub colour: f64,
    /// Standard deviation between drives of the scaled deviation's mean.
    pub offset_sd: f64,
}

/// What a drive without an effect says of the catalogue.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NullDrive {
    /// Trajectory id.
    pub trajectory: String,
    /// Score of the linear catalogue.
    pub score: Vec<f64>,
    /// Its information, row by row.
    pub information: Vec<f64>,
    /// Misfit.
    pub misfit: f64,
    /// Numbers behind it.
    pub numbers: usize,
}

/// The reference statistics of a bundle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reference {
    /// Always `nesam.reference/1`.
    pub schema: String,
    /// Version of the catalogue behind the null scores.
    pub catalogue: String,
    /// Hash of the data behind it.
    pub data_hash: String,
    /// Upper ends of the lower speed bins, m/s.
    pub speed_edges_m_s: [f64; SPEED_BINS - 1],
    /// Channels.
    pub channels: Vec<ChannelStatistics>,
    /// Covariance of the scaled innovations over all channels.
    pub covariance: Vec<Vec<f64>>,
    /// Null scores.
    pub drives: Vec<NullDrive>,
}

/// Null distribution of the evidence of groups of n drives.
#[derive(Clone, Debug)]
pub struct NullGroups {
    /// Factor by which the null evidence of each hypothesis exceeds a standard normal deviate (at least 1).
    pub spread: Vec<f64>,
    /// Largest spread-corrected evidence of each group, ascending.
    pub largest: Vec<f64>,
    /// Family-wise threshold on the spread-corrected evidence.
    pub threshold: f64,
}

impl Reference {
    /// Measures the reference on observed drives that training never saw.
    ///
    /// # Errors
    /// `DiscoveryError::Drives` with fewer than 8 drives, `DiscoveryError::Reference` when the covariance is degenerate.
    pub fn measure(vehicle: &Vehicle, stepping: Stepping, drives: &[ObservedDrive], data_hash: &str) -> Result<Self, DiscoveryError> {
        if drives.len() < DRIVES_MIN {
            return Err(DiscoveryError::Drives {
                reason: format!("a reference needs at least {DRIVES_MIN} drives, there are {}", drives.len()),
            });
        }
        let model = stepping.model(vehicle);
        let rows: Vec<Vec<Row>> = drives.iter().map(|d| d.deviations(&model, &SoilCorrection::NONE)).collect();
        let mut reference = Self {
            schema: SCHEMA.into(),
            catalogue: CATALOGUE.into(),
            data_hash: data_hash.into(),
            speed_edges_m_s: speed_edges(drives),
            channels: Vec::new(),
            covariance: Vec::new(),
            drives: Vec::new(),
        };
        reference.channels = (0..CHANNELS).map(|c| reference.channel(c, drives, &rows)).collect();
        reference.covariance = reference.innovations(drives, &rows);
        let whitening = Whitening::new(&reference, &[true; CHANNELS])?;
        let scored: Vec<NullDrive> = drives
            .iter()
            .map(|drive| {
                let scores = prepare(&whitening, vehicle, stepping, drive).scores;
                NullDrive {
                    trajectory: drive.id.clone(),
                    score: scores.score.iter().copied().collect(),
                    information: scores.information.iter().copied().collect(),
                    misfit: scores.misfit,
                    numbers: scores.numbers,
                }
            })
            .collect();
        reference.drives = scored;
        Ok(reference)
    }

    /// Reads the text of `reference.json`.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` when the text is not of this schema or catalogue, or has the wrong size.
    pub fn from_json(text: &str) -> Result<Self, DiscoveryError> {
        let fail = |reason: String| DiscoveryError::Reference { reason };
        let read: Self = serde_json::from_str(text).map_err(|e| fail(e.to_string()))?;
        if read.schema != SCHEMA || read.catalogue != CATALOGUE {
            let found = format!("{} with catalogue {}", read.schema, read.catalogue);
            return Err(fail(format!(
                "is {found}, this program needs {SCHEMA} with catalogue {CATALOGUE}; run `nesam diagnose --make-reference`"
            )));
        }
        let square = read.covariance.len() == CHANNELS && read.covariance.iter().all(|r| r.len() == CHANNELS);
        let scores = read.drives.iter().all(|d| d.score.len() == COLUMNS && d.information.len() == COLUMNS * COLUMNS);
        if !square || read.channels.len() != CHANNELS || !scores {
            return Err(fail("has arrays of another size; run `nesam diagnose --make-reference`".into()));
        }
        Ok(read)
    }

    /// The text of `reference.json`.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("plain numbers always serialise; this is a bug") + "\n"
    }

    /// Speed bin of a forward speed.
    pub fn speed_bin(&self, speed_m_s: f64) -> usize {
        self.speed_edges_m_s.iter().filter(|edge| speed_m_s > **edge).count()
    }

    /// Null distribution for groups of `n` drives, drawn without replacement with a fixed seed; `None` with fewer than 2n drives.
    ///
    /// The reference is centred on its own drives, so a group of them is closer to the centre than new drives would be; the factor
    /// √((1/n + 1/N) / (1/n - 1/N)) undoes that.
    pub fn null_groups(&self, n: usize) -> Option<NullGroups> {
        let total = self.drives.len();
        if n == 0 || total < 2 * n {
            return None;
        }
        let (per, all) = (1.0 / n as f64, 1.0 / total as f64);
        let widening = ((per + all) / (per - all)).sqrt();
        let parts: Vec<Normal> = self.drives.iter().map(NullDrive::normal).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(n as u64);
        let groups: Vec<Vec<f64>> = (0..NULL_GROUPS)
            .map(|_| {
                let group = Normal::sum(sample(&mut rng, total, n).iter().map(|d| &parts[d])).expect("n is not zero; this is a bug");
                strength(&group).z.iter().map(|z| z * widening).collect()
            })
            .collect();
        let spread: Vec<f64> = (0..Candidate::ALL.len())
            .map(|e| (groups.iter().map(|g| g[e] * g[e]).sum::<f64>() / groups.len() as f64).sqrt().max(1.0))
            .collect();
        let mut largest: Vec<f64> = groups.iter().map(|g| g.iter().zip(&spread).map(|(z, s)| z / s).fold(0.0, f64::max)).collect();
        largest.sort_by(f64::total_cmp);
        let threshold = quantile_sorted(&largest, 1.0 - FALSE_ALARM).max(THRESHOLD_FLOOR);
        Some(NullGroups { spread, largest, threshold })
    }

    /// A deviation in standard deviations from what the reference usually does at that speed.
    pub fn scaled(&self, c: usize, drive: &ObservedDrive, segment: usize, row: &Row) -> f64 {
        let (channel, bin) = (&self.channels[c], self.speed_bin(drive.speed_m_s(segment)));
        (row[c] - channel.mean[bin]) / channel.scale[bin]
    }

    /// Centre, scale, colour and offset of one channel; centre and scale are robust (median, and median distance from it).
    fn channel(&self, c: usize, drives: &[ObservedDrive], rows: &[Vec<Row>]) -> ChannelStatistics {
        let used = drives.iter().all(|d| d.available[c]);
        let mut values: [Vec<f64>; SPEED_BINS] = Default::default();
        for (drive, rows) in drives.iter().zip(rows) {
            for (s, row) in rows.iter().enumerate() {
                values[self.speed_bin(drive.speed_m_s(s))].push(row[c]);
            }
        }
        let finite = |v: f64| if v.is_finite() { v } else { 0.0 };
        let mean: [f64; SPEED_BINS] = core::array::from_fn(|b| finite(median(&values[b])));
        let scale = core::array::from_fn(|b| {
            let distances: Vec<f64> = values[b].iter().map(|v| (v - mean[b]).abs()).collect();
            (NORMAL_PER_MEDIAN * finite(median(&distances))).max(1e-8)
        });
        let mut statistics = ChannelStatistics { name: channels::name(c), used, mean, scale, colour: 0.0, offset_sd: 0.0 };
        let scaled: Vec<Vec<f64>> = drives.iter().zip(rows).map(|(d, r)| self.cut(&statistics, c, d, r)).collect();
        let means: Vec<f64> = scaled.iter().map(|v| v.iter().sum::<f64>() / v.len() as f64).collect();
        let (mut square, mut product, mut count, mut within) = (0.0, 0.0, 0.0, 0.0);
        for ((drive, values), mean) in drives.iter().zip(&scaled).zip(&means) {
            for s in 0..values.len() {
                within += (values[s] - mean).powi(2);
                count += 1.0;
                if drive.follows(s) {
                    product += (values[s] - mean) * (values[s - 1] - mean);
                    square += 0.5 * ((values[s] - mean).powi(2) + (values[s - 1] - mean).powi(2));
                }
            }
        }
        let colour = (product / square.max(1e-12)).clamp(-0.5, 0.9);
        let n = drives.len() as f64;
        let between = means.iter().map(|m| m * m).sum::<f64>() / n - (means.iter().sum::<f64>() / n).powi(2);
        let by_chance = within / count * (1.0 + colour) / (1.0 - colour) / (count / n);
        statistics.colour = colour;
        statistics.offset_sd = (between * n / (n - 1.0) - by_chance).max(0.0).sqrt();
        statistics
    }

    /// Scaled deviations of a drive, cut off as the whitening does.
    fn cut(&self, statistics: &ChannelStatistics, c: usize, drive: &ObservedDrive, rows: &[Row]) -> Vec<f64> {
        let at = |(s, row): (usize, &Row)| {
            let bin = self.speed_bin(drive.speed_m_s(s));
            (row[c] - statistics.mean[bin]) / statistics.scale[bin]
        };
        let scaled: Vec<f64> = rows.iter().enumerate().map(at).collect();
        let middle = median(&scaled);
        scaled.into_iter().map(|v| middle + (v - middle).clamp(-CUT_OFF, CUT_OFF)).collect()
    }

    /// Covariance of the innovations within drives, slightly shrunk to its diagonal; 1 on the diagonal of unused channels.
    fn innovations(&self, drives: &[ObservedDrive], rows: &[Vec<Row>]) -> Vec<Vec<f64>> {
        let mut sum = DMatrix::<f64>::zeros(CHANNELS, CHANNELS);
        let mut count = 0.0;
        for (drive, rows) in drives.iter().zip(rows) {
            let scaled: Vec<Vec<f64>> = (0..CHANNELS).map(|c| self.cut(&self.channels[c], c, drive, rows)).collect();
            let means: Vec<f64> = scaled.iter().map(|v| v.iter().sum::<f64>() / v.len() as f64).collect();
            for s in (1..rows.len()).filter(|&s| drive.follows(s)) {
                let e =
                    DVector::from_fn(CHANNELS, |c, _| scaled[c][s] - means[c] - self.channels[c].colour * (scaled[c][s - 1] - means[c]));
                sum += &e * e.transpose();
                count += 1.0;
            }
        }
        let used = |c: usize| self.channels[c].used;
        (0..CHANNELS)
            .map(|i| {
                (0..CHANNELS)
                    .map(|j| match (i == j, used(i) && used(j)) {
                        (true, false) => 1.0,
                        (false, false) => 0.0,
                        (true, true) => (sum[(i, j)] / f64::max(count, 1.0)).max(1e-9),
                        (false, true) => (1.0 - SHRINKAGE) * sum[(i, j)] / f64::max(count, 1.0),
                    })
                    .collect()
            })
            .collect()
    }
}

impl NullDrive {
    fn normal(&self) -> Normal {
        Normal {
            information: DMatrix::from_column_slice(COLUMNS, COLUMNS, &self.information),
            score: DVector::from_column_slice(&self.score),
            misfit: self.misfit,
            numbers: self.numbers,
        }
    }
}

impl NullGroups {
    /// Share of null groups whose largest evidence reaches this one, never below 1 / (groups + 1).
    pub fn probability(&self, largest: f64) -> f64 {
        let above = self.largest.len() - self.largest.partition_point(|v| *v < largest);
        (above + 1) as f64 / (self.largest.len() + 1) as f64
    }

    /// Smallest probability that the groups can show.
    pub fn attainable(&self) -> f64 {
        1.0 / (self.largest.len() + 1) as f64
    }
}

/// Terciles of the speed at the starts of the segments.
fn speed_edges(drives: &[ObservedDrive]) -> [f64; SPEED_BINS - 1] {
    let mut speeds: Vec<f64> = drives.iter().flat_map(|d| (0..d.starts.len()).map(|s| d.speed_m_s(s))).collect();
    speeds.sort_by(f64::total_cmp);
    [1.0 / 3.0, 2.0 / 3.0].map(|q| quantile_sorted(&speeds, q))
}
