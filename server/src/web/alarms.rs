//! What somebody who looks after vehicles should know now, in words that say what to do.

use std::borrow::Cow;

use nesam_engine::{AppliedEffect, EngineError, SOIL_NOT_LEARNED};
use nesam_model::flag;
use serde_json::{Value, json};

use super::notes::{Notes, SessionNotes};

/// A vehicle that measures at 10 Hz and is silent for this long has lost its link or stands still by itself, s. Chosen.
const SILENT_S: f64 = 1.0;
/// What happened longer ago than this is no alarm any more, s.
const RECENT_S: f64 = 10.0;
/// Of this many of the newest tests of soil buffers…
const TESTS: usize = 10;
/// … so many refused ones say that the model does not describe this drive. One in a hundred is refused by chance.
const REFUSED_TESTS: usize = 3;
/// Share of the candidates with a flag from which on it is worth a line.
const FLAGGED_SHARE: f64 = 0.05;

/// How much an alarm matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Level {
    /// Predictions are wrong or missing.
    Alarm,
    /// Predictions are worse than they could be.
    Warning,
    /// Good to know.
    Notice,
}

/// An alarm that somebody else has found, for instance the engine: handed to [`super::Feed::alarm`], shown until it is taken back.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Raised {
    /// Session; `None` = the service.
    pub session: Option<String>,
    /// Kind; one of a kind for each session.
    pub id: String,
    /// What is the case.
    pub what: String,
    /// What to do.
    pub advice: String,
    /// It holds; false takes it back.
    pub active: bool,
}

impl Raised {
    /// Whether the store hangs, and for how long by now.
    pub fn by_store(hangs_s: Option<f64>) -> Self {
        let what = format!("the store has taken nothing for {:.0} s: what vehicles report is not durable", hangs_s.unwrap_or(0.0));
        let advice = "make room on its disk, or see whether the disk, or etcd, answers".into();
        Self { session: None, id: "store".into(), what, advice, active: hangs_s.is_some() }
    }

    /// What the watch of a session says.
    pub fn by_watch(session: &str, alarm: &nesam_engine::Alarm) -> Self {
        let advice = format!("diagnose what was recorded: {}", alarm.diagnose(session));
        Self { session: Some(session.into()), id: "watch".into(), what: alarm.description(), advice, active: alarm.active }
    }
}

/// A line of the list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Alarm {
    /// How much it matters.
    pub level: Level,
    /// Stays the same as long as the alarm does.
    pub id: Cow<'static, str>,
    /// Session; `None` = the service.
    pub session: Option<String>,
    /// What is the case.
    pub what: String,
    /// What to do.
    pub advice: Cow<'static, str>,
}

impl Alarm {
    /// For the page.
    pub fn to_json(&self) -> Value {
        let level = match self.level {
            Level::Alarm => "alarm",
            Level::Warning => "warning",
            Level::Notice => "notice",
        };
        json!({"level": level, "id": self.id, "session": self.session, "what": self.what, "advice": self.advice})
    }
}

/// What the service itself has to tell.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ServiceFacts {
    /// Commands that are missing in the recording; `None` = nothing is recorded.
    pub dropped_commands: Option<u64>,
    /// The recording has ended before the service.
    pub recording_ended: bool,
}

/// The alarms of this instant, the gravest first.
pub(crate) fn alarms(notes: &Notes, facts: ServiceFacts, now_s: f64) -> Vec<Alarm> {
    let mut found = of_service(notes, facts, now_s);
    found.extend(notes.raised.iter().map(|raised| Alarm {
        level: Level::Alarm,
        id: raised.id.clone().into(),
        session: raised.session.clone(),
        what: raised.what.clone(),
        advice: raised.advice.clone().into(),
    }));
    for (name, session) in &notes.sessions {
        let of_session =
            [link(session, now_s), measurements(session, now_s), soil(session), effects(session), candidates(session, now_s)].concat();
        found.extend(of_session.into_iter().map(|alarm| Alarm { session: Some(name.clone()), ..alarm }));
    }
    found.sort_by_key(|alarm| alarm.level);
    found
}

fn alarm(level: Level, id: &'static str, what: String, advice: &'static str) -> Alarm {
    Alarm { level, id: id.into(), session: None, what, advice: advice.into() }
}

fn of_service(notes: &Notes, facts: ServiceFacts, now_s: f64) -> Vec<Alarm> {
    let recent = |wanted: fn(&EngineError) -> bool| {
        notes.refusals.iter().filter(|(at_s, _, error)| now_s - at_s < RECENT_S && wanted(error)).count()
    };
    let mut found = Vec::new();
    let late = recent(|error| matches!(error, EngineError::Overloaded { .. } | EngineError::Expired));
    if late > 0 {
        let what = format!("{late} requests refused or late within {RECENT_S} s");
        found.push(alarm(Level::Alarm, "overload", what, "ask for fewer candidates or less often, or run a second server"));
    }
    let wrong = recent(|error| matches!(error, EngineError::Invalid { .. } | EngineError::NotReady { .. }));
    if wrong > 0 {
        let newest = notes.refusals.iter().rev().find(|(_, _, e)| matches!(e, EngineError::Invalid { .. } | EngineError::NotReady { .. }));
        let why = newest.map_or(String::new(), |(_, label, error)| format!("; the last, `{label}`: {error}"));
        found.push(alarm(Level::Warning, "refused", format!("{wrong} requests refused{why}"), "correct the field that the answer names"));
    }
    if facts.recording_ended {
        let what = "the recording has ended: the disk failed or its limit is reached".into();
        found.push(alarm(Level::Warning, "recording_ended", what, "make room, or raise `recording.bytes_max`, and restart"));
    } else if let Some(dropped) = facts.dropped_commands.filter(|dropped| *dropped > 0) {
        let what = format!("{dropped} commands are missing in the recording");
        found.push(alarm(Level::Notice, "recording_dropped", what, "record to a faster disk"));
    }
    found
}

fn link(session: &SessionNotes, now_s: f64) -> Vec<Alarm> {
    let silent_s = session.newest.as_ref().map(|(_, at_s)| now_s - at_s).filter(|s| *s > SILENT_S);
    let what = |s: f64| format!("no measurement for {s:.0} s");
    let advice = "see whether the vehicle publishes and its link is up; predictions start from the last state";
    silent_s.map(|s| alarm(Level::Alarm, "silent", what(s.max(1.0)), advice)).into_iter().collect()
}

fn measurements(session: &SessionNotes, now_s: f64) -> Vec<Alarm> {
    let kinds = [
        ("not_finite", "measurements with NaN or infinite numbers", "mend the estimator that publishes them"),
        ("too_old", "measurements arrive too late to be used", "the link reorders more than `limits.reorder_window_s` holds"),
        ("gap", "the history began anew after a gap", "measurements are missing; see the link"),
        ("clock_jump", "the vehicle's clock was set", "synchronise clocks before driving"),
        ("future", "measurements from the future", "synchronise the vehicle's clock"),
    ];
    let recent = |kind: &str| session.outcome_at.get(kind).is_some_and(|at_s| now_s - at_s < RECENT_S);
    let line = |(kind, what, advice): (&'static str, &str, &'static str)| {
        let count = session.outcomes.get(kind).copied().unwrap_or(0);
        alarm(Level::Warning, kind, format!("{what} ({count} so far)"), advice)
    };
    kinds.into_iter().filter(|(kind, ..)| recent(kind)).map(line).collect()
}

fn soil(session: &SessionNotes) -> Vec<Alarm> {
    if session.newest.is_some() && session.map.is_none() {
        let what = "no map: flat ground and a stated default soil are assumed, the soil is not learned".into();
        return vec![alarm(Level::Warning, "no_map", what, "upload a map and name it when the session is opened")];
    }
    let newest: Vec<_> = session.tests.iter().rev().take(TESTS).collect();
    let refused = newest.iter().filter(|test| test.rejected).count();
    if refused >= REFUSED_TESTS {
        let what = format!("{refused} of the last {} soil buffers do not fit the model", newest.len());
        let advice = "the vehicle moves as the model does not expect: run `nesam diagnose` on a recording";
        return vec![alarm(Level::Alarm, "gated", what, advice)];
    }
    Vec::new()
}

/// What was applied to a session changes every prediction of its vehicle.
fn effects(session: &SessionNotes) -> Vec<Alarm> {
    let one = |effect: &AppliedEffect| {
        let values: Vec<String> = effect.parameters.iter().map(|p| format!("{} {}", p.name, p.value)).collect();
        format!("{} ({})", effect.id, values.join(", "))
    };
    let applied: Vec<String> = session.effects.effects.iter().map(one).collect();
    if applied.is_empty() {
        return Vec::new();
    }
    let from = if session.effects.source.is_empty() { String::new() } else { format!(", from {}", session.effects.source) };
    let what = format!("predicts with {}{from}", applied.join(", "));
    vec![alarm(Level::Notice, "effects", what, "`nesam effects revert` takes them away, once the vehicle is as it was")]
}

fn candidates(session: &SessionNotes, now_s: f64) -> Vec<Alarm> {
    let Some(fan) = session.fan.as_ref().filter(|fan| now_s - fan.at_s < RECENT_S) else { return Vec::new() };
    let flags = &fan.prediction.rollout.flags;
    let kinds = [
        (flag::NOT_FINITE, Level::Alarm, "not_finite_state", "end in numbers that are not finite", "discard them; report the query"),
        (flag::OVERTURNED, Level::Alarm, "overturned", "overturn the vehicle", "discard them"),
        (flag::OFF_MAP, Level::Warning, "off_map", "leave the map", "upload more of the map, or keep the plan inside"),
        (
            flag::START_OFF_GROUND,
            Level::Warning,
            "start_off_ground",
            "start above or below the ground of the map",
            "check that map and measurements count heights from the same level",
        ),
        (flag::SPEED_UNTRAINED, Level::Warning, "speed_untrained", "are faster or slower than what was trained", "trust them less"),
        (flag::STEERING_UNTRAINED, Level::Warning, "steering_untrained", "steer harder than what was trained", "trust them less"),
        (flag::SLOPE_UNTRAINED, Level::Warning, "slope_untrained", "tilt the vehicle more than what was trained", "trust them less"),
        (SOIL_NOT_LEARNED, Level::Notice, "soil_not_learned", "rest on the prior alone: the soil is not learned yet", "drive on"),
    ];
    let line = |(bit, level, id, what, advice): (u32, Level, &'static str, &str, &'static str)| {
        let count = flags.iter().filter(|flags| **flags & bit != 0).count();
        let shown = count > 0 && count as f64 >= FLAGGED_SHARE * flags.len() as f64;
        shown.then(|| alarm(level, id, format!("{count} of {} candidates {what}", flags.len()), advice))
    };
    kinds.into_iter().filter_map(line).collect()
}

#[cfg(test)]
mod tests {
    use nesam_engine::{BufferTest, Measurement, WheelMeasurement};
    use nesam_physics::{Control, VehicleState};

    use super::*;
    use crate::web::notes::Ring;

    fn measured(at_s: f64) -> SessionNotes {
        let (state, command) = (VehicleState::zero(), Control { speed_m_s: 1.0, second: 0.0 });
        let measurement = Measurement { sequence: None, boot: None, stamp_ns: 0, state, command, wheels: WheelMeasurement::default() };
        SessionNotes { newest: Some((measurement, at_s)), map: Some(("w".into(), 1, "hash".into())), ..SessionNotes::default() }
    }

    fn found(session: SessionNotes, now_s: f64) -> Vec<String> {
        let notes = Notes { sessions: [("a".to_string(), session)].into(), ..Notes::default() };
        alarms(&notes, ServiceFacts::default(), now_s).iter().map(|alarm| alarm.id.to_string()).collect()
    }

    #[test]
    fn analytic_a_vehicle_that_falls_silent_is_told() {
        assert!(found(measured(5.0), 5.5).is_empty());
        assert_eq!(found(measured(5.0), 7.0), ["silent"]);
        assert_eq!(found(SessionNotes { map: None, ..measured(5.0) }, 5.5), ["no_map"]);
    }

    #[test]
    fn analytic_single_refused_buffers_are_chance_three_are_not() {
        let with = |refused: u64| {
            let mut tests = Ring::default();
            (0..10).for_each(|i| tests.push(BufferTest { judged: i, nis: 60.0, dof: 60, rejected: i < refused }, TESTS));
            found(SessionNotes { tests, ..measured(0.0) }, 0.1)
        };
        assert!(with(2).is_empty());
        assert_eq!(with(3), ["gated"]);
    }

    #[test]
    fn analytic_refusals_are_told_apart_and_forgotten() {
        let mut notes = Notes::default();
        notes.refusals.push((1.0, "predict", EngineError::Expired), 9);
        notes.refusals.push((1.0, "predict", EngineError::invalid("controls", "has 3 numbers")), 9);
        let at = |now_s| alarms(&notes, ServiceFacts::default(), now_s);
        assert_eq!(at(2.0).iter().map(|a| a.id.to_string()).collect::<Vec<_>>(), ["overload", "refused"]);
        assert!(at(2.0)[1].what.contains("controls"), "{:?}", at(2.0)[1]);
        assert!(at(20.0).is_empty());
    }
}
