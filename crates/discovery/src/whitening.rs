//! From deviations to numbers of unit variance without memory, by the statistics of the reference.

use nalgebra::{DMatrix, DVector};
use nesam_evaluation::median;

use crate::channels::{CHANNELS, Row};
use crate::error::DiscoveryError;
use crate::observe::ObservedDrive;
use crate::reference::Reference;

/// Standard deviations from a drive's median beyond which a deviation has no further say.
pub const CUT_OFF: f64 = 3.0;

/// Deviations are centred and scaled by speed, freed of their colour (AR(1) per channel) and of their correlation between channels.
#[derive(Clone, Debug)]
pub struct Whitening<'a> {
    reference: &'a Reference,
    /// Channels that are used.
    used: Vec<usize>,
    /// Inverse Cholesky factor of the innovations' covariance over the used channels.
    factor: DMatrix<f64>,
}

impl<'a> Whitening<'a> {
    /// Whitening over the channels that the reference has and all drives measure.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` when no channel is left or the covariance is not positive definite.
    pub fn new(reference: &'a Reference, available: &[bool; CHANNELS]) -> Result<Self, DiscoveryError> {
        let used: Vec<usize> = (0..CHANNELS).filter(|&c| available[c] && reference.channels[c].used).collect();
        let covariance = DMatrix::from_fn(used.len(), used.len(), |i, j| reference.covariance[used[i]][used[j]]);
        let fail = |reason: &str| DiscoveryError::Reference { reason: reason.into() };
        if used.is_empty() {
            return Err(fail("no channel of the reference is measured in this set"));
        }
        let cholesky = covariance.cholesky().ok_or_else(|| fail("the covariance is not positive definite; make the reference again"))?;
        let factor = cholesky.l().try_inverse().ok_or_else(|| fail("the covariance is singular; make the reference again"))?;
        Ok(Self { reference, used, factor })
    }

    /// Channels used.
    pub fn used(&self) -> &[usize] {
        &self.used
    }

    /// Numbers per drive.
    pub fn len(&self, drive: &ObservedDrive) -> usize {
        self.used.len() * drive.starts.len()
    }

    /// Deviations of the segments of a drive, centred on what the reference usually does at that speed.
    ///
    /// A wheel in the air or a stone under it makes single deviations many times larger than the rest; they are cut off at a few standard
    /// deviations from the drive's median, so that a lasting shift is kept whole and a single event has a bounded say (Huber 1964).
    pub fn residual(&self, drive: &ObservedDrive, rows: &[Row]) -> DVector<f64> {
        let middle = self.medians(drive, rows);
        self.filtered(drive, |s, c| {
            let value = self.reference.scaled(c, drive, s, &rows[s]);
            if self.reference.channels[c].used { middle[c] + (value - middle[c]).clamp(-CUT_OFF, CUT_OFF) } else { value }
        })
    }

    /// A derivative of the deviations, one row per segment; zero where the deviations `at` which it was taken are cut off.
    pub fn direction(&self, drive: &ObservedDrive, rows: &[Row], at: &[Row]) -> DVector<f64> {
        let middle = self.medians(drive, at);
        self.filtered(drive, |s, c| {
            let inside = (self.reference.scaled(c, drive, s, &at[s]) - middle[c]).abs() < CUT_OFF;
            let scale = self.reference.channels[c].scale[self.reference.speed_bin(drive.speed_m_s(s))];
            if inside { rows[s][c] / scale } else { 0.0 }
        })
    }

    fn medians(&self, drive: &ObservedDrive, rows: &[Row]) -> Row {
        let mut middle = [0.0; CHANNELS];
        for &c in &self.used {
            let values: Vec<f64> = rows.iter().enumerate().map(|(s, row)| self.reference.scaled(c, drive, s, row)).collect();
            middle[c] = median(&values);
        }
        middle
    }

    /// The constant offset of each used channel, one prior standard deviation large: drives differ by that much without an effect.
    pub fn offsets(&self, drive: &ObservedDrive) -> Vec<DVector<f64>> {
        self.used.iter().map(|&k| self.filtered(drive, |_, c| if c == k { self.reference.channels[k].offset_sd } else { 0.0 })).collect()
    }

    fn filtered(&self, drive: &ObservedDrive, value: impl Fn(usize, usize) -> f64) -> DVector<f64> {
        let n = self.used.len();
        let mut out = DVector::zeros(n * drive.starts.len());
        let mut before: Option<DVector<f64>> = None;
        for s in 0..drive.starts.len() {
            let follows = s > 0 && drive.follows(s);
            let now = DVector::from_fn(n, |i, _| value(s, self.used[i]));
            let innovation = DVector::from_fn(n, |i, _| {
                let colour = self.reference.channels[self.used[i]].colour;
                match &before {
                    Some(before) if follows => now[i] - colour * before[i],
                    _ => now[i] * (1.0 - colour * colour).sqrt(),
                }
            });
            out.rows_mut(s * n, n).copy_from(&(&self.factor * innovation));
            before = Some(now);
        }
        out
    }
}
