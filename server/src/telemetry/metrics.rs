//! All counters of one server.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use nesam_engine::{Answer, Command, EngineError, Event, Reply};

use super::alarms::AlarmCounts;
use super::histogram::Histogram;
use super::reloads::Reloads;

/// What brought a measurement or a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transport {
    /// gRPC.
    Grpc,
    /// Zenoh.
    Zenoh,
}

impl Transport {
    /// Value of the `transport` label.
    pub fn label(self) -> &'static str {
        match self {
            Self::Grpc => "grpc",
            Self::Zenoh => "zenoh",
        }
    }
}

/// A counter for each pair of label values.
type Pairs = Mutex<BTreeMap<(&'static str, &'static str), u64>>;

/// Counters and histograms of one server.
#[derive(Debug, Default)]
pub struct Metrics {
    commands: Pairs,
    measurements: Pairs,
    /// Answers to measurements that nobody could be told, over Zenoh.
    answers_dropped: AtomicU64,
    requests: Pairs,
    reloads: Reloads,
    events: Mutex<BTreeMap<&'static str, u64>>,
    /// Held maps.
    maps: AtomicU64,
    alarms: AlarmCounts,
    queue: Histogram,
    prediction: Histogram,
    refusals: Histogram,
    /// Predictions that others paused for.
    urgent: AtomicU64,
    /// Time for which predictions paused, ns.
    paused_ns: AtomicU64,
}

fn count(pairs: &Pairs, key: (&'static str, &'static str)) {
    if let Ok(mut pairs) = pairs.lock() {
        *pairs.entry(key).or_default() += 1;
    }
}

/// Name of a refusal as a label.
fn refusal(error: &EngineError) -> &'static str {
    match error {
        EngineError::UnknownSession { .. } | EngineError::UnknownMap { .. } => "not_found",
        EngineError::SessionExists { .. } | EngineError::MapExists { .. } => "already_exists",
        EngineError::MapChanged { .. } => "aborted",
        EngineError::MapInUse { .. } | EngineError::NotReady { .. } => "failed_precondition",
        EngineError::Invalid { .. } | EngineError::ForeignImage { .. } => "invalid_argument",
        EngineError::Exhausted { .. } => "exhausted",
        EngineError::Overloaded { .. } => "overloaded",
        EngineError::Expired => "deadline_exceeded",
        EngineError::Abandoned => "abandoned",
        EngineError::Stopped => "stopped",
        EngineError::RefusedMeasurement { cause, .. } => refusal(cause),
        EngineError::Internal { .. } => "internal",
    }
}

impl Metrics {
    /// Counts the answer to a command and, for a prediction, how long it waited and computed.
    pub fn engine_answer(&self, command: &'static str, answer: &Answer) {
        count(&self.commands, (command, answer.result.as_ref().map_or_else(refusal, |_| "ok")));
        if let Ok(Reply::Predicted(_)) = answer.result {
            self.queue.record_ns(answer.queued_ns);
            self.prediction.record_ns(answer.busy_ns);
        }
        self.urgent.fetch_add(answer.is_urgent.into(), Ordering::Relaxed);
        self.paused_ns.fetch_add(answer.paused_ns, Ordering::Relaxed);
    }

    /// Counts what became of a measurement.
    pub fn measurement(&self, transport: Transport, outcome: &'static str) {
        count(&self.measurements, (transport.label(), outcome));
    }

    /// Counts an answer to a measurement that found no room on its way to Zenoh.
    pub fn answer_dropped(&self) {
        self.answers_dropped.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a request that came over a transport.
    pub fn request(&self, transport: Transport, method: &'static str) {
        count(&self.requests, (transport.label(), method));
    }

    /// What became of certificates and rights that were read again.
    pub(crate) fn reloads(&self) -> &Reloads {
        &self.reloads
    }

    /// Counts something that happened to a session.
    pub fn event(&self, event: &Event) {
        if let Ok(mut events) = self.events.lock() {
            *events.entry(event.label()).or_default() += 1;
        }
        match event {
            Event::MapChanged { held, .. } => self.maps.store(*held as u64, Ordering::Relaxed),
            Event::SoilFilterFailed { session, vehicle, reason } => tracing::warn!(session, vehicle, reason, "the soil filter failed"),
            _ => {}
        }
        self.alarms.note(event);
    }

    /// Counts how long it took to refuse a request for want of room.
    pub fn refused(&self, after: Duration) {
        self.refusals.record_ns(u64::try_from(after.as_nanos()).unwrap_or(u64::MAX));
    }

    /// Such refusals: how many, and how many of them within a millisecond.
    pub fn refusals(&self) -> [u64; 2] {
        [self.refusals.count(), self.refusals.within(1e-3)]
    }

    /// Number of predictions answered.
    pub fn predictions(&self) -> u64 {
        self.prediction.count()
    }

    /// Everything in Prometheus' text format.
    pub fn render(&self, waiting_commands: usize, waiting_predictions: usize) -> String {
        let mut out = String::new();
        if let Ok(mut commands) = self.commands.lock() {
            // Each from the start, so that the first internal error of a command is an increase.
            for command in Command::LABELS {
                commands.entry((command, "internal")).or_default();
            }
        }
        let tables = [
            ("nesam_requests_total", "Requests by transport and method.", ["transport", "method"], &self.requests),
            ("nesam_commands_total", "Engine commands by kind and result.", ["command", "result"], &self.commands),
            ("nesam_measurements_total", "Measurements by transport and outcome.", ["transport", "outcome"], &self.measurements),
        ];
        for (name, help, [first, second], pairs) in tables {
            let _ = writeln!(out, "# HELP {name} {help}\n# TYPE {name} counter");
            let Ok(pairs) = pairs.lock() else { continue };
            for ((a, b), value) in pairs.iter() {
                let _ = writeln!(out, "{name}{{{first}=\"{a}\",{second}=\"{b}\"}} {value}");
            }
        }
        let (name, dropped) = ("nesam_measurement_answers_dropped_total", self.answers_dropped.load(Ordering::Relaxed));
        let help = "Answers to measurements over Zenoh that found no room on their way; vehicles send such measurements again.";
        let _ = writeln!(out, "# HELP {name} {help}\n# TYPE {name} counter\n{name} {dropped}");
        let _ = writeln!(out, "# HELP nesam_events_total What happened to sessions.\n# TYPE nesam_events_total counter");
        if let Ok(mut events) = self.events.lock() {
            // From the start, so that the first failure is an increase.
            events.entry(Event::SOIL_FILTER_FAILED).or_default();
            for (event, value) in events.iter() {
                let _ = writeln!(out, "nesam_events_total{{event=\"{event}\"}} {value}");
            }
        }
        let (name, maps) = ("nesam_maps", self.maps.load(Ordering::Relaxed));
        let _ = writeln!(out, "# HELP {name} Maps that are held.\n# TYPE {name} gauge\n{name} {maps}");
        self.reloads.render(&mut out);
        self.alarms.render(&mut out);
        self.queue.render("nesam_prediction_queue_seconds", "Time that predictions waited for the engine.", &mut out);
        self.prediction.render("nesam_prediction_compute_seconds", "Time that the engine computed a prediction.", &mut out);
        let help = "Time from the head of a request over gRPC to its refusal for want of room.";
        self.refusals.render("nesam_prediction_refusal_seconds", help, &mut out);
        let (name, urgent) = ("nesam_predictions_urgent_total", self.urgent.load(Ordering::Relaxed));
        let help = "Short predictions that were computed at once while a longer one paused for them.";
        let _ = writeln!(out, "# HELP {name} {help}\n# TYPE {name} counter\n{name} {urgent}");
        let (name, paused_s) = ("nesam_prediction_paused_seconds_total", self.paused_ns.load(Ordering::Relaxed) as f64 * 1e-9);
        let help = "Time for which longer predictions paused; their times of computation contain it.";
        let _ = writeln!(out, "# HELP {name} {help}\n# TYPE {name} counter\n{name} {paused_s}");
        for (lane, value) in [("commands", waiting_commands), ("predictions", waiting_predictions)] {
            let _ = writeln!(
                out,
                "# HELP nesam_waiting_{lane} {lane} in the queue now.\n# TYPE nesam_waiting_{lane} gauge\nnesam_waiting_{lane} {value}"
            );
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::super::reloads::Part;
    use super::*;

    #[test]
    fn analytic_rendered_counts_are_what_was_counted() {
        let metrics = Metrics::default();
        for queued_ns in [0, 2_000_000, 9_000_000_000] {
            let result = Ok(Reply::Done);
            metrics.engine_answer("close", &Answer { result, queued_ns, busy_ns: 0, is_urgent: queued_ns == 0, paused_ns: queued_ns });
            metrics.queue.record_ns(queued_ns);
        }
        metrics.engine_answer("predict", &Answer::refused(EngineError::Expired));
        metrics.measurement(Transport::Zenoh, "applied");
        [200, 1000, 1100].into_iter().map(Duration::from_micros).for_each(|after| metrics.refused(after));
        assert_eq!(metrics.refusals(), [3, 2]);
        metrics.event(&Event::MapChanged { map: "m".into(), held: 3 });
        assert!(metrics.render(0, 0).contains("nesam_events_total{event=\"soil_filter_failed\"} 0\n"));
        metrics.event(&Event::SoilFilterFailed { session: "s".into(), vehicle: "v".into(), reason: "why".into() });
        metrics.reloads().changed(Part::Rights, false);
        metrics.reloads().unusable(Part::Rights, true);
        assert!(!metrics.render(0, 0).contains("certificate_expires_seconds 0"), "no certificate");
        metrics.reloads().expires(Part::Certificate, 1_800_000_000);
        metrics.reloads().expires(Part::Cluster, 1_700_000_000);
        let text = metrics.render(3, 4);
        for line in [
            "nesam_commands_total{command=\"close\",result=\"ok\"} 3",
            "nesam_commands_total{command=\"predict\",result=\"deadline_exceeded\"} 1",
            "nesam_commands_total{command=\"predict\",result=\"internal\"} 0",
            "nesam_commands_total{command=\"delete_map\",result=\"internal\"} 0",
            "nesam_measurements_total{transport=\"zenoh\",outcome=\"applied\"} 1",
            "nesam_prediction_queue_seconds_bucket{le=\"0.0025\"} 2",
            "nesam_prediction_queue_seconds_bucket{le=\"+Inf\"} 3",
            "nesam_prediction_refusal_seconds_bucket{le=\"0.001\"} 2",
            "nesam_prediction_refusal_seconds_count 3",
            "nesam_predictions_urgent_total 1",
            "nesam_prediction_paused_seconds_total 9.002",
            "nesam_events_total{event=\"map_changed\"} 1",
            "nesam_events_total{event=\"soil_filter_failed\"} 1",
            "nesam_maps 3",
            "nesam_credentials_reloads_total{part=\"rights\",result=\"failed\"} 1",
            "nesam_credentials_reloads_total{part=\"rights\",result=\"ok\"} 0",
            "nesam_credentials_reloads_total{part=\"certificate\",result=\"failed\"} 0",
            "nesam_credentials_unusable{part=\"rights\"} 1",
            "nesam_credentials_unusable{part=\"certificate\"} 0",
            "nesam_credentials_unusable{part=\"cluster\"} 0",
            "nesam_cluster_certificate_expires_seconds 1700000000",
            "nesam_alarms_total{kind=\"sensor_jump\"} 0",
            "nesam_certificate_expires_seconds 1800000000",
            "nesam_alarms_active 0",
            "nesam_waiting_predictions 4",
        ] {
            assert!(text.lines().any(|l| l == line), "{line} is not in\n{text}");
        }
    }
}
