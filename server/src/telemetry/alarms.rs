//! Alarms as metrics and in the log.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::sync::Mutex;

use nesam_engine::{AlarmKind, Event};

/// Alarms raised by kind, and the sessions whose alarm is active.
#[derive(Debug, Default)]
pub struct AlarmCounts(Mutex<(BTreeMap<&'static str, u64>, BTreeSet<String>)>);

impl AlarmCounts {
    /// Hears the engine.
    pub fn note(&self, event: &Event) {
        let Ok(mut state) = self.0.lock() else { return };
        let (raised, active) = &mut *state;
        match event {
            Event::AlarmChanged { session, vehicle, alarm, carried } => {
                let (kind, onset_ns) = (alarm.kind.label(), alarm.onset_ns);
                if *carried {
                    // Its episode was counted where it began.
                    active.insert(session.clone());
                    tracing::info!(session, vehicle, kind, onset_ns, "session with an active alarm");
                } else if alarm.active {
                    *raised.entry(kind).or_default() += 1;
                    active.insert(session.clone());
                    let (statistic, threshold, diagnose) = (alarm.statistic, alarm.threshold, alarm.diagnose(session));
                    tracing::warn!(session, vehicle, kind, statistic, threshold, onset_ns, diagnose, "{}", alarm.description());
                } else {
                    active.remove(session);
                    tracing::info!(session, vehicle, kind, onset_ns, "alarm cleared");
                }
            }
            Event::SessionClosed { session, .. } => drop(active.remove(session)),
            _ => {}
        }
    }

    /// In Prometheus' text format.
    pub fn render(&self, out: &mut String) {
        let Ok(state) = self.0.lock() else { return };
        let _ = writeln!(
            out,
            "# HELP nesam_alarms_total Episodes in which measurements disagree with predictions, by test.\n# TYPE nesam_alarms_total counter"
        );
        for kind in AlarmKind::ALL.map(AlarmKind::label) {
            let _ = writeln!(out, "nesam_alarms_total{{kind=\"{kind}\"}} {}", state.0.get(kind).copied().unwrap_or(0));
        }
        let _ = writeln!(
            out,
            "# HELP nesam_alarms_active Sessions whose alarm is active.\n# TYPE nesam_alarms_active gauge\nnesam_alarms_active {}",
            state.1.len()
        );
    }
}
