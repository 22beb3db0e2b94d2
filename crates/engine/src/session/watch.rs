//! Whether measurements go on agreeing with predictions: four tests over the last buffers of the soil filter, and the episodes that they open and close.
//!
//! | test | statistic | what it is good for |
//! |---|---|---|
//! | NIS, two-sided | mean of eᵀ S⁻¹ e over its degrees of freedom | errors of any shape; a covariance that is too large |
//! | whiteness | lag-1 correlation of the normalised innovations | the same error again and again |
//! | jump of motion | window-limited generalised likelihood ratio for the mean of each normalised innovation | a vehicle that moves differently than before |
//! | jump of sensors | the same for displacement against velocity and attitude against angular velocity | sensors: neither soil nor forces enter |
//!
//! S is that of the bundle, not matched to the drive ([`nesam_adaptation::Agreement`]). A window-limited GLR of a mean is max over onsets j of
//! (Σ_{i ≥ j} x_i)² / var, n = k - j + 1 (Basseville & Nikiforov 1993, ch. 2.4); the statistics here are its root.
//!
//! The thresholds are constants, chosen on the drives that the training of the shipped car left for validation, where none of them is passed in
//! 12.5 minutes (`nesam bench alarms --split train`). They are multiples of what the bundle's own R_B expects, so they move with the bundle; those of the
//! sensors are the noise of the simulated sensors and a drift. A bundle without a calibrated filter is not watched.
//!
//! Without a map, or with a wheel off it, nothing is predicted: then the test of the sensors alone goes on, and a buffer counts as expected in the others.
//! Their alarms stay active as long. What only sensors can do is told also while another alarm is active.
//!
//! A vehicle that stands because it was told to is not judged: nothing moves, and the NIS would be too small for no reason.
//!
//! No clock, no random numbers: the same buffers give the same alarms.

use std::collections::VecDeque;

use nesam_adaptation::{Agreement, VELOCITY_DIM};
use nesam_physics::CONTRADICTIONS;

use super::alarm::{Alarm, AlarmKind};
use crate::clock::seconds;

/// Buffers in the window; the filter's buffers last a second.
const WINDOW: usize = 12;
/// Buffers after an onset before a jump of motion is tried.
const MOTION_MIN: usize = 3;
/// Buffers over which the NIS is averaged against its upper bound.
const NIS_BUFFERS: usize = 6;
/// Mean NIS over its degrees of freedom that is too large (2.64 at most on validation drives, 14 on ground that is not what it looks like).
const NIS_LARGE: f64 = 3.5;
/// The same, over the whole window, that is too small (0.31 at least on validation drives).
const NIS_SMALL: f64 = 0.15;
/// Lag-1 correlation over the whole window (0.67 at most on validation drives; errors of the model on one patch of ground do resemble each other).
const CORRELATED: f64 = 0.75;
/// Jump of a normalised innovation, standard deviations of its sum (5.3 at most on validation drives).
const MOTION_JUMP: f64 = 6.0;
/// Jump of a contradiction between sensors, standard deviations of its sum (4.6 at most on validation drives).
const SENSOR_JUMP: f64 = 7.0;
/// Noise at the two ends of a stretch: m and rad, order of [`nesam_physics::contradiction`].
const SENSOR_ENDS_SD: [f64; CONTRADICTIONS] = [0.022, 0.023, 0.029, 0.003, 0.003, 0.003];
/// What integration and sensors add with each buffer: m and rad per root of a buffer.
const SENSOR_BUFFER_SD: [f64; CONTRADICTIONS] = [0.005, 0.005, 0.006, 0.0025, 0.003, 0.0015];
/// Share of its threshold below which a statistic is calm.
const CALM_SHARE: f64 = 0.6;
/// Calm buffers in a row that end an episode.
const CALM_BUFFERS: u32 = 5;
/// Numbers of a buffer in an image.
pub(crate) const VALUES: usize = 2 * VELOCITY_DIM + CONTRADICTIONS + 3;

/// One buffer as the watch sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct WatchedBuffer {
    /// First and last stamp, ns of the vehicle's clock.
    pub stamps_ns: [i64; 2],
    /// NIS over its degrees of freedom.
    pub nis: f64,
    /// Mean innovation by channel, normalised.
    pub normalised: [f64; VELOCITY_DIM],
    /// The same in m/s and rad/s.
    pub mean: [f64; VELOCITY_DIM],
    /// How the sensors contradict each other over the buffer, m and rad.
    pub contradiction: [f64; CONTRADICTIONS],
    /// eᵀ R_B⁻¹ e, and what another soil would leave of it.
    pub weighed: [f64; 2],
}

impl WatchedBuffer {
    /// `agreement` is that of the motion with its prediction, where there was one; `contradiction` that of its sensors, of which `unseen` may be a blow between
    /// two samples. Where that alone would raise an alarm, a channel counts as agreeing.
    pub fn new(
        stamps_ns: [i64; 2],
        agreement: Option<&Agreement>,
        contradiction: [f64; CONTRADICTIONS],
        unseen: [f64; CONTRADICTIONS],
    ) -> Self {
        let contradiction = core::array::from_fn(|c| if unseen[c] > SENSOR_JUMP * sensor_sd(c, 1.0, 1.0) { 0.0 } else { contradiction[c] });
        let Some(agreement) = agreement else {
            let expected = [0.0; VELOCITY_DIM];
            return Self { stamps_ns, nis: 1.0, normalised: expected, mean: expected, contradiction, weighed: [0.0; 2] };
        };
        let Agreement { nis, dof, mean, normalised, weighed, beyond_soil } = *agreement;
        Self { stamps_ns, nis: nis / dof.max(1) as f64, normalised, mean, contradiction, weighed: [weighed, beyond_soil] }
    }

    /// Whether its motion was predicted: no measured motion agrees to the bit.
    fn was_predicted(&self) -> bool {
        self.weighed[0] > 0.0
    }

    /// Its numbers in one row.
    pub fn to_values(self) -> [f64; VALUES] {
        let Self { stamps_ns: _, nis, normalised, mean, contradiction, weighed } = self;
        let mut all = normalised.into_iter().chain(mean).chain(contradiction).chain([nis]).chain(weighed);
        core::array::from_fn(|_| all.next().unwrap_or(0.0))
    }

    /// The inverse of [`WatchedBuffer::to_values`].
    pub fn from_values(stamps_ns: [i64; 2], values: &[f64; VALUES]) -> Self {
        let mut all = values.iter().copied();
        let mut next = || all.next().unwrap_or(0.0);
        let normalised = core::array::from_fn(|_| next());
        let mean = core::array::from_fn(|_| next());
        let contradiction = core::array::from_fn(|_| next());
        Self { stamps_ns, normalised, mean, contradiction, nis: next(), weighed: [next(), next()] }
    }
}

/// The watch of one session.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Watch {
    /// The last buffers, oldest first.
    pub window: VecDeque<WatchedBuffer>,
    /// Episodes so far.
    pub episodes: u64,
    /// The alarm of the present one.
    pub active: Option<Alarm>,
    /// Calm buffers in a row.
    pub calm: u32,
}

/// Standard deviation of what sensors contradict each other by in a channel over some buffers in stretches without a gap, m or rad.
fn sensor_sd(channel: usize, buffers: f64, stretches: f64) -> f64 {
    (SENSOR_ENDS_SD[channel].powi(2) * stretches + SENSOR_BUFFER_SD[channel].powi(2) * buffers).sqrt()
}

/// What a test says of the window.
#[derive(Clone, Copy, Debug)]
struct Reading {
    kind: AlarmKind,
    channel: Option<usize>,
    statistic: f64,
    threshold: f64,
    /// Place in the window from which on it disagrees.
    onset: usize,
}

impl Reading {
    /// How far it is on the way to its threshold; 1 = there.
    fn share(&self) -> f64 {
        if self.kind == AlarmKind::NisSmall {
            self.threshold / self.statistic.max(f64::MIN_POSITIVE)
        } else {
            self.statistic / self.threshold
        }
    }
}

impl Watch {
    /// Takes the next buffer; the alarms that it clears and raises, in this order. A buffer with a number that is not finite is left out.
    pub fn feed(&mut self, buffer: WatchedBuffer) -> Vec<Alarm> {
        if !buffer.to_values().iter().all(|v| v.is_finite()) {
            return Vec::new();
        }
        if self.window.len() == WINDOW {
            self.window.pop_front();
        }
        self.window.push_back(buffer);
        let readings = self.readings();
        // The most telling test first: what only sensors can do is not told as motion.
        let raised = readings.iter().find(|r| r.share() > 1.0);
        let active = self.active.map(|alarm| alarm.kind);
        if active.is_none_or(|kind| kind != AlarmKind::SensorJump && raised.is_some_and(|r| r.kind == AlarmKind::SensorJump)) {
            let cleared = self.clear();
            return cleared.into_iter().chain(raised.map(|reading| self.raise(reading))).collect();
        }
        let worst = readings.iter().map(Reading::share).fold(0.0, f64::max);
        if worst >= CALM_SHARE {
            self.calm = 0;
        } else if buffer.was_predicted() || active == Some(AlarmKind::SensorJump) {
            self.calm += 1;
        }
        if self.calm >= CALM_BUFFERS { self.clear().into_iter().collect() } else { Vec::new() }
    }

    /// Begins an episode.
    fn raise(&mut self, reading: &Reading) -> Alarm {
        self.episodes += 1;
        self.calm = 0;
        let alarm = self.alarm(reading);
        self.active = Some(alarm);
        alarm
    }

    /// The vehicle is taken for another one from now on: ends the present episode and forgets the window.
    pub fn begin_again(&mut self) -> Option<Alarm> {
        let cleared = self.clear();
        self.window.clear();
        cleared
    }

    fn clear(&mut self) -> Option<Alarm> {
        let newest_ns = self.window.back().map(|b| b.stamps_ns[1]);
        self.calm = 0;
        self.active.take().map(|alarm| Alarm { active: false, stamp_ns: newest_ns.unwrap_or(alarm.stamp_ns), ..alarm })
    }

    fn readings(&self) -> Vec<Reading> {
        [self.sensor_jump(), self.motion_jump(), self.nis_large(), self.correlated(), self.nis_small()].into_iter().flatten().collect()
    }

    fn alarm(&self, raised: &Reading) -> Alarm {
        let since = self.window.range(raised.onset..);
        let mean = |of: &dyn Fn(&WatchedBuffer) -> f64| since.clone().map(of).sum::<f64>() / since.len().max(1) as f64;
        let length_s = |b: &WatchedBuffer| seconds(b.stamps_ns[1].saturating_sub(b.stamps_ns[0]).max(1));
        let size = match raised.channel {
            Some(c) if c < VELOCITY_DIM => mean(&|b| b.mean[c]),
            Some(c) => mean(&|b| b.contradiction[c - VELOCITY_DIM] / length_s(b)),
            None => 0.0,
        };
        let [weighed, beyond_soil] = [0, 1].map(|i| mean(&|b| b.weighed[i]));
        Alarm {
            episode: self.episodes,
            active: true,
            kind: raised.kind,
            channel: raised.channel,
            size,
            statistic: raised.statistic,
            threshold: raised.threshold,
            soil_share: if weighed > 0.0 { (1.0 - beyond_soil / weighed).clamp(0.0, 1.0) } else { 0.0 },
            stamp_ns: self.window.back().map_or(0, |b| b.stamps_ns[1]),
            onset_ns: self.window.get(raised.onset).map_or(0, |b| b.stamps_ns[0]),
        }
    }

    /// The largest |Σ_{i ≥ j} x_i| / sd over channels and onsets j with at least `least` buffers; `sd` of n buffers in `stretches` without a gap.
    fn jump<const N: usize>(
        &self,
        least: usize,
        value: impl Fn(&WatchedBuffer) -> [f64; N],
        sd: impl Fn(usize, f64, f64) -> f64,
    ) -> Option<(usize, f64, usize)> {
        let mut best: Option<(usize, f64, usize)> = None;
        let (mut sums, mut stretches) = ([0.0; N], 0.0);
        for (n, j) in (0..self.window.len()).rev().enumerate() {
            let (count, buffer) = (n + 1, &self.window[j]);
            let follows = self.window.get(j + 1).is_some_and(|next| next.stamps_ns[0] == buffer.stamps_ns[1]);
            stretches += if follows { 0.0 } else { 1.0 };
            for (c, v) in value(buffer).into_iter().enumerate() {
                sums[c] += v;
                let statistic = sums[c].abs() / sd(c, count as f64, stretches);
                if count >= least && best.is_none_or(|(_, most, _)| statistic > most) {
                    best = Some((c, statistic, j));
                }
            }
        }
        best
    }

    fn motion_jump(&self) -> Option<Reading> {
        let (c, statistic, onset) = self.jump(MOTION_MIN, |b| b.normalised, |_, count, _| count.sqrt())?;
        Some(Reading { kind: AlarmKind::MotionJump, channel: Some(c), statistic, threshold: MOTION_JUMP, onset })
    }

    fn sensor_jump(&self) -> Option<Reading> {
        let (c, statistic, onset) = self.jump(1, |b| b.contradiction, sensor_sd)?;
        Some(Reading { kind: AlarmKind::SensorJump, channel: Some(VELOCITY_DIM + c), statistic, threshold: SENSOR_JUMP, onset })
    }

    fn nis_large(&self) -> Option<Reading> {
        let first = self.window.len().checked_sub(NIS_BUFFERS)?;
        let statistic = self.window.range(first..).map(|b| b.nis).sum::<f64>() / NIS_BUFFERS as f64;
        // The onset is where the sum of what is beyond half of the bound is largest.
        let (mut sum, mut most, mut onset) = (0.0, f64::NEG_INFINITY, first);
        for j in (0..self.window.len()).rev() {
            sum += self.window[j].nis - 0.5 * NIS_LARGE;
            (most, onset) = if sum > most { (sum, j) } else { (most, onset) };
        }
        Some(Reading { kind: AlarmKind::NisLarge, channel: None, statistic, threshold: NIS_LARGE, onset })
    }

    fn nis_small(&self) -> Option<Reading> {
        if self.window.len() < WINDOW {
            return None;
        }
        let statistic = self.window.iter().map(|b| b.nis).sum::<f64>() / WINDOW as f64;
        Some(Reading { kind: AlarmKind::NisSmall, channel: None, statistic, threshold: NIS_SMALL, onset: 0 })
    }

    fn correlated(&self) -> Option<Reading> {
        if self.window.len() < WINDOW {
            return None;
        }
        let dot = |a: &WatchedBuffer, b: &WatchedBuffer| (0..VELOCITY_DIM).map(|c| a.normalised[c] * b.normalised[c]).sum::<f64>();
        let pairs = self.window.iter().zip(self.window.iter().skip(1)).filter(|(a, b)| a.stamps_ns[1] == b.stamps_ns[0]);
        let (products, squares) = pairs.fold((0.0, 0.0), |(p, s), (a, b)| (p + dot(a, b), s + 0.5 * (dot(a, a) + dot(b, b))));
        let statistic = if squares > 0.0 { products / squares } else { 0.0 };
        Some(Reading { kind: AlarmKind::Correlated, channel: None, statistic, threshold: CORRELATED, onset: 0 })
    }

    /// Whether a session can hold this.
    pub fn is_possible(&self) -> bool {
        let in_order = self.window.iter().all(|b| b.stamps_ns[0] < b.stamps_ns[1]);
        let finite = self.window.iter().all(|b| b.to_values().iter().all(|v| v.is_finite()));
        let alarm = self.active.is_none_or(|a| {
            a.active
                && a.episode == self.episodes
                && a.channel.is_none_or(|c| c < VELOCITY_DIM + CONTRADICTIONS)
                && [a.size, a.statistic, a.threshold, a.soil_share].iter().all(|v| v.is_finite())
        });
        self.window.len() <= WINDOW && in_order && finite && alarm
    }
}

#[cfg(test)]
mod tests;
