//! When effects act: each from an onset on, so a vehicle is another one in each phase of a log.

use super::Effect;
use crate::vehicle::Vehicle;

/// An effect and the instant from which it acts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScheduledEffect {
    /// The effect.
    pub effect: Effect,
    /// Onset, s since the start of the log; 0 = always.
    pub onset_s: f64,
}

impl From<Effect> for ScheduledEffect {
    fn from(effect: Effect) -> Self {
        Self { effect, onset_s: 0.0 }
    }
}

/// One thing for each phase between the onsets of a list of effects: the vehicle, or what is prepared from it.
#[derive(Clone, Debug)]
pub struct Phases<M> {
    /// Onset of each phase, ascending, with what holds from then on; the first holds before its onset too.
    phases: Vec<(f64, M)>,
}

impl<M> Phases<M> {
    /// Prepares each phase of a vehicle. `vehicle` has all effects begun; where every effect acts always, it is taken as it is.
    pub fn new(vehicle: &Vehicle, effects: &[ScheduledEffect], prepare: impl Fn(&Vehicle) -> M) -> Self {
        if effects.iter().all(|e| e.onset_s <= 0.0) {
            return Self { phases: vec![(0.0, prepare(vehicle))] };
        }
        let bare = Vehicle { effects: Default::default(), ..vehicle.clone() };
        Self::of(effects, |begun| prepare(&bare.with_effects(begun)))
    }

    /// Prepares each phase from the effects that have begun in it.
    pub fn of(effects: &[ScheduledEffect], prepare: impl Fn(&[Effect]) -> M) -> Self {
        let mut onsets: Vec<f64> = effects.iter().map(|e| e.onset_s).filter(|onset| *onset > 0.0).collect();
        onsets.push(0.0);
        onsets.sort_by(f64::total_cmp);
        onsets.dedup();
        let phase = |from: f64| {
            let begun: Vec<Effect> = effects.iter().filter(|e| e.onset_s <= from).map(|e| e.effect).collect();
            (from, prepare(&begun))
        };
        Self { phases: onsets.into_iter().map(phase).collect() }
    }

    /// What holds at an instant, s since the start of the log; without one, what holds when every effect has begun. An effect that begins within a
    /// step acts from the next one on.
    #[inline]
    pub fn at(&self, time_s: Option<f64>) -> &M {
        let last = self.phases.len() - 1;
        let phase = time_s.map_or(last, |t| self.phases[1..].iter().take_while(|(onset, _)| *onset <= t + 1e-9).count());
        &self.phases[phase.min(last)].1
    }

    /// All of them, in time.
    pub fn all(&self) -> impl Iterator<Item = &M> {
        self.phases.iter().map(|(_, phase)| phase)
    }

    /// Whether some phase is such.
    pub fn any(&self, is_such: impl Fn(&M) -> bool) -> bool {
        self.all().any(is_such)
    }

    /// What holds when every effect has begun.
    pub fn last(&self) -> &M {
        self.at(None)
    }
}
