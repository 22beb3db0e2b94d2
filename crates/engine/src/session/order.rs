//! Which measurements continue the line of a session: duplicates, late ones, clocks that jump, vehicles that restart.

use std::collections::VecDeque;

use super::numbers::Numbers;
use crate::clock::seconds;
use crate::error::EngineError;
use crate::limits::Limits;
use crate::measurement::{Measurement, Outcome};

/// Accepted stamps that are remembered to tell a resent measurement from a late one.
pub(super) const RECENT_MAX: usize = 256;
/// Former starts of the vehicle's software that are remembered to refuse their late measurements.
pub(super) const ENDED_BOOTS_MAX: usize = 64;
/// Consecutive measurements off the line that prove a new one.
const PROOF_COUNT: u32 = 2;
/// Where numbers prove nothing: time of arrival over which the stamps have to keep pace with the arrivals, s and measurements.
const PROOF_PACE: (f64, u32) = (0.5, 3);

/// What to do with a measurement.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Verdict {
    /// It belongs to the line.
    Accept,
    /// It does not; nothing changes.
    Refuse(Outcome),
    /// A new line begins with it.
    Begin(Outcome),
}

/// An accepted stamp and its number.
pub(super) type Numbered = (i64, Option<u64>);
/// A start of the vehicle's software and the highest number accepted of it.
pub type EndedBoot = (u64, Option<u64>);

/// Why a measurement does not continue the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum OffLine {
    /// Behind the window, or behind older ones by its number.
    Late,
    /// Further ahead than time has passed.
    Ahead,
    /// Numbered against the order of the stamps.
    Renumbered,
    /// Of another start of the vehicle's software, which had ended before or not.
    OtherBoot { boot: u64, ended: bool },
}

/// Measurements off the line that follow each other: one of them is an error, several are a clock that was set or a vehicle that was restarted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Suspect {
    kind: OffLine,
    first_stamp_ns: i64,
    first_arrival_ns: u64,
    last: Numbered,
    last_arrival_ns: u64,
    count: u32,
}

/// The line of accepted measurements.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Order {
    /// By ascending stamp.
    pub(super) recent: VecDeque<Numbered>,
    /// Highest accepted number.
    pub(super) last_sequence: Option<u64>,
    /// All accepted numbers of the present start, where one is told.
    pub(super) numbers: Numbers,
    /// Present start of the vehicle's software, where it is told.
    pub(super) boot: Option<u64>,
    /// Starts before it, oldest first.
    pub(super) ended_boots: VecDeque<EndedBoot>,
    /// Engine clock when the newest measurement arrived, ns.
    pub(super) newest_arrival_ns: i64,
    /// Newest stamp that is final: nothing comes before it any more.
    pub(super) final_ns: Option<i64>,
    pub(super) suspect: Option<Suspect>,
}

impl Order {
    /// Newest accepted stamp, ns.
    pub(super) fn newest_ns(&self) -> Option<i64> {
        self.recent.back().map(|(stamp_ns, _)| *stamp_ns)
    }

    /// Judges a measurement that arrives now; only notes what is off the line.
    ///
    /// # Errors
    /// `EngineError::Invalid` for a stamp further ahead than `pause_max_s` that arrives before so much time has passed.
    pub(super) fn judge(&mut self, measurement: &Measurement, now_ns: u64, step_ns: i64, limits: &Limits) -> Result<Verdict, EngineError> {
        let stamp_ns = measurement.stamp_ns;
        let behind_s = self.newest_ns().map_or(0.0, |newest| seconds(newest.saturating_sub(stamp_ns)).max(0.0));
        if let Some(boot) = measurement.boot.filter(|boot| self.boot.is_some_and(|present| present != *boot)) {
            let over = self.ended_boots.iter().find(|(ended, _)| *ended == boot).map(|(_, last)| *last);
            let ended = over.is_some();
            // One that was delayed or is sent once more is no restart, and would end the present one for good.
            let restarted = !ended && self.newest_ns().is_none_or(|newest| stamp_ns > newest)
                || !over.is_some_and(|last| counted(measurement.sequence, last))
                    && self.suspects(OffLine::OtherBoot { boot, ended }, measurement, now_ns, step_ns);
            return Ok(if restarted { Verdict::Begin(Outcome::Restarted) } else { Verdict::Refuse(Outcome::TooOld { behind_s }) });
        }
        let Some(newest_ns) = self.newest_ns() else { return Ok(Verdict::Accept) };
        let of_this_boot = measurement.boot.is_some() && measurement.boot == self.boot;
        let resent = measurement.sequence.is_some() && measurement.sequence == self.last_sequence
            || of_this_boot && measurement.sequence.is_some_and(|number| self.numbers.contains(number));
        let fresh = self.is_fresh(measurement.sequence);
        let place = self.recent.partition_point(|(recent_ns, _)| *recent_ns < stamp_ns);
        // A fresh number on the stamp of an older one is no copy: the clock was set back by whole intervals.
        let known = self.recent.get(place).filter(|(recent_ns, _)| *recent_ns == stamp_ns);
        if resent || known.is_some_and(|(_, number)| number.is_none() || !fresh) {
            return Ok(Verdict::Refuse(Outcome::Duplicate));
        }
        let ahead_s = seconds(stamp_ns.saturating_sub(newest_ns));
        let silent_s = seconds((now_ns as i64).saturating_sub(self.newest_arrival_ns).max(0));
        let edge_ns = newest_ns.saturating_sub(limits.reorder_window_ns()).max(self.final_ns.unwrap_or(i64::MIN));
        let against = self.numbered_against(place, measurement.sequence);
        let off = if stamp_ns <= edge_ns || against && fresh {
            OffLine::Late
        } else if against {
            OffLine::Renumbered
        } else if ahead_s - silent_s > limits.clock_ahead_max_s {
            OffLine::Ahead
        } else if ahead_s > limits.pause_max_s && silent_s <= limits.pause_max_s {
            let limit = limits.pause_max_s;
            let reason = format!(
                "lies {ahead_s} s after the last one, which came {silent_s} s ago; above {limit} s (limits.pause_max_s) it is believed when as much time has passed"
            );
            return Err(EngineError::invalid("stamp_ns", reason));
        } else {
            return Ok(Verdict::Accept);
        };
        // Within one start numbers only rise: one that is not new, and was not accepted or is forgotten, begins no other line.
        if of_this_boot && counted(measurement.sequence, self.last_sequence) {
            return Ok(Verdict::Refuse(Outcome::TooOld { behind_s }));
        }
        let jump_s = ahead_s - silent_s;
        Ok(match (off, self.suspects(off, measurement, now_ns, step_ns)) {
            (OffLine::Ahead, false) => Verdict::Refuse(Outcome::Future { ahead_s: jump_s }),
            (_, false) => Verdict::Refuse(Outcome::TooOld { behind_s }),
            (OffLine::Renumbered, true) => Verdict::Begin(Outcome::Restarted),
            (_, true) if counted(measurement.sequence, self.last_sequence) => Verdict::Begin(Outcome::Restarted),
            (_, true) => Verdict::Begin(Outcome::ClockJump { jump_s }),
        })
    }

    /// Whether a number is higher than all before.
    fn is_fresh(&self, sequence: Option<u64>) -> bool {
        matches!((sequence, self.last_sequence), (Some(number), Some(last)) if number > last)
    }

    /// Whether a number at this place contradicts its neighbours.
    fn numbered_against(&self, place: usize, sequence: Option<u64>) -> bool {
        let Some(sequence) = sequence else { return false };
        let before = self.recent.iter().take(place).rev().find_map(|(_, number)| *number);
        let after = self.recent.iter().skip(place).find_map(|(_, number)| *number);
        before.is_some_and(|before| before >= sequence) || after.is_some_and(|after| after <= sequence)
    }

    /// Notes a measurement off the line and says whether enough of them agree on a new one.
    ///
    /// Two in a row do, if they lie ahead, if their numbers are fresh or contradict the stamps, or if they are of a start that is new: late ones of the old line are never
    /// so. Otherwise the stamps have to keep pace with the arrivals, as no burst of resent measurements does.
    fn suspects(&mut self, kind: OffLine, measurement: &Measurement, now_ns: u64, step_ns: i64) -> bool {
        let here: Numbered = (measurement.stamp_ns, measurement.sequence);
        // The next step, or one after as much time as has passed: a slow sensor, or a link that loses some.
        let follows = |suspect: &Suspect| {
            let interval = here.0.saturating_sub(suspect.last.0);
            let passed = seconds(now_ns.saturating_sub(suspect.last_arrival_ns) as i64);
            let is_next = interval <= step_ns / 2 * 3 || keeps_pace(seconds(interval), passed);
            interval > 0 && is_next && here.1.zip(suspect.last.1).is_none_or(|(number, before)| number > before)
        };
        let (last, last_arrival_ns) = (here, now_ns);
        let suspect = match self.suspect {
            Some(suspect) if suspect.kind == kind && follows(&suspect) => {
                Suspect { last, last_arrival_ns, count: suspect.count + 1, ..suspect }
            }
            _ => Suspect { kind, first_stamp_ns: here.0, first_arrival_ns: now_ns, last, last_arrival_ns, count: 1 },
        };
        self.suspect = Some(suspect);
        let by_count = match kind {
            OffLine::Late => self.is_fresh(measurement.sequence),
            OffLine::OtherBoot { ended, .. } => !ended,
            OffLine::Ahead | OffLine::Renumbered => true,
        };
        if by_count {
            return suspect.count >= PROOF_COUNT;
        }
        let elapsed_s = seconds(now_ns.saturating_sub(suspect.first_arrival_ns) as i64);
        let advance_s = seconds(here.0.saturating_sub(suspect.first_stamp_ns));
        elapsed_s >= PROOF_PACE.0 && suspect.count >= PROOF_PACE.1 && keeps_pace(advance_s, elapsed_s)
    }

    /// Notes an accepted measurement. Says whether it is the newest.
    pub(super) fn accept(&mut self, measurement: &Measurement, now_ns: u64) -> bool {
        let place = self.recent.partition_point(|(recent_ns, _)| *recent_ns < measurement.stamp_ns);
        let newest = place == self.recent.len();
        self.recent.insert(place, (measurement.stamp_ns, measurement.sequence));
        if self.recent.len() > RECENT_MAX {
            self.recent.pop_front();
        }
        self.last_sequence = self.last_sequence.max(measurement.sequence);
        self.boot = measurement.boot.or(self.boot);
        if let (Some(_), Some(number)) = (measurement.boot, measurement.sequence) {
            self.numbers.insert(number);
        }
        self.suspect = None;
        if newest {
            self.newest_arrival_ns = now_ns as i64;
        }
        newest
    }

    /// Forgets the line: the next measurement begins another one.
    pub(super) fn begin(&mut self, boot: Option<u64>) {
        let mut ended_boots = core::mem::take(&mut self.ended_boots);
        // A start that goes on does not tell anew what it has told, whether its clock was set or another one came between.
        let goes_on = boot.is_some() && boot == self.boot;
        let told_before = ended_boots.iter().find(|(ended, _)| Some(*ended) == boot).and_then(|(_, last)| *last);
        let (numbers, last_sequence) = match goes_on {
            true => (core::mem::take(&mut self.numbers), self.last_sequence),
            false => (told_before.map(Numbers::up_to).unwrap_or_default(), None),
        };
        ended_boots.retain(|(ended, _)| Some(*ended) != boot);
        if let Some(ended) = self.boot.filter(|present| boot.is_some_and(|boot| boot != *present)) {
            ended_boots.push_back((ended, self.last_sequence));
            if ended_boots.len() > ENDED_BOOTS_MAX {
                ended_boots.pop_front();
            }
        }
        *self = Self { boot: boot.or(self.boot), ended_boots, numbers, last_sequence, ..Self::default() };
    }
}

/// Whether stamps go on about as fast as they arrive.
fn keeps_pace(advance_s: f64, elapsed_s: f64) -> bool {
    (0.5 * elapsed_s..=2.0 * elapsed_s).contains(&advance_s)
}

/// Whether a number is none that comes after the last one.
fn counted(sequence: Option<u64>, last: Option<u64>) -> bool {
    matches!((sequence, last), (Some(number), Some(last)) if number <= last)
}
