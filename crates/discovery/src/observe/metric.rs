//! How far apart two sets of deviations are: the scatter of segments within a drive and of whole drives, measured on drives without an effect.
//!
//! Deviations of one drive scatter about a level of their own (its soil, its start), and the level scatters from drive to drive: a random intercept by
//! drive and channel. The correlations between levels are shrunk towards zero (Ledoit and Wolf 2004 give the reason; the shares are chosen).

use nalgebra::{DMatrix, DVector};
use nesam_evaluation::median;

use crate::observe::channels::{CHANNELS, Row};

/// Share of the correlations within drives that is not believed: hundreds of segments stand behind them.
const SHRINKAGE_WITHIN: f64 = 0.05;
/// Share of the correlations between drives that is not believed where up to [`DRIVES_BEHIND`] drives stand behind them; it falls as one over their number.
const SHRINKAGE_BETWEEN: f64 = 0.5;
const DRIVES_BEHIND: f64 = 30.0;
/// Robust standard deviations beyond which a deviation has no further say in a covariance (Huber 1964).
const CUT_OFF: f64 = 4.0;
/// Standard deviation of a normal variable per median distance from its median.
const NORMAL_PER_MEDIAN: f64 = 1.4826;

/// Whitening of segments over the channels that are compared.
#[derive(Clone, Debug)]
pub struct Metric {
    /// Channels that are compared.
    pub channels: Vec<usize>,
    /// Usual level of each, in its unit.
    pub centre: DVector<f64>,
    /// Covariance of a segment within its drive.
    pub within: DMatrix<f64>,
    /// Covariance of a drive's level.
    pub between: DMatrix<f64>,
    /// Share of what segments say within a drive that is believed against its level ([`believed_within`](crate::observe::condense::believed_within)); 1 = all of it.
    pub within_believed: f64,
    whiten: DMatrix<f64>,
    level: DMatrix<f64>,
}

impl Metric {
    /// From the deviations of drives without an effect, over the channels that all of them measure; `None` when a covariance is not definite.
    pub fn measure(drives: &[Vec<Row>], available: &[bool; CHANNELS]) -> Option<Self> {
        let channels: Vec<usize> = (0..CHANNELS).filter(|c| available[*c]).collect();
        let size = channels.len();
        let clipped: Vec<Vec<DVector<f64>>> = drives.iter().map(|rows| clip(rows, &channels)).collect();
        let levels: Vec<DVector<f64>> =
            clipped.iter().map(|rows| rows.iter().fold(DVector::zeros(size), |sum, r| sum + r) / rows.len() as f64).collect();
        let centre = levels.iter().fold(DVector::zeros(size), |sum, l| sum + l) / levels.len() as f64;
        let (mut within, mut segments) = (DMatrix::zeros(size, size), 0.0);
        for (rows, level) in clipped.iter().zip(&levels) {
            for row in rows {
                let d = row - level;
                within += &d * d.transpose();
            }
            segments += rows.len() as f64 - 1.0;
        }
        within /= segments.max(1.0);
        let mut between = DMatrix::zeros(size, size);
        for level in &levels {
            let d = level - &centre;
            between += &d * d.transpose();
        }
        between /= (levels.len() as f64 - 1.0).max(1.0);
        for i in 0..size {
            let floor = 1e-4 * within[(i, i)] + 1e-18;
            within[(i, i)] += 1e-18;
            between[(i, i)] = between[(i, i)].max(floor);
        }
        shrink(&mut within, SHRINKAGE_WITHIN);
        shrink(&mut between, SHRINKAGE_BETWEEN * (DRIVES_BEHIND / levels.len() as f64).min(1.0));
        Self::new(channels, centre, within, between)
    }

    /// From its parts; `None` when a covariance is not definite.
    pub fn new(channels: Vec<usize>, centre: DVector<f64>, within: DMatrix<f64>, between: DMatrix<f64>) -> Option<Self> {
        let lower = within.clone().cholesky()?.l();
        let whiten = lower.solve_lower_triangular(&DMatrix::identity(channels.len(), channels.len()))?;
        let level = &whiten * &between * whiten.transpose();
        Some(Self { channels, centre, within, between, within_believed: 1.0, whiten, level })
    }

    /// The same that believes a share of what segments say within a drive.
    pub fn believing(self, within_believed: f64) -> Self {
        Self { within_believed, ..self }
    }

    /// The same that believes all: for what is fitted to predict and claims nothing.
    pub fn believing_all(&self) -> Self {
        self.clone().believing(1.0)
    }

    /// A deviation from the usual level, whitened. (C)
    pub fn residual(&self, row: &Row) -> DVector<f64> {
        &self.whiten * (self.pick(row) - &self.centre)
    }

    /// A shift of the deviations, whitened. (C)
    pub fn shift(&self, row: &Row) -> DVector<f64> {
        &self.whiten * self.pick(row)
    }

    /// One standard deviation of channel `c` of those compared as a whitened shift. (C)
    pub fn unit(&self, c: usize) -> DVector<f64> {
        self.whiten.column(c) * self.within[(c, c)].sqrt()
    }

    /// Inverse covariance of the whitened mean of segments of total weight `weight`. (C, C)
    pub fn level_precision(&self, weight: f64) -> DMatrix<f64> {
        let size = self.channels.len();
        let covariance = &self.level + DMatrix::identity(size, size) / weight.max(1e-9);
        covariance.cholesky().map_or_else(|| DMatrix::zeros(size, size), |c| c.inverse())
    }

    fn pick(&self, row: &Row) -> DVector<f64> {
        DVector::from_iterator(self.channels.len(), self.channels.iter().map(|c| row[*c]))
    }
}

/// Median of some values, and how far from it one has no further say.
pub(crate) fn usual_range(values: &[f64]) -> (f64, f64) {
    let middle = median(values);
    let spread = NORMAL_PER_MEDIAN * median(&values.iter().map(|v| (v - middle).abs()).collect::<Vec<_>>());
    (middle, CUT_OFF * spread)
}

/// Rows of a drive with every channel held within some robust standard deviations of its median; what is no number makes none of them panic.
fn clip(rows: &[Row], channels: &[usize]) -> Vec<DVector<f64>> {
    let bounds: Vec<[f64; 2]> = channels
        .iter()
        .map(|c| {
            let (middle, bound) = usual_range(&rows.iter().map(|r| r[*c]).collect::<Vec<_>>());
            [middle - bound, middle + bound]
        })
        .collect();
    rows.iter()
        .map(|r| DVector::from_iterator(channels.len(), channels.iter().zip(&bounds).map(|(c, [low, high])| r[*c].max(*low).min(*high))))
        .collect()
}

fn shrink(covariance: &mut DMatrix<f64>, share: f64) {
    for i in 0..covariance.nrows() {
        for j in 0..covariance.ncols() {
            if i != j {
                covariance[(i, j)] *= 1.0 - share;
            }
        }
    }
}
