//! Whether what is left is as unrelated from one segment to the next as in drives without an effect: the whiteness test of the innovations of a filter (Mehra 1970).
//!
//! Asked of contradictions between sensors, into which neither forces nor soils nor commands enter: what else deviates goes on as ground and driver do. A level tells of what is
//! there on average; this tells of what comes and goes within a drive, such as a gyro that wanders to both sides. White errors of poses give a lag-one correlation of −1/2, as
//! segments share their ends, and white errors of velocities none: more of the latter alone raises it to zero and no further.

use std::fmt;

use nesam_evaluation::report::Short;
use serde::{Deserialize, Serialize};

use crate::observe::ObservedDrive;
use crate::observe::channels::{PATH_AT, Row, SEGMENT_STEPS, TURN_AT, name};
use crate::observe::metric::usual_range;

/// How many times the largest deviation of drives without an effect a jump is (chosen: impacts on rough ground were within twice).
const JUMP: f64 = 3.0;
/// Standard deviations above zero from which a correlation is surely positive.
const POSITIVE: f64 = 3.0;
/// Channels in which a jump is looked for: impacts shake height, roll and pitch.
const JUMPING: [usize; 3] = [PATH_AT, PATH_AT + 1, TURN_AT + 2];

/// Whether a channel is asked: whether it is a contradiction between sensors.
pub(crate) fn asked(channel: usize) -> bool {
    channel >= PATH_AT
}

/// How a channel goes on from segment to segment of a drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Succession {
    /// Pairs of segments, one right after the other.
    pub pairs: usize,
    /// Sum over the pairs of the products of their deviations from the mean of the drive.
    pub lagged: f64,
    /// Sum over the segments of the squares of the same.
    pub square: f64,
    /// Largest deviation from the median of the drive.
    pub largest: f64,
}

impl Succession {
    /// Of a channel of a drive; `uncounted` segments are left out.
    pub(crate) fn of(drive: &ObservedDrive, uncounted: &[usize], rows: &[Row], channel: usize) -> Self {
        Self::in_series(&drive.starts, uncounted, &rows.iter().map(|row| row[channel]).collect::<Vec<_>>())
    }

    fn in_series(starts: &[usize], uncounted: &[usize], values: &[f64]) -> Self {
        let counted: Vec<(usize, f64)> = (0..values.len()).filter(|k| !uncounted.contains(k)).map(|k| (starts[k], values[k])).collect();
        if counted.is_empty() {
            return Self::default();
        }
        // One jump would be most of the square, and what is left of the correlation would be near zero.
        let (middle, bound) = usual_range(&counted.iter().map(|(_, value)| *value).collect::<Vec<_>>());
        let clipped: Vec<(usize, f64)> =
            counted.iter().map(|(start, value)| (*start, value.clamp(middle - bound, middle + bound))).collect();
        let mean = clipped.iter().map(|(_, value)| value).sum::<f64>() / clipped.len() as f64;
        let products: Vec<f64> = clipped
            .windows(2)
            .filter(|pair| pair[1].0 - pair[0].0 == SEGMENT_STEPS)
            .map(|pair| (pair[0].1 - mean) * (pair[1].1 - mean))
            .collect();
        Self {
            pairs: products.len(),
            lagged: products.iter().sum(),
            square: clipped.iter().map(|(_, value)| (value - mean).powi(2)).sum(),
            largest: counted.iter().map(|(_, value)| (value - middle).abs()).fold(0.0, f64::max),
        }
    }

    fn lag_one(&self) -> f64 {
        self.lagged / self.square.max(f64::MIN_POSITIVE)
    }
}

/// How each channel that is asked goes on in drives without an effect.
#[derive(Clone, Debug, Default)]
pub struct Whiteness {
    usual: Vec<Usual>,
}

#[derive(Clone, Copy, Debug)]
struct Usual {
    channel: usize,
    /// Mean lag-one correlation.
    lag_one: f64,
    /// Its variance from drive to drive, times the pairs of a drive.
    variance: f64,
    /// Pairs of all drives.
    pairs: f64,
    /// Largest deviation in any drive.
    largest: f64,
}

/// What a channel does that it does not do without an effect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Unrest {
    /// It goes on from segment to segment.
    Lasting {
        /// The channel.
        channel: usize,
        /// Lag-one correlation.
        lag_one: f64,
        /// The same without an effect.
        usual: f64,
        /// Evidence.
        z: f64,
    },
    /// It jumps.
    Jump {
        /// The channel.
        channel: usize,
        /// By how much, in its unit.
        by: f64,
        /// Largest deviation without an effect.
        usual: f64,
    },
}

impl fmt::Display for Unrest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Lasting { channel, lag_one, usual, z } => write!(
                f,
                "{} goes on from segment to segment (z = {z:.1}; lag-one correlation {lag_one:.2}, {usual:.2} without an effect)",
                name(*channel)
            ),
            Self::Jump { channel, by, usual } => {
                write!(f, "{} jumps by {} ({} at most without an effect)", name(*channel), Short(*by), Short(*usual))
            }
        }
    }
}

impl Whiteness {
    /// From drives without an effect: how each of these channels goes on in each.
    pub(crate) fn of(channels: impl Iterator<Item = usize>, drives: &[&[Succession]]) -> Self {
        let usual = channels.enumerate().filter_map(|(at, channel)| {
            let own: Vec<Succession> = drives.iter().map(|drive| drive[at]).filter(|s| s.pairs > 0 && s.square > 0.0).collect();
            let pairs = own.iter().map(|s| s.pairs as f64).sum::<f64>();
            let lag_one = own.iter().map(|s| s.pairs as f64 * s.lag_one()).sum::<f64>() / pairs;
            let variance = own.iter().map(|s| s.pairs as f64 * (s.lag_one() - lag_one).powi(2)).sum::<f64>() / (own.len() as f64 - 1.0);
            let largest = own.iter().map(|s| s.largest).fold(0.0, f64::max);
            (own.len() > 3 && variance > 0.0).then_some(Usual { channel, lag_one, variance, pairs, largest })
        });
        Self { usual: usual.collect() }
    }

    /// What goes on most from segment to segment, of channels of drives; `None` where none does with this evidence and a correlation above zero.
    pub(crate) fn lasting(&self, evidence: f64, channels: impl Fn(usize) -> bool, of: impl Fn(usize) -> Vec<Succession>) -> Option<Unrest> {
        let own = self.usual.iter().filter(|usual| channels(usual.channel)).filter_map(|usual| {
            let (lag_one, sd) = usual.lag_one_of(&of(usual.channel))?;
            (lag_one >= POSITIVE * sd).then_some((usual, lag_one, (lag_one - usual.lag_one) / sd))
        });
        let (usual, lag_one, z) = own.max_by(|a, b| a.2.total_cmp(&b.2)).filter(|(_, _, z)| *z >= evidence)?;
        Some(Unrest::Lasting { channel: usual.channel, lag_one, usual: usual.lag_one, z })
    }

    /// The largest jump of a channel of drives; `None` where none jumps.
    pub(crate) fn jump(&self, of: impl Fn(usize) -> Vec<Succession>) -> Option<Unrest> {
        let jumping = self.usual.iter().filter(|usual| JUMPING.contains(&usual.channel) && usual.largest > 0.0);
        let all = jumping.map(|usual| (usual, of(usual.channel).iter().map(|s| s.largest).fold(0.0, f64::max)));
        let (usual, by) = all.max_by(|a, b| (a.1 / a.0.largest).total_cmp(&(b.1 / b.0.largest)))?;
        (by > JUMP * usual.largest).then_some(Unrest::Jump { channel: usual.channel, by, usual: usual.largest })
    }
}

impl Usual {
    /// Lag-one correlation of drives together, with its standard deviation against that without an effect. A loud drive says more, and stands for fewer.
    fn lag_one_of(&self, drives: &[Succession]) -> Option<(f64, f64)> {
        let drives: Vec<&Succession> = drives.iter().filter(|s| s.pairs > 0).collect();
        let square: f64 = drives.iter().map(|s| s.square).sum();
        if square <= 0.0 {
            return None;
        }
        let lag_one = drives.iter().map(|s| s.lagged).sum::<f64>() / square;
        let own: f64 = drives.iter().map(|s| (s.square / square).powi(2) / s.pairs as f64).sum();
        Some((lag_one, (self.variance * (own + 1.0 / self.pairs)).sqrt()))
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const CHANNEL: usize = TURN_AT + 2;

    /// Differences of white errors, one segment after the other, and `more` of each.
    fn drive(rng: &mut ChaCha8Rng, segments: usize, mut more: impl FnMut(usize) -> f64) -> Succession {
        let pose: Vec<f64> = (0..=segments).map(|_| StandardNormal.sample(rng)).collect();
        let values: Vec<f64> = (0..segments).map(|k| pose[k + 1] - pose[k] + more(k)).collect();
        let starts: Vec<usize> = (0..segments).map(|k| k * SEGMENT_STEPS).collect();
        Succession::in_series(&starts, &[], &values)
    }

    fn usual(rng: &mut ChaCha8Rng) -> Whiteness {
        let drives: Vec<[Succession; 1]> = (0..30).map(|_| [drive(rng, 28, |_| 0.0)]).collect();
        Whiteness::of([CHANNEL].into_iter(), &drives.iter().map(|drive| &drive[..]).collect::<Vec<_>>())
    }

    /// Goal: what comes and goes within drives is told, what is always there and what is noise is not. Method: thirty drives of the noise of poses alone; 400 groups of five
    /// more, with a level, and with a sine of twice the noise over 25 s.
    #[test]
    fn analytic_a_sine_goes_on_and_noise_does_not() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let whiteness = usual(&mut rng);
        let own = whiteness.usual[0];
        assert!((own.lag_one + 0.5).abs() < 0.08 && own.pairs == 30.0 * 27.0, "{own:?}");
        let mut group = |more: fn(usize) -> f64| (0..5).map(|_| drive(&mut rng, 28, more)).collect::<Vec<_>>();
        for _ in 0..400 {
            let level = group(|_| 7.0);
            assert_eq!(whiteness.lasting(5.0, |_| true, |_| level.clone()), None);
        }
        let mut rates = ChaCha8Rng::seed_from_u64(5);
        let mut rate = || -> f64 { StandardNormal.sample(&mut rates) };
        let louder: Vec<Succession> = (0..5).map(|_| drive(&mut rng, 28, |_| 4.0 * rate())).collect();
        assert_eq!(whiteness.lasting(5.0, |_| true, |_| louder.clone()), None, "rates that are noisier");
        let mut group = |more: fn(usize) -> f64| (0..5).map(|_| drive(&mut rng, 28, more)).collect::<Vec<_>>();
        let sine = group(|k| 2.0 * (k as f64 * 0.8 / 25.0 * std::f64::consts::TAU).sin());
        let found = whiteness.lasting(9.0, |_| true, |_| sine.clone());
        assert!(matches!(found, Some(Unrest::Lasting { channel: CHANNEL, lag_one, .. }) if lag_one > 0.0), "{found:?}");
        assert_eq!(whiteness.lasting(9.0, |channel| channel != CHANNEL, |_| sine.clone()), None);
    }

    /// Goal: a segment in which a heading jumps is told by how far. Method: five drives of noise, one of which has a segment that is 20 too large.
    #[test]
    fn analytic_a_jump_is_told_by_its_size() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let whiteness = usual(&mut rng);
        let quiet: Vec<Succession> = (0..4).map(|_| drive(&mut rng, 28, |_| 0.0)).collect();
        assert_eq!(whiteness.jump(|_| quiet.clone()), None);
        let jumping = drive(&mut rng, 28, |k| if k == 11 { 20.0 } else { 0.0 });
        let found = whiteness.jump(|_| quiet.iter().copied().chain([jumping]).collect());
        assert!(matches!(found, Some(Unrest::Jump { channel: CHANNEL, by, .. }) if (by - 20.0).abs() < 4.0), "{found:?}");
    }

    /// Segments that are not one right after the other say nothing of one another, nor do uncounted ones of anything.
    #[test]
    fn analytic_only_neighbours_make_pairs() {
        let starts = [0, 8, 24, 32, 40];
        let all = Succession::in_series(&starts, &[], &[1.0, -1.0, 1.0, -1.0, 0.0]);
        assert_eq!((all.pairs, all.lagged, all.square), (3, -2.0, 4.0));
        let without = Succession::in_series(&starts, &[3], &[1.0, -1.0, 1.0, 99.0, -1.0]);
        assert_eq!((without.pairs, without.lagged, without.square, without.largest), (1, -1.0, 4.0, 1.0));
        assert_eq!(Succession::in_series(&starts, &[0, 1, 2, 3, 4], &[1.0; 5]), Succession::default());
    }
}
