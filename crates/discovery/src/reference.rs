//! What a diagnosis must know of the model's usual errors; a bundle carries it as `reference.json`.
//!
//! It holds the statistics of drives that training never saw. Their scatter is the yardstick, and random groups of them, judged by the others, give
//! null groups: the largest evidence of a group of as many drives as a set has is the family-wise threshold.

use nalgebra::{DMatrix, DVector};
use nesam_evaluation::quantile_sorted;
use nesam_physics::{SoilCorrection, Vehicle};
use rand::SeedableRng;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::candidates::{CATALOGUE, COLUMNS, Candidate};
use crate::channels::{CHANNELS, Row};
use crate::error::DiscoveryError;
use crate::expectation::{Expectation, mean, mean_signature};
use crate::features::{FEATURES, Stepping, names, prepare, segment_scale, usable};
use crate::observe::ObservedDrive;

const SCHEMA: &str = "nesam.reference/2";
/// Random groups of null drives.
const NULL_GROUPS: usize = 1000;
/// Fewest drives of a reference.
pub const DRIVES_MIN: usize = 8;
/// Family-wise false-alarm rate of the evidence.
const FALSE_ALARM: f64 = 0.05;
/// Evidence below which nothing is claimed, whatever few null drives say: null groups of some thirty drives overlap, so their tail is known
/// roughly, and an effect worth adding stands far above (chosen).
const THRESHOLD_FLOOR: f64 = 4.0;
/// How far beyond the 99 % quantile of null groups the distance of a group must be before it counts as different without a known cause (chosen).
const DISTANCE_MARGIN: f64 = 1.5;

/// A drive without an effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NullDrive {
    /// Trajectory id.
    pub trajectory: String,
    /// Its statistics.
    pub statistics: Vec<f64>,
}

/// The reference statistics of a bundle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reference {
    /// Always `nesam.reference/2`.
    pub schema: String,
    /// Version of the catalogue behind the signatures.
    pub catalogue: String,
    /// Hash of the data behind it.
    pub data_hash: String,
    /// Names of the statistics.
    pub names: Vec<String>,
    /// Statistics that every drive of the reference has.
    pub usable: Vec<bool>,
    /// Robust standard deviation of one segment, by channel.
    pub scale: Vec<f64>,
    /// Mean shift of the statistics by each column of the linear catalogue.
    pub signature: Vec<Vec<f64>>,
    /// Null drives.
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
    /// Squared distance per statistic beyond which a group differs, whatever the cause.
    pub distance: f64,
}

impl Reference {
    /// Measures the reference on observed drives that training never saw.
    ///
    /// # Errors
    /// `DiscoveryError::Drives` with fewer than 8 drives.
    pub fn measure(vehicle: &Vehicle, stepping: Stepping, drives: &[ObservedDrive], data_hash: &str) -> Result<Self, DiscoveryError> {
        if drives.len() < DRIVES_MIN {
            return Err(DiscoveryError::Drives {
                reason: format!("a reference needs at least {DRIVES_MIN} drives, there are {}", drives.len()),
            });
        }
        let model = stepping.model(vehicle);
        let rows: Vec<Vec<Row>> = drives.iter().map(|d| d.deviations(&model, &SoilCorrection::NONE)).collect();
        let scale = segment_scale(&rows);
        let prepared: Vec<_> = drives.par_iter().map(|d| prepare(&scale, vehicle, stepping, d)).collect();
        let signature = mean_signature(prepared.iter().map(|p| &p.signature));
        let available = core::array::from_fn(|c| drives.iter().all(|d| d.available[c]));
        let numbers = |v: &DVector<f64>| v.iter().copied().collect();
        Ok(Self {
            schema: SCHEMA.into(),
            catalogue: CATALOGUE.into(),
            data_hash: data_hash.into(),
            names: names(),
            usable: usable(&available).to_vec(),
            scale: scale.to_vec(),
            signature: signature.row_iter().map(|r| r.iter().copied().collect()).collect(),
            drives: drives
                .iter()
                .zip(&prepared)
                .map(|(d, p)| NullDrive { trajectory: d.id.clone(), statistics: numbers(&p.statistics) })
                .collect(),
        })
    }

    /// Reads the text of `reference.json`.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` when the text is not of this schema or catalogue, or has the wrong size.
    pub fn from_json(text: &str) -> Result<Self, DiscoveryError> {
        let fail = |reason: String| DiscoveryError::Reference { reason };
        let head: Head = serde_json::from_str(text).map_err(|e| fail(e.to_string()))?;
        if head.schema != SCHEMA || head.catalogue != CATALOGUE {
            let found = format!("{} with catalogue {}", head.schema, head.catalogue);
            return Err(fail(format!(
                "is {found}, this program needs {SCHEMA} with catalogue {CATALOGUE}; run `nesam diagnose --make-reference`"
            )));
        }
        let read: Self = serde_json::from_str(text).map_err(|e| fail(e.to_string()))?;
        let sized = read.usable.len() == FEATURES
            && read.scale.len() == CHANNELS
            && read.signature.len() == COLUMNS
            && read.signature.iter().chain(read.drives.iter().map(|d| &d.statistics)).all(|v| v.len() == FEATURES);
        if !sized || read.drives.len() < DRIVES_MIN {
            return Err(fail("has arrays of another size; run `nesam diagnose --make-reference`".into()));
        }
        Ok(read)
    }

    /// The text of `reference.json`.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("plain numbers always serialise; this is a bug") + "\n"
    }

    /// Robust standard deviation of one segment, by channel.
    pub fn segment_scale(&self) -> Row {
        core::array::from_fn(|c| self.scale[c])
    }

    /// Statistics that the reference and drives with these channels have.
    pub fn usable(&self, available: &[bool; CHANNELS]) -> [bool; FEATURES] {
        let theirs = usable(available);
        core::array::from_fn(|f| theirs[f] && self.usable[f])
    }

    /// What a group of `n` drives without an effect is expected to say.
    pub fn expectation(&self, usable: &[bool; FEATURES], n: usize) -> Option<Expectation> {
        let nulls = self.statistics();
        Expectation::new(&nulls.iter().collect::<Vec<_>>(), usable, n)
    }

    /// Null distribution for groups of `n` drives, drawn with a fixed seed, each judged by the drives that are not in it; `None` with fewer than 2n drives.
    pub fn null_groups(&self, usable: &[bool; FEATURES], n: usize) -> Option<NullGroups> {
        let nulls = self.statistics();
        let total = nulls.len();
        if n == 0 || total < 2 * n {
            return None;
        }
        let signature = DMatrix::from_fn(COLUMNS, FEATURES, |i, j| self.signature[i][j]);
        let mut rng = ChaCha8Rng::seed_from_u64(n as u64);
        let members: Vec<Vec<usize>> = (0..NULL_GROUPS).map(|_| sample(&mut rng, total, n).into_vec()).collect();
        let groups: Vec<(Vec<f64>, f64)> = members
            .par_iter()
            .map(|inside| {
                let others: Vec<&DVector<f64>> = (0..total).filter(|d| !inside.contains(d)).map(|d| &nulls[d]).collect();
                let strength = Expectation::new(&others, usable, n)
                    .map(|expectation| expectation.strength(&mean(inside.iter().map(|d| &nulls[*d])), &signature))?;
                Some((strength.z, strength.distance))
            })
            .collect::<Option<_>>()?;
        let spread: Vec<f64> = (0..Candidate::ALL.len())
            .map(|e| (groups.iter().map(|(z, _)| z[e] * z[e]).sum::<f64>() / groups.len() as f64).sqrt().max(1.0))
            .collect();
        let mut largest: Vec<f64> = groups.iter().map(|(z, _)| z.iter().zip(&spread).map(|(z, s)| z / s).fold(0.0, f64::max)).collect();
        largest.sort_by(f64::total_cmp);
        let mut distances: Vec<f64> = groups.iter().map(|(_, d)| *d).collect();
        distances.sort_by(f64::total_cmp);
        let threshold = quantile_sorted(&largest, 1.0 - FALSE_ALARM).max(THRESHOLD_FLOOR);
        Some(NullGroups { spread, largest, threshold, distance: DISTANCE_MARGIN * quantile_sorted(&distances, 0.99) })
    }

    fn statistics(&self) -> Vec<DVector<f64>> {
        self.drives.iter().map(|d| DVector::from_column_slice(&d.statistics)).collect()
    }
}

/// Enough of the file to say that it is an old one.
#[derive(Deserialize)]
struct Head {
    schema: String,
    catalogue: String,
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
