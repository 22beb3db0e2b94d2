//! What a diagnosis must know of the model's usual errors; a bundle carries it as `reference.json`.
//!
//! It holds the scores of drives that training never saw, and the metric measured on them. Their scatter is the yardstick, and random groups of them,
//! judged by the others, give null groups: the largest evidence of a group of as many drives as a set has is the family-wise threshold.

pub(crate) mod drives;
pub(crate) mod own_reference;
pub(crate) mod tail;
pub(crate) mod whiteness;

use nalgebra::{DMatrix, DVector};
use nesam_evaluation::quantile_sorted;
use nesam_model::{effects_from_toml, effects_to_toml};
use nesam_physics::effects::{Effect, ScheduledEffect, Written};
use rand::SeedableRng;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::candidates::bend::{self, Bend};
use crate::candidates::{Candidate, catalogue};
use crate::error::DiscoveryError;
use crate::observe::channels::{self, CHANNELS};
use crate::observe::condense::{Condensed, believed_within, bend_column, column_names, condense, level_column};
use crate::observe::metric::Metric;
use crate::observe::{Bench, ObservedDrive, available_in_all};
use crate::reference::drives::Segmented;
use crate::reference::whiteness::{Succession, Whiteness, asked};
use crate::select::evidence::{Group, Nulls};

const SCHEMA: &str = "nesam.reference/7";
/// Random groups of null drives.
const NULL_GROUPS: usize = 1000;
/// Fewest drives of a reference.
pub const DRIVES_MIN: usize = 8;
/// Family-wise false-alarm rate of the evidence.
const FALSE_ALARM: f64 = 0.05;
/// Evidence below which nothing is claimed, whatever few null drives say: null groups of some thirty drives overlap, so their tail is known
/// roughly, and an effect worth adding stands far above (chosen).
const THRESHOLD_FLOOR: f64 = 4.0;

/// A drive without an effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NullDrive {
    /// Trajectory id.
    pub trajectory: String,
    /// Score of every column.
    pub score: Vec<f32>,
    /// Information matrix of the columns, lower half by rows.
    pub information: Vec<f32>,
    /// How each compared channel that is asked for whiteness goes on from segment to segment.
    pub successions: Vec<Succession>,
}

impl NullDrive {
    fn of(trajectory: &str, condensed: &Condensed, successions: Vec<Succession>) -> Self {
        Self {
            trajectory: trajectory.into(),
            score: condensed.score.iter().map(|v| *v as f32).collect(),
            information: lower(&condensed.information).into_iter().map(|v| v as f32).collect(),
            successions,
        }
    }
}

/// The reference of a bundle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reference {
    /// Always `nesam.reference/7`.
    pub schema: String,
    /// Hash of the data behind it.
    pub data_hash: String,
    /// Names of the channels that are compared.
    pub channels: Vec<String>,
    /// Hypotheses beside the catalogue: written effects, as the text of an `effects.toml`; empty without any.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub hypotheses: String,
    /// Names of the columns: those of the catalogue, of the written hypotheses, then the level of each channel and the bends of actuators and sensors.
    pub columns: Vec<String>,
    /// Usual level of each compared channel.
    pub centre: Vec<f64>,
    /// Covariance of a segment within its drive, lower half by rows.
    pub within: Vec<f64>,
    /// Share of what segments say within a drive that is believed against its level.
    pub within_believed: f64,
    /// Covariance of a drive's level, lower half by rows.
    pub between: Vec<f64>,
    /// Null drives.
    pub drives: Vec<NullDrive>,
}

/// Null distribution of the evidence of groups of n drives.
#[derive(Clone, Debug)]
pub struct NullGroups {
    /// Factor by which the null evidence of each hypothesis, then of each channel's level and of each bend, exceeds a standard normal deviate (at least 1).
    pub spread: Vec<f64>,
    /// Largest spread-corrected evidence of each group, ascending.
    pub largest: Vec<f64>,
    /// Family-wise threshold on the spread-corrected evidence.
    pub threshold: f64,
    /// Smallest probability that as few drives show, however many groups were drawn.
    least: f64,
    /// Groups beside those drawn that count: what is judged, unless it is among them.
    beside: usize,
}

impl Reference {
    /// Measures the reference on observed drives that training never saw, for the hypotheses of the bench; `done` is called after each drive.
    ///
    /// # Errors
    /// `DiscoveryError::Drives` with fewer than 8 drives, or drives whose deviations have no scatter.
    pub fn measure(
        bench: &Bench<'_>,
        drives: &[ObservedDrive],
        data_hash: &str,
        done: &(dyn Fn(usize) + Sync),
    ) -> Result<Self, DiscoveryError> {
        Self::of(bench, drives, &Segmented::of(bench, drives, done), data_hash)
    }

    /// The same of drives whose segments are known.
    ///
    /// # Errors
    /// As [`Reference::measure`].
    pub fn of(bench: &Bench<'_>, drives: &[ObservedDrive], segmented: &Segmented, data_hash: &str) -> Result<Self, DiscoveryError> {
        if drives.len() < DRIVES_MIN {
            return Err(DiscoveryError::Drives {
                reason: format!("a reference needs at least {DRIVES_MIN} drives, there are {}", drives.len()),
            });
        }
        let (metric, condensed) = scored(segmented, &available_in_all(drives))?;
        let nulls = drives.iter().zip(&segmented.rows).zip(condensed).map(|((drive, rows), condensed)| {
            let successions = asked_of(&metric.channels).map(|c| Succession::of(drive, &[], rows, c)).collect();
            NullDrive::of(&drive.id, &condensed, successions)
        });
        let empty = Self {
            schema: SCHEMA.into(),
            data_hash: data_hash.into(),
            channels: Vec::new(),
            hypotheses: text_of(bench.catalogue),
            columns: column_names(bench.catalogue),
            centre: Vec::new(),
            within: Vec::new(),
            within_believed: 1.0,
            between: Vec::new(),
            drives: Vec::new(),
        };
        Ok(empty.with(nulls.collect(), &metric))
    }

    /// The same measured again in the channels that are available, on what its drives are in `segmented`.
    ///
    /// # Errors
    /// `DiscoveryError::Drives` where no channel is left or the deviations have no scatter.
    pub fn over(&self, segmented: &Segmented, available: &[bool; CHANNELS]) -> Result<Self, DiscoveryError> {
        let compared = self.compared()?;
        let (metric, condensed) = scored(segmented, &core::array::from_fn(|c| available[c] && compared.contains(&c)))?;
        let nulls = self.drives.iter().zip(condensed).map(|(null, condensed)| {
            let known = asked_of(&compared).zip(&null.successions).filter(|(c, _)| available[*c]);
            NullDrive::of(&null.trajectory, &condensed, known.map(|(_, own)| *own).collect())
        });
        Ok(self.clone().with(nulls.collect(), &metric))
    }

    fn with(self, drives: Vec<NullDrive>, metric: &Metric) -> Self {
        Self {
            channels: metric.channels.iter().map(|c| channels::name(*c)).collect(),
            centre: metric.centre.iter().copied().collect(),
            within: lower(&metric.within),
            within_believed: metric.within_believed,
            between: lower(&metric.between),
            drives,
            ..self
        }
    }

    /// Reads the text of `reference.json`.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` when the text is not of this schema or catalogue, or has the wrong size.
    pub fn from_json(text: &str) -> Result<Self, DiscoveryError> {
        let fail = |reason: String| DiscoveryError::Reference { reason };
        let head: Head = serde_json::from_str(text).map_err(|e| fail(e.to_string()))?;
        if head.schema != SCHEMA {
            return Err(fail(format!("is {}, this program needs {SCHEMA}; run `nesam diagnose --make-reference`", head.schema)));
        }
        let read: Self = serde_json::from_str(text).map_err(|e| fail(e.to_string()))?;
        if read.columns != column_names(&read.catalogue()?) {
            return Err(fail("was measured with another catalogue of effects; run `nesam diagnose --make-reference`".into()));
        }
        let (columns, channels) = (read.columns.len(), read.channels.len());
        let half = |n: usize| n * (n + 1) / 2;
        let sized = read.centre.len() == channels
            && read.within.len() == half(channels)
            && read.between.len() == half(channels)
            && read.drives.iter().all(|d| d.score.len() == columns && d.information.len() == half(columns))
            && read.compared().is_ok_and(|compared| read.drives.iter().all(|d| d.successions.len() == asked_of(&compared).count()));
        if !sized || read.drives.len() < DRIVES_MIN {
            return Err(fail("has arrays of another size; run `nesam diagnose --make-reference`".into()));
        }
        if !(read.within_believed > 0.0 && read.within_believed <= 1.0) {
            return Err(fail(format!("believes {} of what varies within a drive, not a share above 0 and up to 1", read.within_believed)));
        }
        Ok(read)
    }

    /// All hypotheses that it was measured for.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` when what is written beside the catalogue cannot be read.
    pub fn catalogue(&self) -> Result<Vec<Candidate>, DiscoveryError> {
        let effects = effects_from_toml(&self.hypotheses).map_err(|reason| DiscoveryError::Reference { reason })?;
        Ok(catalogue(&effects.iter().filter_map(|e| e.effect.written()).collect::<Vec<Written>>()))
    }

    /// The text of `reference.json`.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("plain numbers always serialise; this is a bug") + "\n"
    }

    /// The metric.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` when a channel is unknown or a covariance is not definite; `Drives` when a drive lacks a compared channel.
    pub fn metric(&self, available: &[bool; CHANNELS]) -> Result<Metric, DiscoveryError> {
        let fail = |reason: &str| DiscoveryError::Reference { reason: reason.into() };
        let channels = self.compared()?;
        if let Some(missing) = channels.iter().find(|c| !available[**c]) {
            let reason = format!("the reference compares {}, which a drive does not measure", channels::name(*missing));
            return Err(DiscoveryError::Drives { reason });
        }
        let size = channels.len();
        Metric::new(channels, DVector::from_column_slice(&self.centre), symmetric(&self.within, size), symmetric(&self.between, size))
            .map(|metric| metric.believing(self.within_believed))
            .ok_or_else(|| fail("has a covariance that is not definite"))
    }

    /// How channels go on from segment to segment in the null drives.
    pub(crate) fn whiteness(&self) -> Whiteness {
        let drives: Vec<&[Succession]> = self.drives.iter().map(|d| d.successions.as_slice()).collect();
        Whiteness::of(asked_of(&self.compared().unwrap_or_default()), &drives)
    }

    /// Channels that are compared.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` where one is not known.
    pub(crate) fn compared(&self) -> Result<Vec<usize>, DiscoveryError> {
        let known = |name: &String| (0..CHANNELS).find(|c| channels::name(*c) == *name);
        let unknown = || DiscoveryError::Reference { reason: "names a channel that this program does not know".into() };
        self.channels.iter().map(known).collect::<Option<_>>().ok_or_else(unknown)
    }

    /// Scores of the null drives.
    pub fn condensed(&self) -> Vec<Condensed> {
        let size = self.columns.len();
        self.drives
            .iter()
            .map(|d| Condensed {
                score: DVector::from_iterator(size, d.score.iter().map(|v| f64::from(*v))),
                information: symmetric(&d.information.iter().map(|v| f64::from(*v)).collect::<Vec<_>>(), size),
                square: 0.0,
                soil_score: DVector::zeros(0),
                soil_information: DMatrix::zeros(0, 0),
            })
            .collect()
    }
}

/// The metric of drives without an effect in some channels, and what each of them says in it.
fn scored(segmented: &Segmented, available: &[bool; CHANNELS]) -> Result<(Metric, Vec<Condensed>), DiscoveryError> {
    if available.iter().all(|has| !has) {
        return Err(DiscoveryError::Drives { reason: "these drives measure nothing that the reference compares".into() });
    }
    let metric = Metric::measure(&segmented.rows, available)
        .ok_or_else(|| DiscoveryError::Drives { reason: "the deviations of these drives have no scatter".into() })?;
    let within_believed = believed_within(&metric, segmented.drives());
    let metric = metric.believing(within_believed);
    let condensed = segmented.drives().map(|(rows, signatures)| condense(&metric, rows, signatures)).collect();
    Ok((metric, condensed))
}

/// Evidence of every hypothesis, then of the level of every compared channel and of each bend, with nothing fitted.
pub fn all_evidence(group: &Group, catalogue: &[Candidate], channels: &[usize], bends: &[Bend]) -> Vec<f64> {
    let hypotheses = catalogue.iter().map(|c| {
        let found = group.remainder(&[], &c.columns());
        if c.positive() && found.shares[0] <= 0.0 { 0.0 } else { found.z }
    });
    let nameless = channels.iter().map(|c| level_column(catalogue, *c)).chain(bends.iter().map(|bend| bend_column(catalogue, *bend)));
    hypotheses.chain(nameless.map(|column| group.remainder(&[], &[column]).z)).collect()
}

impl NullGroups {
    /// Null distribution for groups of `n` drives, drawn with a fixed seed, each judged by the drives that are not in it; `None` with fewer than two drives.
    ///
    /// A group takes half of the drives at most. Groups of more are read off those: a drive more in thirty raises the variance of the null evidence by a thirtieth,
    /// because the centre that the group is held against is known by the drives of the reference alone.
    pub fn draw(nulls: &[Condensed], catalogue: &[Candidate], channels: &[usize], n: usize) -> Option<Self> {
        let total = nulls.len();
        let size = n.min(total / 2);
        if size == 0 {
            return None;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(size as u64);
        let members: Vec<Vec<usize>> = (0..NULL_GROUPS).map(|_| sample(&mut rng, total, size).into_vec()).collect();
        let groups: Vec<Vec<f64>> = members
            .par_iter()
            .map(|inside| {
                let others: Vec<&Condensed> = (0..total).filter(|d| !inside.contains(d)).map(|d| &nulls[d]).collect();
                let group = Nulls::new(&others)?.group(inside.iter().map(|d| &nulls[*d]));
                Some(all_evidence(&group, catalogue, channels, &bend::asked_of(channels)))
            })
            .collect::<Option<_>>()?;
        let mut drawn = Self::of(groups);
        let wider = (1.0 + (n - size) as f64 / total as f64).sqrt();
        drawn.spread.iter_mut().for_each(|spread| *spread *= wider);
        Some(drawn)
    }

    /// From the evidence of every hypothesis and level in each of some groups.
    pub(crate) fn of(groups: Vec<Vec<f64>>) -> Self {
        let count = groups.first().map_or(0, Vec::len);
        let spread: Vec<f64> =
            (0..count).map(|e| (groups.iter().map(|z| z[e] * z[e]).sum::<f64>() / groups.len() as f64).sqrt().max(1.0)).collect();
        let mut largest: Vec<f64> = groups.iter().map(|z| z.iter().zip(&spread).map(|(z, s)| z / s).fold(0.0, f64::max)).collect();
        largest.sort_by(f64::total_cmp);
        let threshold = quantile_sorted(&largest, 1.0 - FALSE_ALARM).max(THRESHOLD_FLOOR);
        Self { threshold, spread, largest, least: 0.0, beside: 1 }
    }

    /// Share of null groups whose largest evidence reaches this one, never below what can be shown.
    pub fn probability(&self, largest: f64) -> f64 {
        let above = self.largest.len() - self.largest.partition_point(|v| *v < largest);
        self.attainable().max((above + self.beside) as f64 / (self.largest.len() + self.beside) as f64)
    }

    /// The same where the groups are signs of drives, which of `drives` show no less than 2^-(drives - 1); where `all` signs are among them, so is what was measured.
    pub(crate) fn of_signs(self, drives: usize, all: bool) -> Self {
        Self { least: 0.5f64.powi(drives.saturating_sub(1) as i32), beside: usize::from(!all), ..self }
    }

    /// Smallest probability that the groups can show.
    pub fn attainable(&self) -> f64 {
        self.least.max(1.0 / (self.largest.len() + self.beside) as f64)
    }
}

/// Those of some channels that are asked for whiteness.
fn asked_of(channels: &[usize]) -> impl Iterator<Item = usize> {
    channels.iter().copied().filter(|channel| asked(*channel))
}

/// What is written beside the catalogue.
fn text_of(catalogue: &[Candidate]) -> String {
    let written: Vec<ScheduledEffect> = catalogue.iter().filter_map(Candidate::written).map(|w| Effect::Written(w).into()).collect();
    if written.is_empty() { String::new() } else { effects_to_toml(&written) }
}

/// Enough of the file to say that it is an old one.
#[derive(Deserialize)]
struct Head {
    schema: String,
}

fn lower(matrix: &DMatrix<f64>) -> Vec<f64> {
    (0..matrix.nrows()).flat_map(|i| (0..=i).map(move |j| (i, j))).map(|at| matrix[at]).collect()
}

fn symmetric(lower: &[f64], size: usize) -> DMatrix<f64> {
    DMatrix::from_fn(size, size, |i, j| {
        let (i, j) = (i.max(j), i.min(j));
        lower[i * (i + 1) / 2 + j]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_distr::{Distribution, StandardNormal};

    /// Goal: a set of more drives than half of the reference has a family-wise threshold and a probability. Method: thirty null drives of one level with scores of
    /// unit scatter; groups of 5, 15 and 27. What is drawn for 27 is what is drawn for 15, its spread wider by the root of 1 + 12 / 30.
    #[test]
    fn analytic_large_groups_have_a_null_distribution_too() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut drive = || Condensed {
            score: DVector::from_element(1, StandardNormal.sample(&mut rng)),
            information: DMatrix::identity(1, 1),
            square: 0.0,
            soil_score: DVector::zeros(0),
            soil_information: DMatrix::zeros(0, 0),
        };
        let nulls: Vec<Condensed> = (0..30).map(|_| drive()).collect();
        let of = |n: usize| NullGroups::draw(&nulls, &[], &[0], n).unwrap();
        let (few, half, most) = (of(5), of(15), of(27));
        assert!(few.threshold < 6.2 && most.threshold < 6.2, "{} {}", few.threshold, most.threshold);
        assert_eq!((most.threshold, &most.largest), (half.threshold, &half.largest));
        assert!((most.spread[0] / half.spread[0] - 1.4f64.sqrt()).abs() < 1e-12, "{} {}", most.spread[0], half.spread[0]);
        assert!(NullGroups::draw(&nulls[..1], &[], &[0], 1).is_none());
    }

    #[test]
    fn analytic_a_reference_that_makes_no_sense_is_refused_with_the_reason() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../deploy/bundles/hmmwv-nominal/reference.json");
        let shipped = std::fs::read_to_string(path).unwrap();
        let believed = Reference::from_json(&shipped).unwrap().within_believed;
        assert!(believed > 0.0 && believed < 1.0, "{believed}");
        let with = |key: &str, value: serde_json::Value| {
            let mut document: serde_json::Value = serde_json::from_str(&shipped).unwrap();
            document[key] = value;
            Reference::from_json(&document.to_string()).map(drop)
        };
        for (key, value, reason) in [
            ("within_believed", 0.0.into(), "believes 0 of what varies"),
            ("within_believed", 1.5.into(), "believes 1.5 of what varies"),
            ("within_believed", serde_json::Value::Null, "expected f64"),
            ("schema", "nesam.reference/3".into(), "is nesam.reference/3"),
            ("columns", serde_json::json!(["payload"]), "another catalogue"),
            ("centre", serde_json::json!([0.0]), "another size"),
            ("drives", serde_json::json!([]), "another size"),
        ] {
            let error = with(key, value).unwrap_err().to_string();
            assert!(error.contains(reason), "{key}: {error}");
        }
    }
}
