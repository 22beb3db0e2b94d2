//! The drives behind a reference, segment by segment; a bundle carries them as `reference_drives.safetensors`.
//!
//! A drive that lacks a channel is compared in fewer, and one without velocities or a map is predicted from other states and on other ground. What is usual then is
//! measured again: on the same drives without an effect, looked at in the same way and in the same channels. A signature hardly hangs on the noise of a state, so there is
//! one for all ways of looking, and the deviations of each.

use half::f16;
use nesam_evaluation::DriveMaps;
use nesam_model::Predictor;
use nesam_physics::{SOIL_DIM, SoilCorrection};
use nesam_trajectories::Trajectory;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

use crate::candidates::bend::Driven;
use crate::candidates::column_count;
use crate::error::DiscoveryError;
use crate::observe::channels::{CHANNELS, Row};
use crate::observe::condense::{Signatures, signatures};
use crate::observe::lack::Lack;
use crate::observe::{Bench, ObservedDrive, observe_plain};
use crate::reference::Reference;

const FILE: &str = "reference_drives.safetensors";
const AGAIN: &str = "run `nesam diagnose --make-reference`";

/// Deviations of drives and how columns shift them, one row per segment each.
#[derive(Clone, Debug)]
pub struct Segmented {
    /// Deviations of each drive.
    pub rows: Vec<Vec<Row>>,
    /// Its signatures.
    pub signatures: Vec<Signatures>,
}

impl Segmented {
    /// Of observed drives; `done` is called after each.
    pub fn of(bench: &Bench<'_>, drives: &[ObservedDrive], done: &(dyn Fn(usize) + Sync)) -> Self {
        let rows = drives.iter().map(|d| d.deviations(bench, &[], &SoilCorrection::NONE)).collect();
        let told = |(count, drive): (usize, &ObservedDrive)| {
            let signatures = signatures(bench, drive);
            done(count + 1);
            signatures
        };
        Self { rows, signatures: drives.iter().enumerate().map(told).collect() }
    }

    /// Deviations and signatures of each drive.
    pub fn drives(&self) -> impl Iterator<Item = (&[Row], &Signatures)> {
        self.rows.iter().map(Vec::as_slice).zip(&self.signatures)
    }
}

/// Arrays by their names, as they are written.
#[derive(Debug, Default)]
pub struct ReferenceDrives {
    arrays: Vec<(String, Dtype, Vec<usize>, Vec<u8>)>,
}

impl ReferenceDrives {
    /// Looks at the drives of a reference in each way in which drives may lack more than they do; `segmented` is what they are as they are. `done` is called after each
    /// look at all of them.
    ///
    /// # Errors
    /// As [`observe_all`].
    pub fn measure(
        predictor: &Predictor,
        bench: &Bench<'_>,
        (drives, maps): (&[Trajectory], &DriveMaps),
        (reference, segmented): (&Reference, &Segmented),
        done: &dyn Fn(usize, usize),
    ) -> Result<Self, DiscoveryError> {
        let own = Lack::of(drives, maps);
        let looks: Vec<Lack> = own.and_more();
        let scale = Scale::of(reference)?;
        let mut written = Self::default();
        let mut starts: Vec<Vec<usize>> = Vec::new();
        for (count, lack) in looks.iter().enumerate() {
            let seen: Vec<Trajectory> = drives.iter().map(|drive| lack.seen(drive)).collect();
            let on: Vec<_> = maps.iter().map(|map| map.clone().filter(|_| lack.mapped())).collect();
            let observed = observe_plain(predictor, &seen, &on)?;
            if lack == &own {
                starts = observed.iter().map(|drive| drive.starts.clone()).collect();
            }
            for (mut drive, starts) in observed.into_iter().zip(&starts) {
                // Level ground is known everywhere.
                drive.starts.clone_from(starts);
                let rows = drive.deviations(bench, &[], &SoilCorrection::NONE);
                written.add_half(&rows_name(&drive.id, lack), vec![rows.len()], &scale, rows.iter());
            }
            done(count + 1, looks.len());
        }
        for (null, signatures) in reference.drives.iter().zip(&segmented.signatures) {
            let columns = || signatures.columns.iter().chain(&signatures.soil);
            let shape = vec![columns().count(), signatures.driven.len()];
            written.add_half(&signatures_name(&null.trajectory), shape, &scale, columns().flatten());
            let driven = signatures.driven.iter().flat_map(|d| d.to_array()).flat_map(|v| (v as f32).to_le_bytes()).collect();
            written.arrays.push((driven_name(&null.trajectory), Dtype::F32, vec![signatures.driven.len(), 4], driven));
        }
        Ok(written)
    }

    /// The bytes of the file.
    pub fn to_bytes(&self) -> Vec<u8> {
        let views = self.arrays.iter().map(|(name, dtype, shape, bytes)| {
            (name.as_str(), TensorView::new(*dtype, shape.clone(), bytes).expect("shape matches bytes; this is a bug"))
        });
        safetensors::serialize(views, None).expect("serialising plain arrays cannot fail; this is a bug")
    }

    /// Rows in standard deviations of each channel, which a half holds to 0.05 % (what is further off than 65504 of them stays there).
    fn add_half<'a>(&mut self, name: &str, mut shape: Vec<usize>, scale: &Scale, rows: impl Iterator<Item = &'a Row>) {
        let most = f64::from(f16::MAX);
        let half = |value: f64| f16::from_f64(if value.is_finite() { value.clamp(-most, most) } else { 0.0 }).to_le_bytes();
        let bytes = rows.flat_map(|row| scale.0.iter().flat_map(|(c, sd)| half(row[*c] / sd)).collect::<Vec<u8>>()).collect();
        shape.push(scale.0.len());
        self.arrays.push((name.into(), Dtype::F16, shape, bytes));
    }

    /// Reads what the drives of a reference are if they lack what is given beside what they lack themselves.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` when the bytes are not of the file, or lack an array of this reference.
    pub fn read(bytes: &[u8], reference: &Reference, lack: Lack) -> Result<Segmented, DiscoveryError> {
        let file = SafeTensors::deserialize(bytes).map_err(|e| fail(format!("is no readable safetensors file ({e})")))?;
        let known = |look: &Lack| reference.drives.iter().all(|null| file.tensor(&rows_name(&null.trajectory, look)).is_ok());
        let lack = lack.and_more().into_iter().find(known).ok_or_else(|| fail("has no drives that lack as much".into()))?;
        let scale = Scale::of(reference)?;
        let columns = column_count(&reference.catalogue()?);
        let mut segmented = Segmented { rows: Vec::new(), signatures: Vec::new() };
        for null in &reference.drives {
            let id = &null.trajectory;
            let driven = floats(&file, &driven_name(id), &[None, Some(4)])?;
            let segments = driven.len() / 4;
            let driven: Vec<Driven> = driven.as_chunks().0.iter().map(|four| Driven::from_array(*four)).collect();
            let rows = scale.rows(&file, &rows_name(id, &lack), &[Some(segments)])?;
            let mut all = scale.rows(&file, &signatures_name(id), &[Some(columns + SOIL_DIM), Some(segments)])?.into_iter();
            let mut take = |count: usize| (0..count).map(|_| all.by_ref().take(segments).collect()).collect::<Vec<Vec<Row>>>();
            let (own, soil) = (take(columns), take(SOIL_DIM));
            segmented.rows.push(rows);
            segmented.signatures.push(Signatures { columns: own, soil, driven, uncounted: Vec::new() });
        }
        Ok(segmented)
    }
}

/// The channels that are written, each with its standard deviation.
struct Scale(Vec<(usize, f64)>);

impl Scale {
    fn of(reference: &Reference) -> Result<Self, DiscoveryError> {
        let channels = reference.compared()?;
        let sd = |i: usize| reference.within[i * (i + 1) / 2 + i].sqrt().max(f64::MIN_POSITIVE);
        Ok(Self(channels.into_iter().enumerate().map(|(i, c)| (c, sd(i))).collect()))
    }

    /// Rows of an array; those of channels that are not written are zero.
    fn rows(&self, file: &SafeTensors<'_>, name: &str, shape: &[Option<usize>]) -> Result<Vec<Row>, DiscoveryError> {
        let shape: Vec<Option<usize>> = shape.iter().copied().chain([Some(self.0.len())]).collect();
        let values = floats(file, name, &shape)?;
        let row = |values: &[f64]| {
            let mut row: Row = [0.0; CHANNELS];
            self.0.iter().zip(values).for_each(|((c, sd), value)| row[*c] = value * sd);
            row
        };
        Ok(values.chunks_exact(self.0.len().max(1)).map(row).collect())
    }
}

fn floats(file: &SafeTensors<'_>, name: &str, shape: &[Option<usize>]) -> Result<Vec<f64>, DiscoveryError> {
    let array = file.tensor(name).map_err(|_| fail(format!("has no array `{name}`")))?;
    let fits =
        array.shape().len() == shape.len() && array.shape().iter().zip(shape).all(|(is, asked)| asked.is_none_or(|asked| *is == asked));
    let bytes = array.data();
    let values: Vec<f64> = match array.dtype() {
        Dtype::F16 => bytes.chunks_exact(2).map(|b| f64::from(f16::from_le_bytes([b[0], b[1]]))).collect(),
        Dtype::F32 => bytes.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]]))).collect(),
        other => return Err(fail(format!("has `{name}` as {other:?}"))),
    };
    if !fits || values.is_empty() || values.iter().any(|v| !v.is_finite()) {
        return Err(fail(format!("has an array `{name}` of another size or with what is no number")));
    }
    Ok(values)
}

fn fail(reason: String) -> DiscoveryError {
    DiscoveryError::ReferenceDrives { reason: format!("{FILE} {reason}; {AGAIN}") }
}

fn rows_name(id: &str, lack: &Lack) -> String {
    format!("{id}/rows{}", lack.suffix())
}

fn signatures_name(id: &str) -> String {
    format!("{id}/signatures")
}

fn driven_name(id: &str) -> String {
    format!("{id}/driven")
}
